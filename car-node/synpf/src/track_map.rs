//! A map made ready for localization.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use maps::{Cell, DistanceField, OccupancyGrid, Pose};

use crate::cddt::Cddt;
use crate::error::SetUpError;
use crate::range_table::{RangeTable, TableParameters};
use crate::seed::Blurred;

/// A map with what the filter looks up in it: distance field, separate regions of free space, and range tables,
/// which are built for the regions that a car is in and shared between threads and localizers.
///
/// Inside the crate poses are in the *grid's* frame, with the grid's corner as origin, so that no rotation of the
/// map's origin has to be undone per particle.
#[derive(Debug)]
pub struct TrackMap {
    grid: OccupancyGrid,
    field: DistanceField,
    grid_from_map: Pose,
    regions: Vec<Region>,
    /// For each cell the index of its region; [`NOWHERE`] where it is not free.
    region_of: Vec<u16>,
    tables: Mutex<HashMap<(usize, TableParameters), Arc<RangeTable>>>,
    cddt: OnceLock<Arc<Cddt>>,
    blurred: OnceLock<Blurred>,
}

/// A connected piece of free space.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Region {
    /// Its cells.
    pub(crate) cells: Vec<u32>,
    /// Greatest distance from a wall in it [m]; small for a track, large for an infield.
    pub(crate) clearance: f64,
}

const NOWHERE: u16 = u16::MAX;

/// Regions smaller than this hold no car [m^2].
const SMALLEST_REGION: f64 = 1.0;

/// A track is nowhere wider than twice this; what is wider lies beside it [m].
const TRACK_CLEARANCE: f64 = 5.0;

impl TrackMap {
    /// Builds the distance field and finds the regions. Range tables follow with `TrackMap::prepare`, or when a
    /// localizer first needs them. Fails on a map without walls or without room for a car.
    pub fn new(grid: OccupancyGrid) -> Result<Self, SetUpError> {
        if !grid.has_wall() {
            return Err(SetUpError::NoWall {
                width: grid.width,
                height: grid.height,
            });
        }
        let field = DistanceField::new(&grid);
        let (regions, region_of) = regions(&grid, &field);
        if regions.is_empty() {
            return Err(SetUpError::NoFreeSpace {
                width: grid.width,
                height: grid.height,
            });
        }
        let grid_from_map = grid.origin.inverse();
        Ok(Self {
            grid,
            field,
            grid_from_map,
            regions,
            region_of,
            tables: Mutex::default(),
            cddt: OnceLock::new(),
            blurred: OnceLock::new(),
        })
    }

    /// The grid it was built from.
    pub fn grid(&self) -> &OccupancyGrid {
        &self.grid
    }

    /// The distance field.
    pub fn field(&self) -> &DistanceField {
        &self.field
    }

    /// Signed distance from a point of `map` to the nearest wall's face [m]; positive in free space, 0 outside
    /// the map.
    pub fn distance(&self, point: [f64; 2]) -> f64 {
        self.field.distance(point)
    }

    /// Range that a laser at `map_from_laser` measures along its x axis [m], at most `max_range`; to the wall's
    /// face in the distance field.
    pub fn range(&self, map_from_laser: Pose, max_range: f64) -> f64 {
        let laser = self.grid_from_map * map_from_laser;
        let resolution = self.grid.resolution;
        let (sin, cos) = laser.heading.sin_cos();
        let start = [(laser.x / resolution) as f32, (laser.y / resolution) as f32];
        let cells = self
            .field
            .trace(start, [cos as f32, sin as f32], (max_range / resolution) as f32);
        (f64::from(cells) * resolution).min(max_range)
    }

    /// Memory that the range tables (and the CDDT, where a set uses it) take [bytes].
    pub fn table_bytes(&self) -> usize {
        let tables = self.tables.lock().unwrap_or_else(PoisonError::into_inner);
        tables.values().map(|table| table.bytes()).sum::<usize>()
            + self.cddt.get().map_or(0, |cddt| cddt.bytes())
    }

    pub(crate) fn table(&self, region: usize, parameters: TableParameters) -> Arc<RangeTable> {
        let mut tables = self.tables.lock().unwrap_or_else(PoisonError::into_inner);
        let build = || {
            Arc::new(RangeTable::new(
                &self.grid,
                &self.field,
                &self.regions[region].cells,
                parameters,
            ))
        };
        Arc::clone(tables.entry((region, parameters)).or_insert_with(build))
    }

    pub(crate) fn cddt(&self) -> Arc<Cddt> {
        Arc::clone(self.cddt.get_or_init(|| Arc::new(Cddt::new(&self.field))))
    }

    /// Whether a pose in `map` lies on the grid.
    pub(crate) fn covers(&self, map_from_base_link: Pose) -> bool {
        let at = self.grid_from_map * map_from_base_link;
        let inside = |v: f64, cells: usize| (0.0..=cells as f64 * self.grid.resolution).contains(&v);
        inside(at.x, self.grid.width) && inside(at.y, self.grid.height)
    }

    pub(crate) fn blurred(&self) -> &Blurred {
        self.blurred.get_or_init(|| Blurred::new(&self.grid, &self.field))
    }

    /// Whether a beam from a laser ends where nothing was mapped, without having met a wall on its way: through an open door,
    /// or past where mapping stopped. Such a beam says nothing on where the laser is. Points in the grid's frame [m].
    pub(crate) fn unmapped(&self, laser: [f32; 2], end: [f32; 2]) -> bool {
        let cells = 1.0 / self.grid.resolution as f32;
        let cell = end.map(|v| (v * cells).floor() as i64);
        if self.grid.cell(cell[0], cell[1]) != Cell::Unknown {
            return false;
        }
        let (dx, dy) = (end[0] - laser[0], end[1] - laser[1]);
        let range = dx.hypot(dy).max(1e-3);
        let direction = [dx / range, dy / range];
        let start = laser.map(|v| v * cells);
        let path = self.field.trace(start, direction, range * cells);
        let met = [start[0] + path * direction[0], start[1] + path * direction[1]];
        // Past the map's rim there are no walls.
        path >= range * cells || (path > 0.0 && self.field.sample(met[0], met[1]).is_none())
    }

    pub(crate) fn grid_from_map(&self) -> Pose {
        self.grid_from_map
    }

    /// The region that a pose in the grid's frame is in, or the nearest within a metre.
    pub(crate) fn region_at(&self, pose: Pose) -> Option<usize> {
        let resolution = self.grid.resolution;
        let at = |dx: f64, dy: f64| {
            let column = ((pose.x + dx) / resolution).floor();
            let row = ((pose.y + dy) / resolution).floor();
            let inside = column >= 0.0
                && row >= 0.0
                && column < self.grid.width as f64
                && row < self.grid.height as f64;
            inside.then(|| self.region_of[row as usize * self.grid.width + column as usize])
        };
        let around = [0.0, 0.1, 0.3, 1.0].into_iter().flat_map(|radius| {
            (0..8).map(move |k| {
                let (sin, cos) = (f64::from(k) * std::f64::consts::FRAC_PI_4).sin_cos();
                [radius * cos, radius * sin]
            })
        });
        around
            .filter_map(|[dx, dy]| at(dx, dy))
            .find(|&region| region != NOWHERE)
            .map(usize::from)
    }

    pub(crate) fn regions(&self) -> &[Region] {
        &self.regions
    }

    /// The regions that may hold a car of which nothing is known: tracks if there are any, else all.
    pub(crate) fn plausible_regions(&self) -> Vec<usize> {
        let tracks: Vec<usize> = (0..self.regions.len())
            .filter(|&i| self.regions[i].clearance <= TRACK_CLEARANCE)
            .collect();
        let area = |i: &usize| self.regions[*i].cells.len();
        let largest = tracks.iter().map(area).max().unwrap_or(0);
        if largest == 0 {
            return (0..self.regions.len()).collect();
        }
        // Pockets in walls and islands are no tracks.
        tracks.into_iter().filter(|i| area(i) * 10 >= largest).collect()
    }
}

/// Free space in pieces that a car cannot pass between.
fn regions(grid: &OccupancyGrid, field: &DistanceField) -> (Vec<Region>, Vec<u16>) {
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
        // In the order of the grid, so that neighbours in space are neighbours in a table.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_without_walls_is_refused() {
        for cell in [Cell::Free, Cell::Unknown] {
            let grid = OccupancyGrid::new(40, 30, 0.05, Pose::IDENTITY, vec![cell; 40 * 30]);
            let error = TrackMap::new(grid).expect_err("no wall");
            assert_eq!(error.to_string(), "the map has no wall (40 x 30 cells)");
        }
    }
}
