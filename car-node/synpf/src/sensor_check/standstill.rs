//! Standstill, recognised from scans: odometry that creeps while nothing in view moves.

use localizer::{Scan, SensorFinding, SensorFindings};
use maps::Pose;

use super::scan_pair::ScanPair;
use super::{DrivenSums, STANDS, ScanGeometry};

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

/// A motion is judged when odometry claims this much of it \[m\], \[rad\].
const CLAIMED: [f64; 2] = [0.02, 0.01];

/// ...and given up for judging, when it claims so much \[m\].
const TOO_FAR: f64 = 0.1;

/// By how much the likelihood of one explanation must exceed the other's, as a logarithm.
const SURE: f64 = 12.0;

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
        if speed.abs() >= STANDS {
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
        let Some(pair) = ScanPair::new(&self.ranges, scan, geometry, 0.0) else {
            return 0.0;
        };
        let motions = [Pose::IDENTITY, laser, pair.best_motion(laser)];
        let Some(variance) = pair.variance(&motions) else {
            return 0.0;
        };
        let [stood, claimed, best] = motions.map(|motion| pair.cost(motion, variance));
        // The best one fits a little better by its freedom alone.
        if stood - best > 2.0 * SURE {
            0.5 * (best - stood)
        } else {
            0.5 * (claimed - stood)
        }
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
    use crate::sensor_check::SensorCheck;
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
            let geometry = SensorCheck::default().geometry(&scan);
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
            let geometry = SensorCheck::default().geometry(&scan);
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
