//! The occupancy grid.

use crate::Pose;

/// What a map says of one cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Cell {
    /// A car can be here.
    Free,
    /// A wall or an obstacle.
    Occupied,
    /// Never seen.
    Unknown,
}

/// An occupancy grid, row 0 at the bottom (y grows with the row), as `nav_msgs/OccupancyGrid` has it.
#[derive(Debug, Clone, PartialEq)]
pub struct OccupancyGrid {
    /// Cells along the grid's x axis.
    pub width: usize,
    /// Cells along the grid's y axis.
    pub height: usize,
    /// Edge of a cell [m].
    pub resolution: f64,
    /// The lower left corner of cell (0, 0) in `map`; its heading turns the whole grid.
    pub origin: Pose,
    /// `width * height` cells, row by row from the bottom.
    pub cells: Vec<Cell>,
    /// How much of each cell is wall, 0 (none) to 255 (all), in the order of `cells`: the grey of the map's
    /// image. Maps drawn or edited with anti-aliasing say with it where in a cell a wall's face lies.
    pub occupancy: Vec<u8>,
}

impl OccupancyGrid {
    /// A grid of which only the cells' states are known. Panics unless there are `width * height` cells.
    pub fn new(width: usize, height: usize, resolution: f64, origin: Pose, cells: Vec<Cell>) -> Self {
        assert_eq!(cells.len(), width * height, "one cell per place");
        let occupancy = cells
            .iter()
            .map(|cell| match cell {
                Cell::Free => 0,
                Cell::Unknown => 128,
                Cell::Occupied => 255,
            })
            .collect();
        Self {
            width,
            height,
            resolution,
            origin,
            cells,
            occupancy,
        }
    }

    /// The cell at (`column`, `row`); [`Cell::Unknown`] outside the grid.
    pub fn cell(&self, column: i64, row: i64) -> Cell {
        if (0..self.width as i64).contains(&column) && (0..self.height as i64).contains(&row) {
            self.cells[row as usize * self.width + column as usize]
        } else {
            Cell::Unknown
        }
    }

    /// A point of `map` [m] in grid coordinates [cells]: the centre of cell (0, 0) is (0.5, 0.5).
    pub fn to_grid(&self, point: [f64; 2]) -> [f64; 2] {
        self.origin
            .inverse()
            .transform(point)
            .map(|v| v / self.resolution)
    }

    /// A point in grid coordinates [cells], in `map` [m].
    pub fn to_map(&self, point: [f64; 2]) -> [f64; 2] {
        self.origin.transform(point.map(|v| v * self.resolution))
    }

    /// The cell that holds a point of `map` [m]; [`Cell::Unknown`] outside the grid.
    pub fn at(&self, point: [f64; 2]) -> Cell {
        let [column, row] = self.to_grid(point);
        self.cell(column.floor() as i64, row.floor() as i64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn grid() -> OccupancyGrid {
        let cells = vec![
            Cell::Free,
            Cell::Free,
            Cell::Occupied,
            Cell::Free,
            Cell::Unknown,
            Cell::Free,
        ];
        OccupancyGrid::new(3, 2, 0.05, Pose::new(25.9, 48.5, 3.0), cells)
    }

    #[test]
    fn row_zero_is_at_the_bottom() {
        assert_eq!(grid().cell(2, 0), Cell::Occupied);
        assert_eq!(grid().at(grid().to_map([1.5, 1.5])), Cell::Unknown);
        assert_eq!(grid().cell(-1, 0), Cell::Unknown);
    }

    proptest! {
        #[test]
        fn map_and_grid_coordinates_are_inverse(x in -100.0..100.0, y in -100.0..100.0) {
            let [u, v] = grid().to_map(grid().to_grid([x, y]));
            prop_assert!((u - x).abs() < 1e-9 && (v - y).abs() < 1e-9);
        }
    }
}
