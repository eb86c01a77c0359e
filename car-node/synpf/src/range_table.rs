//! Ranges looked up: for every cell that a car can be in and every direction, the range to the wall.

use maps::{DistanceField, OccupancyGrid};
use rayon::prelude::*;
use wide::{f32x8, i32x8};

use crate::cddt::{CddtSlice, DIRECTIONS, HALF_TURN};

/// Directions that are filled at once while the table is built: their crossings with walls are in memory together.
const SEGMENT: usize = 16;
/// Rows that one task fills, direction by direction.
const CHUNK: usize = 1024;

/// One unit of a stored range \[m\]; 16 bits reach 164 m.
pub(crate) const UNIT: f32 = 0.0025;

/// What a table's contents depend on, beside the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct TableParameters {
    /// Directions that differ; fewer than [`DIRECTIONS`] only to reproduce a coarser table.
    pub(crate) directions: u16,
}

/// A range table for one region.
#[derive(Debug)]
pub(crate) struct RangeTable {
    /// For each block of cells its row in `ranges`; [`NO_ROW`] for blocks outside the region, and once more at the
    /// end for what is outside the grid.
    row_of: Vec<u32>,
    /// Rows of [`DIRECTIONS`] ranges, the first along x, in units of [`UNIT`].
    ranges: Vec<u16>,
    /// Blocks along x and y.
    width: usize,
    height: usize,
    /// One over the cells along a block's side.
    blocks_per_cell: f32,
}

/// The blocks of a grid: squares of `side` x `side` cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Blocks {
    /// Cells along a side.
    pub(crate) side: usize,
    /// Cells along x.
    grid_width: usize,
    /// Blocks along x and y.
    width: usize,
    height: usize,
}

impl Blocks {
    pub(crate) fn new(grid: &OccupancyGrid, side: usize) -> Self {
        Self {
            side,
            grid_width: grid.width,
            width: grid.width.div_ceil(side),
            height: grid.height.div_ceil(side),
        }
    }

    fn count(self) -> usize {
        self.width * self.height
    }

    /// The block of a cell.
    fn of(self, cell: u32) -> usize {
        let (column, line) = (cell as usize % self.grid_width, cell as usize / self.grid_width);
        line / self.side * self.width + column / self.side
    }

    /// The number of blocks that hold one of the cells.
    fn filled(self, cells: &[u32]) -> usize {
        if self.side == 1 {
            return cells.len();
        }
        let mut filled = vec![false; self.count()];
        for cell in cells {
            filled[self.of(*cell)] = true;
        }
        filled.into_iter().filter(|filled| *filled).count()
    }

    /// For each block that holds one of the cells, in order: its index, and the cell nearest to its middle of those that lie before
    /// a wall's face.
    fn representatives(self, cells: &[u32], field: &DistanceField) -> Vec<(usize, Option<u32>)> {
        let mut nearest = vec![(f32::INFINITY, None); self.count()];
        let middle = (self.side as f32 - 1.0) / 2.0;
        let mut filled = vec![false; self.count()];
        for &cell in cells {
            let block = self.of(cell);
            filled[block] = true;
            if field.values()[cell as usize] <= 0.0 {
                continue;
            }
            let (column, line) = (cell as usize % self.grid_width, cell as usize / self.grid_width);
            let aside = [column, line].map(|at| (at % self.side) as f32 - middle);
            let distance = aside[0].hypot(aside[1]);
            if distance < nearest[block].0 {
                nearest[block] = (distance, Some(cell));
            }
        }
        let blocks = filled.into_iter().enumerate().filter(|(_, filled)| *filled);
        blocks.map(|(block, _)| (block, nearest[block].1)).collect()
    }
}

const NO_ROW: u32 = u32::MAX;

impl RangeTable {
    /// A table for the region of `cells`, with a row for each block of `side` x `side` cells.
    pub(crate) fn new(
        grid: &OccupancyGrid,
        field: &DistanceField,
        cells: &[u32],
        side: usize,
        parameters: TableParameters,
    ) -> Self {
        let blocks = Blocks::new(grid, side);
        let representatives = blocks.representatives(cells, field);
        let mut row_of = vec![NO_ROW; blocks.count() + 1];
        for (row, (block, _)) in representatives.iter().enumerate() {
            row_of[*block] = row as u32;
        }
        let scale = grid.resolution as f32 / UNIT;
        let stored = |range: f32| (range * scale + 0.5) as u16;
        let faces = field.contour();
        // A free cell may lie behind a face where the map is grey. No laser is there: its ranges stay 0.
        let centre = |cell: u32| {
            let (column, line) = (cell as usize % grid.width, cell as usize / grid.width);
            [column as f32 + 0.5, line as f32 + 0.5]
        };
        let mut ranges = vec![0u16; representatives.len() * DIRECTIONS];
        for segment in (0..HALF_TURN).step_by(SEGMENT) {
            let slice = |k: usize| {
                let direction = (segment + k) as f64 / DIRECTIONS as f64;
                let steps = f64::from(parameters.directions);
                CddtSlice::new(
                    &faces,
                    (direction * steps).round() / steps * std::f64::consts::TAU,
                )
            };
            let slices: Vec<_> = (0..SEGMENT).into_par_iter().map(slice).collect();
            ranges
                .par_chunks_mut(CHUNK * DIRECTIONS)
                .zip(representatives.par_chunks(CHUNK))
                .for_each(|(rows, representatives)| {
                    for (k, slice) in slices.iter().enumerate() {
                        for (row, (_, cell)) in rows.chunks_exact_mut(DIRECTIONS).zip(representatives) {
                            if let Some(cell) = cell {
                                // The same half a turn on.
                                let [ahead, behind] = slice.ranges(centre(*cell));
                                row[segment + k] = stored(ahead);
                                row[segment + k + HALF_TURN] = stored(behind);
                            }
                        }
                    }
                });
        }
        Self {
            row_of,
            ranges,
            width: blocks.width,
            height: blocks.height,
            blocks_per_cell: 1.0 / side as f32,
        }
    }

    /// Memory that it takes \[bytes\].
    pub(crate) fn bytes(&self) -> usize {
        size_of_val(&*self.ranges) + size_of_val(&*self.row_of)
    }

    /// Memory that a table with blocks of `side` x `side` cells takes for a region \[bytes\].
    pub(crate) fn bytes_for(grid: &OccupancyGrid, cells: &[u32], side: usize) -> usize {
        let blocks = Blocks::new(grid, side);
        blocks.filled(cells) * DIRECTIONS * size_of::<u16>() + (blocks.count() + 1) * size_of::<u32>()
    }

    /// The rows for eight points in grid coordinates \[cells\]; see [`RangeTable::row`].
    #[inline]
    pub(crate) fn rows_at(&self, u: f32x8, v: f32x8) -> [u32; 8] {
        let zero = f32x8::ZERO;
        let scale = f32x8::splat(self.blocks_per_cell);
        let (u, v) = (u * scale, v * scale);
        // False for NaN.
        let inside = u.simd_ge(zero)
            & v.simd_ge(zero)
            & u.simd_lt(f32x8::splat(self.width as f32))
            & v.simd_lt(f32x8::splat(self.height as f32));
        let cell = v.fast_trunc_int() * i32x8::splat(self.width as i32) + u.fast_trunc_int();
        let (inside, cell) = (inside.to_bitmask(), cell.to_array());
        let outside = self.row_of.len() - 1;
        std::array::from_fn(|k| {
            let cell = if inside >> k & 1 == 1 {
                cell[k] as usize
            } else {
                outside
            };
            self.row_of[cell]
        })
    }

    /// The ranges in all directions of a row; None for one outside the region.
    #[inline]
    pub(crate) fn row(&self, row: u32) -> Option<&[u16; DIRECTIONS]> {
        let start = row as usize * DIRECTIONS;
        self.ranges.get(start..start + DIRECTIONS)?.try_into().ok()
    }

    /// Range from a point \[cells\] for a particle's heading and a beam's direction \[m\], rounded as the beam model does it.
    pub(crate) fn range(&self, from: [f32; 2], heading: f32, beam: f32) -> Option<f32> {
        let row = self.row(self.rows_at(f32x8::splat(from[0]), f32x8::splat(from[1]))[0])?;
        let step = |angle: f32| (angle / std::f32::consts::TAU * DIRECTIONS as f32).round() as i64;
        let direction = (step(heading) + step(beam)).rem_euclid(DIRECTIONS as i64);
        Some(f32::from(row[direction as usize]) * UNIT)
    }
}
