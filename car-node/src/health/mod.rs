//! How well the car is localized, and why: every metric of an update held against thresholds, and the state
//! that follows.
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
//! LOST is said when two independent families of evidence speak for it for 0.3 s, when the scan alone is so far off the
//! walls that no change of the map explains it, and at the update at which the filter itself gives its pose up to search
//! the map. An opponent does not count: beams that are cut short in excess of those that are too long are left out.
//!
//! Pure: it reads no clock. Times are stamps of the sensors' clock, given by the caller. What is good, bad or
//! lost is in [`Thresholds`].

mod metrics;
mod monitor;
mod rules;
mod scan_fit;
mod set_recommender;
mod slip;
mod thresholds;

pub use metrics::Metrics;
pub use monitor::{Monitor, Verdict};
// A state and its causes are what is told: the words for them are the same on the car as at the wall.
pub use protocol::{Cause, CauseKind, Severity, State};
pub use set_recommender::{Proposal, SetRecommender};
pub use slip::{SlipEvent, SlipTracker};
pub use thresholds::Thresholds;

/// What the tests of several modules drive with.
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
        }
    }
}
