//! The lag between the scanner's stamps and odometry's, by the turns of both.

use super::DrivenSums;
use super::linear_fit::LinearFit;

/// Fits the turn by the scans to the turn by odometry, as it was some time before or after.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ScanLag {
    fits: [LinearFit; CANDIDATES],
    /// Stretches since the last decision.
    lag: f64,
}

/// Lags that are tried, [`STEP`] apart, around none.
const CANDIDATES: usize = 25;

/// From one candidate to the next \[s\].
const STEP: f64 = 0.01;

/// How far back turns count \[s\].
const MEMORY: f64 = 60.0;

/// Least turning to judge by, as the sum of the squares of the yaw rate about its mean [rad^2/s]: a few bends.
const TURNING: f64 = 4.0;

/// A smaller lag is none [s]: a scan's own stamp may be its middle, and a gyroscope filters.
const SMALL: f64 = 0.012;

/// A lag must leave this many times less of the turn unexplained than none.
const BETTER: f64 = 3.0;

/// More left is no turn of the same car.
const MOST_LEFT: f64 = 0.1;

impl ScanLag {
    /// The longest lag that is found \[s\].
    pub(crate) const LONGEST: f64 = STEP * (CANDIDATES / 2) as f64;

    /// How late the scans' stamps are against odometry's \[s\]; 0 while none is known.
    pub(crate) fn lag(&self) -> f64 {
        self.lag
    }

    /// Takes in a turn by the scans \[rad\] over `seconds`. `between` gives what odometry said over the same time, earlier by a lag.
    pub(super) fn learn(&mut self, seconds: f64, turn: f64, between: impl Fn(f64) -> Option<DrivenSums>) {
        for (index, fit) in self.fits.iter_mut().enumerate() {
            let lag = Self::candidate(index);
            let Some(driven) = between(lag) else {
                return;
            };
            fit.add(driven.turn / seconds, turn / seconds, seconds, MEMORY);
        }
        if self.fits[0].excitation() < TURNING {
            return;
        }
        let left = self
            .fits
            .map(|fit| fit.slope().map_or(1.0, |slope| fit.unexplained(slope)));
        let (best, least) =
            left.iter()
                .copied()
                .enumerate()
                .fold((CANDIDATES / 2, f64::INFINITY), |best, next| {
                    if next.1 < best.1 { next } else { best }
                });
        let inside = (1..CANDIDATES - 1).contains(&best);
        if !inside || least > MOST_LEFT || left[CANDIDATES / 2] < BETTER * least {
            self.lag = 0.0;
            return;
        }
        // The vertex of the parabola through the best and its neighbours.
        let (before, after) = (left[best - 1], left[best + 1]);
        let bend = before - 2.0 * least + after;
        let offset = if bend > 1e-12 {
            0.5 * (before - after) / bend
        } else {
            0.0
        };
        let lag = Self::candidate(best) + offset.clamp(-0.5, 0.5) * STEP;
        // Steady, so that the pose does not jump about with it.
        if lag.abs() < SMALL {
            self.lag = 0.0;
        } else if (lag - self.lag).abs() > 0.5 * STEP {
            self.lag = lag;
        }
    }

    fn candidate(index: usize) -> f64 {
        (index as f64 - (CANDIDATES / 2) as f64) * STEP
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The lag found in half a minute of bends, of odometry that turns `scale` times as far.
    fn found(lag: f64, scale: f64) -> f64 {
        let heading = |t: f64| (0.9 * t).sin() + 0.4 * (2.3 * t + 1.0).sin();
        let mut check = ScanLag::default();
        for step in 0..300 {
            let (from, to) = (f64::from(step) * 0.1, f64::from(step + 1) * 0.1);
            let odometry = |tried: f64| DrivenSums {
                // The stamps say `to`, and the scan was measured `lag` before.
                turn: scale * (heading(to - tried) - heading(from - tried)),
                ..DrivenSums::default()
            };
            check.learn(0.1, heading(to - lag) - heading(from - lag), |tried| {
                Some(odometry(tried))
            });
        }
        check.lag()
    }

    #[test]
    fn a_lag_is_found_in_both_directions() {
        for lag in [-0.1, -0.02, 0.018_75, 0.05, 0.1] {
            assert!(
                (found(lag, 1.0) - lag).abs() < 0.003,
                "{lag}: {}",
                found(lag, 1.0)
            );
            assert!(
                (found(lag, 0.8) - lag).abs() < 0.003,
                "{lag}: {}",
                found(lag, 0.8)
            );
        }
    }

    #[test]
    fn without_a_lag_there_is_none() {
        assert_eq!(found(0.0, 1.0).to_bits(), 0.0f64.to_bits());
        assert_eq!(found(0.008, 0.7).to_bits(), 0.0f64.to_bits());
    }
}
