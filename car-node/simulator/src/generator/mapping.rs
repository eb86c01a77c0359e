//! The map that SLAM would draw of the walls, with its errors.

use std::f64::consts::TAU;

use maps::{Cell, OccupancyGrid, Pose};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::spline::{distance, normals};
use crate::{LidarParams, Walls};

/// How the map is made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MappingParams {
    /// Edge of a cell \[m\].
    pub resolution: f64,
    /// Standard deviation of the mapping run's position error after closing the loop \[m\].
    pub drift: f64,
    /// Standard deviation of its heading error \[rad\].
    pub heading_drift: f64,
    /// Least share of beams that end in an occupied cell, of all beams that end in it or pass it. One half is the most
    /// likely map (Hahnel et al., 2003). `gmapping` uses 0.25, Karto and `slam_toolbox` 0.1: they draw every cell that
    /// noise reaches, so their walls stand about 3 cm too close.
    pub occupied_share: f64,
    /// Distance between the poses of the scans \[m\].
    pub step: f64,
}

impl Default for MappingParams {
    fn default() -> Self {
        Self {
            resolution: 0.05,
            drift: 0.008,
            heading_drift: 0.001,
            occupied_share: 0.5,
            step: 0.2,
        }
    }
}

/// Longer beams are not used, as in common mappers \[m\].
const REACH: f64 = 12.0;
/// Free border around the walls \[m\].
const BORDER: f64 = 0.5;

/// Maps the walls from one slow drive along `path` with a noisy laser. Counts for every cell the beams that end in it and
/// those that pass (reflection probability maps; Hahnel et al., 2003). Cells that no beam reaches are unknown.
pub fn draw_map(path: &[[f64; 2]], walls: &Walls, params: &MappingParams, seed: u64) -> OccupancyGrid {
    let mut rng = StdRng::seed_from_u64(seed ^ 0x6d61_7070);
    let lidar = LidarParams::default();
    let (low, high) = extent(walls, path);
    let origin = Pose::new(
        ((low[0] - BORDER) / params.resolution).floor() * params.resolution,
        ((low[1] - BORDER) / params.resolution).floor() * params.resolution,
        0.0,
    );
    let width = ((high[0] + BORDER - origin.x) / params.resolution).ceil() as usize;
    let height = ((high[1] + BORDER - origin.y) / params.resolution).ceil() as usize;
    let mut ends = vec![0_u32; width * height];
    let mut passes = vec![0_u32; width * height];
    let drift: [Wave; 3] = std::array::from_fn(|_| Wave::random(&mut rng));

    let left = normals(path);
    let mut travelled = 0.0;
    let mut next = 0.0;
    for (i, &[x, y]) in path.iter().enumerate() {
        let lap = i as f64 / path.len() as f64;
        if travelled >= next {
            next += params.step;
            let truth = Pose::new(x, y, (-left[i][0]).atan2(left[i][1]));
            // The mapper's pose error changes slowly along the lap.
            let believed = Pose::new(
                truth.x + params.drift * drift[0].at(lap),
                truth.y + params.drift * drift[1].at(lap),
                truth.heading + params.heading_drift * drift[2].at(lap),
            );
            for beam in 0..lidar.beams {
                let share = beam as f64 / (lidar.beams - 1) as f64 - 0.5;
                let angle = share * lidar.field_of_view;
                let Some(range) = measure(&mut rng, &lidar, truth, angle, walls) else {
                    continue;
                };
                let from = [believed.x - origin.x, believed.y - origin.y].map(|v| v / params.resolution);
                let (sin, cos) = (believed.heading + angle).sin_cos();
                enter(
                    from,
                    [cos, sin],
                    range / params.resolution,
                    [width, height],
                    &mut ends,
                    &mut passes,
                );
            }
        }
        travelled += distance(path[i], path[(i + 1) % path.len()]);
    }
    let cells = ends
        .iter()
        .zip(&passes)
        .map(|(&ends, &passes)| {
            let seen = f64::from(ends + passes);
            if seen < 2.0 {
                Cell::Unknown
            } else if f64::from(ends) > params.occupied_share * seen {
                Cell::Occupied
            } else {
                Cell::Free
            }
        })
        .collect();
    OccupancyGrid::new(width, height, params.resolution, origin, cells)
}

/// Range of one beam of the mapping run \[m\]; None without a return.
fn measure(rng: &mut StdRng, lidar: &LidarParams, pose: Pose, angle: f64, walls: &Walls) -> Option<f64> {
    let jitter: f64 = StandardNormal.sample(rng);
    let noise: f64 = StandardNormal.sample(rng);
    let luck: f64 = rng.random();
    let (sin, cos) = (pose.heading + angle + lidar.jitter * jitter).sin_cos();
    let hit = walls.cast([pose.x, pose.y], [cos, sin], REACH)?;
    (luck >= lidar.loss(&hit)).then_some(hit.range + lidar.noise * noise)
}

/// Counts a beam in every cell that it passes and in the one where it ends.
fn enter(
    from: [f64; 2],
    direction: [f64; 2],
    range: f64,
    [width, height]: [usize; 2],
    ends: &mut [u32],
    passes: &mut [u32],
) {
    let index = |[u, v]: [f64; 2]| {
        let inside = u >= 0.0 && v >= 0.0 && u < width as f64 && v < height as f64;
        inside.then(|| v as usize * width + u as usize)
    };
    let at = |t: f64| index([from[0] + t * direction[0], from[1] + t * direction[1]]);
    let end = at(range);
    // Steps of half a cell visit every cell that matters. A cell visited twice in a row counts once.
    let mut last = end;
    for step in 0..(2.0 * range) as usize {
        let here = at(step as f64 / 2.0);
        if here != last
            && here != end
            && let Some(i) = here
        {
            passes[i] += 1;
        }
        last = here;
    }
    if let Some(i) = end {
        ends[i] += 1;
    }
}

/// Bounding box of walls and path \[m\].
fn extent(walls: &Walls, path: &[[f64; 2]]) -> ([f64; 2], [f64; 2]) {
    let points = walls.polylines().iter().flat_map(|wall| &wall.points).chain(path);
    points.fold(([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]), |(low, high), p| {
        (
            [low[0].min(p[0]), low[1].min(p[1])],
            [high[0].max(p[0]), high[1].max(p[1])],
        )
    })
}

/// A smooth closed function of unit variance: the first harmonics with random phases.
struct Wave([(f64, f64); 3]);

impl Wave {
    fn random(rng: &mut StdRng) -> Self {
        Self(std::array::from_fn(|k| {
            let phase: f64 = rng.random::<f64>() * TAU;
            // Weights 1, 1/2, 1/3, over their root mean square.
            let norm = (0.5 * (1.0 + 0.25 + 1.0 / 9.0_f64)).sqrt();
            (1.0 / ((k + 1) as f64 * norm), phase)
        }))
    }

    fn at(&self, lap: f64) -> f64 {
        (0..3)
            .map(|k| self.0[k].0 * (TAU * (k + 1) as f64 * lap + self.0[k].1).sin())
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Surface, Wall};

    fn ring() -> (Walls, Vec<[f64; 2]>) {
        let circle = |radius: f64| -> Vec<[f64; 2]> {
            (0..=200)
                .map(|i| TAU * f64::from(i) / 200.0)
                .map(|a| [radius * a.cos(), radius * a.sin()])
                .collect()
        };
        let wall = |radius| Wall {
            surface: Surface::Plain,
            points: circle(radius),
        };
        (
            Walls::new(vec![wall(2.0), wall(4.0)]),
            circle(3.0)[..200].to_vec(),
        )
    }

    #[test]
    fn walls_are_drawn_where_they_stand() {
        let (walls, path) = ring();
        let grid = draw_map(&path, &walls, &MappingParams::default(), 1);
        for i in 0..120 {
            let (sin, cos) = (f64::from(i) * TAU / 120.0).sin_cos();
            assert_eq!(grid.at([3.0 * cos, 3.0 * sin]), Cell::Free);
            assert_eq!(grid.at([4.4 * cos, 4.4 * sin]), Cell::Unknown);
            assert_eq!(grid.at([1.5 * cos, 1.5 * sin]), Cell::Unknown);
            // The map has a wall within a cell and a half of the true face.
            for radius in [2.0, 4.0] {
                let near = (-7..=7).map(|k| radius + 0.01 * f64::from(k));
                let drawn = near
                    .map(|r| grid.at([r * cos, r * sin]))
                    .any(|cell| cell == Cell::Occupied);
                assert!(drawn, "at {i} of 120, radius {radius}");
            }
        }
    }

    #[test]
    fn the_same_seed_draws_the_same_map() {
        let (walls, path) = ring();
        let draw = |seed| draw_map(&path, &walls, &MappingParams::default(), seed);
        assert_eq!(draw(1), draw(1));
        assert_ne!(draw(1), draw(2));
    }
}
