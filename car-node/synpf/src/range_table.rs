//! Ranges looked up: for every cell that a car can be in and every direction, the range to the wall.

use maps::{DistanceField, OccupancyGrid};
use rayon::prelude::*;

use crate::cddt::{HALF_TURN, Lanes};

/// Directions that a table distinguishes; a power of two, so that headings wrap with a mask.
pub(crate) const DIRECTIONS: usize = 256;

/// Directions that one task of the building handles.
const STRETCH: usize = 16;

/// One unit of a stored range [m]; 16 bits reach 164 m.
pub(crate) const UNIT: f32 = 0.0025;

/// What a table's contents depend on, beside the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct TableParameters {
    /// Directions that differ; fewer than [`DIRECTIONS`] only to reproduce a coarser table.
    pub(crate) directions: u16,
    /// Ranges come out half a cell long, as the reference's.
    pub(crate) long_ranges: bool,
}

/// A range table for one region.
#[derive(Debug)]
pub(crate) struct RangeTable {
    /// For each cell of the grid its row in `ranges`; [`NO_ROW`] for cells outside the region.
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
        let mut row_of = vec![NO_ROW; grid.cells.len()];
        for (row, &cell) in cells.iter().enumerate() {
            row_of[cell as usize] = row as u32;
        }
        let scale = grid.resolution as f32 / UNIT;
        let bias = if parameters.long_ranges { 0.5 } else { 0.0 };
        let stored = |range: f32| ((range + bias) * scale + 0.5) as u16;
        let faces = field.contour();
        // Each task fills a stretch of directions, and the same half a turn on, in buffers of its own.
        let stretches: Vec<Vec<[[u16; STRETCH]; 2]>> = (0..HALF_TURN / STRETCH)
            .into_par_iter()
            .map(|stretch| {
                let mut part = vec![[[0; STRETCH]; 2]; cells.len()];
                for k in 0..STRETCH {
                    let direction = (stretch * STRETCH + k) as f64 / DIRECTIONS as f64;
                    let steps = f64::from(parameters.directions);
                    let lanes = Lanes::new(
                        &faces,
                        (direction * steps).round() / steps * std::f64::consts::TAU,
                    );
                    for (entry, &cell) in part.iter_mut().zip(cells) {
                        let cell = cell as usize;
                        // On a wall's face, where grey calls a cell free, there is no laser.
                        if field.values()[cell] > 0.0 {
                            let centre = [(cell % grid.width) as f32 + 0.5, (cell / grid.width) as f32 + 0.5];
                            let [ahead, behind] = lanes.ranges(centre);
                            entry[0][k] = stored(ahead);
                            entry[1][k] = stored(behind);
                        }
                    }
                }
                part
            })
            .collect();
        let mut ranges = vec![0u16; cells.len() * DIRECTIONS];
        ranges
            .par_chunks_mut(DIRECTIONS)
            .enumerate()
            .for_each(|(row, out)| {
                for (stretch, part) in stretches.iter().enumerate() {
                    for (half, values) in part[row].iter().enumerate() {
                        let from = half * HALF_TURN + stretch * STRETCH;
                        out[from..from + STRETCH].copy_from_slice(values);
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

    /// Memory that it takes [bytes].
    pub(crate) fn bytes(&self) -> usize {
        self.ranges.len() * size_of::<u16>() + self.row_of.len() * size_of::<u32>()
    }

    /// The ranges from a point in grid coordinates [cells], in all directions; None outside the region.
    #[inline]
    pub(crate) fn row(&self, u: f32, v: f32) -> Option<&[u16; DIRECTIONS]> {
        if !(u >= 0.0 && v >= 0.0) {
            return None;
        }
        let (column, row) = (u as usize, v as usize);
        if column >= self.width || row >= self.height {
            return None;
        }
        let start = self.row_of[row * self.width + column] as usize * DIRECTIONS;
        self.ranges.get(start..start + DIRECTIONS)?.try_into().ok()
    }
}
