//! How scans fit the map, over time.

use super::Metrics;

/// The shares and the residual that one scan gave, or many of them smoothed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ScanFit {
    pub(super) alignment: f64,
    pub(super) residual: f64,
    pub(super) short_beams: f64,
    pub(super) long_beams: f64,
}

impl ScanFit {
    pub(super) fn of(metrics: &Metrics) -> Self {
        Self {
            alignment: metrics.alignment,
            residual: metrics.residual,
            short_beams: metrics.short_beams,
            long_beams: metrics.long_beams,
        }
    }

    /// Goes this share of the way to `other`.
    pub(super) fn towards(self, other: Self, share: f64) -> Self {
        let step = |from: f64, to: f64| from + share * (to - from);
        Self {
            alignment: step(self.alignment, other.alignment),
            residual: step(self.residual, other.residual),
            short_beams: step(self.short_beams, other.short_beams),
            long_beams: step(self.long_beams, other.long_beams),
        }
    }

    /// Share of the beams that something in view has cut short. A wrong pose makes beams short and long alike, an
    /// opponent only makes them short: so it is those in excess of the long ones.
    pub(super) fn blocked(&self) -> f64 {
        (self.short_beams - self.long_beams).clamp(0.0, 1.0)
    }

    /// Alignment of the beams that nothing in view has cut short: what the pose is judged by.
    pub(super) fn clear_alignment(&self) -> f64 {
        (self.alignment / (1.0 - self.blocked()).max(0.05)).min(1.0)
    }
}
