//! How near walls are, at two resolutions: the maps on which a correlative match scores poses (Olson, ICRA 2009).

use maps::{DistanceField, OccupancyGrid};

/// How near a wall is, coarsely and in few bytes, so that a whole map stays in a processor's cache while every
/// pose is tried on it.
#[derive(Debug)]
pub(crate) struct ScorePyramid {
    /// For poses that are tried a second time.
    pub(crate) fine: Level,
    /// For poses that are tried everywhere.
    pub(crate) coarse: Level,
}

/// A map blurred so far.
#[derive(Debug)]
pub(crate) struct Level {
    width: usize,
    /// 255 on a wall, a half at a distance as far off as a pose of this level is, falling to 0.
    nearness: Vec<u8>,
    /// Edge of a cell \[m\].
    resolution: f32,
}

/// A level's cells are about this large \[m\], fine and coarse, and it is blurred twice as far.
const CELL: [f64; 2] = [0.1, 0.2];

/// Least mean nearness of a pose that is looked at again.
const LEAST_NEARNESS: f32 = 0.3;

impl ScorePyramid {
    pub(crate) fn new(grid: &OccupancyGrid, field: &DistanceField) -> Self {
        let [fine, coarse] = CELL.map(|cell| Level::new(grid, field, cell));
        Self { fine, coarse }
    }
}

impl Level {
    fn new(grid: &OccupancyGrid, field: &DistanceField, cell: f64) -> Self {
        let factor = (cell / grid.resolution).round().max(1.0) as usize;
        let (width, height) = (grid.width.div_ceil(factor), grid.height.div_ceil(factor));
        let nearest = |index: usize| {
            let (column, row) = (index % width * factor, index / width * factor);
            let columns = column..(column + factor).min(grid.width);
            let rows = row..(row + factor).min(grid.height);
            let cells = rows.flat_map(|row| columns.clone().map(move |column| row * grid.width + column));
            cells
                .map(|cell| field.values()[cell].abs())
                .fold(f32::INFINITY, f32::min)
        };
        let nearness = (0..width * height)
            .map(|index| {
                let ratio = nearest(index) / (2.0 * cell as f32);
                (255.0 / (1.0 + ratio * ratio)) as u8
            })
            .collect();
        Self {
            width,
            nearness,
            resolution: (grid.resolution * factor as f64) as f32,
        }
    }

    /// Nearness at a point in cells, 0 outside.
    #[inline]
    fn at(&self, u: f32, v: f32) -> u32 {
        // Negative coordinates become 0 and lie outside or in the rim; a column beyond the width is caught.
        let (column, row) = (u as usize, v as usize);
        if column >= self.width || u < 0.0 || v < 0.0 {
            return 0;
        }
        self.nearness
            .get(row * self.width + column)
            .map_or(0, |&nearness| u32::from(nearness))
    }

    /// The points turned by each heading, in cells.
    pub(crate) fn turned(
        &self,
        points: &[[f32; 2]],
        headings: impl Iterator<Item = f64>,
    ) -> Vec<Vec<[f32; 2]>> {
        let cells = 1.0 / self.resolution;
        headings
            .map(|heading| {
                let (sin, cos) = (heading.sin() as f32 * cells, heading.cos() as f32 * cells);
                points
                    .iter()
                    .map(|p| [cos * p[0] - sin * p[1], sin * p[0] + cos * p[1]])
                    .collect()
            })
            .collect()
    }

    /// The summed nearness of points around a position \[m\]; None if it is too little. Most poses are hopeless after half
    /// of the points.
    #[inline]
    pub(crate) fn matched(&self, position: [f32; 2], points: &[[f32; 2]]) -> Option<u32> {
        let cells = 1.0 / self.resolution;
        let (u, v) = (position[0] * cells, position[1] * cells);
        let sum = |points: &[[f32; 2]]| -> u32 { points.iter().map(|p| self.at(u + p[0], v + p[1])).sum() };
        let least = |points: usize| (LEAST_NEARNESS * 255.0 * points as f32) as u32;
        let (half, rest) = points.split_at(points.len() / 2);
        let first = sum(half);
        if first * 3 < least(half.len()) * 2 {
            return None;
        }
        let whole = first + sum(rest);
        (whole >= least(points.len())).then_some(whole)
    }
}
