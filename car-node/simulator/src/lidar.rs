//! The laser scanner: one beam after the other while the car moves.

use std::f64::consts::PI;
use std::time::Duration;

use maps::Pose;
use rand::RngExt;
use rand::rngs::StdRng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::{Hit, Obstacle, Walls};

/// A scanner's parameters. The defaults are a Hokuyo UST-10LX (its data sheet; 1081 beams over 270 degrees at 40 Hz, of
/// which the sweep takes three quarters).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LidarParams {
    /// Beams in a scan.
    pub beams: usize,
    /// From the first to the last beam, symmetric about straight ahead \[rad\].
    pub field_of_view: f64,
    /// From one scan's first beam to the next one's.
    pub period: Duration,
    /// From the first to the last beam of a scan.
    pub sweep: Duration,
    /// Shortest valid range \[m\].
    pub range_min: f64,
    /// Longest range \[m\].
    pub range_max: f64,
    /// Standard deviation of a range \[m\].
    pub noise: f64,
    /// Standard deviation of a beam's direction \[rad\]. It models the beam's width: grazing beams become noisy and edges
    /// ragged.
    pub jitter: f64,
    /// Share of the beams lost at random.
    pub dropout: f64,
    /// Returned power (reflectance x cosine of incidence / squared range \[1/m^2\]) at which half the beams are lost. The
    /// data sheet's 30 m on white paper is 0.001.
    pub half_power: f64,
    /// Pose of the scanner on the car.
    pub base_link_from_laser: Pose,
    /// Shortest time from a scan's last beam to its arrival.
    pub transport: Duration,
    /// Largest random addition to `transport`. Real cars log scans 17 to 22 ms after their stamp.
    pub transport_jitter: Duration,
}

impl Default for LidarParams {
    fn default() -> Self {
        Self {
            beams: 1081,
            field_of_view: 1.5 * PI,
            period: Duration::from_millis(25),
            sweep: Duration::from_micros(18_750),
            range_min: 0.06,
            range_max: 30.0,
            noise: 0.015,
            jitter: 0.001,
            dropout: 0.003,
            half_power: 0.001,
            base_link_from_laser: Pose {
                x: 0.27,
                y: 0.0,
                heading: 0.0,
            },
            transport: Duration::from_micros(500),
            transport_jitter: Duration::from_micros(2500),
        }
    }
}

impl LidarParams {
    /// Probability that such a beam has no return: a detector with a soft threshold on the returned power.
    pub(crate) fn loss(&self, hit: &Hit) -> f64 {
        let distance = hit.range.max(0.5);
        let power = hit.surface.reflectance() * hit.incidence / (distance * distance);
        let ratio = power / self.half_power;
        // A logistic curve over the logarithm of the power, of slope 4.
        let faint = 1.0 / (1.0 + ratio.powi(4));
        self.dropout + (1.0 - self.dropout) * faint
    }
}

/// One sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct Scan {
    /// When the first beam was measured, since the start of the race.
    pub stamp: Duration,
    /// Direction of the first beam in the laser's frame \[rad\].
    pub angle_min: f64,
    /// From one beam to the next \[rad\].
    pub angle_increment: f64,
    /// From one beam to the next \[s\].
    pub time_increment: f64,
    /// Shortest valid range \[m\].
    pub range_min: f64,
    /// Longest valid range \[m\].
    pub range_max: f64,
    /// A range for each beam \[m\]; infinite where there was no return.
    pub ranges: Vec<f32>,
}

/// A running scanner.
#[derive(Debug)]
pub struct Lidar {
    params: LidarParams,
    rng: StdRng,
    /// When the current scan's first beam is due.
    stamp: Duration,
    ranges: Vec<f32>,
}

impl Lidar {
    /// A scanner that starts its first sweep at `start`.
    pub fn new(params: LidarParams, start: Duration, rng: StdRng) -> Self {
        Self {
            ranges: Vec::with_capacity(params.beams),
            stamp: start,
            params,
            rng,
        }
    }

    /// The scanner's parameters.
    pub fn params(&self) -> &LidarParams {
        &self.params
    }

    /// Measures every beam that is due in `[from, to)`, while `map_from_base_link` moves evenly from the first to the
    /// second pose. Returns a scan and its time of arrival once its last beam is measured.
    pub fn sense(
        &mut self,
        [from, to]: [Duration; 2],
        poses: [Pose; 2],
        walls: &Walls,
        others: &[Obstacle],
    ) -> Option<(Duration, Scan)> {
        let laser = poses.map(|pose| pose * self.params.base_link_from_laser);
        let turn = maps::wrap_angle(laser[1].heading - laser[0].heading);
        let per_beam = self.params.sweep.as_secs_f64() / (self.params.beams - 1) as f64;
        let increment = self.params.field_of_view / (self.params.beams - 1) as f64;
        let span = to.saturating_sub(from).as_secs_f64();
        while self.ranges.len() < self.params.beams {
            let beam = self.ranges.len() as f64;
            let due = self.stamp + Duration::from_secs_f64(beam * per_beam);
            if due >= to {
                return None;
            }
            let t = (due.as_secs_f64() - from.as_secs_f64()) / span;
            let origin = [
                laser[0].x + t * (laser[1].x - laser[0].x),
                laser[0].y + t * (laser[1].y - laser[0].y),
            ];
            let angle = laser[0].heading + t * turn + beam * increment - self.params.field_of_view / 2.0;
            let range = self.measure(origin, angle, walls, others);
            self.ranges.push(range);
        }
        let scan = Scan {
            stamp: self.stamp,
            angle_min: -self.params.field_of_view / 2.0,
            angle_increment: increment,
            time_increment: per_beam,
            range_min: self.params.range_min,
            range_max: self.params.range_max,
            ranges: std::mem::replace(&mut self.ranges, Vec::with_capacity(self.params.beams)),
        };
        let jitter = self.params.transport_jitter.mul_f64(self.rng.random());
        let arrival = self.stamp + self.params.sweep + self.params.transport + jitter;
        self.stamp += self.params.period;
        Some((arrival, scan))
    }

    /// One beam.
    fn measure(&mut self, origin: [f64; 2], angle: f64, walls: &Walls, others: &[Obstacle]) -> f32 {
        let rng = &mut self.rng;
        let mut normal = || -> f64 { StandardNormal.sample(rng) };
        let (sin, cos) = (angle + self.params.jitter * normal()).sin_cos();
        let noise = self.params.noise * normal();
        let luck: f64 = self.rng.random();
        let direction = [cos, sin];
        let wall = walls.cast(origin, direction, self.params.range_max);
        let hit = others
            .iter()
            .filter_map(|other| other.cast(origin, direction))
            .chain(wall)
            .min_by(|a, b| a.range.total_cmp(&b.range));
        let Some(hit) = hit.filter(|hit| hit.range <= self.params.range_max) else {
            return f32::INFINITY;
        };
        if luck < self.params.loss(&hit) {
            return f32::INFINITY;
        }
        // The device reports whole millimetres.
        let range = ((hit.range + noise) * 1000.0).round() / 1000.0;
        if range < self.params.range_min {
            f32::INFINITY
        } else {
            range as f32
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Surface, Wall};
    use rand::SeedableRng;

    const TICK: Duration = Duration::from_micros(2500);

    fn room(surface: Surface) -> Walls {
        let points = vec![[-3.0, -2.0], [3.0, -2.0], [3.0, 2.0], [-3.0, 2.0], [-3.0, -2.0]];
        Walls::new(vec![Wall { surface, points }])
    }

    /// The first scan of a laser at the middle of the room that moves at `speed` \[m/s\] along x.
    fn scan(params: LidarParams, walls: &Walls, others: &[Obstacle], speed: f64) -> Scan {
        let mut lidar = Lidar::new(params, Duration::ZERO, StdRng::seed_from_u64(1));
        let mount = params.base_link_from_laser.inverse();
        for tick in 0..20 {
            let times = [TICK * tick, TICK * (tick + 1)];
            let poses = times.map(|t| Pose::new(speed * t.as_secs_f64(), 0.0, 0.0) * mount);
            if let Some((arrival, scan)) = lidar.sense(times, poses, walls, others) {
                assert!(arrival >= scan.stamp + params.sweep);
                return scan;
            }
        }
        panic!("no scan in 50 ms");
    }

    fn perfect() -> LidarParams {
        LidarParams {
            noise: 0.0,
            jitter: 0.0,
            dropout: 0.0,
            half_power: 1e-12,
            ..LidarParams::default()
        }
    }

    #[test]
    fn a_still_perfect_laser_measures_the_room() {
        let scan = scan(perfect(), &room(Surface::Plain), &[], 0.0);
        assert_eq!(scan.ranges.len(), 1081);
        for (beam, expected) in [(540, 3.0), (540 + 360, 2.0), (540 - 360, 2.0)] {
            assert!((scan.ranges[beam] - expected).abs() < 0.0006);
        }
    }

    #[test]
    fn the_sweep_smears_what_a_moving_laser_sees() {
        // Straight ahead is measured half a sweep after the stamp: 9.4 ms at 7 m/s are 6.6 cm.
        let scan = scan(perfect(), &room(Surface::Plain), &[], 7.0);
        let expected = 3.0 - 7.0 * 0.018_75 / 2.0;
        assert!((f64::from(scan.ranges[540]) - expected).abs() < 0.001);
    }

    #[test]
    fn noise_has_its_standard_deviation() {
        let params = LidarParams {
            dropout: 0.0,
            ..LidarParams::default()
        };
        let walls = room(Surface::Plain);
        let exact = scan(perfect(), &walls, &[], 0.0);
        let noisy = scan(params, &walls, &[], 0.0);
        // Beams near the normal, where direction hardly matters.
        let errors: Vec<f64> = (500..580)
            .map(|i| f64::from(noisy.ranges[i] - exact.ranges[i]))
            .collect();
        let sigma = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        // 80 samples pin a standard deviation to 8 %; three times that is allowed.
        assert!((sigma / params.noise - 1.0).abs() < 0.24, "{sigma}");
    }

    #[test]
    fn beams_to_black_walls_are_lost() {
        let lost = |surface| {
            let scan = scan(LidarParams::default(), &room(surface), &[], 0.0);
            scan.ranges.iter().filter(|r| r.is_infinite()).count()
        };
        assert!(lost(Surface::Plain) < 20);
        let black = lost(Surface::Black);
        assert!(black > 60, "{black} of 1081");
    }

    #[test]
    fn beams_that_graze_a_wall_are_lost() {
        // A corridor 2 m wide: its wall returns where it is met at 20 degrees, 3 m away, and not at 3 degrees, 19 m away.
        let points = vec![
            [-29.0, -1.0],
            [29.0, -1.0],
            [29.0, 1.0],
            [-29.0, 1.0],
            [-29.0, -1.0],
        ];
        let walls = Walls::new(vec![Wall {
            surface: Surface::Plain,
            points,
        }]);
        let lossless = scan(perfect(), &walls, &[], 0.0);
        let real = scan(LidarParams::default(), &walls, &[], 0.0);
        let lost = |scan: &Scan, degrees: usize| {
            let middle = 540 + 4 * degrees;
            let beams = &scan.ranges[middle - 4..=middle + 4];
            beams.iter().filter(|range| range.is_infinite()).count()
        };
        assert_eq!([20, 3].map(|degrees| lost(&lossless, degrees)), [0, 0]);
        assert!(lost(&real, 20) <= 1 && lost(&real, 3) >= 7);
    }

    #[test]
    fn as_many_beams_drop_out_as_set() {
        let params = LidarParams {
            dropout: 0.1,
            ..perfect()
        };
        let scan = scan(params, &room(Surface::Plain), &[], 0.0);
        let lost = scan.ranges.iter().filter(|range| range.is_infinite()).count();
        // 108 of 1081 with a standard deviation of 10; three are allowed.
        assert!((78..139).contains(&lost), "{lost}");
    }

    #[test]
    fn another_car_stands_in_view() {
        let other = Obstacle {
            map_from_centre: Pose::new(1.5, 0.0, 1.0),
            half: [0.25, 0.14],
        };
        let scan = scan(perfect(), &room(Surface::Plain), &[other], 0.0);
        assert!((1.2..1.5).contains(&scan.ranges[540]));
        assert!((scan.ranges[540 + 360] - 2.0).abs() < 0.001);
    }
}
