//! A grid of probabilities that its cells are occupied, which grows as scans are inserted.

/// Probabilities are kept within these bounds.
pub(crate) const LEAST: f64 = 0.1;
pub(crate) const MOST: f64 = 0.9;

/// A cell's value: 0 while unknown, else 1 for [`LEAST`] to this for [`MOST`].
const TOP: u16 = 32_767;

/// Marks a cell that the scan under way has already changed.
const MARK: u16 = 1 << 15;

/// The grid grows by blocks of this many cells.
const BLOCK: i64 = 64;

/// No submap is longer than this: end points farther out are left out [cells].
const LONGEST: i64 = 8192;

/// A grid whose axes are those of its frame.
#[derive(Debug, Clone)]
pub(crate) struct ProbabilityGrid {
    resolution: f64,
    /// Indices of the first column and row: cell `[i, j]` covers `[i, i + 1) * resolution`.
    first: [i64; 2],
    width: usize,
    height: usize,
    values: Vec<u16>,
    /// The cells that the scan under way has changed.
    changed: Vec<usize>,
}

/// A probability and its gradient [1/m].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Sample {
    pub(crate) probability: f64,
    pub(crate) gradient: [f64; 2],
}

/// What one observation makes of each value.
#[derive(Debug, Clone)]
pub(crate) struct Observation(Vec<u16>);

fn value_of(probability: f64) -> u16 {
    let share = (probability.clamp(LEAST, MOST) - LEAST) / (MOST - LEAST);
    1 + (share * f64::from(TOP - 1)).round() as u16
}

fn probability_of(value: u16) -> f64 {
    LEAST + f64::from(value.saturating_sub(1)) * ((MOST - LEAST) / f64::from(TOP - 1))
}

impl Observation {
    /// The table for an observation that a cell is occupied with this probability (Probabilistic Robotics, table 9.1).
    pub(crate) fn new(probability: f64) -> Self {
        let odds = |p: f64| p / (1.0 - p);
        let by = odds(probability);
        let table = (0..=TOP).map(|value| {
            if value == 0 {
                return value_of(probability);
            }
            let after = by * odds(probability_of(value));
            value_of(after / (1.0 + after))
        });
        Self(table.collect())
    }
}

impl ProbabilityGrid {
    /// A grid without cells.
    pub(crate) fn new(resolution: f64) -> Self {
        Self {
            resolution,
            first: [0; 2],
            width: 0,
            height: 0,
            values: Vec::new(),
            changed: Vec::new(),
        }
    }

    /// A grid from its cells' probabilities, row by row, None where unknown. Its corner is the origin of its frame.
    pub(crate) fn from_probabilities(
        width: usize,
        resolution: f64,
        probabilities: impl Iterator<Item = Option<f64>>,
    ) -> Self {
        let values: Vec<u16> = probabilities.map(|p| p.map_or(0, value_of)).collect();
        Self {
            resolution,
            first: [0; 2],
            width,
            height: values.len() / width.max(1),
            values,
            changed: Vec::new(),
        }
    }

    pub(crate) fn resolution(&self) -> f64 {
        self.resolution
    }

    pub(crate) fn width(&self) -> usize {
        self.width
    }

    pub(crate) fn height(&self) -> usize {
        self.height
    }

    /// The cell that contains a point.
    pub(crate) fn cell(&self, point: [f64; 2]) -> [i64; 2] {
        point.map(|v| (v / self.resolution).floor() as i64)
    }

    fn index(&self, cell: [i64; 2]) -> Option<usize> {
        let (column, row) = (cell[0] - self.first[0], cell[1] - self.first[1]);
        let inside = (0..self.width as i64).contains(&column) && (0..self.height as i64).contains(&row);
        inside.then(|| row as usize * self.width + column as usize)
    }

    /// The probability of a cell; [`LEAST`] where nothing is known.
    #[inline]
    pub(crate) fn probability(&self, cell: [i64; 2]) -> f64 {
        self.index(cell).map_or(LEAST, |i| probability_of(self.values[i]))
    }

    /// The values of `N` cells of a row from a cell on, all of them on the grid.
    #[inline]
    fn row<const N: usize>(&self, cell: [i64; 2]) -> Option<&[u16; N]> {
        let (column, row) = (cell[0] - self.first[0], cell[1] - self.first[1]);
        let inside =
            column >= 0 && row >= 0 && column + N as i64 <= self.width as i64 && row < self.height as i64;
        if !inside {
            return None;
        }
        let begin = row as usize * self.width + column as usize;
        self.values.get(begin..begin + N)?.try_into().ok()
    }

    /// Adds the probabilities of `sums.len()` cells of a row from a cell on, in steps of [`MOST`] - [`LEAST`] over
    /// [`ProbabilityGrid::STEPS`] above [`LEAST`].
    #[inline]
    pub(crate) fn add_row(&self, cell: [i64; 2], sums: &mut [u32]) {
        let (column, row) = (cell[0] - self.first[0], cell[1] - self.first[1]);
        if row < 0 || row >= self.height as i64 {
            return;
        }
        let begin = row as usize * self.width;
        if column >= 0 && column + sums.len() as i64 <= self.width as i64 {
            let values = &self.values[begin + column as usize..][..sums.len()];
            for (sum, value) in sums.iter_mut().zip(values) {
                *sum += u32::from(value.saturating_sub(1));
            }
            return;
        }
        for (i, sum) in (column..).zip(sums) {
            if (0..self.width as i64).contains(&i) {
                *sum += u32::from(self.values[begin + i as usize].saturating_sub(1));
            }
        }
    }

    /// Steps from [`LEAST`] to [`MOST`].
    pub(crate) const STEPS: f64 = (TOP - 1) as f64;

    /// The probabilities of all cells from the first row on.
    pub(crate) fn probabilities(&self) -> impl Iterator<Item = f64> + '_ {
        self.values.iter().map(|&value| probability_of(value))
    }

    /// Interpolated by cubic convolution between the cells' centres (Keys, 1981).
    pub(crate) fn sample(&self, point: [f64; 2]) -> Sample {
        let [u, v] = point.map(|x| x / self.resolution - 0.5);
        let (column, row) = (u.floor(), v.floor());
        let (wu, du) = cubic(u - column);
        let (wv, dv) = cubic(v - row);
        let at = [column as i64 - 1, row as i64 - 1];
        let (mut p, mut pu, mut pv) = (0.0, 0.0, 0.0);
        for (j, (wv, dv)) in wv.into_iter().zip(dv).enumerate() {
            let (mut along, mut slope) = (0.0, 0.0);
            let begin = [at[0], at[1] + j as i64];
            let values = match self.row::<4>(begin) {
                Some(values) => values.map(probability_of),
                None => [0, 1, 2, 3].map(|i| self.probability([begin[0] + i, begin[1]])),
            };
            for ((wu, du), value) in wu.into_iter().zip(du).zip(values) {
                along += wu * value;
                slope += du * value;
            }
            p += wv * along;
            pu += wv * slope;
            pv += dv * along;
        }
        Sample {
            probability: p,
            gradient: [pu, pv].map(|slope| slope / self.resolution),
        }
    }

    /// Inserts a scan: beams end in `hits` and pass what lies between; nothing is known of the ends of `misses`. A cell
    /// changes once, and as hit where it is both.
    pub(crate) fn insert(
        &mut self,
        origin: [f64; 2],
        hits: &[[f64; 2]],
        misses: &[[f64; 2]],
        [hit, miss]: [&Observation; 2],
        free_space: bool,
    ) {
        self.grow(std::iter::once(&origin).chain(hits).chain(misses));
        for &end in hits {
            let cell = self.cell(end);
            self.observe(cell, hit);
        }
        if free_space {
            for (ends, whole) in [(hits, false), (misses, true)] {
                for &end in ends {
                    self.pass(origin, end, whole, miss);
                }
            }
        }
        for i in self.changed.drain(..) {
            self.values[i] &= !MARK;
        }
    }

    fn observe(&mut self, cell: [i64; 2], observation: &Observation) {
        let Some(i) = self.index(cell) else { return };
        let value = self.values[i];
        if value & MARK == 0 {
            self.values[i] = observation.0[usize::from(value)] | MARK;
            self.changed.push(i);
        }
    }

    /// Observes the cells from `origin` to `end`, and the last if `whole` (Amanatides and Woo, 1987).
    fn pass(&mut self, origin: [f64; 2], end: [f64; 2], whole: bool, observation: &Observation) {
        let (mut cell, last) = (self.cell(origin), self.cell(end));
        let way = [0, 1].map(|k| end[k] - origin[k]);
        let step = way.map(|v| if v < 0.0 { -1 } else { 1 });
        let per_cell = way.map(|v| {
            if v == 0.0 {
                f64::INFINITY
            } else {
                self.resolution / v.abs()
            }
        });
        let mut next = [0, 1].map(|k| {
            let border = (cell[k] + i64::from(way[k] >= 0.0)) as f64 * self.resolution;
            if way[k] == 0.0 {
                f64::INFINITY
            } else {
                ((border - origin[k]) / way[k]).max(0.0)
            }
        });
        let most = (cell[0].abs_diff(last[0]) + cell[1].abs_diff(last[1])).min(4 * LONGEST as u64);
        for _ in 0..most {
            if cell == last {
                break;
            }
            self.observe(cell, observation);
            let k = usize::from(next[1] < next[0]);
            cell[k] += step[k];
            next[k] += per_cell[k];
        }
        if whole && cell == last {
            self.observe(cell, observation);
        }
    }

    /// Grows until it covers the points, but never beyond [`LONGEST`].
    fn grow<'a>(&mut self, points: impl Iterator<Item = &'a [f64; 2]>) {
        let (mut low, mut high) = if self.values.is_empty() {
            ([i64::MAX; 2], [i64::MIN; 2])
        } else {
            let last = [self.width, self.height].map(|v| v as i64 - 1);
            (self.first, [self.first[0] + last[0], self.first[1] + last[1]])
        };
        for &point in points {
            let cell = self.cell(point);
            let longer = |k: usize| high[k].max(cell[k]).saturating_sub(low[k].min(cell[k])) >= LONGEST;
            if low[0] != i64::MAX && (longer(0) || longer(1)) {
                continue;
            }
            for k in 0..2 {
                low[k] = low[k].min(cell[k]);
                high[k] = high[k].max(cell[k]);
            }
        }
        if low[0] == i64::MAX {
            return;
        }
        let first = low.map(|v| v.div_euclid(BLOCK) * BLOCK);
        let size = [0, 1].map(|k| ((high[k].div_euclid(BLOCK) + 1) * BLOCK - first[k]) as usize);
        if first == self.first && size == [self.width, self.height] {
            return;
        }
        let mut values = vec![0; size[0] * size[1]];
        for row in 0..self.height {
            let to = (row as i64 + self.first[1] - first[1]) as usize * size[0]
                + (self.first[0] - first[0]) as usize;
            let from = row * self.width;
            values[to..to + self.width].copy_from_slice(&self.values[from..from + self.width]);
        }
        *self = Self {
            resolution: self.resolution,
            first,
            width: size[0],
            height: size[1],
            values,
            changed: std::mem::take(&mut self.changed),
        };
    }
}

/// Weights of the four values around a place, `t` of the way from the second to the third, and their derivatives.
fn cubic(t: f64) -> ([f64; 4], [f64; 4]) {
    let (t2, t3) = (t * t, t * t * t);
    (
        [
            0.5 * (-t3 + 2.0 * t2 - t),
            0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
            0.5 * (-3.0 * t3 + 4.0 * t2 + t),
            0.5 * (t3 - t2),
        ],
        [
            0.5 * (-3.0 * t2 + 4.0 * t - 1.0),
            0.5 * (9.0 * t2 - 10.0 * t),
            0.5 * (-9.0 * t2 + 8.0 * t + 1.0),
            0.5 * (3.0 * t2 - 2.0 * t),
        ],
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn inserted(times: usize) -> ProbabilityGrid {
        let mut grid = ProbabilityGrid::new(0.5);
        let (hit, miss) = (Observation::new(0.55), Observation::new(0.49));
        for _ in 0..times {
            grid.insert(
                [0.25, 0.25],
                &[[2.25, 0.25]],
                &[[0.25, -3.25]],
                [&hit, &miss],
                true,
            );
        }
        grid
    }

    #[test]
    fn odds_multiply_and_stay_within_bounds() {
        let odds = |p: f64| p / (1.0 - p);
        let grid = inserted(3);
        let expected = odds(0.55).powi(3);
        assert!((odds(grid.probability([4, 0])) - expected).abs() < 1e-3);
        let expected = odds(0.49).powi(3);
        assert!((odds(grid.probability([3, 0])) - expected).abs() < 1e-3);
        // The end of a miss is free too; beyond it nothing is known.
        assert!((odds(grid.probability([0, -7])) - expected).abs() < 1e-3);
        assert!((grid.probability([0, -8]) - LEAST).abs() < 1e-9);
        assert!((inserted(1000).probability([4, 0]) - MOST).abs() < 1e-9);
        assert!((inserted(1000).probability([2, 0]) - LEAST).abs() < 1e-4);
    }

    #[test]
    fn growing_keeps_what_was_there() {
        let mut grid = inserted(1);
        let before = grid.probability([4, 0]);
        let (hit, miss) = (Observation::new(0.55), Observation::new(0.49));
        grid.insert([-60.0, 80.0], &[[-61.0, 90.0]], &[], [&hit, &miss], true);
        assert!((grid.probability([4, 0]) - before).abs() < 1e-12);
        assert!(grid.probability([-122, 180]) > 0.54);
    }

    #[test]
    fn a_point_far_away_costs_no_memory() {
        let mut grid = inserted(1);
        let (hit, miss) = (Observation::new(0.55), Observation::new(0.49));
        grid.insert([0.0, 0.0], &[[1e9, 0.0], [0.0, -1e12]], &[], [&hit, &miss], true);
        assert!(grid.width().max(grid.height()) <= 8192 + 64);
    }

    #[test]
    fn the_gradient_is_that_of_the_probability() {
        let values = (0..100).map(|i| Some(0.15 + 0.007 * f64::from((i * 37) % 100)));
        let grid = ProbabilityGrid::from_probabilities(10, 0.05, values);
        for point in [[0.2, 0.21], [0.123, 0.303], [0.01, 0.27], [0.48, 0.49]] {
            let sample = grid.sample(point);
            for k in 0..2 {
                let mut ahead = point;
                ahead[k] += 1e-6;
                let slope = (grid.sample(ahead).probability - sample.probability) / 1e-6;
                assert!((slope - sample.gradient[k]).abs() < 1e-3, "{point:?}");
            }
        }
        // At a cell's centre it is the cell's own.
        let centre = [3.5 * 0.05, 6.5 * 0.05];
        assert!((grid.sample(centre).probability - grid.probability([3, 6])).abs() < 1e-9);
    }
}
