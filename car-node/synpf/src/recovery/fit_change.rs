//! Whether a scan fits worse than scans have done here until now: a reason to look at the rest of the map.
//!
//! A good map is fitted the same all along a drive, to a few per cent. A pose that is wrong along a straight still has most
//! end points on walls, so that no limit on alignment shows it, but the fit falls by many times its own variation, or a
//! little for long: evidence of that is summed up (Page's cumulative sum; Biometrika 41, 1954). It decides nothing: a map
//! that is out of date looks the same.

/// Follows the fit of scans at the estimate.
#[derive(Debug, Clone, Default)]
pub(crate) struct FitChangeDetector {
    /// Mean fit and mean distance from it, over the long term.
    usual: Option<[f64; 2]>,
    /// For how long fits have come in \[s\].
    seconds: f64,
    /// For how long the fit has been far below the usual one \[s\]; None while it is not.
    below_for: Option<f64>,
    /// The cumulative sum, in variations times seconds.
    evidence: f64,
}

/// Time over which the usual fit is learned \[s\].
const LEARNED_OVER: f64 = 2.5;

/// Time until it is known \[s\].
const KNOWN: f64 = 2.0;

/// So many variations below the mean are common, on end too: maps differ from place to place...
const COMMON: f64 = 1.5;

/// ...and so many are a change within two scans...
const FAR: f64 = 5.0;

/// ...or this many times a second, summed up.
const ENOUGH: f64 = 0.3;

/// Variation is never taken for smaller than this: 60 beams resolve no less.
const LEAST_VARIATION: f64 = 0.008;

impl FitChangeDetector {
    /// The usual fit; None before it is known.
    pub(crate) fn usual(&self) -> Option<f64> {
        self.usual.filter(|_| self.seconds > KNOWN).map(|[mean, _]| mean)
    }

    /// Takes in the fit of a scan, in [0, 1], and the time since the one before \[s\]. True when it has changed for the worse.
    pub(crate) fn push(&mut self, fit: f64, seconds: f64) -> bool {
        let [mean, variation] = *self.usual.get_or_insert([fit, 0.05]);
        self.seconds += seconds;
        let below = (mean - fit) / variation.max(LEAST_VARIATION);
        let known = self.seconds > KNOWN;
        self.below_for = (known && below > FAR).then(|| self.below_for.map_or(0.0, |time| time + seconds));
        self.evidence = if known {
            (self.evidence + (below.min(FAR) - COMMON) * seconds).clamp(0.0, 2.0 * ENOUGH)
        } else {
            0.0
        };
        // The first scan may come at the time of the pose that was set.
        let over = LEARNED_OVER.min(self.seconds).max(f64::MIN_POSITIVE);
        let gain = 1.0 - (-seconds / over).exp();
        let off = (fit - mean).abs();
        self.usual = Some([mean + gain * (fit - mean), variation + gain * (off - variation)]);
        self.below_for.is_some_and(|time| time > 0.0) || self.evidence > ENOUGH
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The time at which a change is first seen \[s\].
    fn first(rate: f64, seconds: f64, fit: impl Fn(f64) -> f64) -> Option<f64> {
        let mut detector = FitChangeDetector::default();
        let scans = (seconds * rate) as usize;
        (0..scans)
            .map(|scan| scan as f64 / rate)
            .find(|time| detector.push(fit(*time), 1.0 / rate))
    }

    /// A fit about 0.94 that varies by this much.
    fn steady(time: f64, variation: f64) -> f64 {
        0.94 + variation * (time * 57.0).sin()
    }

    #[test]
    fn a_fall_is_seen_in_the_same_time_at_every_rate() {
        for rate in [10.0, 20.0, 40.0] {
            let falls = |variation: f64, by: f64| {
                first(rate, 20.0, |time| {
                    steady(time, variation) - if time >= 10.0 { by } else { 0.0 }
                })
            };
            let far = falls(0.005, 0.09).expect("far below");
            assert!((10.0..=10.0 + 1.01 / rate).contains(&far), "{rate}: {far}");
            let slight = falls(0.005, 0.03).expect("a little below, for long");
            assert!((10.05..10.4).contains(&slight), "{rate}: {slight}");
            assert_eq!(
                falls(0.05, 0.02),
                None,
                "{rate}: the map fits no better than that anyway"
            );
            assert_eq!(falls(0.005, 0.0), None, "{rate}");
        }
    }

    #[test]
    fn one_bad_scan_and_a_slow_fall_are_none() {
        let one = first(40.0, 10.0, |time| {
            if (time - 5.0).abs() < 0.01 {
                0.3
            } else {
                steady(time, 0.005)
            }
        });
        assert_eq!(one, None);
        assert_eq!(
            first(40.0, 100.0, |time| steady(time, 0.005) - 0.002 * time),
            None
        );
    }

    #[test]
    fn nothing_changes_before_the_usual_is_known() {
        assert_eq!(first(40.0, 1.8, |time| if time < 0.8 { 0.95 } else { 0.3 }), None);
    }

    /// The usual fit was not a number from then on: no change was seen any more, and no search confirmed a place.
    #[test]
    fn a_scan_at_the_time_of_the_pose_that_was_set_is_learned_from_like_any_other() {
        let mut detector = FitChangeDetector::default();
        detector.push(0.9, 0.0);
        for _ in 0..200 {
            detector.push(0.9, 0.025);
        }
        assert!(detector.usual().is_some_and(|usual| (usual - 0.9).abs() < 1e-9));
        detector.push(0.3, 0.025);
        assert!(detector.push(0.3, 0.025));
    }
}
