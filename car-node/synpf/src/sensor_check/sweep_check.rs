//! Whether a scan without `time_increment` was measured at one time or as a sweep: by which of both it fits the map.

/// Compares the fit of both readings, scan by scan, until one of them is clearly better.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct SweepCheck {
    scans: u32,
    /// Sum of the differences of the fit, as a sweep less at one time, and of their squares.
    gain: f64,
    squares: f64,
    sweep: Option<bool>,
}

/// Least scans to decide by.
const LEAST_SCANS: u32 = 8;

/// The mean difference must be this many times its own standard deviation. Scans after each other err together, so that five
/// are worth no more than two or three.
const SURE: f64 = 6.0;

/// After so many scans without a decision the scan is taken as it is stated.
const MOST_SCANS: u32 = 400;

/// A sweep of a car that moves by less is a scan at one time \[m\], \[rad\].
const MOVES: [f64; 2] = [0.02, 0.01];

impl SweepCheck {
    pub(crate) fn is_sweep(&self) -> bool {
        self.sweep == Some(true)
    }

    pub(crate) fn is_decided(&self) -> bool {
        self.sweep.is_some()
    }

    /// Whether a car with this speed [m/s] and yaw rate [rad/s] moves enough in a sweep of `seconds` to tell.
    pub(crate) fn can_tell(speed: f64, yaw_rate: f64, seconds: f64) -> bool {
        (speed * seconds).abs() > MOVES[0] || (yaw_rate * seconds).abs() > MOVES[1]
    }

    /// Takes in how well one scan fits the map, read both ways, each in [0, 1].
    pub(crate) fn learn(&mut self, at_one_time: f64, as_sweep: f64) {
        let gain = as_sweep - at_one_time;
        self.scans += 1;
        self.gain += gain;
        self.squares += gain * gain;
        let scans = f64::from(self.scans);
        let mean = self.gain / scans;
        let deviation = ((self.squares / scans - mean * mean).max(0.0) / scans).sqrt();
        if self.scans >= LEAST_SCANS && mean.abs() > SURE * deviation {
            self.sweep = Some(mean > 0.0);
        } else if self.scans >= MOST_SCANS {
            self.sweep = Some(false);
        }
    }

    /// What was compared at a pose that is given up says nothing.
    pub(crate) fn forget_pose(&mut self) {
        if self.sweep.is_none() {
            *self = Self::default();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_better_fit_decides() {
        for (gain, expected) in [(0.05, true), (-0.05, false)] {
            let mut check = SweepCheck::default();
            for scan in 0..20 {
                let scatter = if scan % 2 == 0 { 0.02 } else { -0.02 };
                check.learn(0.8, 0.8 + gain + scatter);
            }
            assert_eq!(check.sweep, Some(expected));
        }
    }

    #[test]
    fn equal_fits_decide_nothing_for_long() {
        let mut check = SweepCheck::default();
        for scan in 0..100 {
            check.learn(0.8, if scan % 2 == 0 { 0.81 } else { 0.79 });
        }
        assert_eq!(check.sweep, None);
    }
}
