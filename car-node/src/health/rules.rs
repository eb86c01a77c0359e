//! The table of metrics against their thresholds: which are bad, and what they speak for.

use super::{CauseKind, Metrics, Severity, Thresholds};

/// Families of evidence. Two metrics of one family rise and fall together, so that they count once; only
/// evidence of two families makes a car lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Family {
    /// Where the beams end, by the map.
    EndPoints,
    /// Beams that pass through walls of the map.
    LongBeams,
    /// How well scans fit, against how well they used to.
    Likelihood,
    /// What the particles look like. Never enough to be lost, together with nothing but itself.
    Particles,
}

impl Family {
    pub(super) const COUNT: usize = 4;
}

/// A metric that is over its limit at one update.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Finding {
    pub(super) kind: CauseKind,
    pub(super) severity: Severity,
    pub(super) value: f64,
    pub(super) limit: f64,
    /// Whether it makes the state DEGRADED when it lasts.
    pub(super) degrades: bool,
    /// What it speaks for when it says that the pose is wrong.
    pub(super) lost: Option<Family>,
}

/// On which side of its limit a metric is bad.
#[derive(Debug, Clone, Copy)]
enum Bad {
    Above,
    Below,
}

impl Bad {
    fn holds(self, value: f64, limit: f64) -> bool {
        match self {
            Self::Above => value > limit,
            Self::Below => value < limit,
        }
    }
}

/// A metric that degrades the state past `limit`.
fn degraded(kind: CauseKind, bad: Bad, value: f64, limit: f64) -> Option<Finding> {
    bad.holds(value, limit).then_some(Finding {
        kind,
        severity: Severity::Warning,
        value,
        limit,
        degrades: true,
        lost: None,
    })
}

/// A metric that, past `limit`, speaks for a wrong pose.
fn lost(kind: CauseKind, bad: Bad, value: f64, limit: f64, family: Family) -> Option<Finding> {
    bad.holds(value, limit).then_some(Finding {
        kind,
        severity: Severity::Critical,
        value,
        limit,
        degrades: true,
        lost: Some(family),
    })
}

/// A magnitude that says why the pose may soon be bad, not that it is.
fn hint(kind: CauseKind, severity: Severity, value: f64, limit: f64) -> Option<Finding> {
    (value.abs() > limit).then_some(Finding {
        kind,
        severity,
        value,
        limit,
        degrades: false,
        lost: None,
    })
}

/// Everything that is over its limit. `raw` is this update alone, `smoothed` has alignment and residual over
/// time: the first says quickly that a pose is wrong, the second keeps single scans from degrading the state.
pub(super) fn findings(raw: &Metrics, smoothed: &Metrics, t: &Thresholds) -> Vec<Finding> {
    // A wrong pose makes beams short and long alike; an opponent only makes them short.
    let occluded = raw.short_beams > t.short_beams_occluded && raw.long_beams <= t.long_beams_degraded;
    let fit = if occluded {
        [None; 3]
    } else {
        fit(raw, smoothed, t)
    };
    fit.into_iter()
        .chain(pose(raw, smoothed, t))
        .chain(hints(raw, t))
        .flatten()
        .collect()
}

/// How the scan fits the map; means nothing while an opponent fills the view.
fn fit(raw: &Metrics, smoothed: &Metrics, t: &Thresholds) -> [Option<Finding>; 3] {
    use Bad::{Above, Below};
    use CauseKind::{Alignment, Likelihood, Residual};
    let ends = Family::EndPoints;
    [
        lost(Alignment, Below, raw.alignment, t.alignment_lost, ends)
            .or_else(|| degraded(Alignment, Below, smoothed.alignment, t.alignment_degraded)),
        lost(Residual, Above, raw.residual, t.residual_lost, ends)
            .or_else(|| degraded(Residual, Above, smoothed.residual, t.residual_degraded)),
        lost(Likelihood, Below, raw.w_ratio, t.w_ratio_lost, Family::Likelihood)
            .or_else(|| degraded(Likelihood, Below, raw.w_ratio, t.w_ratio_degraded)),
    ]
}

/// What else speaks against the pose.
fn pose(raw: &Metrics, smoothed: &Metrics, t: &Thresholds) -> [Option<Finding>; 7] {
    use Bad::{Above, Below};
    use CauseKind::{Age, EffectiveSampleSize, Innovation, LongBeams, SecondMode, SpreadAcross, SpreadAlong};
    [
        lost(
            LongBeams,
            Above,
            raw.long_beams,
            t.long_beams_lost,
            Family::LongBeams,
        )
        .or_else(|| degraded(LongBeams, Above, raw.long_beams, t.long_beams_degraded)),
        degraded(EffectiveSampleSize, Below, raw.ess_ratio, t.ess_degraded),
        degraded(SpreadAcross, Above, raw.spread_across, t.spread_across_degraded),
        degraded(SpreadAlong, Above, raw.spread_along, t.spread_along_degraded),
        lost(
            SecondMode,
            Above,
            raw.second_mode,
            t.second_mode_lost,
            Family::Particles,
        )
        .or_else(|| degraded(SecondMode, Above, raw.second_mode, t.second_mode_degraded)),
        degraded(Innovation, Above, raw.innovation, t.innovation)
            .or_else(|| degraded(Innovation, Above, raw.innovation_angle.abs(), t.innovation_angle)),
        degraded(Age, Above, smoothed.age_p50, t.age),
    ]
}

fn hints(raw: &Metrics, t: &Thresholds) -> [Option<Finding>; 4] {
    use CauseKind::{NoReturn, Occluded, Slip, YawRate};
    [
        hint(Slip, Severity::Warning, raw.slip, t.slip_severe)
            .or_else(|| hint(Slip, Severity::Info, raw.slip, t.slip)),
        hint(
            YawRate,
            Severity::Info,
            raw.yaw_rate_residual,
            t.yaw_rate_residual,
        ),
        hint(Occluded, Severity::Info, raw.short_beams, t.short_beams_occluded),
        hint(NoReturn, Severity::Info, raw.no_return, t.no_return_info),
    ]
}
