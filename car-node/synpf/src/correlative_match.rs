//! Where on the whole map a scan may have been taken: coarse to fine, after Olson (ICRA 2009).
//!
//! Every position and heading of a coarse grid is tried on a blurred map; around the best ones a grid twice as fine in all
//! three directions is tried on a map that is less blurred; and of these the best of each neighbourhood are the seeds that
//! the search fits and follows.

use std::cmp::Reverse;
use std::f64::consts::TAU;
use std::ops::Range;

use maps::{Pose, wrap_angle};
use rayon::prelude::*;

use crate::TrackMap;
use crate::search_parameters::SearchParameters;

/// Beams that are looked at.
const BEAMS: usize = 36;

/// Coarse poses around which the finer grid is tried.
const COARSE: usize = 8_000;

/// Fine poses that are looked through for the best of each neighbourhood.
const FINE: usize = 6000;

/// A car is nowhere nearer to a wall than this \[m\].
const CLEARANCE: f32 = 0.12;

/// Seeds nearer to each other than this are one \[m\], \[rad\].
const NEIGHBOURHOOD: [f64; 2] = [0.45, 0.3];

/// Neighbouring positions of the fine grid.
struct Block {
    /// Their middle \[m\].
    centre: [f32; 2],
    positions: Range<usize>,
}

/// The positions where the car can be \[m\], in blocks of up to two by two.
fn blocks(map: &TrackMap, search_step: f64) -> (Vec<Block>, Vec<[f32; 2]>) {
    let resolution = map.grid().resolution;
    let width = map.grid().width;
    let step = (search_step / resolution).round().max(1.0) as usize;
    // Row and column of the block, then those in the grid.
    let mut places: Vec<[usize; 4]> = map
        .plausible_regions()
        .into_iter()
        .flat_map(|region| map.regions()[region].cells.iter())
        .map(|&cell| (cell as usize % width, cell as usize / width, cell as usize))
        .filter(|&(column, row, cell)| {
            column % step == 0 && row % step == 0 && map.field().values()[cell] > CLEARANCE
        })
        .map(|(column, row, _)| [row / step / 2, column / step / 2, row, column])
        .collect();
    places.sort_unstable();
    let metres = |cells: f32| cells * resolution as f32;
    let positions = places
        .iter()
        .map(|&[_, _, row, column]| [metres(column as f32 + 0.5), metres(row as f32 + 0.5)])
        .collect();
    let mut start = 0;
    let blocks = places
        .chunk_by(|a, b| a[..2] == b[..2])
        .map(|block| {
            let positions = start..start + block.len();
            start = positions.end;
            let middle = |index: usize| metres(((2 * index * step) as f32) + 0.5 * step as f32 + 0.5);
            Block {
                centre: [middle(block[0][1]), middle(block[0][0])],
                positions,
            }
        })
        .collect();
    (blocks, positions)
}

/// Keeps the best, of equals the first ones.
fn best<T>(matches: &mut Vec<(u32, T)>, most: usize) {
    matches.sort_by_key(|(matched, _)| Reverse(*matched));
    matches.truncate(most);
}

/// Poses that a scan with these end points \[m\], in the car's frame, may have been taken at, the best match first: three for
/// every candidate that is wanted. The same whatever the number of threads.
pub(crate) fn seed(map: &TrackMap, points: &[[f32; 2]], parameters: &SearchParameters) -> Vec<Pose> {
    if points.is_empty() {
        return Vec::new();
    }
    let pyramid = map.score_pyramid();
    let (blocks, positions) = blocks(map, parameters.search_step);
    let stride = points.len().div_ceil(BEAMS).max(1);
    // Spread over the field of view in both halves, so that a look at the first half tells.
    let looked_at = || points.iter().step_by(stride);
    let points: Vec<[f32; 2]> = looked_at()
        .step_by(2)
        .chain(looked_at().skip(1).step_by(2))
        .copied()
        .collect();

    let pairs = (0.5 * TAU / parameters.search_turn).ceil() as usize;
    let turn = 0.5 * TAU / pairs as f64;
    let heading = |k: usize| turn * k as f64;
    let coarsely = pyramid
        .coarse
        .turned(&points, (0..pairs).map(|pair| heading(2 * pair) + 0.5 * turn));
    let mut coarse: Vec<(u32, (usize, usize))> = coarsely
        .par_iter()
        .enumerate()
        .flat_map_iter(|(pair, points)| {
            let matched = |block: usize| pyramid.coarse.matched(blocks[block].centre, points);
            let matches: Vec<_> = (0..blocks.len())
                .filter_map(|block| Some((matched(block)?, (block, pair))))
                .collect();
            matches
        })
        .collect();
    best(&mut coarse, COARSE);

    let finely = pyramid.fine.turned(&points, (0..2 * pairs).map(heading));
    let mut fine: Vec<(u32, Pose)> = coarse
        .into_par_iter()
        .flat_map_iter(|(_, (block, pair))| {
            let positions = &positions[blocks[block].positions.clone()];
            [2 * pair, 2 * pair + 1]
                .into_iter()
                .flat_map(move |k| positions.iter().map(move |&position| (k, position)))
                .filter_map(|(k, position)| {
                    let matched = pyramid.fine.matched(position, &finely[k])?;
                    let [x, y] = position.map(f64::from);
                    Some((matched, Pose::new(x, y, heading(k))))
                })
                .collect::<Vec<_>>()
        })
        .collect();
    best(&mut fine, FINE);

    let most = 3 * parameters.search_candidates;
    let mut picked: Vec<Pose> = Vec::with_capacity(most);
    for (_, pose) in fine {
        let near = |other: &Pose| {
            other.distance(pose) < NEIGHBOURHOOD[0]
                && wrap_angle(other.heading - pose.heading).abs() < NEIGHBOURHOOD[1]
        };
        if !picked.iter().any(near) {
            picked.push(pose);
            if picked.len() == most {
                break;
            }
        }
    }
    picked
}

#[cfg(test)]
mod tests {
    use super::*;
    use maps::{Cell, OccupancyGrid};

    /// An L of 12 x 12 m in cells of 5 cm, its legs 4 m wide, and a niche in one of them so that nothing is symmetric.
    fn map() -> TrackMap {
        let free = |column: usize, row: usize| {
            let inside = |v: usize, from: usize, to: usize| (from..to).contains(&v);
            inside(column, 2, 238) && inside(row, 2, 82)
                || inside(column, 2, 82) && inside(row, 2, 238)
                || inside(column, 150, 190) && inside(row, 82, 100)
        };
        let cell = |column: usize, row: usize| {
            if free(column, row) {
                Cell::Free
            } else {
                Cell::Occupied
            }
        };
        TrackMap::new(OccupancyGrid::from_fn(240, 240, 0.05, Pose::IDENTITY, cell)).expect("free space")
    }

    /// What a laser sees over 270 degrees, in its own frame.
    fn scan(map: &TrackMap, pose: Pose) -> Vec<[f32; 2]> {
        let start = [(pose.x / 0.05) as f32, (pose.y / 0.05) as f32];
        (-270..=270)
            .map(|i| {
                let angle = f64::from(i) * 0.25f64.to_radians();
                let direction = pose.heading + angle;
                let towards = [direction.cos() as f32, direction.sin() as f32];
                let range = 0.05 * map.field().trace(start, towards, 600.0);
                [range * angle.cos() as f32, range * angle.sin() as f32]
            })
            .collect()
    }

    #[test]
    fn the_true_pose_is_among_the_first_seeds_wherever_it_is() {
        let map = map();
        for (x, y, heading) in [
            (1.0, 1.0, 0.3),
            (9.0, 2.1, -2.9),
            (2.2, 10.7, 1.5),
            (8.4, 4.6, 0.0),
        ] {
            let pose = Pose::new(x, y, heading);
            let seeds = seed(&map, &scan(&map, pose), &SearchParameters::default());
            assert!(seeds.len() <= 120);
            let rank = seeds.iter().position(|seed| {
                seed.distance(pose) < 0.3 && wrap_angle(seed.heading - pose.heading).abs() < 0.1
            });
            assert!(rank.is_some_and(|rank| rank < 5), "{pose:?} is number {rank:?}");
        }
    }

    #[test]
    fn a_scan_without_points_has_no_seeds() {
        assert_eq!(seed(&map(), &[], &SearchParameters::default()), []);
    }
}
