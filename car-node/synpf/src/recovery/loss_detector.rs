//! What the pose that is followed is worth: the log of its odds against being somewhere else.
//!
//! Its history counts. While scan after scan goes on where the one before left off and fits the map, the odds grow with the
//! way, to a limit. They fall when a scan breaks with the ones before it ([`super::continuity`]), by the likelihood
//! ratio of that, and while hardly anything fits.

use super::RecoveryParameters;
use super::continuity::Continued;
use crate::quality::Quality;

/// Follows what speaks for the pose and against it, the map's other places left aside.
#[derive(Debug, Clone, Default)]
pub(crate) struct LossDetector {
    /// Log of the odds that the pose is right.
    odds: f64,
    /// The break that is being looked into.
    breaking: Option<Break>,
    /// A break has lasted.
    carried: bool,
    /// For how long the scans have contradicted the pose since a break \[s\].
    contradicted_for: f64,
}

/// Scans that do not go on from one before them.
#[derive(Debug, Clone, Copy)]
struct Break {
    /// The log odds before.
    before: f64,
    /// The log-likelihood ratio of the scan that breaks least: as the car drives on, all differ more and more.
    ratio: f64,
}

/// Log odds that a metre of driving with fitting scans adds [1/m].
const GAIN: f64 = 3.0;

/// Clear alignment from which on a scan counts as fitting, and with which it counts in full: a right pose on a map with
/// half of its walls changed has 0.5, a wrong one 0.1 to 0.5, and then a rival leads soon.
const FITTING: [f64; 2] = [0.4, 0.8];

/// Clear alignment below which hardly anything fits, and what a metre of that costs [1/m].
const HOPELESS: f64 = 0.3;
const LOSS: f64 = 2.0;

/// A break so unlikely to be none is worth a look at the map.
const DOUBTFUL: f64 = 4.0;

impl LossDetector {
    /// Takes in how a scan goes on from the one before, how it fits, and the way since \[m\]. `leading` says that another
    /// place explains more.
    pub(crate) fn push(
        &mut self,
        continued: Continued,
        quality: &Quality,
        way: f64,
        leading: bool,
        parameters: &RecoveryParameters,
    ) {
        match continued {
            // The scan goes on from the one before the break: it was none.
            Continued::Yes => {
                if let Some(broken) = self.breaking.take() {
                    self.odds = self.odds.max(broken.before);
                }
            }
            Continued::Unknown => self.breaking = None,
            Continued::Broken { ratio, settled } if ratio > DOUBTFUL => {
                let broken = self.breaking.get_or_insert(Break {
                    before: self.odds,
                    ratio,
                });
                broken.ratio = broken.ratio.min(ratio);
                self.odds = (broken.before - broken.ratio).max(0.0);
                if settled {
                    self.breaking = None;
                    self.carried = true;
                }
            }
            Continued::Broken { .. } => {}
        }
        let alignment = quality.clear_alignment();
        let fits = ((alignment - FITTING[0]) / (FITTING[1] - FITTING[0])).clamp(0.0, 1.0);
        if alignment < HOPELESS {
            self.odds -= LOSS * way;
        } else if !leading {
            self.odds += GAIN * fits * way;
        }
        self.odds = self.odds.clamp(0.0, parameters.trust_limit);
        self.carried &= self.odds < parameters.switch_odds;
    }

    /// Log of the odds that the pose is right, as long as no other place explains more.
    pub(crate) fn odds(&self) -> f64 {
        self.odds
    }

    /// True when the pose was trusted, and a break says that the car was carried.
    pub(crate) fn broken(&self, parameters: &RecoveryParameters) -> bool {
        (self.breaking.is_some() || self.carried) && self.odds < parameters.switch_odds
    }

    /// True when the car seems to have been carried and the scans have contradicted the pose since for long enough: alignment
    /// and the beams that reach through walls agree, or nearly everything is elsewhere, or the fit has fallen. Without a
    /// break a pose is given up for a rival only: the map may be wrong.
    pub(crate) fn contradicted(
        &mut self,
        quality: &Quality,
        fit_ratio: f64,
        seconds: f64,
        parameters: &RecoveryParameters,
    ) -> bool {
        let alignment = quality.clear_alignment();
        let low = alignment < parameters.lost_alignment;
        let through_walls = quality.long > parameters.lost_long_beams;
        // Nearly everything short and nothing aligned is no opponent: it is another place.
        let elsewhere = alignment < 0.5 * parameters.lost_alignment && quality.short < 0.8;
        let fallen = fit_ratio < parameters.check_ratio;
        if self.broken(parameters) && (low && (through_walls || elsewhere) || fallen) {
            self.contradicted_for += seconds;
        } else {
            self.contradicted_for = 0.0;
        }
        // Steps of a scan's interval do not add up exactly.
        self.contradicted_for > parameters.lost_after - 1e-3
    }

    /// A pose that was found or given starts with these odds.
    pub(crate) fn start(&mut self, odds: f64) {
        *self = Self {
            odds,
            ..Self::default()
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FITS: Quality = Quality {
        alignment: 0.95,
        residual: 0.02,
        short: 0.0,
        long: 0.0,
    };

    /// Half of the walls have changed.
    const CHANGED: Quality = Quality {
        alignment: 0.4,
        residual: 0.3,
        short: 0.1,
        long: 0.5,
    };

    fn push(detector: &mut LossDetector, continued: Continued, quality: &Quality) {
        detector.push(continued, quality, 0.1, false, &RecoveryParameters::default());
    }

    fn driven() -> LossDetector {
        let mut detector = LossDetector::default();
        for _ in 0..100 {
            push(&mut detector, Continued::Yes, &FITS);
        }
        detector
    }

    #[test]
    fn a_trusted_pose_outlives_a_map_that_is_out_of_date() {
        let parameters = RecoveryParameters::default();
        let mut detector = driven();
        for _ in 0..400 {
            push(&mut detector, Continued::Yes, &CHANGED);
            assert!(!detector.contradicted(&CHANGED, 0.5, 0.025, &parameters));
        }
        assert!(detector.odds() > 10.0 && !detector.broken(&parameters));
    }

    #[test]
    fn a_carried_car_is_lost_in_the_same_time_at_every_rate_and_another_is_not() {
        let parameters = RecoveryParameters::default();
        for rate in [10.0, 20.0, 40.0] {
            let contradicted = |detector: &mut LossDetector| {
                (1..1000).find(|_| detector.contradicted(&CHANGED, 0.5, 1.0 / rate, &parameters))
            };
            assert_eq!(contradicted(&mut LossDetector::default()), None);
            let mut detector = driven();
            let settled = true;
            push(
                &mut detector,
                Continued::Broken { ratio: 15.0, settled },
                &CHANGED,
            );
            let scans = contradicted(&mut detector);
            let seconds = scans.map_or(f64::INFINITY, |scans| f64::from(scans) / rate);
            assert!(
                (seconds - parameters.lost_after).abs() < 1e-9,
                "{rate} Hz: {seconds}"
            );
        }
    }

    #[test]
    fn a_break_costs_the_trust_and_one_bad_scan_costs_nothing() {
        let parameters = RecoveryParameters::default();
        let broken = |settled| Continued::Broken { ratio: 15.0, settled };
        let mut detector = driven();
        push(&mut detector, broken(false), &FITS);
        assert!(detector.broken(&parameters) && detector.odds() < 1.0);
        push(&mut detector, Continued::Yes, &FITS);
        assert!(!detector.broken(&parameters) && detector.odds() > 10.0);
        push(&mut detector, broken(true), &CHANGED);
        push(&mut detector, Continued::Yes, &CHANGED);
        assert!(detector.broken(&parameters) && detector.odds() < 1.0);
    }
}
