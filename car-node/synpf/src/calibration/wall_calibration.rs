//! What the scans tell of the walls as a whole: how far off the map's they stand, and how far about them end points scatter.
//!
//! A map's face is the near edge of the cells that end points fell into, so walls stand up to a cell behind it, and the fit
//! would be pushed away from whatever is on one side only. And a set tuned for one laser and a good map claims too much with
//! another: with end points that scatter by 5 cm in place of 2, a fit that goes by `refine_sigma` alone takes noise for
//! structure along a straight.

use maps::{DistanceField, Pose};

/// The walls as a laser sees them, learned while driving.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct WallCalibration {
    /// How much nearer they stand than the map has them [m].
    pub(crate) offset: f64,
    /// Standard deviation of the end points about them [m]; 0 before anything was seen.
    pub(crate) scatter: f64,
}

/// End points farther from all walls are no hits of theirs [m].
const REACH: f32 = 0.25;

/// As many end points at least make an observation.
const FEWEST: usize = 20;

/// End points that are looked at.
const MOST: usize = 180;

impl WallCalibration {
    /// The walls by one scan at a pose; None where hardly a point lies at a wall. The offset is the robust mean of the signed
    /// distances, the scatter their median absolute deviation (Huber, Robust Statistics, 1981, section 5.1) about what is
    /// `known`, as a standard deviation.
    pub(crate) fn seen(field: &DistanceField, points: &[[f32; 2]], pose: Pose, known: Self) -> Option<Self> {
        const ROBUST: f32 = 0.06;
        const SIGMA_OF_MEDIAN: f32 = 1.4826;
        let stride = points.len().div_ceil(MOST).max(1);
        let cells = 1.0 / field.resolution() as f32;
        let (sin, cos) = (pose.heading.sin() as f32, pose.heading.cos() as f32);
        let (mut sum, mut total) = (0.0f32, 0.0f32);
        let mut deviations = [0.0f32; MOST];
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
            sum += weight * sample.distance;
            total += weight;
            if deviation.abs() < REACH {
                deviations[count] = deviation.abs();
                count += 1;
            }
        }
        if count < FEWEST || total < FEWEST as f32 {
            return None;
        }
        let (_, median, _) = deviations[..count].select_nth_unstable_by(count / 2, f32::total_cmp);
        Some(Self {
            offset: f64::from(sum / total),
            scatter: f64::from(*median * SIGMA_OF_MEDIAN),
        })
    }

    /// Takes in what one scan showed, after so much driving [m]: a car that stands sees the same again.
    pub(crate) fn learn(&mut self, seen: Self, driven: f64, distance: f64) {
        /// More is not a map's grain [m].
        const MOST_OFFSET: f64 = 0.05;
        /// More is a wrong pose [m].
        const MOST_SCATTER: f64 = 0.1;
        let gain = 1.0 - (-driven.abs() / distance).exp();
        self.offset = (self.offset + gain * (seen.offset - self.offset)).clamp(-MOST_OFFSET, MOST_OFFSET);
        self.scatter = (self.scatter + gain * (seen.scatter - self.scatter)).min(MOST_SCATTER);
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
        let cells = (0..400 * 60)
            .map(|i| if i / 400 >= 40 { Cell::Occupied } else { Cell::Free })
            .collect();
        DistanceField::new(&OccupancyGrid::new(400, 60, 0.05, Pose::IDENTITY, cells))
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
