//! Unit, sign and bias of yaw rates, by the turn of the scans.

use localizer::{SensorFinding, SensorFindings};

use super::Stretch;
use super::linear_fit::LinearFit;

/// What makes a turn of a sensor's one of the car.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TurnCorrection {
    factor: f64,
    /// Bias of the reading, in the sensor's unit.
    bias: f64,
}

impl Default for TurnCorrection {
    fn default() -> Self {
        Self {
            factor: 1.0,
            bias: 0.0,
        }
    }
}

impl TurnCorrection {
    /// The turn of the car \[rad\] where the sensor says `turn` over `seconds`.
    pub(crate) fn corrected(self, turn: f64, seconds: f64) -> f64 {
        self.factor * (turn - self.bias * seconds)
    }
}

/// How far back turns count [s]: a bias drifts over minutes.
const MEMORY: f64 = 30.0;

/// Least turning to judge a yaw rate by, as the sum of its squares about the mean [rad^2/s]: one bend. The heading by the
/// scans is good to 0.002 rad, so that stretches of 0.1 s of half a minute have 0.02.
const TURNING: f64 = 0.5;

/// Least time to judge a yaw rate by \[s\].
const LISTENED: f64 = 1.0;

/// A sensor that leaves more of the turn unexplained is of no use.
const USELESS: f64 = 0.25;

/// A bias below this is usual for a gyroscope that nobody has calibrated [rad/s].
const USUAL_BIAS: f64 = 0.03;

/// Held against the turn by the scans: the gyroscope.
#[derive(Debug, Clone, Default)]
pub(super) struct GyroCheck {
    fit: LinearFit,
    verdict: Option<GyroVerdict>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum GyroVerdict {
    Fits(TurnCorrection),
    AlwaysZero,
    Useless,
}

/// Readings per rad/s.
const GYRO_UNITS: [f64; 4] = [
    1.0,
    -1.0,
    180.0 / std::f64::consts::PI,
    -180.0 / std::f64::consts::PI,
];

impl GyroCheck {
    pub(super) fn learn(&mut self, stretch: &Stretch) {
        let driven = &stretch.driven;
        // Silent for a part of the time.
        if driven.gyro_time < 0.9 * stretch.seconds {
            return;
        }
        let (reading, truth) = (driven.gyro_turn / stretch.seconds, stretch.turn / stretch.seconds);
        self.fit.add(reading, truth, stretch.seconds, MEMORY);
        let fit = &self.fit;
        if fit.seconds() < LISTENED || fit.excitation() < TURNING {
            return;
        }
        let (unexplained, unit) = GYRO_UNITS
            .map(|unit| (fit.unexplained(1.0 / unit), unit))
            .into_iter()
            .fold(
                (f64::INFINITY, 1.0),
                |best, next| if next.0 < best.0 { next } else { best },
            );
        self.verdict = Some(if fit.deviation_x() < 1e-3 {
            GyroVerdict::AlwaysZero
        } else if unexplained < USELESS {
            GyroVerdict::Fits(TurnCorrection {
                factor: 1.0 / unit,
                bias: fit.bias(1.0 / unit),
            })
        } else {
            GyroVerdict::Useless
        });
    }

    /// How to use it; None while it is not known to be of use.
    pub(super) fn correction(&self) -> Option<TurnCorrection> {
        match self.verdict {
            Some(GyroVerdict::Fits(correction)) => Some(correction),
            _ => None,
        }
    }

    pub(super) fn report(&self, findings: &mut SensorFindings) {
        let ratio = self.fit.slope().map_or(0.0, |slope| 1.0 / slope);
        match self.verdict {
            Some(GyroVerdict::Fits(TurnCorrection { factor, bias })) => {
                if factor.abs() < 0.5 {
                    findings.insert(SensorFinding::GyroInDegrees, ratio);
                }
                if factor < 0.0 {
                    findings.insert(SensorFinding::GyroFlipped, ratio);
                }
                let bias = bias * factor;
                if bias.abs() > USUAL_BIAS {
                    findings.insert(SensorFinding::GyroBias, bias);
                }
            }
            Some(GyroVerdict::AlwaysZero) => {
                findings.insert(SensorFinding::GyroAlwaysZero, self.fit.deviation_x());
            }
            Some(GyroVerdict::Useless) => {
                let left = self.fit.unexplained(self.fit.slope().unwrap_or(0.0));
                findings.insert(SensorFinding::GyroIgnored, 1.0 - left);
            }
            None => {}
        }
    }
}

/// Held against the turn by the scans: odometry's.
#[derive(Debug, Clone, Default)]
pub(super) struct OdometryTurnCheck {
    fit: LinearFit,
    correction: TurnCorrection,
    useless: bool,
}

/// Odometry's turn may be off by this share: a yaw rate by the steering is, in bends at the limit.
const USUAL_SHARE: f64 = 0.35;

/// ...and by this much on a straight [rad/s].
const USUAL_OFFSET: f64 = 0.2;

/// A correction must leave this many times less.
const BETTER: f64 = 4.0;

impl OdometryTurnCheck {
    pub(super) fn learn(&mut self, stretch: &Stretch) {
        let Stretch {
            seconds,
            turn,
            ref driven,
            ..
        } = *stretch;
        if driven.sliding > 0.0 {
            return;
        }
        self.fit
            .add(driven.turn / seconds, turn / seconds, seconds, MEMORY);
        let fit = &self.fit;
        if fit.seconds() < LISTENED || fit.excitation() < TURNING {
            return;
        }
        let slope = fit.slope().filter(|slope| (0.01..4.0).contains(&slope.abs()));
        let left = slope.map_or(1.0, |slope| fit.unexplained(slope));
        self.useless = left > USELESS && fit.unexplained_as_it_is() > USELESS;
        self.correction = TurnCorrection::default();
        if let Some(factor) = slope
            && !self.useless
        {
            let bias = fit.bias(factor);
            let wrong = (1.0 / factor - 1.0).abs() > USUAL_SHARE || (factor * bias).abs() > USUAL_OFFSET;
            if wrong && fit.unexplained_as_it_is() > BETTER * left {
                self.correction = TurnCorrection { factor, bias };
            }
        }
    }

    pub(super) fn correction(&self) -> TurnCorrection {
        self.correction
    }

    pub(super) fn report(&self, findings: &mut SensorFindings) {
        let TurnCorrection { factor, bias } = self.correction;
        if (1.0 / factor - 1.0).abs() > USUAL_SHARE {
            findings.insert(SensorFinding::OdometryTurnScale, 1.0 / factor);
        }
        if (factor * bias).abs() > USUAL_OFFSET {
            findings.insert(SensorFinding::OdometryTurnBias, factor * bias);
        }
        if self.useless {
            let left = self.fit.unexplained(self.fit.slope().unwrap_or(0.0));
            findings.insert(SensorFinding::OdometryTurnWrong, 1.0 - left);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor_check::DrivenSums;

    /// A slalom of 1.5 rad/s, seen by the scans and by a gyroscope and odometry that make `gyro` and `odometry` of it.
    fn slalom(gyro: impl Fn(f64) -> f64, odometry: impl Fn(f64) -> f64) -> (GyroCheck, OdometryTurnCheck) {
        let (mut gyro_check, mut turn_check) = (GyroCheck::default(), OdometryTurnCheck::default());
        for step in 0..50 {
            let rate = 1.5 * (f64::from(step) * 0.2).sin();
            let stretch = Stretch {
                seconds: 0.1,
                distance: 0.4,
                turn: rate * 0.1,
                information: 0.5,
                driven: DrivenSums {
                    distance: 0.4,
                    turn: odometry(rate) * 0.1,
                    gyro_turn: gyro(rate) * 0.1,
                    gyro_time: 0.1,
                    sliding: 0.0,
                },
            };
            gyro_check.learn(&stretch);
            turn_check.learn(&stretch);
        }
        (gyro_check, turn_check)
    }

    fn findings(gyro: impl Fn(f64) -> f64, odometry: impl Fn(f64) -> f64) -> SensorFindings {
        let (gyro, turn) = slalom(gyro, odometry);
        let mut findings = SensorFindings::default();
        gyro.report(&mut findings);
        turn.report(&mut findings);
        findings
    }

    #[test]
    fn a_sound_gyroscope_is_used_as_it_is() {
        assert_eq!(findings(|rate| rate, |rate| 0.8 * rate).iter().count(), 0);
        let correction = slalom(|rate| rate, |rate| rate).0.correction().expect("used");
        assert!((correction.corrected(0.15, 0.1) - 0.15).abs() < 1e-6);
    }

    #[test]
    fn unit_sign_and_bias_are_found_and_corrected() {
        let raw = |rate: f64| -(rate + 0.3).to_degrees();
        let correction = slalom(raw, |rate| rate).0.correction().expect("used");
        assert!((correction.corrected(raw(1.0) * 0.1, 0.1) - 0.1).abs() < 1e-3);
        let found = findings(raw, |rate| rate);
        let value = |finding| found.get(finding).expect("found");
        assert!((value(SensorFinding::GyroInDegrees) + 57.3).abs() < 0.1);
        assert!((value(SensorFinding::GyroFlipped) + 57.3).abs() < 0.1);
        assert!((value(SensorFinding::GyroBias) - 0.3).abs() < 0.02, "{found:?}");
    }

    #[test]
    fn a_gyroscope_that_does_not_follow_is_left_out() {
        assert!(
            findings(|_| 0.0, |rate| rate)
                .get(SensorFinding::GyroAlwaysZero)
                .is_some()
        );
        assert!(
            findings(|rate| (40.0 * rate).sin(), |rate| rate)
                .get(SensorFinding::GyroIgnored)
                .is_some()
        );
        assert_eq!(slalom(|_| 0.0, |rate| rate).0.correction(), None);
    }

    #[test]
    fn odometry_that_turns_by_a_wrong_rule_is_corrected() {
        for (scale, offset) in [(-1.0, 0.0), (0.5, 0.0), (1.6, 0.0), (1.0, 1.0), (1.0, 0.3)] {
            let raw = |rate: f64| scale * rate + offset;
            let correction = slalom(|rate| rate, raw).1.correction();
            let turn = correction.corrected(raw(1.0) * 0.1, 0.1);
            assert!((turn - 0.1).abs() < 1e-3, "{scale} {offset}: {turn}");
            assert_eq!(findings(|rate| rate, raw).iter().count(), 1, "{scale} {offset}");
        }
        assert!(
            findings(|rate| rate, |_| 0.0)
                .get(SensorFinding::OdometryTurnWrong)
                .is_some()
        );
    }
}
