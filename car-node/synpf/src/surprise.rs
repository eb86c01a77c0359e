//! Whether a scan fits worse than scans have done here until now: on a straight, the only trace of being carried away.
//!
//! A good map is fitted the same all along a drive, to a few per cent. A pose that is wrong along a straight still has most
//! end points on walls, so that no limit on alignment shows it, but the fit falls by many times its own variation, from one
//! scan to the next; or it jumps to the side or turns, which no straight hides, and then stays a little worse than usual: evidence
//! of that is summed up (Page's cumulative sum; Biometrika 41, 1954). Without the jump a slight fall says nothing: a pose
//! that is a little too far on looks the same, and a wall that runs along the grid stands up to half a cell off over its whole
//! length (in `hall` other places fit the right pose's scans better for seconds). Nor does it on a map that fits badly, whose
//! fit varies from place to place.

use crate::loss_detector::RecoveryParameters;

/// Follows the fit of scans at the estimate.
#[derive(Debug, Clone, Default)]
pub(crate) struct Surprise {
    /// Mean fit and mean distance from it, over the long term.
    usual: Option<[f64; 2]>,
    scans: u32,
    /// Scans on end that fitted much worse than usual.
    worse: u32,
    /// Mean size of the corrections across the heading [m] and of the heading [rad].
    corrections: [f64; 2],
    /// Scans for which the last jump still counts.
    jumped: u32,
    /// By how many variations in all the scans since a jump fitted worse than is common.
    evidence: f64,
}

/// A fit that is worse than usual.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fall {
    /// The least fit that would be usual, in [0, 1].
    pub(crate) least: f64,
    /// It came with a jump of the pose.
    pub(crate) jumped: bool,
}

/// Scans until the usual fit is known.
const KNOWN: u32 = 80;

/// Scans on end before it is a surprise.
const ON_END: u32 = 2;

/// A correction across the heading, or of it, this many times as large as usual is a jump...
const JUMP: f64 = 6.0;

/// ...never taken for smaller than this [m], [rad]...
const LEAST_CORRECTION: [f64; 2] = [0.001, 0.0005];

/// ...and the scans after it, so many, are looked at more closely.
const AFTER_JUMP: u32 = 60;

/// So many variations below the mean are common, on end too: maps differ from place to place...
const COMMON: f64 = 1.5;

/// ...and so many beyond that, summed up after a jump, are not.
const ENOUGH: f64 = 12.0;

/// Only a map that scans usually fit at least so well is as good all over; a worse one is wrong about whole rooms.
const GOOD: f64 = 0.85;

/// Variation is never taken for smaller than this: 60 beams cannot tell less.
const LEAST_VARIATION: f64 = 0.008;

impl Surprise {
    /// Takes in the fit of a scan, in [0, 1], and by how much it corrected the prediction across the heading [m] and
    /// in it [rad].
    pub(crate) fn push(&mut self, fit: f64, correction: [f64; 2], parameters: &RecoveryParameters) {
        let [mean, variation] = *self.usual.get_or_insert([fit, 0.05]);
        self.scans = self.scans.saturating_add(1);
        let alpha = parameters.alpha_slow.max(1.0 / f64::from(self.scans));
        let below = (mean - fit) / variation.max(LEAST_VARIATION);
        let known = self.scans > KNOWN;
        self.worse = if known && below > parameters.surprise {
            self.worse + 1
        } else {
            0
        };
        let jump = (0..2).any(|k| correction[k] > JUMP * self.corrections[k].max(LEAST_CORRECTION[k]));
        if known && jump {
            self.jumped = AFTER_JUMP;
        }
        self.jumped = self.jumped.saturating_sub(1);
        self.evidence = if self.jumped > 0 && mean >= GOOD {
            // One scan alone is never enough.
            (self.evidence + below.min(parameters.surprise) - COMMON).clamp(0.0, 2.0 * ENOUGH)
        } else {
            0.0
        };
        for k in 0..2 {
            let off = correction[k].min(JUMP * self.corrections[k].max(LEAST_CORRECTION[k]));
            self.corrections[k] += alpha * (off - self.corrections[k]);
        }
        // After a jump what is a surprise is not usual, and counts no more than the least surprise does.
        let least = mean - parameters.surprise * variation.max(LEAST_VARIATION);
        let fit = if self.jumped > 0 { fit.max(least) } else { fit };
        let off = (fit - mean).abs();
        self.usual = Some([mean + alpha * (fit - mean), variation + alpha * (off - variation)]);
    }

    /// What is surprising; None while nothing is.
    pub(crate) fn fall(&self) -> Option<Fall> {
        let jumped = self.evidence > ENOUGH;
        let [mean, variation] = self.usual.filter(|_| jumped || self.worse >= ON_END)?;
        Some(Fall {
            least: mean - 2.0 * variation.max(LEAST_VARIATION),
            jumped,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The scan at which the fall of the fit first is a surprise.
    fn first(fits: impl Iterator<Item = f64>) -> Option<usize> {
        first_with(fits.map(|fit| (fit, [0.002, 0.001])))
    }

    /// The same with each scan's correction.
    fn first_with(scans: impl Iterator<Item = (f64, [f64; 2])>) -> Option<usize> {
        let parameters = RecoveryParameters::default();
        let mut surprise = Surprise::default();
        scans
            .enumerate()
            .find(|(_, (fit, correction))| {
                surprise.push(*fit, *correction, &parameters);
                surprise.fall().is_some()
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
    fn a_slight_fall_that_stays_is_a_surprise_after_a_jump() {
        // The fit falls by this at scan 400, which corrects the prediction by that across the heading.
        let falls = |by: f64, jump: f64| {
            let after = (0..40).map(move |scan| 0.94 - by + 0.01 * f64::from(scan % 2));
            steady(0.01)
                .chain(after)
                .enumerate()
                .map(move |(scan, fit)| (fit, [if scan == 400 { jump } else { 0.002 }, 0.001]))
        };
        let noticed = first_with(falls(0.035, 0.03)).expect("a surprise");
        assert!((403..415).contains(&noticed), "{noticed}");
        assert_eq!(first_with(falls(0.035, 0.004)), None, "no jump");
        assert_eq!(first_with(falls(0.01, 0.03)), None, "the fit is what it was");
        let worse_map = falls(0.035, 0.03).map(|(fit, correction)| (fit - 0.12, correction));
        assert_eq!(first_with(worse_map), None, "it is wrong about whole rooms");
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
