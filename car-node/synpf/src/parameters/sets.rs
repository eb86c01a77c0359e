//! The sets that ship.
//!
//! HQ and LQ name a condition, not a tuning that was ever published: high-quality odometry on a surface with
//! grip (26 N of lateral pull in the paper), low-quality odometry from wheels that slip (19 N).

use crate::Parameters;
use crate::defects::Defects;
use crate::motion_model::{MotionModel, MotionParameters};
use crate::scan_matcher::RefinementParameters;

/// A set by name; see [`Parameters::NAMES`].
pub(super) fn named(name: &str) -> Option<Parameters> {
    match name {
        "hq" => Some(Parameters::default()),
        "lq" => Some(lq()),
        "adaptive" => Some(adaptive()),
        "synpf-baseline" => Some(baseline()),
        _ => None,
    }
}

/// Wheels slip and the yaw rate comes from the steering angle: odometry is believed less.
fn lq() -> Parameters {
    let hq = Parameters::default();
    Parameters {
        motion: MotionParameters {
            odometry_speed_error: 0.2,
            odometry_side_error: 0.25,
            odometry_yaw_error: 1.0,
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

/// The reference as it is shipped, defects and all (`ForzaETH/particle_filter`, `pf2_params.yaml`).
fn baseline() -> Parameters {
    let mut set = Parameters::default();
    set.particles.max_particles = 3000;
    set.particles.min_particles = 3000;
    set.particles.resample_ess_ratio = 1.0;
    set.beams.beams = 21;
    set.beams.deskew = false;
    set.motion.motion_model = MotionModel::Tum;
    set.motion.alpha_1_tum = 0.5;
    set.motion.alpha_2_tum = 0.015;
    set.motion.alpha_3_tum = 1.0;
    set.motion.alpha_4_tum = 0.1;
    set.motion.diffusion_xy = 0.0;
    set.motion.diffusion_heading = 0.0;
    set.motion.learn_slip = false;
    set.sensor.sigma_hit = 0.1;
    set.sensor.squash_factor = 2.2;
    set.sensor.theta_discretization = 150;
    set.refinement = RefinementParameters {
        refine: false,
        wall_offset_distance: 0.0,
        ..set.refinement
    };
    set.recovery.injection = false;
    set.recovery.recover = false;
    set.defects = Defects::ALL;
    set
}
