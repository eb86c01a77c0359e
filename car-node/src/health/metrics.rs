//! The metrics of an update.

use serde::Serialize;
use synpf::Update;

/// The numbers that a verdict is based on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Metrics {
    /// Share of the valid beams that end within 0.10 m of a wall (0.05 m and a cell where cells are larger), smoothed, in [0, 1].
    pub alignment: f64,
    /// Mean over the same beams of min(distance to the nearest wall, 1 m), smoothed \[m\].
    pub residual: f64,
    /// Share of the valid beams more than 0.3 m shorter than on the map, in [0, 1].
    pub short_beams: f64,
    /// Share of the valid beams more than 0.3 m longer than on the map, in [0, 1].
    pub long_beams: f64,
    /// Share of the beams without a return, in [0, 1].
    pub no_return: f64,
    /// Effective sample size over the number of particles, in [0, 1].
    pub ess_ratio: f64,
    /// Short-term over long-term average of the fit of the scan; 1 when nothing changes.
    pub w_ratio: f64,
    /// Standard deviation of the particles along the track \[m\].
    pub spread_along: f64,
    /// Standard deviation of the particles across the track \[m\].
    pub spread_across: f64,
    /// Mass of the second cluster over that of the first, in [0, 1].
    pub second_mode: f64,
    /// Share of odometry's distance that the car did not drive; positive when the wheels spin.
    pub slip: f64,
    /// Odometry's yaw rate minus the posterior's [rad/s].
    pub yaw_rate_residual: f64,
    /// Distance by which the scan corrected the pose \[m\].
    pub innovation: f64,
    /// Angle by which the scan corrected the pose \[rad\].
    pub innovation_angle: f64,
    /// Median age of poses over the last second \[s\].
    pub age_p50: f64,
    /// 99th percentile of the age of poses over the last second \[s\].
    pub age_p99: f64,
    /// Particles in use.
    pub particles: usize,
}

impl Metrics {
    /// Of one update, without smoothing and without ages.
    pub(super) fn of(update: &Update) -> Self {
        Self {
            alignment: update.alignment,
            residual: update.residual,
            short_beams: update.short_beams,
            long_beams: update.long_beams,
            no_return: update.no_return,
            ess_ratio: update.ess_ratio,
            w_ratio: update.w_ratio,
            spread_along: update.spread[0],
            spread_across: update.spread[1],
            second_mode: update.second_mode,
            slip: update.slip,
            yaw_rate_residual: update.yaw_rate_residual,
            innovation: update.innovation[0],
            innovation_angle: update.innovation[1],
            age_p50: 0.0,
            age_p99: 0.0,
            particles: update.particles,
        }
    }
}
