//! Connected pieces of free space.

use maps::{Cell, DistanceField, OccupancyGrid};

/// A connected piece of free space.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Region {
    /// Its cells.
    pub(crate) cells: Vec<u32>,
    /// Greatest distance from a wall within it [m]: small for a track, large for an infield.
    pub(crate) clearance: f64,
}

/// In place of a region's index: the cell is in none.
pub(crate) const NOWHERE: u16 = u16::MAX;

/// Smaller regions are left out; they are too small for a car [m^2].
const SMALLEST_REGION: f64 = 1.0;

/// Splits the free space into connected pieces. Returns them with the index of each cell's region, [`NOWHERE`] for none.
pub(crate) fn regions(grid: &OccupancyGrid, field: &DistanceField) -> (Vec<Region>, Vec<u16>) {
    let mut region_of = vec![NOWHERE; grid.cells.len()];
    let mut regions = Vec::new();
    let smallest = SMALLEST_REGION / (grid.resolution * grid.resolution);
    let mut seen = vec![false; grid.cells.len()];
    for seed in 0..grid.cells.len() {
        if seen[seed] || grid.cells[seed] != Cell::Free {
            continue;
        }
        seen[seed] = true;
        let (mut cells, mut next) = (vec![seed as u32], 0);
        while next < cells.len() {
            let i = cells[next] as usize;
            next += 1;
            let (column, row) = (i % grid.width, i / grid.width);
            let neighbours = [
                (column > 0).then(|| i - 1),
                (column + 1 < grid.width).then(|| i + 1),
                (row > 0).then(|| i - grid.width),
                (row + 1 < grid.height).then(|| i + grid.width),
            ];
            for j in neighbours.into_iter().flatten() {
                if !seen[j] && grid.cells[j] == Cell::Free {
                    seen[j] = true;
                    cells.push(j as u32);
                }
            }
        }
        if (cells.len() as f64) < smallest || regions.len() + 1 >= usize::from(NOWHERE) {
            continue;
        }
        // In the order of the grid, so that the rows of neighbouring cells lie close together in a table.
        cells.sort_unstable();
        for &cell in &cells {
            region_of[cell as usize] = regions.len() as u16;
        }
        let deepest = cells
            .iter()
            .map(|&cell| field.values()[cell as usize])
            .fold(0.0, f32::max);
        regions.push(Region {
            cells,
            clearance: f64::from(deepest),
        });
    }
    (regions, region_of)
}
