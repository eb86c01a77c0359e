//! How far from the map's faces the laser sees the walls.
//!
//! Cartographer's map is made of the laser's own end points. A team's image of it is not: it is thresholded, smoothed and cleaned by
//! hand, and its walls end up a cell or more in front of those that the laser sees. A laser looks ahead, so that all walls
//! seem too far in one direction, and every match stands back by as much, along the drive.

use maps::{DistanceField, Pose};
use nalgebra::{Matrix4, Vector4};

use crate::scan_points::transformed;

/// Farther from the map's faces than so many cells no wall of it stands.
const MOST: f64 = 1.5;

/// End points that are off by more count little \[m\].
const ROBUST: f64 = 0.1;

/// End points that are off by more lie on no wall \[m\].
const ON_WALL: f64 = 0.15;

/// Least share of the end points on walls for the walls to be known by them...
const LEAST_SHARE: f64 = 0.7;

/// ...and least number of them.
const FEWEST: usize = 20;

/// That walls stand as drawn counts as much as this way of seeing them \[m\].
const DRAWN: f64 = 0.5;

const ITERATIONS: usize = 10;

/// The offset, learned while driving.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct WallOffset {
    /// Signed distance from the map's faces at which end points lie \[m\].
    pub(crate) offset: f64,
    /// Way on which it was learned \[m\].
    way: f64,
    /// Where it was last seen.
    last: Option<Pose>,
}

impl WallOffset {
    /// Takes in what the scan at a pose has shown: a mean over the last `distance` driven \[m\]. A car that stands sees the same
    /// again.
    pub(crate) fn learn(&mut self, seen: f64, pose: Pose, distance: f64) {
        let driven = self.last.map_or(0.0, |last| last.distance(pose));
        self.way = (self.way + driven).min(distance);
        self.offset += driven.min(distance) / (self.way + DRAWN) * (seen - self.offset);
        self.last = Some(pose);
    }
}

/// The offset of the walls by one scan near a pose: least squares for both together, since an error of one makes one of the other.
/// None if the scan does not fit.
pub(crate) fn fit_offset(field: &DistanceField, points: &[[f32; 2]], near: Pose, known: f64) -> Option<f64> {
    let cells = 1.0 / field.resolution();
    let (mut pose, mut offset, mut on_walls) = (near, known, 0);
    for _ in 0..ITERATIONS {
        let (sin, cos) = pose.heading.sin_cos();
        let (mut information, mut gradient) = (Matrix4::zeros(), Vector4::zeros());
        on_walls = 0;
        for &point in points {
            let end = transformed([sin, cos], pose, point);
            let [u, v] = end.map(|v| (v * cells) as f32);
            let Some(sample) = field.sample(u, v) else {
                continue;
            };
            let residual = f64::from(sample.distance) - offset;
            on_walls += usize::from(residual.abs() < ON_WALL);
            // Geman and McClure's weight.
            let weight = (1.0 + (residual / ROBUST).powi(2)).powi(-2);
            let [gx, gy] = sample.gradient.map(f64::from);
            let turned = gy * (end[0] - pose.x) - gx * (end[1] - pose.y);
            let row = Vector4::new(gx, gy, turned, -1.0);
            information += weight * row * row.transpose();
            gradient += weight * residual * row;
        }
        // Where nothing is known of a direction, it stays.
        information += Matrix4::from_diagonal_element(0.1);
        let step = information.cholesky()?.solve(&gradient);
        pose = Pose::new(pose.x - step[0], pose.y - step[1], pose.heading - step[2]);
        offset -= step[3];
        if step.amax() < 1e-4 {
            break;
        }
    }
    let enough = on_walls >= FEWEST && on_walls as f64 >= LEAST_SHARE * points.len() as f64;
    let sound = offset.abs() <= MOST * field.resolution() && pose.distance(near) < 2.0 * ON_WALL;
    (enough && sound).then_some(offset)
}

#[cfg(test)]
mod tests {
    use super::*;
    use maps::{Cell, OccupancyGrid};

    /// A room of 8 m x 4 m whose walls are drawn this much too near [m].
    fn field(near: f64) -> DistanceField {
        DistanceField::new(&OccupancyGrid::from_fn(
            180,
            100,
            0.05,
            Pose::IDENTITY,
            |column, row| {
                let inside = |at: usize, [low, high]: [f64; 2]| {
                    let at = (at as f64 + 0.5) * 0.05;
                    at > low + near && at < high - near
                };
                if inside(column, [0.5, 8.5]) && inside(row, [0.5, 4.5]) {
                    Cell::Free
                } else {
                    Cell::Occupied
                }
            },
        ))
    }

    /// What a laser at a pose in the room sees over 270 deg.
    fn scan(pose: Pose) -> Vec<[f32; 2]> {
        let beam = |i: i32| {
            let (sin, cos) = (pose.heading + f64::from(i).to_radians()).sin_cos();
            let to = |at: f64, step: f64, [low, high]: [f64; 2]| {
                if step > 0.0 {
                    (high - at) / step
                } else {
                    (low - at) / step
                }
            };
            let range = to(pose.x, cos, [0.5, 8.5]).min(to(pose.y, sin, [0.5, 4.5]));
            let (sin, cos) = f64::from(i).to_radians().sin_cos();
            [(range * cos) as f32, (range * sin) as f32]
        };
        (-135..=135).map(beam).collect()
    }

    #[test]
    fn offset_and_pose_are_found_together() {
        let pose = Pose::new(3.0, 2.0, 0.4);
        for near in [-0.05, 0.0, 0.05] {
            for by in [[0.0; 3], [0.05, -0.05, 0.02], [-0.04, -0.06, -0.03]] {
                let start = Pose::new(pose.x + by[0], pose.y + by[1], pose.heading + by[2]);
                let seen = fit_offset(&field(near), &scan(pose), start, 0.0).expect("it fits");
                assert!((seen + near).abs() < 0.004, "{near} {by:?}: {seen}");
            }
        }
    }

    #[test]
    fn a_scan_of_another_place_says_nothing() {
        let away = Pose::new(4.5, 2.6, 0.4);
        assert_eq!(
            fit_offset(&field(0.0), &scan(Pose::new(3.0, 2.0, 0.0)), away, 0.0),
            None
        );
        assert_eq!(fit_offset(&field(0.0), &[], away, 0.0), None);
        // Two cells and a half are another wall.
        let pose = Pose::new(3.0, 2.0, 0.4);
        assert_eq!(fit_offset(&field(0.125), &scan(pose), pose, 0.0), None);
    }

    #[test]
    fn it_is_learned_by_driving() {
        let mut walls = WallOffset::default();
        for _ in 0..100 {
            walls.learn(-0.05, Pose::IDENTITY, 3.0);
        }
        assert!(walls.offset.abs() < 1e-12);
        for step in 1..=40 {
            walls.learn(-0.05, Pose::new(0.1 * f64::from(step), 0.0, 0.0), 3.0);
        }
        assert!((walls.offset + 0.05).abs() < 0.01, "{walls:?}");
    }
}
