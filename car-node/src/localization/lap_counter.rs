//! Laps along a raceline.

use maps::{Raceline, TrackPosition};
use synpf::Stamp;

/// The start line is crossed when `s` changes by more than this share of the track's length in one step.
const WRAP: f64 = 0.5;

/// A crossing of the start line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// The lap that ended; 0 for the first crossing, which ends no whole lap.
    pub ended: u32,
    /// Its time \[s\]; None for the first crossing.
    pub time: Option<f64>,
}

/// Counts laps.
#[derive(Debug, Default)]
pub struct LapCounter {
    last: Option<(Stamp, f64)>,
    begun_at: Option<Stamp>,
    /// Laps begun; 0 before the first crossing.
    begun: u32,
    /// Crossings in reverse. Each cancels one crossing forwards.
    reversed: u32,
}

impl LapCounter {
    /// Laps begun; 0 before the first crossing of the start line.
    pub fn laps(&self) -> u32 {
        self.begun
    }

    /// The localizer got a new pose: the step to it does not count as motion.
    pub fn on_new_pose(&mut self) {
        self.last = None;
    }

    /// Adds a position. Returns a crossing of the start line, at its interpolated time.
    pub fn on_position(&mut self, stamp: Stamp, at: TrackPosition, line: &Raceline) -> Option<Crossing> {
        let length = line.length();
        let (last_stamp, last_s) = self.last.replace((stamp, at.s))?;
        let step = at.s - last_s;
        if step > WRAP * length {
            self.reversed += 1;
            return None;
        }
        if step > -WRAP * length {
            return None;
        }
        if self.reversed > 0 {
            self.reversed -= 1;
            return None;
        }
        let driven = step + length;
        let share = if driven > 0.0 {
            (length - last_s) / driven
        } else {
            1.0
        };
        let crossed = last_stamp.plus(share * stamp.since(last_stamp));
        let crossing = Crossing {
            ended: self.begun,
            time: self.begun_at.map(|begun| crossed.since(begun)),
        };
        self.begun_at = Some(crossed);
        self.begun += 1;
        Some(crossing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn circle() -> Raceline {
        let points: Vec<[f64; 2]> = (0..100)
            .map(|i| {
                let (sin, cos) = (f64::from(i) / 100.0 * std::f64::consts::TAU).sin_cos();
                [5.0 * cos, 5.0 * sin]
            })
            .collect();
        Raceline::through(&points, 3.0).expect("a line")
    }

    /// Drives along `arc(t)` with 40 positions a second, and returns all crossings.
    fn drive(seconds: f64, arc: impl Fn(f64) -> f64) -> Vec<Crossing> {
        let (line, mut laps) = (circle(), LapCounter::default());
        (0..(seconds * 40.0) as usize)
            .filter_map(|i| {
                let t = i as f64 / 40.0;
                let at = TrackPosition {
                    s: line.wrap(arc(t)),
                    ..line.project([5.0, 0.0])
                };
                laps.on_position(Stamp(0).plus(t), at, &line)
            })
            .collect()
    }

    #[test]
    fn lap_times_follow_from_the_speed() {
        let length = circle().length();
        let crossings = drive(40.0, |t| 3.0 * t + 10.0);
        let first = crossings.first().expect("one");
        assert_eq!((first.ended, first.time), (0, None));
        for (lap, crossing) in crossings.iter().enumerate().skip(1) {
            assert_eq!(crossing.ended as usize, lap);
            let time = crossing.time.expect("a whole lap");
            assert!((time - length / 3.0).abs() < 1e-3, "{time}");
        }
        assert_eq!(crossings.len(), ((3.0 * 40.0 + 10.0) / length) as usize);
    }

    #[test]
    fn standing_on_the_start_line_counts_one_lap_at_most() {
        let crossings = drive(10.0, |t| 0.02 * (40.0 * t).sin());
        assert!(crossings.len() <= 1, "{crossings:?}");
    }
}
