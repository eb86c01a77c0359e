//! Standstill, recognised from scans: odometry that creeps while nothing in view moves.

use localizer::{Scan, SensorFinding, SensorFindings};
use maps::Pose;
use nalgebra::{Matrix3, Vector3};

use super::{DrivenSums, ScanGeometry};

/// Holds scans against one from the time when the car became slow: do they look as if it had moved since, or not?
#[derive(Debug, Clone, Default)]
pub(super) struct Standstill {
    /// Readings of that scan \[m\]; empty without one.
    ranges: Vec<f32>,
    /// The sums at that time.
    driven: DrivenSums,
    standing: bool,
    /// Speed of the car by odometry [m/s].
    creep: f64,
}

/// Odometry of a car at standstill creeps more slowly [m/s]: a speed controller's offset is about a tenth.
const SLOW: f64 = 0.3;

/// A motion is judged when odometry claims this much of it \[m\], \[rad\].
const CLAIMED: [f64; 2] = [0.02, 0.01];

/// ...and given up for judging, when it claims so much \[m\].
const TOO_FAR: f64 = 0.1;

/// Readings that are compared, at most.
const READINGS: usize = 120;

/// Fewer say nothing.
const LEAST_READINGS: usize = 20;

/// Range noise of a good laser \[m\].
const NOISE: f64 = 0.01;

/// By how much the likelihood of one explanation must exceed the other's, as a logarithm.
const SURE: f64 = 12.0;

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

impl Standstill {
    pub(super) fn stands(
        &mut self,
        scan: &Scan,
        geometry: &ScanGeometry,
        base_link_from_laser: Pose,
        driven: &DrivenSums,
        speed: f64,
    ) -> bool {
        self.creep = speed;
        if speed.abs() >= SLOW {
            self.standing = false;
            self.ranges.clear();
            return false;
        }
        if self.ranges.len() != scan.ranges.len() {
            self.ranges.clone_from(&scan.ranges);
            self.driven = *driven;
            return self.standing;
        }
        let claimed = driven.since(&self.driven);
        if claimed.distance.abs() < CLAIMED[0] && claimed.turn.abs() < CLAIMED[1] {
            return self.standing;
        }
        let motion = Pose::exp([claimed.distance, 0.0, claimed.turn]);
        let laser = base_link_from_laser.inverse() * motion * base_link_from_laser;
        let odds = self.log_odds_of_standing(scan, geometry, laser);
        let decided = odds.abs() > SURE;
        if decided {
            self.standing = odds > 0.0;
        }
        if decided || claimed.distance.abs() > TOO_FAR {
            self.ranges.clone_from(&scan.ranges);
            self.driven = *driven;
        }
        self.standing
    }

    /// Log of the likelihood of the scan where the laser has not moved over that where it has moved by `laser`. Where another
    /// motion explains the scan far better than standing does, over the likelihood of that one.
    fn log_odds_of_standing(&self, scan: &Scan, geometry: &ScanGeometry, laser: Pose) -> f64 {
        let readings = self.readings(scan, geometry);
        if readings.len() < LEAST_READINGS {
            return 0.0;
        }
        let best = best_motion(&readings, laser);
        let motions = [Pose::IDENTITY, laser, best];
        // The noise as the best explanation leaves it, with what moves in view left out.
        let variance = motions
            .map(|motion| typical_square(&readings, motion))
            .into_iter()
            .fold(f64::INFINITY, f64::min)
            .max(2.0 * NOISE * NOISE);
        let [stood, claimed, best] = motions.map(|motion| cost(&readings, motion, variance));
        // The best one fits a little better by its freedom alone.
        if stood - best > 2.0 * SURE {
            0.5 * (best - stood)
        } else {
            0.5 * (claimed - stood)
        }
    }

    /// The readings at which both scans met a wall whose direction is known.
    fn readings(&self, scan: &Scan, geometry: &ScanGeometry) -> Vec<Reading> {
        let stride = (scan.ranges.len() / READINGS).max(1);
        let valid = |range: f32| {
            let range = f64::from(range);
            range > scan.range_min.max(0.05) && range < geometry.range_max.min(100.0)
        };
        let direction = |i: usize| (scan.angle_min + geometry.angle_increment * i as f64).sin_cos();
        let reading = |i: usize| {
            let spacing = f64::from(self.ranges[i]) * geometry.angle_increment.abs();
            let beside = ((WALL / spacing.max(1e-4)).ceil() as usize).clamp(1, WALL_BEAMS);
            let (first, last) = (i.checked_sub(beside)?, i + beside);
            if last >= scan.ranges.len() {
                return None;
            }
            let (before, here, after) = (self.ranges[first], self.ranges[i], self.ranges[last]);
            if ![before, here, after, scan.ranges[i]].into_iter().all(valid) {
                return None;
            }
            let point = |i: usize, range: f32| {
                let (sin, cos) = direction(i);
                [f64::from(range) * cos, f64::from(range) * sin]
            };
            let (a, b) = (point(first, before), point(last, after));
            let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
            let length = dx.hypot(dy).max(1e-9);
            let (sin, cos) = direction(i);
            let reading = Reading {
                beam: [cos, sin],
                before: f64::from(here),
                now: f64::from(scan.ranges[i]),
                wall: [dx / length, dy / length],
                length,
            };
            (reading.slope([cos, sin]).abs() >= FLAT).then_some(reading)
        };
        (0..scan.ranges.len())
            .step_by(stride)
            .filter_map(reading)
            .collect()
    }

    pub(super) fn report(&self, findings: &mut SensorFindings) {
        if self.standing && self.creep.abs() > 1e-3 {
            findings.insert(SensorFinding::Creep, self.creep);
        }
    }
}

/// One direction of the laser, in both scans.
#[derive(Debug, Clone, Copy)]
struct Reading {
    /// Unit vector along the beam.
    beam: [f64; 2],
    /// Range in the earlier scan and in this one \[m\].
    before: f64,
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
        let to_wall = self.slope([self.before * x - motion.x, self.before * y - motion.y]);
        // An error of the wall's direction counts with the way along the wall; half of the variance is one scan's.
        let along = motion.x * self.wall[0] + motion.y * self.wall[1];
        let wider = 1.0 + (along / (slope * self.length)).powi(2);
        Some((self.now - to_wall / slope, wider))
    }
}

/// Beyond three standard deviations it is another thing in view.
fn cost(readings: &[Reading], motion: Pose, variance: f64) -> f64 {
    let of = |reading: &Reading| {
        reading.off(motion).map_or(9.0, |(off, wider)| {
            (off * off / (variance * wider)).min(9.0) + wider.ln()
        })
    };
    readings.iter().map(of).sum()
}

/// Variance of the ranges about what `motion` explains, told from the smaller half of the squares.
fn typical_square(readings: &[Reading], motion: Pose) -> f64 {
    let mut squares: Vec<f64> = readings
        .iter()
        .map(|reading| reading.off(motion).map_or(f64::INFINITY, |(off, _)| off * off))
        .collect();
    let half = squares.len() / 2;
    squares.select_nth_unstable_by(half, f64::total_cmp);
    // Of normal noise the smaller half of the squares has a mean of 0.14 variances.
    squares[..half].iter().sum::<f64>() / half.max(1) as f64 / 0.14
}

/// The motion of the laser that explains the readings best, near `claimed`: least squares that count far ones less.
fn best_motion(readings: &[Reading], claimed: Pose) -> Pose {
    let mut best = claimed;
    for _ in 0..FITS {
        let mut information = Matrix3::from_diagonal(&Vector3::repeat(1e-6));
        let mut sum = Vector3::zeros();
        for reading in readings {
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
            return claimed;
        };
        best = Pose::new(best.x + step[0], best.y + step[1], best.heading + step[2]);
        if !best.is_finite() {
            return claimed;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use localizer::{SensorFindings, Stamp};

    /// A room of 6 x 4 m seen from `x` along it, with some noise that repeats after many scans.
    fn scan(x: f64, corridor: bool, number: u32) -> Scan {
        let beams = 541;
        let half = if corridor { 1e3 } else { 3.0 };
        let increment = 1.5 * std::f64::consts::PI / 540.0;
        let ranges = (0..beams).map(|i| {
            let (sin, cos) = (-0.75 * std::f64::consts::PI + increment * f64::from(i)).sin_cos();
            let ahead = if cos > 0.0 {
                (half - x) / cos
            } else {
                (half + x) / -cos
            };
            let noise =
                ((f64::from(i) * 12.9898 + f64::from(number) * 78.233).sin() * 43_758.547).fract() * 0.02;
            (ahead.min(2.0 / sin.abs()) + noise) as f32
        });
        Scan {
            stamp: Stamp(i64::from(number) * 25_000_000),
            angle_min: -0.75 * std::f64::consts::PI,
            angle_increment: increment,
            time_increment: 0.0,
            scan_time: None,
            angle_max: None,
            range_min: 0.06,
            range_max: 20.0,
            ranges: ranges.collect(),
        }
    }

    /// After 2 s in which odometry creeps at -0.1 m/s and the car moves at `speed`.
    fn after(speed: f64, corridor: bool) -> Standstill {
        let mut check = Standstill::default();
        for number in 0..80 {
            let t = f64::from(number) * 0.025;
            let scan = scan(speed * t, corridor, number);
            let geometry = ScanGeometry {
                angle_increment: scan.angle_increment,
                time_increment: 0.0,
                range_max: 20.0,
                alternative: None,
                lag: 0.0,
            };
            let driven = DrivenSums {
                distance: -0.1 * t,
                ..DrivenSums::default()
            };
            check.stands(&scan, &geometry, Pose::new(0.27, 0.0, 0.0), &driven, -0.1);
        }
        check
    }

    #[test]
    fn odometry_that_creeps_at_standstill_is_found() {
        let check = after(0.0, false);
        let mut findings = SensorFindings::default();
        check.report(&mut findings);
        assert!(check.standing);
        let creep = findings.get(SensorFinding::Creep).expect("found");
        assert!((creep + 0.1).abs() < 1e-6);
    }

    #[test]
    fn a_car_that_crawls_is_not_held() {
        assert!(!after(-0.1, false).standing);
    }

    /// Wheels that lock say that the car only turns. It slides on, and side walls look the same: it was held.
    #[test]
    fn a_car_that_slides_on_is_not_held_though_its_wheels_stand() {
        let mut check = Standstill::default();
        for number in 0..20u32 {
            let t = f64::from(number) * 0.025;
            let scan = scan(5.0 * t, false, number);
            let geometry = ScanGeometry {
                angle_increment: scan.angle_increment,
                time_increment: 0.0,
                range_max: 20.0,
                alternative: None,
                lag: 0.0,
            };
            let driven = DrivenSums {
                turn: 0.6 * t,
                ..DrivenSums::default()
            };
            check.stands(&scan, &geometry, Pose::new(0.27, 0.0, 0.0), &driven, 0.0);
            assert!(!check.standing, "scan {number}");
        }
    }

    #[test]
    fn between_walls_that_look_the_same_everywhere_nothing_is_decided() {
        assert!(!after(-0.1, true).standing);
        assert!(!after(0.0, true).standing);
    }
}
