//! How well the car is localized, and why: compares every metric of an update with thresholds and derives the state.
//!
//! ```text
//!            first pose            0.5 s good and 1 m driven
//!   INIT ------------> CONVERGING --------------------------> LOCALIZED <----> DEGRADED
//!                        ^    |                                   any metric bad for 0.04 s; 0.5 s good
//!        a pose is found |    | the pose is wrong, see below (from any of the three)
//!                        |    v
//!              RELOCALIZING <-- LOST            STALE: no sensor data, from any of them
//! ```
//!
//! The state becomes LOST in three cases: two independent families of evidence are against the pose for 0.3 s; the scan
//! is so far off the walls that no change of the map explains it; or the localizer gives its pose up and searches the map.
//! An opponent is no evidence: beams that are blocked are left out ([`localizer::ScanFit`]).
//!
//! Pure: it reads no clock. The caller gives the times, on the sensors' clock. The limits are in [`Thresholds`].

mod causes;
mod metrics;
mod monitor;
mod pose_ages;
mod rules;
mod sensor_silence;
mod set_recommender;
mod slip;
mod thresholds;

pub use metrics::Metrics;
pub use monitor::{Monitor, Verdict};
// The car and the pit wall use the same types for a state and its causes, so that both show the same words.
pub use protocol::{Cause, CauseKind, Severity, State};
pub use set_recommender::{Proposal, SetRecommender};
pub use slip::{SlipEvent, SlipTracker};
pub use thresholds::Thresholds;

/// For the tests of several modules.
#[cfg(test)]
pub(crate) mod tests_support {
    use maps::Pose;
    use nalgebra::Matrix3;
    use synpf::{Mode, Stamp, Twist, Update};

    /// An update with nothing wrong.
    pub(crate) fn good_update(stamp: Stamp, number: u64) -> Update {
        Update {
            stamp,
            number,
            pose: Pose::IDENTITY,
            twist: Twist::default(),
            covariance: Matrix3::identity(),
            mode: Mode::Tracking,
            particles: 100,
            ess_ratio: 0.6,
            spread: [0.05, 0.03],
            second_mode: 0.0,
            alignment: 0.9,
            residual: 0.05,
            short_beams: 0.02,
            long_beams: 0.01,
            no_return: 0.01,
            w_ratio: 1.0,
            odometry_jump: None,
            innovation: [0.01, 0.01],
            slip: 0.0,
            yaw_rate_residual: 0.0,
            doubt: None,
            trust: None,
            sensors: synpf::SensorFindings::default(),
        }
    }
}
