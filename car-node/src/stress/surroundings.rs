//! What stands around the car and is not on the map: boards, people, other cars.

use maps::Pose;
use rand::rngs::SmallRng;
use rand_distr::{Distribution, StandardNormal};
use synpf::{Scan, Twist};
use xxhash_rust::xxh3::xxh3_64;

/// Boards and groups of people are this long \[m\].
const STRETCH: f64 = 2.0;
/// A board stands this far inside the wall \[m\].
const BOARD: f64 = 0.10;
/// People stand at least this far inside the wall \[m\], and up to 1.6 times as far.
const PERSON: f64 = 0.30;
/// Width of a person \[m\].
const WIDTH: f64 = 0.3;

/// A number from 0 to 1 for each square of an edge of `size` \[m\] around a point.
fn hash(point: [f64; 2], size: f64) -> f64 {
    let [x, y] = point.map(|v| (v / size).floor() as i64);
    let mut bytes = [0; 16];
    bytes[..8].copy_from_slice(&x.to_le_bytes());
    bytes[8..].copy_from_slice(&y.to_le_bytes());
    xxh3_64(&bytes) as f64 / u64::MAX as f64
}

/// Changes every range that is a measurement; `change` gets the end point in `map` \[m\] and the range.
fn on_ends(scan: &mut Scan, map_from_laser: Pose, change: impl Fn([f64; 2], f64) -> f64) {
    let least = scan.range_min.max(0.02);
    for (beam, range) in scan.ranges.iter_mut().enumerate() {
        let measured = f64::from(*range);
        if !(scan.range_min..scan.range_max).contains(&measured) {
            continue;
        }
        let angle = map_from_laser.heading + scan.angle_min + beam as f64 * scan.angle_increment;
        let end = [
            map_from_laser.x + measured * angle.cos(),
            map_from_laser.y + measured * angle.sin(),
        ];
        *range = change(end, measured).max(least) as f32;
    }
}

/// Puts boards before a `share` of the walls.
pub(super) fn boards(scan: &mut Scan, map_from_laser: Pose, share: f64) {
    on_ends(scan, map_from_laser, |end, range| {
        if hash(end, STRETCH) < share {
            range - BOARD
        } else {
            range
        }
    });
}

/// Puts people before a `share` of the walls.
pub(super) fn people(scan: &mut Scan, map_from_laser: Pose, share: f64) {
    on_ends(scan, map_from_laser, |end, range| {
        if hash(end, STRETCH) < share {
            range - PERSON * (1.0 + 0.6 * hash(end, WIDTH))
        } else {
            range
        }
    });
}

/// Half of a car's length and width \[m\].
const CAR: [f64; 2] = [0.25, 0.15];
/// Standard deviation of a range to a car \[m\].
const CAR_NOISE: f64 = 0.02;

/// Where other cars drive, as ways along our own and to the left \[m\]: one, two, or three close ones.
fn places(cars: usize) -> &'static [[f64; 2]] {
    match cars {
        1 => &[[1.6, 0.15]],
        2 => &[[1.3, 0.25], [2.6, -0.2]],
        _ => &[[0.8, 0.12], [0.15, 0.45], [0.15, -0.45]],
    }
}

/// Puts cars around ours, which moves with `twist`.
pub(super) fn cars(
    scan: &mut Scan,
    base_link_from_laser: Pose,
    twist: Twist,
    cars: usize,
    random: &mut SmallRng,
) {
    let curvature = if twist.linear_x.abs() > 0.3 {
        (twist.angular / twist.linear_x).clamp(-1.0, 1.0)
    } else {
        0.0
    };
    for [ahead, left] in places(cars) {
        let car = Pose::exp([*ahead, 0.0, curvature * ahead]) * Pose::new(0.0, *left, 0.0);
        let car_from_laser = car.inverse() * base_link_from_laser;
        for (beam, range) in scan.ranges.iter_mut().enumerate() {
            let angle = scan.angle_min + beam as f64 * scan.angle_increment;
            let Some(hit) = ray_to_box(car_from_laser * Pose::new(0.0, 0.0, angle)) else {
                continue;
            };
            let noise: f64 = StandardNormal.sample(random);
            let hit = (hit + CAR_NOISE * noise) as f32;
            // NaN and infinity are no return, and the car is nearer than that.
            if hit > scan.range_min as f32 && (hit < *range || !range.is_finite()) {
                *range = hit;
            }
        }
    }
}

/// The range along a ray to the box of half edges [`CAR`] around the origin \[m\].
fn ray_to_box(ray: Pose) -> Option<f64> {
    let (sin, cos) = ray.heading.sin_cos();
    let (mut near, mut far) = (0.0_f64, f64::INFINITY);
    for (from, along, half) in [(ray.x, cos, CAR[0]), (ray.y, sin, CAR[1])] {
        if along.abs() < 1e-12 {
            if from.abs() > half {
                return None;
            }
            continue;
        }
        let [a, b] = [(-half - from) / along, (half - from) / along];
        (near, far) = (near.max(a.min(b)), far.min(a.max(b)));
    }
    (near <= far && near > 0.0).then_some(near)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use synpf::Stamp;

    /// A scan of 721 beams all around, all of `range`.
    fn scan(range: f32) -> Scan {
        Scan {
            stamp: Stamp(0),
            angle_min: -std::f64::consts::PI,
            angle_increment: std::f64::consts::TAU / 720.0,
            time_increment: 0.0,
            scan_time: None,
            angle_max: None,
            range_min: 0.05,
            range_max: 30.0,
            ranges: vec![range; 721],
        }
    }

    #[test]
    fn people_and_boards_hide_their_share_of_the_walls_wherever_the_car_is() {
        // A wall all around at 25 m has 157 m, about 80 stretches.
        for laser in [Pose::IDENTITY, Pose::new(40.0, -7.0, 1.0)] {
            let mut with_people = scan(25.0);
            people(&mut with_people, laser, 0.4);
            let hidden = with_people.ranges.iter().filter(|range| **range < 24.8).count();
            assert!((0.2..0.6).contains(&(hidden as f64 / 721.0)), "{hidden}");
            let mut with_boards = scan(25.0);
            boards(&mut with_boards, laser, 1.1);
            assert!(with_boards.ranges.iter().all(|range| (range - 24.9).abs() < 1e-4));
        }
    }

    #[test]
    fn the_same_place_is_hidden_from_two_poses() {
        let end = |scan: &Scan, laser: Pose, beam: usize| {
            let angle = laser.heading + scan.angle_min + beam as f64 * scan.angle_increment;
            [laser.x + 10.0 * angle.cos(), laser.y + 10.0 * angle.sin()]
        };
        let laser = Pose::new(3.0, 2.0, 0.5);
        let mut damaged = scan(10.0);
        boards(&mut damaged, laser, 0.5);
        for beam in 0..721 {
            let hidden = hash(end(&damaged, laser, beam), STRETCH) < 0.5;
            assert_eq!(damaged.ranges[beam] < 9.95, hidden);
        }
    }

    #[test]
    fn a_car_ahead_is_seen_where_it_is_and_nowhere_else() {
        let mut random = SmallRng::seed_from_u64(1);
        let mut damaged = scan(f32::INFINITY);
        damaged.ranges[0] = f32::NAN;
        cars(&mut damaged, Pose::IDENTITY, Twist::default(), 1, &mut random);
        // 0.3 m wide at 1.35 m: about 0.22 rad.
        let hits: Vec<_> = (0..721)
            .filter(|beam| damaged.ranges[*beam].is_finite())
            .collect();
        assert!((22..30).contains(&hits.len()), "{hits:?}");
        assert!(
            hits.iter()
                .all(|beam| (damaged.ranges[*beam] - 1.36).abs() < 0.15)
        );
        // Straight ahead is beam 360, and the car is a little to the left.
        assert!(hits.iter().all(|beam| (355..395).contains(beam)));
    }
}
