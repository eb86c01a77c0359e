//! Standstill, recognised from scans: odometry that creeps while nothing in view moves.

use localizer::{Scan, SensorFinding, SensorFindings};
use maps::Pose;

use super::{DrivenSums, ScanGeometry};

/// Holds scans against one from the time when the car became slow: do they look as if it had moved since, or not?
#[derive(Debug, Clone, Default)]
pub(super) struct Standstill {
    /// Readings of that scan \[m\]; empty without one.
    ranges: Vec<f32>,
    /// The sums at that time.
    driven: DrivenSums,
    standing: bool,
    /// Speed of the wheels [m/s].
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

    /// Log of the likelihood of the scan where the laser has not moved over that where it has moved by `laser`.
    fn log_odds_of_standing(&self, scan: &Scan, geometry: &ScanGeometry, laser: Pose) -> f64 {
        let stride = (scan.ranges.len() / READINGS).max(1);
        let valid = |range: f32| {
            let range = f64::from(range);
            range > scan.range_min.max(0.05) && range < geometry.range_max.min(100.0)
        };
        let direction = |i: usize| (scan.angle_min + geometry.angle_increment * i as f64).sin_cos();
        let (mut count, mut still, mut moved) = (0usize, 0.0, 0.0);
        // Squares of what both explanations leave, and of how an error of the wall's direction adds to the second.
        let mut terms = [[0.0f64; 3]; 2 * READINGS];
        for i in (0..scan.ranges.len()).step_by(stride) {
            let spacing = f64::from(self.ranges[i]) * geometry.angle_increment.abs();
            let beside = ((WALL / spacing.max(1e-4)).ceil() as usize).clamp(1, WALL_BEAMS);
            let (Some(first), last) = (i.checked_sub(beside), i + beside) else {
                continue;
            };
            if last >= scan.ranges.len() || count == terms.len() {
                continue;
            }
            let (before, here, after) = (self.ranges[first], self.ranges[i], self.ranges[last]);
            if ![before, here, after, scan.ranges[i]].into_iter().all(valid) {
                continue;
            }
            let point = |i: usize, range: f32| {
                let (sin, cos) = direction(i);
                [f64::from(range) * cos, f64::from(range) * sin]
            };
            let (a, b) = (point(first, before), point(last, after));
            let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
            let length = dx.hypot(dy).max(1e-9);
            let normal = [-dy / length, dx / length];
            let (sin, cos) = direction(i);
            let (turn_sin, turn_cos) = laser.heading.sin_cos();
            let beam = [cos * turn_cos - sin * turn_sin, cos * turn_sin + sin * turn_cos];
            let slope = normal[0] * beam[0] + normal[1] * beam[1];
            if slope.abs() < FLAT {
                continue;
            }
            let here = f64::from(here);
            let off_wall = normal[0] * (here * cos - laser.x) + normal[1] * (here * sin - laser.y);
            let expected = off_wall / slope;
            let now = f64::from(scan.ranges[i]);
            // By how much the reading changes where the wall is turned a little.
            let along = (laser.x * dx + laser.y * dy) / length;
            let by_direction = 2.0 * (along / (slope * length)).powi(2);
            terms[count] = [(now - here).powi(2), (now - expected).powi(2), by_direction];
            count += 1;
        }
        if count < LEAST_READINGS {
            return 0.0;
        }
        // The noise as the better explanation leaves it, with what moves in view left out.
        let mean = |k: usize| {
            let mut squares = terms;
            let squares = &mut squares[..count];
            squares.sort_unstable_by(|a, b| a[k].total_cmp(&b[k]));
            // Of normal noise the smaller half of the squares has a mean of 0.14 variances.
            squares[..count / 2].iter().map(|term| term[k]).sum::<f64>() / (count / 2) as f64 / 0.14
        };
        let variance = mean(0).min(mean(1)).max(2.0 * NOISE * NOISE);
        // Beyond three standard deviations it is another thing in view.
        let capped = |square: f64| square.min(9.0);
        for &[stood, drove, by_direction] in &terms[..count] {
            // Half of the variance is one scan's, by which the direction errs.
            let wider = 1.0 + 0.5 * by_direction;
            still += capped(stood / variance);
            moved += capped(drove / (variance * wider)) + wider.ln();
        }
        0.5 * (moved - still)
    }

    pub(super) fn report(&self, findings: &mut SensorFindings) {
        if self.standing && self.creep.abs() > 1e-3 {
            findings.insert(SensorFinding::Creep, self.creep);
        }
    }
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

    #[test]
    fn between_walls_that_look_the_same_everywhere_nothing_is_decided() {
        assert!(!after(-0.1, true).standing);
        assert!(!after(0.0, true).standing);
    }
}
