//! Branch-and-bound scan matching (Hess et al., ICRA 2016, section V): the best pose of a scan within a window, or anywhere
//! on the map, without scoring every candidate.

use maps::Pose;

use crate::probability_grid::{LEAST, MOST, ProbabilityGrid};
use crate::scan_points::{angular_step, transform_all};

/// Level `h`: the greatest probability among the `2^h` x `2^h` cells from each cell on, for an upper bound of the scores
/// of all candidates with offsets in that block (algorithm 3, `PrecomputeGrid`).
#[derive(Debug)]
struct PrecomputationGrid {
    /// Cells by which the grid begins before the map's.
    before: i64,
    width: usize,
    values: Vec<u8>,
}

impl PrecomputationGrid {
    /// The greatest of the values within `size` cells from each on.
    fn new(cells: &[u8], [width, height]: [usize; 2], size: usize) -> Self {
        let before = size - 1;
        let (wide, high) = (width + before, height + before);
        let mut rows = vec![0; wide * height];
        for row in 0..height {
            let from = &cells[row * width..(row + 1) * width];
            sliding_maximum(from, size, &mut rows[row * wide..(row + 1) * wide]);
        }
        let mut values = vec![0; wide * high];
        let (mut column_in, mut column_out) = (vec![0; height], vec![0; high]);
        for column in 0..wide {
            for (row, value) in column_in.iter_mut().enumerate() {
                *value = rows[row * wide + column];
            }
            sliding_maximum(&column_in, size, &mut column_out);
            for (row, value) in column_out.iter().enumerate() {
                values[row * wide + column] = *value;
            }
        }
        Self {
            before: before as i64,
            width: wide,
            values,
        }
    }

    #[inline]
    fn value(&self, cell: [i64; 2]) -> u32 {
        let (column, row) = (cell[0] + self.before, cell[1] + self.before);
        if column < 0 || row < 0 || column >= self.width as i64 {
            return 0;
        }
        let i = row as usize * self.width + column as usize;
        self.values.get(i).map_or(0, |&value| u32::from(value))
    }
}

/// `out[i]` is the greatest of `values[i - size + 1..=i]`, as far as they exist (van Herk's method would not be faster for the
/// few sizes here; a monotonic queue is linear).
fn sliding_maximum(values: &[u8], size: usize, out: &mut [u8]) {
    let mut queue = std::collections::VecDeque::<usize>::new();
    for (i, out) in out.iter_mut().enumerate() {
        if i < values.len() {
            while queue.back().is_some_and(|&last| values[last] <= values[i]) {
                queue.pop_back();
            }
            queue.push_back(i);
        }
        while queue.front().is_some_and(|&first| first + size <= i) {
            queue.pop_front();
        }
        *out = queue.front().map_or(0, |&first| values[first]);
    }
}

/// The levels of a map, the finest first.
#[derive(Debug)]
pub(crate) struct PrecomputationGridStack {
    resolution: f64,
    size: [usize; 2],
    levels: Vec<PrecomputationGrid>,
}

/// A place that a scan may have been taken at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FastMatch {
    pub(crate) pose: Pose,
    /// Mean probability of the cells in which the points end.
    pub(crate) score: f64,
}

/// Where to look.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SearchWindow {
    /// On each side of the start \[m\].
    pub(crate) linear: f64,
    /// On each side of the start's heading \[rad\].
    pub(crate) angular: f64,
}

/// Offsets of a turned scan, a block of `2^level` x `2^level` of them.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    turn: usize,
    offset: [i64; 2],
    score: f64,
}

/// One turn of the scan: the cells of its points, and which offsets are within the window.
struct TurnedScan {
    heading: f64,
    cells: Vec<[i64; 2]>,
    low: [i64; 2],
    high: [i64; 2],
}

impl PrecomputationGridStack {
    /// The levels of a map. The grid's corner is the origin of its frame.
    pub(crate) fn new(grid: &ProbabilityGrid, depth: usize) -> Self {
        let to_byte = |p: f64| ((p - LEAST) / (MOST - LEAST) * 255.0).round() as u8;
        let cells: Vec<u8> = grid.probabilities().map(to_byte).collect();
        let size = [grid.width(), grid.height()];
        Self {
            resolution: grid.resolution(),
            size,
            levels: (0..depth)
                .map(|level| PrecomputationGrid::new(&cells, size, 1 << level))
                .collect(),
        }
    }

    /// The best match within a window around `start` whose score is above `min_score`.
    pub(crate) fn match_around(
        &self,
        points: &[[f32; 2]],
        start: Pose,
        window: SearchWindow,
        min_score: f64,
    ) -> Option<FastMatch> {
        let reach = (window.linear / self.resolution).ceil() as i64;
        self.search(
            points,
            start,
            window.angular,
            [[-reach; 2], [reach; 2]],
            min_score,
        )
    }

    /// The best match anywhere on the map whose score is above `min_score`.
    pub(crate) fn match_anywhere(&self, points: &[[f32; 2]], min_score: f64) -> Option<FastMatch> {
        let start = Pose::IDENTITY;
        let most = self.size.map(|v| v as i64);
        self.search(points, start, std::f64::consts::PI, [[0; 2], most], min_score)
    }

    fn search(
        &self,
        points: &[[f32; 2]],
        start: Pose,
        angular: f64,
        [low, high]: [[i64; 2]; 2],
        min_score: f64,
    ) -> Option<FastMatch> {
        let coarsest = self.levels.len().checked_sub(1)?;
        if points.is_empty() {
            return None;
        }
        let step = angular_step(points, self.resolution);
        let turns = (angular / step).ceil() as i64;
        let turned: Vec<TurnedScan> = (-turns..=turns)
            .map(|turn| self.turned(points, start, start.heading + turn as f64 * step, low, high))
            .collect();
        let stride = 1i64 << coarsest;
        let mut roots = Vec::new();
        for (turn, scan) in turned.iter().enumerate() {
            let mut y = scan.low[1];
            while y <= scan.high[1] {
                let mut x = scan.low[0];
                while x <= scan.high[0] {
                    let score = self.score(coarsest, scan, [x, y]);
                    if score > min_score {
                        roots.push(Candidate {
                            turn,
                            offset: [x, y],
                            score,
                        });
                    }
                    x += stride;
                }
                y += stride;
            }
        }
        let best = self.best(&turned, roots, coarsest, min_score)?;
        let offset = best.offset.map(|v| v as f64 * self.resolution);
        let heading = turned[best.turn].heading;
        Some(FastMatch {
            pose: Pose::new(start.x + offset[0], start.y + offset[1], heading),
            score: best.score,
        })
    }

    /// The scan turned, with the offsets at which some point of it is on the map.
    fn turned(
        &self,
        points: &[[f32; 2]],
        start: Pose,
        heading: f64,
        low: [i64; 2],
        high: [i64; 2],
    ) -> TurnedScan {
        let at = Pose::new(start.x, start.y, heading);
        let cells: Vec<[i64; 2]> = transform_all(points, at)
            .into_iter()
            .map(|point| point.map(|v| (v / self.resolution).floor() as i64))
            .collect();
        let bound = |k: usize| {
            let (least, most) = cells.iter().fold((i64::MAX, i64::MIN), |(least, most), cell| {
                (least.min(cell[k]), most.max(cell[k]))
            });
            (low[k].max(-most), high[k].min(self.size[k] as i64 - 1 - least))
        };
        let (x, y) = (bound(0), bound(1));
        TurnedScan {
            heading: at.heading,
            cells,
            low: [x.0, y.0],
            high: [x.1, y.1],
        }
    }

    /// The best candidate among blocks of one level (algorithm 2, depth first).
    fn best(
        &self,
        turned: &[TurnedScan],
        mut candidates: Vec<Candidate>,
        level: usize,
        min_score: f64,
    ) -> Option<Candidate> {
        candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
        if level == 0 {
            return candidates
                .into_iter()
                .find(|candidate| candidate.score > min_score);
        }
        let (mut best, mut bound) = (None, min_score);
        for candidate in candidates {
            if candidate.score <= bound {
                break;
            }
            let half = 1i64 << (level - 1);
            let scan = &turned[candidate.turn];
            let mut children = Vec::with_capacity(4);
            for (dx, dy) in [(0, 0), (half, 0), (0, half), (half, half)] {
                let offset = [candidate.offset[0] + dx, candidate.offset[1] + dy];
                if offset[0] > scan.high[0] || offset[1] > scan.high[1] {
                    continue;
                }
                let score = self.score(level - 1, scan, offset);
                if score > bound {
                    children.push(Candidate {
                        turn: candidate.turn,
                        offset,
                        score,
                    });
                }
            }
            if let Some(found) = self.best(turned, children, level - 1, bound) {
                bound = found.score;
                best = Some(found);
            }
        }
        best
    }

    fn score(&self, level: usize, scan: &TurnedScan, offset: [i64; 2]) -> f64 {
        let grid = &self.levels[level];
        let sum: u32 = scan
            .cells
            .iter()
            .map(|cell| grid.value([cell[0] + offset[0], cell[1] + offset[1]]))
            .sum();
        let mean = f64::from(sum) / (255.0 * scan.cells.len() as f64);
        LEAST + mean * (MOST - LEAST)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_room::{room_grid, room_scan};

    /// Every candidate scored one by one.
    fn brute_force(
        stack: &PrecomputationGridStack,
        points: &[[f32; 2]],
        start: Pose,
        window: SearchWindow,
    ) -> f64 {
        let reach = (window.linear / stack.resolution).ceil() as i64;
        let step = angular_step(points, stack.resolution);
        let turns = (window.angular / step).ceil() as i64;
        let mut best = 0.0f64;
        for turn in -turns..=turns {
            let heading = start.heading + turn as f64 * step;
            let scan = stack.turned(points, start, heading, [-reach; 2], [reach; 2]);
            for y in -reach..=reach {
                for x in -reach..=reach {
                    best = best.max(stack.score(0, &scan, [x, y]));
                }
            }
        }
        best
    }

    #[test]
    fn branch_and_bound_finds_what_brute_force_finds() {
        let grid = room_grid();
        let points: Vec<[f32; 2]> = room_scan(Pose::new(3.0, 2.0, 0.5))
            .into_iter()
            .step_by(9)
            .collect();
        let window = SearchWindow {
            linear: 1.0,
            angular: 0.3,
        };
        for depth in [1, 3, 5, 7] {
            let stack = PrecomputationGridStack::new(&grid, depth);
            for start in [
                Pose::new(3.4, 1.6, 0.6),
                Pose::new(2.1, 2.9, 0.3),
                Pose::new(0.2, 0.1, -2.0),
            ] {
                let expected = brute_force(&stack, &points, start, window);
                let found = stack
                    .match_around(&points, start, window, 0.0)
                    .expect("something");
                assert!(
                    (found.score - expected).abs() < 1e-12,
                    "{depth}: {found:?} {expected}"
                );
            }
        }
    }

    #[test]
    fn a_scan_is_found_anywhere_on_the_map() {
        let grid = room_grid();
        let truth = Pose::new(3.0, 2.0, 0.5);
        let stack = PrecomputationGridStack::new(&grid, 7);
        let found = stack.match_anywhere(&room_scan(truth), 0.6).expect("a match");
        assert!(found.pose.distance(truth) < 0.08, "{found:?}");
        assert!(maps::wrap_angle(found.pose.heading - truth.heading).abs() < 0.03);
        assert_eq!(stack.match_anywhere(&[], 0.6), None);
    }

    #[test]
    fn a_level_bounds_the_one_below() {
        let stack = PrecomputationGridStack::new(&room_grid(), 5);
        for level in 1..5 {
            let half = 1i64 << (level - 1);
            for i in 0..500i64 {
                let cell = [(i * 7) % 130 - 5, (i * 13) % 90 - 5];
                let blocks = [[0, 0], [half, 0], [0, half], [half, half]];
                let greatest = blocks
                    .map(|by| stack.levels[level - 1].value([cell[0] + by[0], cell[1] + by[1]]))
                    .into_iter()
                    .max();
                assert_eq!(
                    Some(stack.levels[level].value(cell)),
                    greatest,
                    "{level} {cell:?}"
                );
            }
        }
    }
}
