//! A sampler that passes a fixed share of what it is asked.

/// Passes a fixed share, evenly spread, the first one included.
#[derive(Debug, Clone)]
pub(crate) struct FixedRatioSampler {
    /// At 1 the next one passes.
    due: f64,
}

impl Default for FixedRatioSampler {
    fn default() -> Self {
        Self { due: 1.0 }
    }
}

/// What sums of a ratio may lack of 1.
const ROUNDING: f64 = 1e-9;

impl FixedRatioSampler {
    /// Whether the next one passes. The ratio may change from one to the next.
    pub(crate) fn pulse(&mut self, ratio: f64) -> bool {
        if ratio <= 0.0 {
            return false;
        }
        let passes = self.due >= 1.0 - ROUNDING;
        self.due += ratio - f64::from(u8::from(passes));
        passes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn passed(sampler: &mut FixedRatioSampler, ratio: f64) -> usize {
        (0..100).filter(|_| sampler.pulse(ratio)).count()
    }

    #[test]
    fn the_share_that_passes_is_the_ratio() {
        for (ratio, expected) in [(0.0, 0), (0.05, 5), (0.3, 30), (1.0, 100)] {
            assert_eq!(passed(&mut FixedRatioSampler::default(), ratio), expected);
        }
    }

    /// A set with a smaller ratio used to pass nothing for as long as the set before had passed all.
    #[test]
    fn another_ratio_holds_at_once() {
        let mut sampler = FixedRatioSampler::default();
        for (ratio, expected) in [(1.0, 100), (0.5, 50), (0.05, 5), (1.0, 100)] {
            assert!(passed(&mut sampler, ratio).abs_diff(expected) <= 1, "{ratio}");
        }
    }
}
