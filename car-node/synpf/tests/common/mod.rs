//! A track and a drive around it, made from nothing but geometry.

use std::f64::consts::{PI, TAU};
use std::sync::{Arc, OnceLock};

use maps::{Cell, OccupancyGrid, Pose};
use synpf::{Odometry, Scan, Stamp, TrackMap, Twist};

/// Where the laser sits on the car.
pub(crate) const BASE_LINK_FROM_LASER: Pose = Pose {
    x: 0.27,
    y: 0.0,
    heading: 0.0,
};

/// Speed of the drive [m/s].
pub(crate) const SPEED: f64 = 5.0;

/// Radius of the track's middle at an angle around its centre [m]: a ring with five unequal bulges, so that no
/// place looks like another.
fn radius(angle: f64) -> f64 {
    7.0 + 0.7 * (2.0 * angle).sin() + 0.35 * (5.0 * angle + 1.0).cos() + 0.3 * (3.0 * angle).cos()
}

/// The track, shared by all tests of a process.
pub(crate) fn ring() -> Arc<TrackMap> {
    static RING: OnceLock<Arc<TrackMap>> = OnceLock::new();
    Arc::clone(RING.get_or_init(new_ring))
}

/// A ring 2.4 m wide on a grid of 0.05 m whose origin is turned, with tables of its own.
pub(crate) fn new_ring() -> Arc<TrackMap> {
    let (size, resolution) = (400usize, 0.05);
    let middle = size as f64 * resolution / 2.0;
    let cell = |column: usize, row: usize| {
        let [x, y] = [column, row].map(|v| (v as f64 + 0.5) * resolution - middle);
        let off = x.hypot(y) - radius(y.atan2(x));
        if off.abs() < 1.2 {
            Cell::Free
        } else {
            Cell::Occupied
        }
    };
    let origin = Pose::new(0.0, 0.0, 0.5) * Pose::new(-middle, -middle, 0.0);
    Arc::new(
        TrackMap::new(OccupancyGrid::from_fn(size, size, resolution, origin, cell)).expect("a ring is free"),
    )
}

/// The true pose after `seconds` of driving, counter-clockwise.
pub(crate) fn truth(seconds: f64) -> Pose {
    let at = |angle: f64| [radius(angle) * angle.cos(), radius(angle) * angle.sin()];
    let angle = SPEED * seconds / 7.0;
    let ([x, y], [x2, y2]) = (at(angle), at(angle + 1e-5));
    Pose::new(0.0, 0.0, 0.5) * Pose::new(x, y, (y2 - y).atan2(x2 - x))
}

/// Odometry at a time: the true motion, with a scale error of its own.
pub(crate) fn odometry(seconds: f64, scale: f64) -> Odometry {
    let dt = 1e-3;
    let step = truth(seconds + dt).since(truth(seconds));
    let start = truth(0.0);
    let pose = truth(seconds).since(start);
    Odometry {
        stamp: stamp(seconds),
        pose: Pose::new(pose.x * scale, pose.y * scale, pose.heading),
        twist: Twist {
            linear_x: step.x / dt * scale,
            linear_y: step.y / dt * scale,
            angular: step.heading / dt,
        },
    }
}

/// A scan of 541 beams over 270 deg from where the car is.
pub(crate) fn scan(map: &TrackMap, seconds: f64) -> Scan {
    let laser = truth(seconds) * BASE_LINK_FROM_LASER;
    let increment = 1.5 * PI / 540.0;
    let ranges = (0..541).map(|i| {
        let beam = Pose::new(0.0, 0.0, -0.75 * PI + increment * f64::from(i));
        map.range(laser * beam, 30.0) as f32
    });
    Scan {
        stamp: stamp(seconds),
        angle_min: -0.75 * PI,
        angle_increment: increment,
        time_increment: 0.0,
        scan_time: None,
        angle_max: None,
        range_min: 0.02,
        range_max: 30.0,
        ranges: ranges.collect(),
    }
}

/// Seconds of the drive as a stamp.
pub(crate) fn stamp(seconds: f64) -> Stamp {
    Stamp(1_700_000_000_000_000_000).plus(seconds)
}

/// Time that one lap takes \[s\].
#[allow(dead_code, reason = "not every user of this module needs all of it")]
pub(crate) fn lap() -> f64 {
    TAU * 7.0 / SPEED
}
