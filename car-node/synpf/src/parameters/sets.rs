//! The sets that ship.
//!
//! HQ and LQ name a condition, not a tuning that was ever published: high-quality odometry on a surface with
//! grip (26 N of lateral pull in the paper), low-quality odometry from wheels that slip (19 N).

use crate::Parameters;
use crate::motion_model::MotionParameters;

/// A set by name; see [`Parameters::NAMES`].
pub(super) fn named(name: &str) -> Option<Parameters> {
    match name {
        "hq" => Some(Parameters::default()),
        "lq" => Some(lq()),
        "adaptive" => Some(adaptive()),
        _ => None,
    }
}

/// Wheels slip and the yaw rate comes from the steering angle: odometry is believed less.
fn lq() -> Parameters {
    let hq = Parameters::default();
    Parameters {
        motion: MotionParameters {
            odometry_speed_error: 0.3,
            odometry_side_error: 0.375,
            odometry_yaw_error: 1.5,
            diffusion_heading: 0.3,
            ..hq.motion
        },
        ..hq
    }
}

/// `hq` while the wheels grip; the noise grows with the slip that the filter itself sees.
fn adaptive() -> Parameters {
    let hq = Parameters::default();
    Parameters {
        motion: MotionParameters {
            adaptive: true,
            ..hq.motion
        },
        ..hq
    }
}
