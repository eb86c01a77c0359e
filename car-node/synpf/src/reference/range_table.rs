//! The reference's ranges: rays marched through the grid from the corners of cells, in a table of a few directions.
//!
//! What `range_libc` does, as `RayMarching` and `GiantLUTCast`: a ray starts at its cell's corner, steps by the distance to
//! the nearest wall's cell, by one cell at least, and ends in the first wall's cell that a step hits. Both ends are whole
//! cells, which makes ranges half a cell long. Only occupied cells stop a ray; the unknown does not.
//!
//! The reference's table holds every cell of the map. Ours holds the free cells of the region that the car is in, with
//! the same numbers; elsewhere rays are cast when they are needed.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use maps::{Cell, OccupancyGrid};
use rayon::prelude::*;

use super::parameters::ReferenceParameters;

/// What ranges depend on, beside the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Method {
    /// Directions that differ.
    pub(super) directions: u16,
    /// The greatest range \[cells\].
    most: u16,
    /// Ranges come out half a cell long.
    long: bool,
}

impl Method {
    pub(super) fn new(parameters: &ReferenceParameters, resolution: f64) -> Self {
        Self {
            directions: parameters.theta_discretization,
            most: (parameters.max_range / resolution) as u16,
            long: parameters.defects.defect_long_ranges,
        }
    }

    /// The cell of the sensor table for a range in cells.
    fn stored(self, range: f32) -> u16 {
        let most = f32::from(self.most);
        if !self.long {
            // To the wall's face, from the middle of a cell; no return stays what it is.
            return if range >= most {
                self.most
            } else {
                (range - 0.5).max(0.0) as u16
            };
        }
        // Through 16 bits and back, rounded down both times, as in the reference's table.
        let limit = f32::from(u16::MAX);
        let bits = (range.min(most) * (limit / most)) as u16;
        (f32::from(bits) * (most / limit)) as u16
    }
}

/// Distance from each cell to the nearest occupied one, between centres \[cells\].
#[derive(Debug)]
pub(super) struct Walls {
    width: usize,
    height: usize,
    distance: Vec<f32>,
}

impl Walls {
    pub(super) fn new(grid: &OccupancyGrid) -> Self {
        let (width, height) = (grid.width, grid.height);
        let far = ((width + height) as f64).powi(2);
        let mut squared: Vec<f64> = grid
            .cells
            .iter()
            .map(|cell| if *cell == Cell::Occupied { 0.0 } else { far })
            .collect();
        let mut column = vec![0.0; height];
        for x in 0..width {
            for (y, value) in column.iter_mut().enumerate() {
                *value = squared[y * width + x];
            }
            for (y, value) in lower_envelope(&column).into_iter().enumerate() {
                squared[y * width + x] = value;
            }
        }
        let rows = squared
            .par_chunks(width)
            .flat_map_iter(|row| lower_envelope(row).into_iter().map(|value| value.sqrt() as f32));
        Self {
            width,
            height,
            distance: rows.collect(),
        }
    }

    /// The range from a cell's corner in a direction \[rad\], at most `most`, in cells.
    fn range(&self, [column, row]: [i32; 2], angle: f32, most: f32) -> f32 {
        let (x0, y0) = (column as f32, row as f32);
        let (sin, cos) = angle.sin_cos();
        let mut way = 0.0;
        while way < most {
            // Rounded towards zero.
            let (x, y) = ((x0 + cos * way) as i32, (y0 + sin * way) as i32);
            if x < 0 || y < 0 || x >= self.width as i32 || y >= self.height as i32 {
                return most;
            }
            let distance = self.distance[y as usize * self.width + x as usize];
            if distance <= 0.0 {
                return (x as f32 - x0).hypot(y as f32 - y0);
            }
            way += (distance * 0.999).max(1.0);
        }
        most
    }

    /// The cell of the sensor table for a ray from a cell in one of the directions.
    pub(super) fn cast(&self, cell: [i32; 2], direction: usize, method: Method) -> u16 {
        let angle = direction as f32 * (std::f32::consts::TAU / f32::from(method.directions));
        method.stored(self.range(cell, angle, f32::from(method.most)))
    }

    fn bytes(&self) -> usize {
        self.distance.len() * size_of::<f32>()
    }
}

/// For each place the least of `values[i] + (place - i)^2` (Felzenszwalb and Huttenlocher, Theory of Computing 8, 2012).
fn lower_envelope(values: &[f64]) -> Vec<f64> {
    // Parabolas of the envelope, and from where on each is the lowest.
    let mut parabolas: Vec<(usize, f64)> = Vec::new();
    for (i, value) in values.iter().enumerate() {
        let meets = |other: usize| {
            let square = |k: usize| (k as f64).powi(2);
            (value + square(i) - values[other] - square(other)) / (2 * (i - other)) as f64
        };
        let mut from = f64::NEG_INFINITY;
        while let Some(&(last, last_from)) = parabolas.last() {
            from = meets(last);
            if from > last_from {
                break;
            }
            parabolas.pop();
            from = f64::NEG_INFINITY;
        }
        parabolas.push((i, from));
    }
    let mut k = 0;
    (0..values.len())
        .map(|place| {
            while parabolas.get(k + 1).is_some_and(|next| next.1 < place as f64) {
                k += 1;
            }
            let i = parabolas[k].0;
            values[i] + (place.abs_diff(i) as f64).powi(2)
        })
        .collect()
}

/// The ranges from the free cells of one region, as cells of the sensor table.
#[derive(Debug)]
pub(super) struct Table {
    /// For each cell of the grid its row in `ranges`; [`NO_ROW`] outside the region.
    row_of: Vec<u32>,
    /// Rows of one range per direction.
    ranges: Vec<u16>,
    directions: usize,
}

const NO_ROW: u32 = u32::MAX;

impl Table {
    fn new(grid: &OccupancyGrid, walls: &Walls, cells: &[u32], method: Method) -> Self {
        let mut row_of = vec![NO_ROW; grid.cells.len()];
        for (row, &cell) in cells.iter().enumerate() {
            row_of[cell as usize] = row as u32;
        }
        let directions = usize::from(method.directions);
        let mut ranges = vec![0; cells.len() * directions];
        ranges
            .par_chunks_mut(directions)
            .zip(cells)
            .for_each(|(row, &cell)| {
                let cell = [cell as usize % grid.width, cell as usize / grid.width].map(|v| v as i32);
                for (direction, range) in row.iter_mut().enumerate() {
                    *range = walls.cast(cell, direction, method);
                }
            });
        Self {
            row_of,
            ranges,
            directions,
        }
    }

    /// The ranges from a cell by direction; None outside the region.
    pub(super) fn row(&self, cell: usize) -> Option<&[u16]> {
        let start = *self.row_of.get(cell)? as usize * self.directions;
        self.ranges.get(start..start + self.directions)
    }

    fn bytes(&self) -> usize {
        self.ranges.len() * size_of::<u16>() + self.row_of.len() * size_of::<u32>()
    }
}

/// What the reference looks up in a map; built when it is first needed and shared.
#[derive(Debug, Default)]
pub(crate) struct RangeTables {
    walls: OnceLock<Arc<Walls>>,
    tables: Mutex<HashMap<(usize, Method), Arc<Table>>>,
}

impl RangeTables {
    pub(super) fn walls(&self, grid: &OccupancyGrid) -> Arc<Walls> {
        Arc::clone(self.walls.get_or_init(|| Arc::new(Walls::new(grid))))
    }

    /// Builds the table for a region, away from the filter's thread, unless all tables then took more than `budget` \[bytes\].
    pub(super) fn build(
        &self,
        grid: &OccupancyGrid,
        region: usize,
        cells: &[u32],
        method: Method,
        budget: usize,
    ) {
        let bytes = cells.len() * usize::from(method.directions) * size_of::<u16>()
            + grid.cells.len() * size_of::<u32>();
        if self.get(region, method).is_some() || self.bytes() + bytes > budget {
            return;
        }
        let table = Arc::new(Table::new(grid, &self.walls(grid), cells, method));
        let mut tables = self.tables.lock().unwrap_or_else(PoisonError::into_inner);
        tables.entry((region, method)).or_insert(table);
    }

    /// The table for a region, if it has been built.
    pub(super) fn get(&self, region: usize, method: Method) -> Option<Arc<Table>> {
        let tables = self.tables.lock().unwrap_or_else(PoisonError::into_inner);
        tables.get(&(region, method)).cloned()
    }

    /// Memory that all this takes \[bytes\].
    pub(crate) fn bytes(&self) -> usize {
        let tables = self.tables.lock().unwrap_or_else(PoisonError::into_inner);
        tables.values().map(|table| table.bytes()).sum::<usize>()
            + self.walls.get().map_or(0, |walls| walls.bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maps::Pose;

    /// A room of 40 x 30 cells with walls one cell thick; beyond a gap in the right wall is the unknown.
    fn room() -> OccupancyGrid {
        let cell = |x: usize, y: usize| {
            let inside = (5..45).contains(&x) && (5..35).contains(&y);
            let gap = x >= 44 && (18..22).contains(&y);
            let rim = x == 5 || x == 44 || y == 5 || y == 34;
            match (inside, rim) {
                (true, true) if !gap => Cell::Occupied,
                (true, _) => Cell::Free,
                (false, _) => Cell::Unknown,
            }
        };
        OccupancyGrid::from_fn(60, 40, 0.05, Pose::IDENTITY, cell)
    }

    fn method(long: bool) -> Method {
        Method {
            directions: 150,
            most: 400,
            long,
        }
    }

    #[test]
    fn distances_are_those_to_the_nearest_wall() {
        let grid = room();
        let walls = Walls::new(&grid);
        let occupied: Vec<[f32; 2]> = (0..grid.cells.len())
            .filter(|&i| grid.cells[i] == Cell::Occupied)
            .map(|i| [(i % grid.width) as f32, (i / grid.width) as f32])
            .collect();
        for i in (0..grid.cells.len()).step_by(7) {
            let (x, y) = ((i % grid.width) as f32, (i / grid.width) as f32);
            let nearest = occupied
                .iter()
                .map(|[wx, wy]| (wx - x).hypot(wy - y))
                .fold(f32::INFINITY, f32::min);
            assert!((walls.distance[i] - nearest).abs() < 1e-4, "{x} {y}");
        }
    }

    #[test]
    fn ranges_are_half_a_cell_long_and_the_unknown_stops_no_ray() {
        let walls = Walls::new(&room());
        let range = |cell, angle: f32| walls.range(cell, angle, 400.0);
        // From the middle of cell 20 to the face at 44 it is 23.5 cells, to that at 6 it is 14.5.
        assert!((range([20, 10], 0.0) - 24.0).abs() < 1e-6);
        // Rounding makes the ray leave its row.
        assert!((range([20, 10], std::f32::consts::PI) - 15.0).abs() < 0.05);
        assert!((range([20, 20], 0.0) - 400.0).abs() < 1e-6, "through the gap");
    }

    #[test]
    fn what_is_stored_is_half_a_cell_shorter_when_mended() {
        for range in [3.0, 17.3, 120.9] {
            let difference = method(true).stored(range + 0.5) - method(false).stored(range + 0.5);
            assert!(difference <= 1, "{range}");
            assert_eq!(method(false).stored(range + 0.5), range as u16);
        }
        // Rounding costs the reference a cell.
        assert_eq!([true, false].map(|long| method(long).stored(400.0)), [399, 400]);
    }

    #[test]
    fn the_table_holds_what_a_cast_gives() {
        let grid = room();
        let tables = RangeTables::default();
        let cells: Vec<u32> = (0..grid.cells.len() as u32)
            .filter(|&i| grid.cells[i as usize] == Cell::Free)
            .collect();
        assert!(tables.get(0, method(true)).is_none());
        tables.build(&grid, 0, &cells, method(true), usize::MAX);
        let table = tables.get(0, method(true)).expect("built");
        let walls = tables.walls(&grid);
        for cell in [20 + 10 * 60, 43 + 20 * 60] {
            let row = table.row(cell).expect("free");
            for (direction, range) in row.iter().enumerate() {
                let at = [cell as i32 % 60, cell as i32 / 60];
                assert_eq!(*range, walls.cast(at, direction, method(true)));
            }
        }
        assert!(table.row(0).is_none() && table.row(usize::MAX).is_none());
    }
}
