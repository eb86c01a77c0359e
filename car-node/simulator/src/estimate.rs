//! The localizer's estimate, as the driver uses it.

use std::time::Duration;

use maps::Pose;

/// Pose and motion of a car at a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Time of the estimate, since the start of the race.
    pub time: Duration,
    /// `map_from_base_link`.
    pub pose: Pose,
    /// Forward speed \[m/s\].
    pub speed: f64,
    /// Yaw rate \[rad/s\].
    pub yaw_rate: f64,
}
