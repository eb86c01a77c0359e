//! Whether a scan fits worse than scans have done here until now: on a straight, the only trace of being carried away.
//!
//! A good map is fitted the same all along a drive, to a few per cent. A pose that is wrong along a straight still has most
//! end points on walls, so that no limit on alignment shows it, but the fit falls by many times its own variation, from one
//! scan to the next. On a map that fits badly the variation is large, and the same fall says nothing.

use crate::recovery::RecoveryParameters;

/// Follows the fit of scans at the estimate.
#[derive(Debug, Clone, Default)]
pub(crate) struct Surprise {
    /// Mean fit and mean distance from it, over the long term.
    usual: Option<[f64; 2]>,
    scans: u32,
    /// Scans on end that fitted worse than usual.
    worse: u32,
}

/// Scans until the usual fit is known.
const KNOWN: u32 = 80;

/// Scans on end before it is a surprise.
const ON_END: u32 = 2;

/// Variation is never taken for smaller than this: 60 beams cannot tell less.
const LEAST_VARIATION: f64 = 0.008;

impl Surprise {
    /// Takes in the fit of a scan, in [0, 1].
    pub(crate) fn push(&mut self, fit: f64, parameters: &RecoveryParameters) {
        let [mean, variation] = *self.usual.get_or_insert([fit, 0.05]);
        self.scans = self.scans.saturating_add(1);
        let worse = self.scans > KNOWN && fit < mean - parameters.surprise * variation.max(LEAST_VARIATION);
        self.worse = if worse { self.worse + 1 } else { 0 };
        let alpha = parameters.alpha_slow.max(1.0 / f64::from(self.scans));
        let off = (fit - mean).abs();
        self.usual = Some([mean + alpha * (fit - mean), variation + alpha * (off - variation)]);
    }

    /// The least fit that is still usual; None while nothing is a surprise.
    pub(crate) fn least(&self) -> Option<f64> {
        let [mean, variation] = self.usual.filter(|_| self.worse >= ON_END)?;
        Some(mean - 2.0 * variation.max(LEAST_VARIATION))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The surprise after scans of these fits, and the scan at which it first was one.
    fn first(fits: impl Iterator<Item = f64>) -> Option<usize> {
        let parameters = RecoveryParameters::default();
        let mut surprise = Surprise::default();
        fits.enumerate()
            .find(|(_, fit)| {
                surprise.push(*fit, &parameters);
                surprise.least().is_some()
            })
            .map(|(scan, _)| scan)
    }

    /// Fits about 0.94 that vary by this much, one way and the other.
    fn steady(variation: f64) -> impl Iterator<Item = f64> {
        (0..400).map(move |scan| 0.94 + if scan % 2 == 0 { variation } else { -variation })
    }

    #[test]
    fn a_small_fall_is_a_surprise_where_the_fit_is_steady() {
        let falls = |variation| steady(variation).chain(std::iter::repeat_n(0.85, 40));
        assert_eq!(first(steady(0.005)), None);
        assert_eq!(first(falls(0.005)), Some(401), "at the second scan");
        assert_eq!(
            first(falls(0.05)),
            None,
            "the map is fitted no better than that anyway"
        );
    }

    #[test]
    fn one_bad_scan_and_a_slow_fall_are_none() {
        let one = steady(0.005).chain([0.3]).chain(steady(0.005));
        assert_eq!(first(one), None);
        let slow = steady(0.005).chain((0..4000).map(|scan| 0.94 - 0.0001 * f64::from(scan)));
        assert_eq!(first(slow), None);
    }

    #[test]
    fn nothing_is_a_surprise_before_the_usual_is_known() {
        assert_eq!(
            first((0..60).map(|scan| if scan < 30 { 0.95 } else { 0.3 })),
            None
        );
    }
}
