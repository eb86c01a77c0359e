//! What the scans tell of the walls as a whole: how far off the map's they stand, and how far about them end points scatter.
//!
//! A map's face is the near edge of the cells that end points fell into, so walls stand up to a cell behind it, and the fit
//! would be pushed away from whatever is on one side only. Maps that were smoothed or cleaned by hand are farther off: by 4 and
//! 5 cm on two real ones. A laser looks ahead, so that walls too near on the map push the pose back.
//!
//! And a set tuned for one laser and a good map claims too much with another: with end points that scatter by 5 cm in place of
//! 2, a fit that goes by `refine_sigma` alone takes noise for structure along a straight.

use maps::{DistanceField, Pose};
use nalgebra::{Matrix4, Vector4};

/// The walls as a laser sees them, learned while driving.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct WallCalibration {
    /// How much nearer they stand than the map has them \[m\].
    pub(crate) offset: f64,
    /// Way on which that was learned \[m\].
    way: f64,
    /// Standard deviation of the end points about them \[m\]; 0 before anything was seen.
    pub(crate) scatter: f64,
    /// How far the end points of one stretch of wall err together, and how long a stretch stays in view.
    shared: Shared,
}

/// What end points on the same stretch of wall have in common. Laser noise differs from beam to beam and the grain of a map
/// from cell to cell; a board in front of the wall or a bend of the map pulls a whole stretch the same way.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Shared {
    /// Sum of the products of the pulls of two end points on one stretch, over all pairs [m^2].
    common: f64,
    /// Sum of their squares [m^2].
    own: f64,
    /// How far the laser sees on average \[m\].
    view: f64,
    /// Way between two scans \[m\].
    step: f64,
}

/// End points farther from all walls are no hits of theirs \[m\].
const REACH: f32 = 0.25;

/// End points that are off by more count little for where the walls stand \[m\].
const ON_WALL: f32 = 0.1;

/// With a smaller share of the end points on walls nothing is known of where they stand.
const LEAST_SHARE: f64 = 0.7;

/// More is not how a map is drawn \[m\]: a cell and a half of 5 cm. A wrong pose shows more.
const MOST_OFFSET: f64 = 0.075;

/// That walls stand as drawn counts as much as this way of seeing them \[m\].
const DRAWN: f64 = 0.5;

/// Information of a pose and an offset that are as they were, in end points.
const UNKNOWN: f32 = 0.1;

/// As many end points at least make an observation.
const FEWEST: usize = 20;

/// End points that are looked at.
const MOST: usize = 180;

/// Length of a stretch of wall whose end points are taken to err together [m]: a board, a person, a bend of the map.
const STRETCH: f32 = 1.0;

/// End points farther apart than this are on different walls \[m\].
const GAP: f32 = 0.3;

/// A stretch counts as seen by so many scans at most.
const MOST_SCANS: f64 = 200.0;

impl Shared {
    /// By how much the variance of a sum over the end points of all scans that see a stretch exceeds what it were if they erred
    /// independently (the design effect of Kish, Survey Sampling, 1965): 1 + (number that err together - 1) times their
    /// correlation.
    fn design_effect(&self, most_scans: f64) -> f64 {
        if self.own <= 0.0 {
            return 1.0;
        }
        let scans = (self.view / self.step.max(1e-3)).clamp(1.0, most_scans.max(1.0));
        1.0 + scans * (self.common / self.own).max(0.0)
    }
}

impl WallCalibration {
    /// How many end points count as one, by what those of one stretch have in common, for an estimate that holds the errors of so
    /// many scans.
    pub(crate) fn correlation_within(&self, scans: f64) -> f64 {
        self.shared.design_effect(scans.min(MOST_SCANS))
    }

    /// Walls of a sound map that a laser of 2 cm sees, but for what their end points have in common.
    #[cfg(test)]
    pub(crate) fn with_correlation(correlation: f64) -> Self {
        Self {
            offset: 0.0,
            way: 0.0,
            scatter: 0.02,
            shared: Shared {
                common: correlation - 1.0,
                own: 1.0,
                view: 1.0,
                step: 1.0,
            },
        }
    }

    /// The walls by one scan at a pose; None where hardly a point lies at a wall. The offset is fitted together with the pose, by
    /// robust least squares: an error of one makes one of the other. The scatter is the median absolute deviation (Huber, Robust
    /// Statistics, 1981, section 5.1) of the signed distances about what is `known`, as a standard deviation.
    pub(crate) fn seen(field: &DistanceField, points: &[[f32; 2]], pose: Pose, known: Self) -> Option<Self> {
        const ROBUST: f32 = 0.06;
        const SIGMA_OF_MEDIAN: f32 = 1.4826;
        let stride = points.len().div_ceil(MOST).max(1);
        let cells = 1.0 / field.resolution() as f32;
        let (sin, cos) = (pose.heading.sin() as f32, pose.heading.cos() as f32);
        let mut total = 0.0f32;
        let (mut looked_at, mut on_walls) = (0, 0);
        let (mut information, mut gradient) = (Matrix4::<f32>::zeros(), Vector4::<f32>::zeros());
        // The stretch at hand: where it began, its last point, the sum of its pulls.
        let (mut began, mut last, mut pull) = ([f32::MAX; 2], [f32::MAX; 2], 0.0f32);
        let (mut together, mut own, mut view) = (0.0f32, 0.0f32, 0.0f32);
        let mut deviations = [0.0f32; MOST];
        let gap = GAP * (stride as f32).max(1.0);
        let mut count = 0;
        for point in points.iter().step_by(stride) {
            let (dx, dy) = (cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]);
            let Some(sample) = field.sample((pose.x as f32 + dx) * cells, (pose.y as f32 + dy) * cells)
            else {
                continue;
            };
            let deviation = sample.distance - known.offset as f32;
            let ratio = deviation / ROBUST;
            let weight = 1.0 / (1.0 + ratio * ratio).powi(2);
            let [gx, gy] = sample.gradient;
            let row = Vector4::new(gx, gy, gy * dx - gx * dy, -1.0);
            looked_at += 1;
            on_walls += usize::from(deviation.abs() < 1.5 * ON_WALL);
            let ratio = deviation / ON_WALL;
            let on_wall = 1.0 / (1.0 + ratio * ratio).powi(2);
            information += on_wall * row * row.transpose();
            gradient += on_wall * deviation * row;
            total += weight;
            let squared = |from: [f32; 2]| (point[0] - from[0]).powi(2) + (point[1] - from[1]).powi(2);
            if squared(began) > STRETCH * STRETCH || squared(last) > gap * gap {
                together += pull * pull;
                (began, pull) = (*point, 0.0);
            }
            last = *point;
            pull += weight * deviation;
            own += (weight * deviation).powi(2);
            view += weight * (point[0] * point[0] + point[1] * point[1]).sqrt();
            if deviation.abs() < REACH {
                deviations[count] = deviation.abs();
                count += 1;
            }
        }
        if count < FEWEST || total < FEWEST as f32 {
            return None;
        }
        together += pull * pull;
        let (_, median, _) = deviations[..count].select_nth_unstable_by(count / 2, f32::total_cmp);
        // Where nothing is known of a direction, it stays.
        information += Matrix4::from_diagonal_element(UNKNOWN);
        let step = information.cholesky()?.solve(&gradient);
        let offset = known.offset - f64::from(step[3]);
        let told = on_walls as f64 >= LEAST_SHARE * looked_at as f64;
        Some(Self {
            offset: if told {
                offset.clamp(-MOST_OFFSET, MOST_OFFSET)
            } else {
                known.offset
            },
            scatter: f64::from(*median * SIGMA_OF_MEDIAN),
            // Of the points between those looked at, each has the same in common with its stretch.
            shared: Shared {
                common: f64::from(together - own) * stride as f64,
                own: f64::from(own),
                view: f64::from(view / total),
                step: 0.0,
            },
            ..known
        })
    }

    /// Takes in what one scan showed, after so much driving [m]: a car that stands sees the same again.
    pub(crate) fn learn(&mut self, seen: Self, driven: f64, distance: f64) {
        /// More is a wrong pose \[m\].
        const MOST_SCATTER: f64 = 0.1;
        let gain = 1.0 - (-driven.abs() / distance).exp();
        // The mean of all that was seen at first, then of the latest. After a gap, one scan counts for no more than the drawing.
        let way = driven.abs().min(DRAWN);
        self.way = (self.way + way).min(distance);
        let share = way / (self.way + DRAWN);
        self.offset += share * (seen.offset - self.offset);
        self.scatter = (self.scatter + gain * (seen.scatter - self.scatter)).min(MOST_SCATTER);
        let learned = |old: f64, new: f64| old + gain * (new - old);
        self.shared = Shared {
            common: learned(self.shared.common, seen.shared.common),
            own: learned(self.shared.own, seen.shared.own),
            view: learned(self.shared.view, seen.shared.view),
            step: learned(self.shared.step, driven.abs()),
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maps::{Cell, OccupancyGrid};
    use rand::rngs::SmallRng;
    use rand::{RngExt, SeedableRng};

    /// A long wall along x, its face at y = 2 m.
    fn wall() -> DistanceField {
        let cell = |_, row| if row >= 40 { Cell::Occupied } else { Cell::Free };
        DistanceField::new(&OccupancyGrid::from_fn(400, 60, 0.05, Pose::IDENTITY, cell))
    }

    /// Hits on it from (10, 1), standing nearer by `offset` and scattering by `sigma`, with an opponent in every fourth beam.
    fn hits(offset: f64, sigma: f64) -> Vec<[f32; 2]> {
        let mut random = SmallRng::seed_from_u64(1);
        let mut normal = || (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
        (0..540)
            .map(|i| {
                let wall = if i % 4 == 0 {
                    0.4
                } else {
                    1.0 - offset + sigma * normal()
                };
                [(i as f32 - 270.0) * 0.02, wall as f32]
            })
            .collect()
    }

    #[test]
    fn offset_and_scatter_are_learned_while_driving() {
        let (field, pose) = (wall(), Pose::new(10.0, 1.0, 0.0));
        let mut walls = WallCalibration::default();
        let scan = hits(0.02, 0.05);
        for driven in [0.0, 0.1].map(|step| [step; 200]).concat() {
            let seen = WallCalibration::seen(&field, &scan, pose, walls).expect("a wall in view");
            walls.learn(seen, driven, 3.0);
        }
        assert!((walls.offset - 0.02).abs() < 0.01, "{walls:?}");
        assert!((walls.scatter - 0.05).abs() < 0.01, "{walls:?}");
        let mut standing = WallCalibration::default();
        standing.learn(walls, 0.0, 3.0);
        assert_eq!(standing, WallCalibration::default());
    }

    /// A laser looks ahead: where the walls are drawn too near, the fit of a scan stands back, and finds them as drawn.
    #[test]
    fn walls_that_are_drawn_too_near_are_told_from_a_pose_that_stands_back() {
        const DRAWN_NEAR: f64 = 0.05;
        let (far, width) = (8.0, 4.0);
        // A room from (0, 0), in a grid that begins half a metre before it.
        let field = DistanceField::new(&OccupancyGrid::from_fn(
            180,
            100,
            0.05,
            Pose::IDENTITY,
            |column, row| {
                let inside = |at: usize, length: f64| {
                    let at = (at as f64 + 0.5) * 0.05 - 0.5;
                    at > DRAWN_NEAR && at < length - DRAWN_NEAR
                };
                if inside(column, far) && inside(row, width) {
                    Cell::Free
                } else {
                    Cell::Occupied
                }
            },
        ));
        let pose = Pose::new(2.5, 2.0, 0.1);
        let points: Vec<[f32; 2]> = (-540..=540)
            .map(|beam| {
                let angle = (f64::from(beam) / 4.0).to_radians();
                let (sin, cos) = (pose.heading + angle).sin_cos();
                let to = |at: f64, step: f64, length: f64| {
                    (if step > 0.0 { length - at } else { at }) / step.abs()
                };
                let range = to(pose.x, cos, far).min(to(pose.y, sin, width));
                [(range * angle.cos()) as f32, (range * angle.sin()) as f32]
            })
            .collect();
        let back = Pose::new(pose.x - 0.03, pose.y, pose.heading);
        let in_grid = Pose::new(back.x + 0.5, back.y + 0.5, back.heading);
        let mut walls = WallCalibration::default();
        for _ in 0..50 {
            let seen = WallCalibration::seen(&field, &points, in_grid, walls).expect("a room in view");
            walls.learn(seen, 0.1, 3.0);
        }
        assert!((walls.offset + DRAWN_NEAR).abs() < 0.01, "{walls:?}");
    }

    #[test]
    fn a_board_in_front_of_the_wall_is_an_error_that_end_points_share() {
        let (field, pose) = (wall(), Pose::new(10.0, 1.0, 0.0));
        let correlation = |points: &[[f32; 2]]| {
            let mut walls = WallCalibration::default();
            for _ in 0..200 {
                let seen = WallCalibration::seen(&field, points, pose, walls).expect("a wall in view");
                walls.learn(seen, 0.1, 3.0);
            }
            walls.correlation_within(f64::INFINITY)
        };
        let plain = hits(0.0, 0.02);
        let mut boarded = plain.clone();
        for point in &mut boarded[240..300] {
            point[1] -= 0.08;
        }
        let (plain, boarded) = (correlation(&plain), correlation(&boarded));
        assert!(boarded > 50.0 && boarded > 5.0 * plain, "{plain} {boarded}");
    }

    #[test]
    fn without_walls_nothing_is_seen() {
        let field = wall();
        let nothing = |points: &[[f32; 2]]| {
            WallCalibration::seen(
                &field,
                points,
                Pose::new(10.0, 1.0, 0.0),
                WallCalibration::default(),
            )
        };
        assert_eq!(nothing(&[]), None);
        assert_eq!(nothing(&[[1.0, 0.1]; 100]), None, "in the open");
        assert_eq!(nothing(&[[1e9, f32::NAN]; 100]), None, "off the map");
    }
}
