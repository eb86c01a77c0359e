//! The rules: which metrics are over their limits, and what that means for the state.

use localizer::{Doubt, ScanFit};

use super::{CauseKind, Metrics, Severity, Thresholds};

/// Families of evidence. Metrics of one family rise and fall together, so they count once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Family {
    /// Where the beams end, by the map.
    EndPoints,
    /// Beams that pass through walls of the map. Counts only together with the first: a missing wall is no wrong pose.
    LongBeams,
    /// How the particles are distributed. Never enough for LOST by itself.
    Particles,
}

impl Family {
    pub(super) const ALL: [Self; 3] = [Self::EndPoints, Self::LongBeams, Self::Particles];
    pub(super) const COUNT: usize = Self::ALL.len();
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
    /// Whether it does so with a single scan.
    pub(super) at_once: bool,
    /// The family of evidence against the pose that it belongs to; None if it is no such evidence.
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

/// A metric that degrades the state when it is past `limit`.
fn degraded(kind: CauseKind, bad: Bad, value: f64, limit: f64) -> Option<Finding> {
    bad.holds(value, limit).then_some(Finding {
        kind,
        severity: Severity::Warning,
        value,
        limit,
        degrades: true,
        at_once: false,
        lost: None,
    })
}

/// A metric that is evidence of a wrong pose when it is past `limit`.
fn lost(kind: CauseKind, bad: Bad, value: f64, limit: f64, family: Family) -> Option<Finding> {
    bad.holds(value, limit).then_some(Finding {
        kind,
        severity: Severity::Critical,
        value,
        limit,
        degrades: true,
        at_once: false,
        lost: Some(family),
    })
}

/// A magnitude that warns that the pose may become bad.
fn hint(kind: CauseKind, severity: Severity, value: f64, limit: f64) -> Option<Finding> {
    (value.abs() > limit).then_some(Finding {
        kind,
        severity,
        value,
        limit,
        degrades: false,
        at_once: false,
        lost: None,
    })
}

/// What an update is judged by.
#[derive(Debug, Clone, Copy)]
pub(super) struct Evidence<'a> {
    /// Of this update alone, except for the ages.
    pub(super) metrics: &'a Metrics,
    /// The fit over a quarter of a second, so that single scans do not degrade the state.
    pub(super) slow: ScanFit,
    /// The fit over a tenth of a second, so that a wrong pose shows soon.
    pub(super) fast: ScanFit,
    /// The localizer's own doubt about its pose.
    pub(super) doubt: Option<Doubt>,
    /// The state is good now, so that limits apply as they are. Otherwise they are stricter by the hysteresis.
    pub(super) good: bool,
}

/// Everything that is over its limit.
pub(super) fn findings(evidence: &Evidence<'_>, t: &Thresholds) -> Vec<Finding> {
    let fit = fit(evidence, t);
    let off_walls = fit.iter().flatten().any(|finding| finding.lost.is_some());
    fit.into_iter()
        .chain([long_beams(evidence, off_walls, t)])
        .chain(pose(evidence.metrics, t))
        .chain([evidence.doubt.map(|doubt| in_doubt(doubt, t))])
        .chain(hints(evidence, t))
        .flatten()
        .collect()
}

/// How the scan fits the map. Not judged while an opponent fills the view.
fn fit(evidence: &Evidence<'_>, t: &Thresholds) -> [Option<Finding>; 2] {
    use Bad::{Above, Below};
    use CauseKind::{Alignment, Residual};
    let Evidence { slow, fast, good, .. } = evidence;
    let ends = Family::EndPoints;
    let margin = if *good { 0.0 } else { t.hysteresis };
    if fast.blocked() > t.blocked_most {
        return [None; 2];
    }
    // The end points on an obstacle are far from the walls, as those of a wrong pose are: the residual does not count then.
    let residual = (fast.blocked() < t.blocked_some).then(|| {
        lost(Residual, Above, fast.residual, t.residual_lost, ends).or_else(|| {
            let limit = t.residual_degraded * (1.0 - margin);
            degraded(Residual, Above, slow.residual, limit)
        })
    });
    [
        lost(Alignment, Below, fast.clear_alignment(), t.alignment_lost, ends).or_else(|| {
            let limit = t.alignment_degraded + margin;
            degraded(Alignment, Below, slow.clear_alignment(), limit)
        }),
        residual.flatten(),
    ]
}

/// Beams through walls. Where the scan lies on the walls nevertheless, the map is out of date.
fn long_beams(evidence: &Evidence<'_>, off_walls: bool, t: &Thresholds) -> Option<Finding> {
    let (kind, share) = (CauseKind::LongBeams, evidence.fast.long_beams);
    if off_walls {
        lost(kind, Bad::Above, share, t.long_beams, Family::LongBeams)
    } else {
        hint(kind, Severity::Info, share, t.long_beams)
    }
}

/// Metrics of the pose and of the particles.
fn pose(metrics: &Metrics, t: &Thresholds) -> [Option<Finding>; 5] {
    use Bad::Above;
    use CauseKind::{Age, Innovation, SecondMode, SpreadAcross, SpreadAlong};
    let m = metrics;
    [
        degraded(SpreadAcross, Above, m.spread_across, t.spread_across_degraded),
        degraded(SpreadAlong, Above, m.spread_along, t.spread_along_degraded),
        lost(
            SecondMode,
            Above,
            m.second_mode,
            t.second_mode_lost,
            Family::Particles,
        )
        .or_else(|| degraded(SecondMode, Above, m.second_mode, t.second_mode_degraded)),
        degraded(Innovation, Above, m.innovation, t.innovation)
            .or_else(|| degraded(Innovation, Above, m.innovation_angle.abs(), t.innovation_angle)),
        degraded(Age, Above, m.age_p50, t.age),
    ]
}

/// The localizer doubts its pose: another place explains the scans as well, or the scan does not match the one before.
fn in_doubt(doubt: Doubt, t: &Thresholds) -> Finding {
    let serious = doubt.probability > t.doubted;
    Finding {
        kind: if doubt.rival.is_some() {
            CauseKind::SecondMode
        } else {
            CauseKind::Likelihood
        },
        severity: if serious {
            Severity::Warning
        } else {
            Severity::Info
        },
        value: doubt.probability,
        limit: t.doubted,
        degrades: serious,
        at_once: true,
        lost: None,
    }
}

/// Others fill the view. The state is degraded once too few beams are left to confirm the pose.
fn occluded(evidence: &Evidence<'_>, t: &Thresholds) -> Option<Finding> {
    let Evidence { slow, fast, good, .. } = evidence;
    let found = hint(
        CauseKind::Occluded,
        Severity::Info,
        fast.blocked(),
        t.blocked_some,
    )?;
    let margin = if *good { 0.0 } else { t.hysteresis };
    let degrades = slow.alignment < t.confirming_least + margin;
    let severity = if degrades {
        Severity::Warning
    } else {
        found.severity
    };
    Some(Finding {
        severity,
        degrades,
        ..found
    })
}

/// Metrics that warn; only an occluded view degrades the state.
fn hints(evidence: &Evidence<'_>, t: &Thresholds) -> [Option<Finding>; 6] {
    use CauseKind::{EffectiveSampleSize, Likelihood, NoReturn, Slip, YawRate};
    let m = evidence.metrics;
    let below = |kind, value: f64, limit: f64| {
        (value < limit).then_some(Finding {
            kind,
            severity: Severity::Info,
            value,
            limit,
            degrades: false,
            at_once: false,
            lost: None,
        })
    };
    [
        hint(Slip, Severity::Warning, m.slip, t.slip_severe)
            .or_else(|| hint(Slip, Severity::Info, m.slip, t.slip)),
        hint(YawRate, Severity::Info, m.yaw_rate_residual, t.yaw_rate_residual),
        occluded(evidence, t),
        hint(NoReturn, Severity::Info, m.no_return, t.no_return_info),
        below(EffectiveSampleSize, m.ess_ratio, t.ess_info),
        below(Likelihood, m.w_ratio, t.w_ratio_info),
    ]
}
