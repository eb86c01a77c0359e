//! What counts as good, as degraded and as lost.

use serde::{Deserialize, Serialize};

/// Limits of every metric, and the times that go with them. Sources: the failure criteria of `als_ros`, and
/// what correct and wrong poses gave on recorded drives of real cars (a correct pose puts 0.77 to 0.91 of the
/// end points within 0.10 m of a wall, a wrong one 0.29).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Thresholds {
    /// Alignment below this is degraded, in [0, 1].
    pub alignment_degraded: f64,
    /// Alignment below this speaks for a wrong pose, in [0, 1].
    pub alignment_lost: f64,
    /// Residual above this is degraded [m].
    pub residual_degraded: f64,
    /// Residual above this speaks for a wrong pose [m].
    pub residual_lost: f64,
    /// Share of long beams above this is degraded, in [0, 1].
    pub long_beams_degraded: f64,
    /// Share of long beams above this speaks for a wrong pose, in [0, 1].
    pub long_beams_lost: f64,
    /// Share of short beams above this is an opponent in view, and alignment does not count, in [0, 1].
    pub short_beams_occluded: f64,
    /// Share of beams without a return above this is worth saying, in [0, 1].
    pub no_return_info: f64,
    /// Effective sample size over the number of particles below this is degraded.
    pub ess_degraded: f64,
    /// `w_fast / w_slow` below this is degraded.
    pub w_ratio_degraded: f64,
    /// `w_fast / w_slow` below this speaks for a wrong pose.
    pub w_ratio_lost: f64,
    /// Spread across the track above this is degraded [m].
    pub spread_across_degraded: f64,
    /// Spread along the track above this is degraded [m].
    pub spread_along_degraded: f64,
    /// Second mode over the first above this is degraded.
    pub second_mode_degraded: f64,
    /// Second mode over the first above this speaks for a wrong pose.
    pub second_mode_lost: f64,
    /// Magnitude of slip above this is worth saying.
    pub slip: f64,
    /// Magnitude of slip above this is a warning.
    pub slip_severe: f64,
    /// Magnitude of the yaw-rate residual above this is worth saying [rad/s].
    pub yaw_rate_residual: f64,
    /// A correction above this is degraded [m].
    pub innovation: f64,
    /// A correction above this is degraded [rad].
    pub innovation_angle: f64,
    /// Median age of poses above this is degraded [s]. Above the 40 ms of a busy car: a scan alone arrives 17 to
    /// 22 ms after its stamp.
    pub age: f64,
    /// Sensor data is missing after this long [s]. A real log has a gap of 0.14 s in its odometry and is well.
    pub stale_after: f64,
    /// Alignment and residual are smoothed with this time constant [s].
    pub smoothing: f64,
    /// A metric is bad when it was so for this many scans on end.
    pub bad_scans: u32,
    /// Two families of evidence for this long mean lost [s].
    pub lost_after: f64,
    /// The state recovers when all was good for this long [s].
    pub good_for: f64,
    /// A new pose is confirmed when the car has driven this far with it [m].
    pub confirmed_after: f64,
}

impl Default for Thresholds {
    fn default() -> Self {
        Self {
            alignment_degraded: 0.70,
            alignment_lost: 0.45,
            residual_degraded: 0.18,
            residual_lost: 0.35,
            long_beams_degraded: 0.15,
            long_beams_lost: 0.30,
            short_beams_occluded: 0.40,
            no_return_info: 0.30,
            ess_degraded: 0.05,
            w_ratio_degraded: 0.8,
            w_ratio_lost: 0.5,
            spread_across_degraded: 0.15,
            spread_along_degraded: 0.40,
            second_mode_degraded: 0.25,
            second_mode_lost: 0.60,
            slip: 0.08,
            slip_severe: 0.20,
            yaw_rate_residual: 0.3,
            innovation: 0.3,
            innovation_angle: 10_f64.to_radians(),
            age: 0.080,
            stale_after: 0.5,
            smoothing: 0.25,
            bad_scans: 3,
            lost_after: 0.3,
            good_for: 0.5,
            confirmed_after: 1.0,
        }
    }
}
