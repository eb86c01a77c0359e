//! How well a scan fits the map at a pose.

/// The fit of one scan, or of several, smoothed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScanFit {
    /// Share of the valid beams that end within 0.10 m of a wall (0.05 m and a cell where cells are larger), in [0, 1].
    pub alignment: f64,
    /// Mean over the same beams of min(distance to the nearest wall, 1 m) \[m\].
    pub residual: f64,
    /// Share of the valid beams more than 0.3 m shorter than the map says, in [0, 1].
    pub short_beams: f64,
    /// Share of the valid beams more than 0.3 m longer than the map says, in [0, 1].
    pub long_beams: f64,
}

/// Obstacles are taken to block at most this share of the beams: the alignment of a few free beams must not count as that
/// of a whole scan.
const BLOCKED_AT_MOST: f64 = 0.8;

impl ScanFit {
    /// Share of the beams that an obstacle blocks, in [0, 1].
    ///
    /// A wrong pose makes as many beams too short as too long. An obstacle only makes beams too short. So the excess of
    /// short beams over long ones is due to obstacles.
    pub fn blocked(&self) -> f64 {
        (self.short_beams - self.long_beams).clamp(0.0, 1.0)
    }

    /// Alignment of the beams that no obstacle blocks, in [0, 1].
    pub fn clear_alignment(&self) -> f64 {
        let free = 1.0 - self.blocked().min(BLOCKED_AT_MOST);
        (self.alignment / free).min(1.0)
    }

    /// Moves by `share` of the way to `other`: one step of a first-order low-pass filter.
    #[must_use]
    pub fn towards(self, other: Self, share: f64) -> Self {
        let step = |from: f64, to: f64| from + share * (to - from);
        Self {
            alignment: step(self.alignment, other.alignment),
            residual: step(self.residual, other.residual),
            short_beams: step(self.short_beams, other.short_beams),
            long_beams: step(self.long_beams, other.long_beams),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fit(alignment: f64, short_beams: f64, long_beams: f64) -> ScanFit {
        ScanFit {
            alignment,
            residual: 0.05,
            short_beams,
            long_beams,
        }
    }

    #[test]
    fn beams_that_an_obstacle_blocks_do_not_count() {
        assert!((fit(0.45, 0.5, 0.0).clear_alignment() - 0.9).abs() < 1e-12);
        // A wrong pose: as many beams too short as too long.
        assert!((fit(0.45, 0.3, 0.3).clear_alignment() - 0.45).abs() < 1e-12);
    }

    #[test]
    fn the_alignment_of_a_few_free_beams_does_not_become_that_of_a_scan() {
        let nearly_all_blocked = fit(0.05, 0.95, 0.0);
        assert!((nearly_all_blocked.blocked() - 0.95).abs() < 1e-12);
        assert!((nearly_all_blocked.clear_alignment() - 0.25).abs() < 1e-12);
        assert!(fit(0.9, 0.9, 0.0).clear_alignment() <= 1.0);
    }
}
