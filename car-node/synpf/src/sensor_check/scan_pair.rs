//! Two scans compared beam by beam: by which motion of the laser do they differ?

use localizer::Scan;
use maps::Pose;
use nalgebra::{Matrix3, Vector3};

use super::ScanGeometry;

/// The readings at which both scans met a wall whose direction is known.
#[derive(Debug, Clone)]
pub(super) struct ScanPair {
    readings: Vec<Reading>,
}

/// Readings that are compared, at most.
const READINGS: usize = 120;

/// Fewer say nothing.
const LEAST_READINGS: usize = 20;

/// Range noise of a good laser \[m\].
const NOISE: f64 = 0.01;

/// Range noise of a bad one \[m\].
const MOST_NOISE: f64 = 0.1;

/// The direction of a wall is taken over this length to both sides \[m\]...
const WALL: f64 = 0.2;
/// ...but over no more beams than this.
const WALL_BEAMS: usize = 40;

/// A wall at a flatter angle than this to the beam is no reference (sine of it).
const FLAT: f64 = 0.3;

/// Steps of the search for the motion that explains a scan best.
const FITS: usize = 4;

/// Readings that are off by so much count half in it \[m\].
const FAR: f64 = 0.05;

impl ScanPair {
    /// `before` are the ranges \[m\] of an earlier scan of the same geometry, since when the laser has turned by about `turn` \[rad\].
    /// None where too few beams met a wall in both.
    pub(super) fn new(before: &[f32], scan: &Scan, geometry: &ScanGeometry, turn: f64) -> Option<Self> {
        if before.len() != scan.ranges.len() {
            return None;
        }
        let stride = (scan.ranges.len() / READINGS).max(1);
        let valid = |range: f32| {
            let range = f64::from(range);
            range > scan.nearest().max(0.05) && range < geometry.range_max.min(100.0)
        };
        let direction = |i: usize| (scan.angle_min + geometry.angle_increment * i as f64).sin_cos();
        let beams = (turn / geometry.angle_increment).round();
        let shift = if beams.is_finite() { beams as isize } else { 0 };
        let reading = |now: usize| {
            // The beam of the earlier scan in this direction.
            let i = now.checked_add_signed(shift).filter(|&i| i < before.len())?;
            let spacing = f64::from(before[i]) * geometry.angle_increment.abs();
            let beside = ((WALL / spacing.max(1e-4)).ceil() as usize).clamp(1, WALL_BEAMS);
            let (first, last) = (i.checked_sub(beside)?, i + beside);
            if last >= scan.ranges.len() {
                return None;
            }
            let (left, here, right) = (before[first], before[i], before[last]);
            if ![left, here, right, scan.ranges[now]].into_iter().all(valid) {
                return None;
            }
            let point = |i: usize, range: f32| {
                let (sin, cos) = direction(i);
                [f64::from(range) * cos, f64::from(range) * sin]
            };
            let (a, b) = (point(first, left), point(last, right));
            let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
            let length = dx.hypot(dy).max(1e-9);
            let (sin, cos) = direction(now);
            let reading = Reading {
                beam: [cos, sin],
                before: point(i, here),
                now: f64::from(scan.ranges[now]),
                wall: [dx / length, dy / length],
                length,
            };
            let (sin, cos) = direction(i);
            (reading.slope([cos, sin]).abs() >= FLAT).then_some(reading)
        };
        let readings: Vec<_> = (0..scan.ranges.len())
            .step_by(stride)
            .filter_map(reading)
            .collect();
        (readings.len() >= LEAST_READINGS).then_some(Self { readings })
    }

    /// Variance of the ranges as the best of these motions leaves it, with what moves in view left out \[m^2\]. None where each
    /// leaves more than any laser errs: the scans show different walls, and say nothing of the motion.
    pub(super) fn variance(&self, motions: &[Pose]) -> Option<f64> {
        let least = motions
            .iter()
            .map(|motion| self.typical_square(*motion))
            .fold(f64::INFINITY, f64::min);
        (least < 2.0 * MOST_NOISE * MOST_NOISE).then_some(least.max(2.0 * NOISE * NOISE))
    }

    /// Beyond three standard deviations it is another thing in view.
    pub(super) fn cost(&self, motion: Pose, variance: f64) -> f64 {
        let of = |reading: &Reading| {
            reading.off(motion).map_or(9.0, |(off, wider)| {
                (off * off / (variance * wider)).min(9.0) + wider.ln()
            })
        };
        self.readings.iter().map(of).sum()
    }

    /// Variance of the ranges about what `motion` explains, told from the smaller half of the squares.
    fn typical_square(&self, motion: Pose) -> f64 {
        let mut squares: Vec<f64> = self
            .readings
            .iter()
            .map(|reading| reading.off(motion).map_or(f64::INFINITY, |(off, _)| off * off))
            .collect();
        let half = squares.len() / 2;
        squares.select_nth_unstable_by(half, f64::total_cmp);
        // Of normal noise the smaller half of the squares has a mean of 0.14 variances.
        squares[..half].iter().sum::<f64>() / half.max(1) as f64 / 0.14
    }

    /// The motion of the laser that explains the readings best, close to `near`: least squares that count far ones less.
    pub(super) fn best_motion(&self, near: Pose) -> Pose {
        let mut best = near;
        for _ in 0..FITS {
            let mut information = Matrix3::from_diagonal(&Vector3::repeat(1e-6));
            let mut sum = Vector3::zeros();
            for reading in &self.readings {
                let Some((off, _)) = reading.off(best) else {
                    continue;
                };
                let (sin, cos) = best.heading.sin_cos();
                let [x, y] = reading.beam;
                let beam = [x * cos - y * sin, x * sin + y * cos];
                let slope = reading.slope(beam);
                // How the expected range changes with the motion.
                let range = reading.now - off;
                let by_turn = -range * (reading.wall[0] * beam[0] + reading.wall[1] * beam[1]) / slope;
                let by = Vector3::new(reading.wall[1] / slope, -reading.wall[0] / slope, by_turn);
                let weight = 1.0 / (1.0 + (off / FAR).powi(2));
                information += by * by.transpose() * weight;
                sum += by * (off * weight);
            }
            let Some(step) = information.cholesky().map(|root| root.solve(&sum)) else {
                return near;
            };
            best = Pose::new(best.x + step[0], best.y + step[1], best.heading + step[2]);
            if !best.is_finite() {
                return near;
            }
        }
        best
    }
}

/// One direction of the laser, in both scans.
#[derive(Debug, Clone, Copy)]
struct Reading {
    /// Unit vector along the beam of this scan.
    beam: [f64; 2],
    /// Where the beam of the earlier scan ended \[m\], and the range of this one \[m\].
    before: [f64; 2],
    now: f64,
    /// Unit vector along the wall, and the length over which it was taken \[m\].
    wall: [f64; 2],
    length: f64,
}

impl Reading {
    /// Sine of the angle between a beam and the wall.
    fn slope(&self, beam: [f64; 2]) -> f64 {
        self.wall[0] * beam[1] - self.wall[1] * beam[0]
    }

    /// By how much the range differs from what a laser that has moved by `motion` measures \[m\], and its variance, relative to
    /// that of a laser that stands. None where the beam no longer meets the wall.
    fn off(&self, motion: Pose) -> Option<(f64, f64)> {
        let (sin, cos) = motion.heading.sin_cos();
        let [x, y] = self.beam;
        let slope = self.slope([x * cos - y * sin, x * sin + y * cos]);
        if slope.abs() < 0.5 * FLAT {
            return None;
        }
        let to_wall = self.slope([self.before[0] - motion.x, self.before[1] - motion.y]);
        // An error of the wall's direction counts with the way along the wall; half of the variance is one scan's.
        let along = motion.x * self.wall[0] + motion.y * self.wall[1];
        let wider = 1.0 + (along / (slope * self.length)).powi(2);
        Some((self.now - to_wall / slope, wider))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor_check::SensorCheck;
    use localizer::Stamp;

    /// A view of 180 deg onto corners whose distance changes by up to 2 m; another place shows others. Noise of 2 cm.
    fn scan(place: f64, noise: f64) -> Scan {
        let increment = std::f64::consts::PI / 180.0;
        let range = |i: i32| {
            let angle = increment * f64::from(i);
            let random = ((f64::from(i) * 12.9898 + noise * 78.233).sin() * 43_758.547).fract();
            (3.0 + (3.0 * angle + place).sin() + (7.0 * angle + 2.0 * place).cos() + 0.02 * random) as f32
        };
        Scan {
            stamp: Stamp(0),
            angle_min: -0.5 * std::f64::consts::PI,
            angle_increment: increment,
            time_increment: 0.0,
            scan_time: None,
            angle_max: None,
            range_min: 0.06,
            range_max: 20.0,
            ranges: (-90..=90).map(range).collect(),
        }
    }

    fn pair(a: &Scan, b: &Scan) -> ScanPair {
        let geometry = SensorCheck::default().geometry(a);
        ScanPair::new(&a.ranges, b, &geometry, 0.0).expect("walls")
    }

    /// A robot that turned by 20 deg between two scans was held to stand, as that misfitted a little less than its odometry.
    #[test]
    fn scans_that_no_motion_explains_say_nothing() {
        let here = scan(0.0, 1.0);
        let same = pair(&here, &scan(0.0, 2.0));
        let variance = same.variance(&[Pose::IDENTITY]).expect("explained");
        assert!(variance < 0.05f64.powi(2), "{variance}");
        let elsewhere = pair(&here, &scan(2.0, 2.0));
        let motions = [
            Pose::IDENTITY,
            Pose::new(0.1, 0.0, 0.1),
            elsewhere.best_motion(Pose::IDENTITY),
        ];
        assert_eq!(elsewhere.variance(&motions), None);
    }
}
