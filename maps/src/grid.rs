//! The occupancy grid.

use crate::Pose;

/// The state of a cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Cell {
    /// Free space.
    Free,
    /// A wall or an obstacle.
    Occupied,
    /// Not mapped.
    Unknown,
}

/// An occupancy grid, row 0 at the bottom (y grows with the row), as `nav_msgs/OccupancyGrid` has it.
#[derive(Debug, Clone, PartialEq)]
pub struct OccupancyGrid {
    /// Cells along the grid's x axis.
    pub width: usize,
    /// Cells along the grid's y axis.
    pub height: usize,
    /// Edge of a cell \[m\].
    pub resolution: f64,
    /// The lower left corner of cell (0, 0) in `map`; its heading turns the whole grid.
    pub origin: Pose,
    /// `width * height` cells, row by row from the bottom.
    pub cells: Vec<Cell>,
    /// The share of wall in each cell, 0 (none) to 255 (all), in the order of `cells`: the grey of the map's image. On maps
    /// drawn or edited with anti-aliasing it gives the place of a wall's face within the cell.
    pub occupancy: Vec<u8>,
}

impl OccupancyGrid {
    /// A grid from the cells' states alone. Panics unless there are `width * height` cells.
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

    /// A grid whose cell at column and row is `cell(column, row)`.
    pub fn from_fn(
        width: usize,
        height: usize,
        resolution: f64,
        origin: Pose,
        cell: impl Fn(usize, usize) -> Cell,
    ) -> Self {
        let cells = (0..width * height)
            .map(|index| cell(index % width, index / width))
            .collect();
        Self::new(width, height, resolution, origin, cells)
    }

    /// True if a laser can see a wall: an occupied cell, or, on a map that marks no walls, the border of free and unknown
    /// space.
    pub fn has_wall(&self) -> bool {
        let has = |state| self.cells.contains(&state);
        has(Cell::Occupied) || has(Cell::Free) && has(Cell::Unknown)
    }

    /// The cell at (`column`, `row`); [`Cell::Unknown`] outside the grid.
    pub fn cell(&self, column: i64, row: i64) -> Cell {
        if (0..self.width as i64).contains(&column) && (0..self.height as i64).contains(&row) {
            self.cells[row as usize * self.width + column as usize]
        } else {
            Cell::Unknown
        }
    }

    /// A point of `map` \[m\] in grid coordinates \[cells\]: the centre of cell (0, 0) is (0.5, 0.5).
    pub fn to_grid(&self, point: [f64; 2]) -> [f64; 2] {
        self.origin
            .inverse()
            .transform(point)
            .map(|v| v / self.resolution)
    }

    /// A point in grid coordinates \[cells\], in `map` \[m\].
    pub fn to_map(&self, point: [f64; 2]) -> [f64; 2] {
        self.origin.transform(point.map(|v| v * self.resolution))
    }

    /// The cell that contains a point of `map` \[m\]; [`Cell::Unknown`] outside the grid.
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
    fn a_map_of_one_state_has_no_wall() {
        use Cell::{Free, Occupied, Unknown};
        for (cells, expected) in [
            ([Free, Free], false),
            ([Unknown, Unknown], false),
            ([Free, Occupied], true),
            ([Free, Unknown], true),
        ] {
            let grid = OccupancyGrid::new(2, 1, 0.05, Pose::IDENTITY, cells.to_vec());
            assert_eq!(grid.has_wall(), expected, "{cells:?}");
        }
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
