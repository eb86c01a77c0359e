//! When the filter doubts itself: injection of particles, and the decision to search anew.

use serde::{Deserialize, Serialize};

use crate::validation::Check;

/// Parameters of recovery.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct RecoveryParameters {
    /// Share by which the long-term average of the likelihood follows each scan (Probabilistic Robotics, table 8.3).
    pub alpha_slow: f64,
    /// Share by which the short-term average follows.
    pub alpha_fast: f64,
    /// Inject particles along the track when the short-term average falls below the long-term one.
    pub injection: bool,
    /// Below this ratio of the averages particles are injected.
    pub injection_ratio: f64,
    /// Most particles that one resampling injects, as a share.
    pub injection_share: f64,
    /// Search the whole map when localization is lost.
    pub recover: bool,
    /// Alignment below which the pose may be wrong.
    pub lost_alignment: f64,
    /// Share of beams that are longer than the map says above which the pose may be wrong.
    pub lost_long_beams: f64,
    /// How long both must hold until the filter searches [s].
    pub lost_after: f64,
    /// Ratio of the averages below which the pose is doubted, and compared with the rest of the map.
    pub doubt_ratio: f64,
    /// How long the doubt must last before that [s].
    pub doubt_after: f64,
    /// A fit of two scans that is below the usual one by this many times its usual variation raises the doubt at once.
    pub surprise: f64,
}

impl Default for RecoveryParameters {
    fn default() -> Self {
        Self {
            alpha_slow: 0.01,
            alpha_fast: 0.3,
            injection: true,
            injection_ratio: 0.8,
            injection_share: 0.2,
            recover: true,
            lost_alignment: 0.45,
            lost_long_beams: 0.15,
            lost_after: 0.25,
            doubt_ratio: 0.8,
            doubt_after: 0.1,
            surprise: 5.0,
        }
    }
}

impl RecoveryParameters {
    pub(crate) fn validate(&self, check: &mut Check) {
        check.range("alpha_slow", self.alpha_slow, 1e-6, 1.0);
        check.range("alpha_fast", self.alpha_fast, 1e-6, 1.0);
        check.that("alpha_slow", self.alpha_slow < self.alpha_fast, || {
            format!("{} is not below alpha_fast, {}", self.alpha_slow, self.alpha_fast)
        });
        check.range("injection_ratio", self.injection_ratio, 0.0, 1.0);
        check.range("injection_share", self.injection_share, 0.0, 0.9);
        check.range("lost_alignment", self.lost_alignment, 0.0, 1.0);
        check.range("lost_long_beams", self.lost_long_beams, 0.0, 1.0);
        check.range("lost_after", self.lost_after, 0.05, 10.0);
        check.range("doubt_ratio", self.doubt_ratio, 0.0, 1.0);
        check.range("doubt_after", self.doubt_after, 0.02, 10.0);
        check.range("surprise", self.surprise, 1.0, 1000.0);
    }
}

/// The averages of augmented MCL, over the fit of the scan at the estimate.
#[derive(Debug, Clone, Default)]
pub(crate) struct Doubt {
    averages: Option<[f64; 2]>,
    /// The alignment of the last scans, whatever stands in view, averaged over the short term, the newest first.
    recent: [f64; SUDDEN_SCANS],
    /// For how much longer the last sudden fall counts [s].
    sudden_for: f64,
    /// For how long the pose has looked wrong [s].
    wrong_for: f64,
    /// For how long the fit has been below what it used to be [s].
    doubted_for: f64,
    /// Time until the rest of the map may be looked at again [s], and how long to wait the next time.
    patience: [f64; 2],
}

/// A car that was carried away fits worse from one scan to the next; a map that is out of date, or an opponent that
/// comes into view, makes the fit fall slowly. Sudden is a fall by this share of the long-term average...
const SUDDEN_FALL: f64 = 0.16;

/// ...within this many scans.
const SUDDEN_SCANS: usize = 6;

/// How long a sudden fall is a reason to doubt the pose [s].
const SUDDEN_FOR: f64 = 1.0;

/// Alignment of a localized car on a map of usual quality: what the averages start from, so that a pose that was
/// wrong from the start is doubted too.
const USUAL: f64 = 0.8;

/// Comparing with the rest of the map takes as long as many updates: after each time that the pose was found to
/// be the best one, the filter waits twice as long, up to this [s].
const MOST_PATIENCE: f64 = 4.0;

impl Doubt {
    /// Takes in the likelihood of a scan, any positive measure whose ratio means something. Returns
    /// `w_fast` / `w_slow`.
    pub(crate) fn push(&mut self, likelihood: f64, alignment: f64, parameters: &RecoveryParameters) -> f64 {
        let [slow, fast] = self.averages.unwrap_or([USUAL; 2]);
        let slow = slow + parameters.alpha_slow * (likelihood - slow);
        let fast = fast + parameters.alpha_fast * (likelihood - fast);
        if self.averages.is_none() {
            self.recent = [USUAL; SUDDEN_SCANS];
        }
        let now = self.recent[0] + parameters.alpha_fast * (alignment - self.recent[0]);
        self.recent.rotate_right(1);
        self.recent[0] = now;
        let highest = self.recent.into_iter().fold(0.0, f64::max);
        if highest - now > SUDDEN_FALL * slow {
            self.sudden_for = SUDDEN_FOR;
        }
        self.averages = Some([slow, fast]);
        if slow > 0.0 { fast / slow } else { 1.0 }
    }

    /// True when the pose has looked wrong for long enough: alignment and the beams that reach through walls agree.
    /// What stands in view makes beams short, not long, so an opponent alone is never a reason.
    pub(crate) fn lost(
        &mut self,
        alignment: f64,
        long_beams: f64,
        short_beams: f64,
        seconds: f64,
        parameters: &RecoveryParameters,
    ) -> bool {
        let misaligned = alignment < parameters.lost_alignment;
        let through_walls = long_beams > parameters.lost_long_beams;
        // Nearly everything short and nothing aligned is no opponent: it is another place.
        let elsewhere = alignment < 0.5 * parameters.lost_alignment && short_beams < 0.8;
        if misaligned && (through_walls || elsewhere) {
            self.wrong_for += seconds;
        } else {
            self.wrong_for = 0.0;
        }
        // Steps of a scan's interval do not add up exactly.
        self.wrong_for > parameters.lost_after - 1e-3
    }

    /// True when the scan has fitted worse than before for long enough, or suddenly worse, to ask whether another place
    /// fits better. `ratio` is `w_fast / w_slow`; `surprised` says that the fit is below what is usual. An opponent in view
    /// looks the same at first; the comparison tells them apart.
    pub(crate) fn asks(
        &mut self,
        alignment: f64,
        ratio: f64,
        surprised: bool,
        seconds: f64,
        parameters: &RecoveryParameters,
    ) -> bool {
        let [wait, next] = self.patience;
        self.sudden_for = (self.sudden_for - seconds).max(0.0);
        self.patience[0] = (wait - seconds).max(0.0);
        let fell = (ratio <= parameters.doubt_ratio || self.sudden()) && alignment <= 0.85;
        if !fell && !surprised {
            self.doubted_for = 0.0;
            if ratio > 0.95 {
                self.patience[1] = 0.0;
            }
            return false;
        }
        self.doubted_for += seconds;
        let long_enough = surprised || self.doubted_for >= parameters.doubt_after - 1e-3;
        if !long_enough || self.patience[0] > 0.0 {
            return false;
        }
        let wait = (2.0 * next).clamp(0.1, MOST_PATIENCE);
        self.patience = [wait, wait];
        true
    }

    /// True for a while after the fit has fallen from one moment to the next.
    pub(crate) fn sudden(&self) -> bool {
        self.sudden_for > 0.0
    }

    /// Starts anew, because the pose has been set or found.
    pub(crate) fn clear(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sudden_fall_shows_and_fades() {
        let parameters = RecoveryParameters::default();
        let mut doubt = Doubt::default();
        for _ in 0..200 {
            assert!((0.99..1.15).contains(&doubt.push(0.9, 0.9, &parameters)));
        }
        let mut ratio = 1.0;
        for _ in 0..10 {
            ratio = doubt.push(0.2, 0.2, &parameters);
        }
        assert!(ratio < 0.4, "{ratio}");
        for _ in 0..2000 {
            ratio = doubt.push(0.2, 0.2, &parameters);
        }
        assert!(ratio > 0.95, "{ratio}");
    }

    #[test]
    fn a_fall_is_sudden_or_it_is_not() {
        let parameters = RecoveryParameters::default();
        // Falls from 0.9 to 0.5 within so many scans.
        let falls = |scans: i32| {
            let mut doubt = Doubt::default();
            for _ in 0..200 {
                doubt.push(0.9, 0.9, &parameters);
            }
            (0..=scans + 3).any(|scan| {
                let fit = 0.9 - 0.4 * f64::from(scan.min(scans)) / f64::from(scans);
                doubt.push(fit, fit, &parameters);
                doubt.sudden()
            })
        };
        assert!(falls(1), "carried away");
        assert!(!falls(40), "into a part of the map that is out of date");
    }

    #[test]
    fn the_map_is_asked_soon_and_then_less_and_less() {
        let parameters = RecoveryParameters::default();
        let mut doubt = Doubt::default();
        let asked: Vec<usize> = (0..400)
            .filter(|_| doubt.asks(0.5, 0.6, false, 0.025, &parameters))
            .collect();
        assert_eq!(asked[0], 3);
        let pauses: Vec<usize> = asked.windows(2).map(|pair| pair[1] - pair[0]).collect();
        assert!(
            pauses.windows(2).all(|pair| pair[0] <= pair[1]) && asked.len() < 9,
            "{asked:?}"
        );
        assert!(
            !doubt.asks(0.95, 0.6, false, 1.0, &parameters),
            "a scan that fits raises no doubt"
        );
    }

    #[test]
    fn an_opponent_is_no_loss_but_a_wrong_place_is() {
        let parameters = RecoveryParameters::default();
        let mut doubt = Doubt::default();
        for _ in 0..100 {
            assert!(!doubt.lost(0.4, 0.0, 0.6, 0.025, &parameters));
        }
        let scans = (1..100).find(|_| doubt.lost(0.3, 0.3, 0.3, 0.025, &parameters));
        assert_eq!(scans, Some(10));
    }
}
