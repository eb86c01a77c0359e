//! Ranges looked up: for every cell that a car can be in and every direction, the range to the wall.

use maps::{DistanceField, OccupancyGrid};
use rayon::prelude::*;
use wide::{f32x8, i32x8};

use crate::cddt::{CddtSlice, DIRECTIONS, HALF_TURN};

/// Directions that one task fills while the table is built.
const SEGMENT: usize = 16;

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
    /// For each cell of the grid its row in `ranges`; [`NO_ROW`] for cells outside the region, and once more at the
    /// end for what is outside the grid.
    row_of: Vec<u32>,
    /// Rows of [`DIRECTIONS`] ranges, the first along x, in units of [`UNIT`].
    ranges: Vec<u16>,
    width: usize,
    height: usize,
}

const NO_ROW: u32 = u32::MAX;

impl RangeTable {
    pub(crate) fn new(
        grid: &OccupancyGrid,
        field: &DistanceField,
        cells: &[u32],
        parameters: TableParameters,
    ) -> Self {
        let mut row_of = vec![NO_ROW; grid.cells.len() + 1];
        for (row, &cell) in cells.iter().enumerate() {
            row_of[cell as usize] = row as u32;
        }
        let scale = grid.resolution as f32 / UNIT;
        let stored = |range: f32| (range * scale + 0.5) as u16;
        let faces = field.contour();
        // A free cell may lie behind a face where the map is grey. No laser is there: its ranges stay 0.
        let centres: Vec<(usize, [f32; 2])> = cells
            .iter()
            .enumerate()
            .filter(|(_, cell)| field.values()[**cell as usize] > 0.0)
            .map(|(row, &cell)| {
                let (column, line) = (cell as usize % grid.width, cell as usize / grid.width);
                (row, [column as f32 + 0.5, line as f32 + 0.5])
            })
            .collect();
        // Each task fills a segment of directions, and the same half a turn on, in its own buffers.
        let segments: Vec<Vec<[[u16; SEGMENT]; 2]>> = (0..HALF_TURN / SEGMENT)
            .into_par_iter()
            .map(|segment| {
                let mut part = vec![[[0; SEGMENT]; 2]; cells.len()];
                let fill = |part: &mut [[[u16; SEGMENT]; 2]], k: usize| {
                    let direction = (segment * SEGMENT + k) as f64 / DIRECTIONS as f64;
                    let steps = f64::from(parameters.directions);
                    let slice = CddtSlice::new(
                        &faces,
                        (direction * steps).round() / steps * std::f64::consts::TAU,
                    );
                    for &(row, centre) in &centres {
                        let [ahead, behind] = slice.ranges(centre);
                        part[row][0][k] = stored(ahead);
                        part[row][1][k] = stored(behind);
                    }
                };
                (0..SEGMENT).for_each(|k| fill(&mut part, k));
                part
            })
            .collect();
        let mut ranges = vec![0u16; cells.len() * DIRECTIONS];
        ranges
            .par_chunks_mut(DIRECTIONS)
            .enumerate()
            .for_each(|(row, out)| {
                for (segment, part) in segments.iter().enumerate() {
                    for (half, values) in part[row].iter().enumerate() {
                        let from = half * HALF_TURN + segment * SEGMENT;
                        out[from..from + SEGMENT].copy_from_slice(values);
                    }
                }
            });
        Self {
            row_of,
            ranges,
            width: grid.width,
            height: grid.height,
        }
    }

    /// Memory that it takes \[bytes\].
    pub(crate) fn bytes(&self) -> usize {
        size_of_val(&*self.ranges) + size_of_val(&*self.row_of)
    }

    /// Memory that a table for `region_cells` cells of a grid of `grid_cells` takes \[bytes\].
    pub(crate) fn bytes_for(grid_cells: usize, region_cells: usize) -> usize {
        region_cells * DIRECTIONS * size_of::<u16>() + (grid_cells + 1) * size_of::<u32>()
    }

    /// The rows for eight points in grid coordinates \[cells\]; see [`RangeTable::row`].
    #[inline]
    pub(crate) fn rows_at(&self, u: f32x8, v: f32x8) -> [u32; 8] {
        let zero = f32x8::ZERO;
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
    #[cfg(test)]
    pub(crate) fn range(&self, from: [f32; 2], heading: f32, beam: f32) -> Option<f32> {
        let row = self.row(self.rows_at(f32x8::splat(from[0]), f32x8::splat(from[1]))[0])?;
        let step = |angle: f32| (angle / std::f32::consts::TAU * DIRECTIONS as f32).round() as i64;
        let direction = (step(heading) + step(beam)).rem_euclid(DIRECTIONS as i64);
        Some(f32::from(row[direction as usize]) * UNIT)
    }
}
