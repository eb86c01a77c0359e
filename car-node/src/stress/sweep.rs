//! Scans as a slower scanner would sweep them, which states no time between its beams.

use std::collections::VecDeque;
use std::f64::consts::TAU;

use maps::{Pose, wrap_angle};
use synpf::{Scan, Stamp};

use super::sensor_damage::TruePose;

/// Makes sweeps from the scans of a log. A beam of a sweep takes the range of the nearest scan in time, seen from where the
/// laser is by then.
#[derive(Debug)]
pub(super) struct SweepMaker {
    /// From one sweep to the next \[s\].
    period: f64,
    base_link_from_laser: Pose,
    /// The scans that the current sweep may need.
    sources: VecDeque<Source>,
    /// The stamp of the next sweep.
    begin: Option<Stamp>,
}

/// A scan with its end points.
#[derive(Debug)]
struct Source {
    stamp: Stamp,
    time_increment: f64,
    /// In `map`; None for a beam without return.
    ends: Vec<Option<[f64; 2]>>,
}

/// A beam takes end points of beams within this angle \[rad\]: the car turns that far at most between a beam and its source.
const NEIGHBOURS: f64 = 0.1;

impl SweepMaker {
    pub(super) fn new(period: f64, base_link_from_laser: Pose) -> Self {
        Self {
            period,
            base_link_from_laser,
            sources: VecDeque::new(),
            begin: None,
        }
    }

    /// Takes in a scan. Returns a sweep when one is complete.
    pub(super) fn add(&mut self, scan: &Scan, truth: TruePose<'_>) -> Option<Scan> {
        let begin = *self.begin.get_or_insert(scan.stamp);
        let beams = scan.ranges.len();
        let mut laser = truth(scan.stamp)? * self.base_link_from_laser;
        let ends = scan.ranges.iter().enumerate().map(|(beam, range)| {
            if scan.time_increment > 0.0 {
                let at = scan.stamp.plus(scan.time_increment * beam as f64);
                laser = truth(at).map_or(laser, |pose| pose * self.base_link_from_laser);
            }
            let measured = (scan.range_min..scan.range_max).contains(&f64::from(*range));
            let angle = scan.angle_min + beam as f64 * scan.angle_increment;
            measured.then(|| {
                let range = f64::from(*range);
                laser.transform([range * angle.cos(), range * angle.sin()])
            })
        });
        let ends = ends.collect();
        self.sources.push_back(Source {
            stamp: scan.stamp,
            time_increment: scan.time_increment,
            ends,
        });
        // A scanner turns once per period, and sweeps its field of view in that part of it.
        let view = (scan.angle_increment * beams as f64).abs();
        let duration = self.period * (view / TAU).min(1.0);
        if scan.stamp.since(begin) < duration {
            return None;
        }
        let ranges = (0..beams)
            .map(|beam| {
                let at = begin.plus(duration * beam as f64 / beams as f64);
                self.range(scan, beam, at, truth).unwrap_or(f32::INFINITY)
            })
            .collect();
        let mut next = begin.plus(self.period);
        // After a gap of the log, it goes on from the latest scan.
        if scan.stamp.since(next) > self.period {
            next = scan.stamp;
        }
        self.begin = Some(next);
        let needed = |source: &Source| source.stamp.since(next) > -0.1;
        while self.sources.front().is_some_and(|source| !needed(source)) {
            self.sources.pop_front();
        }
        Some(Scan {
            stamp: begin,
            time_increment: 0.0,
            scan_time: Some(self.period),
            ranges,
            ..*scan
        })
    }

    /// The range of a beam at a time, by the end points of the scan whose same beam is nearest in time.
    fn range(&self, scan: &Scan, beam: usize, at: Stamp, truth: TruePose<'_>) -> Option<f32> {
        let laser = (truth(at)? * self.base_link_from_laser).inverse();
        let apart = |source: &&Source| {
            let time = source.stamp.plus(source.time_increment * beam as f64);
            time.since(at).abs()
        };
        let source = self.sources.iter().min_by(|a, b| apart(a).total_cmp(&apart(b)))?;
        let reach = (NEIGHBOURS / scan.angle_increment.abs()).ceil() as usize;
        let beams = beam.saturating_sub(reach)..(beam + reach + 1).min(source.ends.len());
        let angle = scan.angle_min + beam as f64 * scan.angle_increment;
        let seen = source.ends.get(beams)?.iter().flatten().map(|end| {
            let [x, y] = laser.transform(*end);
            (wrap_angle(y.atan2(x) - angle).abs(), x.hypot(y))
        });
        let (off, range) = seen.min_by(|a, b| a.0.total_cmp(&b.0))?;
        (off < 1.5 * scan.angle_increment.abs()).then_some(range as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At 5 m/s along x, beside a wall at y = 2 m.
    #[expect(clippy::unnecessary_wraps, reason = "a truth may be unknown elsewhere")]
    fn truth(stamp: Stamp) -> Option<Pose> {
        Some(Pose::new(5.0 * stamp.since(Stamp(0)), 0.0, 0.0))
    }

    /// The range to a wall across the way at x = 60 m, straight ahead.
    fn ahead(stamp: Stamp) -> f32 {
        60.0 - 5.0 * stamp.since(Stamp(0)) as f32
    }

    fn scan(stamp: Stamp) -> Scan {
        Scan {
            stamp,
            angle_min: -0.02,
            angle_increment: 0.01,
            time_increment: 0.0,
            scan_time: None,
            angle_max: None,
            range_min: 0.05,
            range_max: 100.0,
            ranges: (0..5)
                .map(|beam| ahead(stamp) / (0.01 * (beam as f32 - 2.0)).cos())
                .collect(),
        }
    }

    #[test]
    fn each_beam_of_a_sweep_is_measured_from_where_the_car_is_by_then() {
        // A view of 0.05 rad takes so small a part of a turn that the sweep is stretched to be visible.
        let period = 0.1 * TAU / 0.05;
        let mut maker = SweepMaker::new(period, Pose::IDENTITY);
        let sweep = (0..400)
            .find_map(|tick| maker.add(&scan(Stamp(0).plus(0.025 * f64::from(tick))), &truth))
            .expect("a sweep");
        assert_eq!((sweep.stamp, sweep.time_increment), (Stamp(0), 0.0));
        assert_eq!(sweep.ranges.len(), 5);
        for (beam, range) in sweep.ranges.iter().enumerate() {
            let at = Stamp(0).plus(0.1 * beam as f64 / 5.0);
            let expected = ahead(at) / (0.01 * (beam as f32 - 2.0)).cos();
            assert!((range - expected).abs() < 0.01, "{beam}: {range} {expected}");
        }
    }

    #[test]
    fn without_truth_there_is_no_sweep() {
        let mut maker = SweepMaker::new(0.1, Pose::IDENTITY);
        assert_eq!(maker.add(&scan(Stamp(0)), &|_| None), None);
    }
}
