//! What counts as good, as degraded and as lost.

use serde::{Deserialize, Serialize};

/// Limits of every metric, and the times that go with them.
///
/// Where they come from: the failure criteria of `als_ros`, and what right and wrong poses gave on logs. On five drives
/// of real cars a right pose has a [clear alignment](Self::alignment_degraded) of 0.66 to 1.00, a wrong one of a whole
/// building 0.29; filters without recovery that were carried to another place of a club track have 0.1 to 0.5 in the
/// seconds after. `car-node evaluate --fault` measures the same on any log.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Thresholds {
    /// Clear alignment below this is degraded, in [0, 1]. Clear means: of the beams that no opponent has cut short.
    /// About halfway between right and wrong.
    pub alignment_degraded: f64,
    /// Clear alignment below this speaks for a wrong pose, in [0, 1].
    pub alignment_lost: f64,
    /// Clear alignment below this is a wrong pose, whatever else says, in [0, 1].
    pub alignment_wrong: f64,
    /// Residual above this is degraded [m]. Halfway between right and wrong poses of `als_ros`, 0.165 and 0.299 m, and a
    /// little more: real maps are older than theirs.
    pub residual_degraded: f64,
    /// Residual above this speaks for a wrong pose [m].
    pub residual_lost: f64,
    /// By how much alignment must be better, and by which share the residual, before a state is good again.
    pub hysteresis: f64,
    /// Share of long beams above this is worth saying, and speaks for a wrong pose where the scan is off the walls too,
    /// in [0, 1]. By itself it is a map that is out of date: up to 0.7 on a real log with a right pose.
    pub long_beams: f64,
    /// Share of blocked beams above this is worth saying, and the residual does not count, in [0, 1].
    pub blocked_some: f64,
    /// Share of blocked beams above this leaves too few to judge the pose by, in [0, 1].
    pub blocked_most: f64,
    /// Share of beams without a return above this is worth saying, in [0, 1].
    pub no_return_info: f64,
    /// Effective sample size over the number of particles below this is worth saying. It degrades nothing: with slipping
    /// wheels it is this low for seconds while the fitted pose is right to a centimetre.
    pub ess_info: f64,
    /// A `w_ratio` below this is reported. It is computed from the alignment, so it is no evidence beside it.
    pub w_ratio_info: f64,
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
    /// A correction above this by one scan is another place: the pose was wrong until then [m].
    pub leap: f64,
    /// Median age of poses above this is degraded [s]. Above the 40 ms of a busy car: a scan alone arrives 17 to
    /// 22 ms after its stamp.
    pub age: f64,
    /// Sensor data is missing after this long [s]. A real log has a gap of 0.14 s in its odometry and is well.
    pub stale_after: f64,
    /// The fit is smoothed with this time constant before it degrades the state [s]...
    pub smoothing: f64,
    /// ...and with this one before it speaks for a wrong pose [s].
    pub smoothing_lost: f64,
    /// A metric degrades the state when it was bad for this long without a break [s].
    pub bad_for: f64,
    /// Two families of evidence for this long mean lost [s].
    pub lost_after: f64,
    /// Alignment below `alignment_wrong` for this long means lost [s].
    pub wrong_after: f64,
    /// Alignment below `alignment_lost` alone for this long means lost [s].
    pub alone_after: f64,
    /// The state recovers when all was good for this long [s].
    pub good_for: f64,
    /// A new pose is confirmed when all was good while the car drove this far with it [m].
    pub confirmed_after: f64,
}

impl Default for Thresholds {
    fn default() -> Self {
        Self {
            alignment_degraded: 0.60,
            alignment_lost: 0.45,
            alignment_wrong: 0.30,
            residual_degraded: 0.25,
            residual_lost: 0.35,
            hysteresis: 0.05,
            long_beams: 0.15,
            blocked_some: 0.15,
            blocked_most: 0.80,
            no_return_info: 0.30,
            ess_info: 0.05,
            w_ratio_info: 0.8,
            spread_across_degraded: 0.15,
            spread_along_degraded: 0.40,
            second_mode_degraded: 0.25,
            second_mode_lost: 0.60,
            slip: 0.08,
            slip_severe: 0.20,
            yaw_rate_residual: 0.3,
            innovation: 0.3,
            innovation_angle: 10_f64.to_radians(),
            leap: 1.0,
            age: 0.080,
            stale_after: 0.4,
            smoothing: 0.25,
            smoothing_lost: 0.1,
            bad_for: 0.04,
            lost_after: 0.3,
            wrong_after: 0.3,
            alone_after: 2.0,
            good_for: 0.5,
            confirmed_after: 1.0,
        }
    }
}
