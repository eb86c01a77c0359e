//! The limits between good, degraded and lost.

use serde::{Deserialize, Serialize};

/// The limits of all metrics, and the times for which they must be exceeded.
///
/// They come from the failure criteria of `als_ros`, and from right and wrong poses on logs. On five drives of real cars a
/// right pose has a [clear alignment](Self::alignment_degraded) of 0.66 to 1.00. A wrong one on the map of a building has
/// 0.29. Filters without recovery, carried to another place of a club track, have 0.1 to 0.5 in the seconds after.
/// `car-node evaluate --fault` measures the same on any log.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Thresholds {
    /// Clear alignment below this is degraded, in [0, 1]: the alignment of the beams that no opponent blocks. About halfway
    /// between right and wrong poses.
    pub alignment_degraded: f64,
    /// Clear alignment below this is evidence of a wrong pose, in [0, 1].
    pub alignment_lost: f64,
    /// Clear alignment below this is a wrong pose, without other evidence, in [0, 1].
    pub alignment_wrong: f64,
    /// Residual above this is degraded \[m\]. A little above the middle of right and wrong poses of `als_ros` (0.165 and
    /// 0.299 m): real maps are older than theirs.
    pub residual_degraded: f64,
    /// Residual above this is evidence of a wrong pose \[m\].
    pub residual_lost: f64,
    /// Hysteresis: the state is good again once the alignment is better than its limit by this, and the residual by this share.
    pub hysteresis: f64,
    /// Share of long beams above this is reported, in [0, 1]. It is evidence of a wrong pose only where the scan is off the
    /// walls, too. By itself it means a map that is out of date: up to 0.7 on a real log with a right pose.
    pub long_beams: f64,
    /// Share of blocked beams above this is reported, and the residual is not judged, in [0, 1].
    pub blocked_some: f64,
    /// Share of blocked beams above this leaves too few to judge the pose, in [0, 1].
    pub blocked_most: f64,
    /// Where beams are blocked and a smaller share of all beams than this lies on walls, the scan tells a right pose from a wrong
    /// one no longer, and the state is degraded, in [0, 1]. Wrong poses have as much.
    pub confirming_least: f64,
    /// Share of beams without a return above this is reported, in [0, 1].
    pub no_return_info: f64,
    /// Effective sample size over the number of particles below this is reported. It never degrades the state: with slipping
    /// wheels it stays this low for seconds while the fitted pose is right to a centimetre.
    pub ess_info: f64,
    /// A `w_ratio` below this is reported. It is computed from the alignment, so it is no further evidence.
    pub w_ratio_info: f64,
    /// Spread across the track above this is degraded \[m\].
    pub spread_across_degraded: f64,
    /// Spread along the track above this is degraded \[m\].
    pub spread_along_degraded: f64,
    /// Second mode over the first above this is degraded.
    pub second_mode_degraded: f64,
    /// Second mode over the first above this is evidence of a wrong pose.
    pub second_mode_lost: f64,
    /// Magnitude of slip above this is reported.
    pub slip: f64,
    /// Magnitude of slip above this is a warning.
    pub slip_severe: f64,
    /// Magnitude of the yaw-rate residual above this is reported [rad/s].
    pub yaw_rate_residual: f64,
    /// A correction above this is degraded \[m\].
    pub innovation: f64,
    /// A correction above this is degraded \[rad\].
    pub innovation_angle: f64,
    /// A correction by one scan above this means that the pose was wrong before \[m\].
    pub leap: f64,
    /// Median age of poses above this is degraded \[s\]. A busy car has 40 ms: a scan arrives 17 to 22 ms after its stamp.
    pub age: f64,
    /// Where a scan takes long, a pose at its first beam may be so much older than the sweep \[s\].
    pub age_after_sweep: f64,
    /// Sensor data is missing after this long \[s\]. A real log has harmless gaps of 0.14 s in its odometry.
    pub stale_after: f64,
    /// Time constant with which the fit is smoothed before it degrades the state \[s\].
    pub smoothing: f64,
    /// Time constant with which the fit is smoothed before it is evidence of a wrong pose \[s\].
    pub smoothing_lost: f64,
    /// A metric degrades the state when every update of this long was bad \[s\].
    pub bad_for: f64,
    /// Two families of evidence against the pose for this long mean lost \[s\].
    pub lost_after: f64,
    /// Alignment below `alignment_wrong` for this long means lost \[s\].
    pub wrong_after: f64,
    /// Alignment below `alignment_lost` alone for this long means lost \[s\].
    pub alone_after: f64,
    /// The state recovers when everything was good for this long \[s\].
    pub good_for: f64,
    /// A new pose is confirmed when everything was good while the car drove this far \[m\].
    pub confirmed_after: f64,
    /// Log of the odds above which a localizer's own judgement keeps a pose from being lost by the fit of scans alone.
    pub trusted: f64,
    /// Probability that the pose is wrong, by the localizer itself, above which the state is degraded: log odds of 5.
    pub doubted: f64,
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
            confirming_least: 0.42,
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
            age_after_sweep: 0.060,
            stale_after: 0.4,
            smoothing: 0.25,
            smoothing_lost: 0.1,
            bad_for: 0.04,
            lost_after: 0.3,
            wrong_after: 0.3,
            alone_after: 2.0,
            good_for: 0.5,
            confirmed_after: 1.0,
            trusted: 5.0,
            doubted: 0.0067,
        }
    }
}
