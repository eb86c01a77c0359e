//! A map made ready for localization.

use std::sync::{Arc, OnceLock};

use localizer::{ScanFit, leaves_map};
use maps::{DistanceField, OccupancyGrid, Pose};

use crate::cddt::Cddt;
use crate::error::SetUpError;
#[cfg(feature = "gpu")]
use crate::gpu::{GpuError, GpuMap};
use crate::quality::Quality;
use crate::range_table::{RangeTable, TableParameters};
use crate::reference::RangeTables;
use crate::regions::{NOWHERE, Region, regions};
use crate::score_pyramid::ScorePyramid;
use crate::table_store::{Table, TableJob, TableKey, TablePolicy, TableStore};

/// A map with what the filter looks up in it: distance field, separate regions of free space, and range tables,
/// which are built for the regions that a car is in and shared between threads and localizers.
///
/// Inside the crate poses are in the *grid's* frame, with the grid's corner as origin, so that no rotation of the
/// map's origin has to be undone per particle.
#[derive(Debug)]
pub struct TrackMap {
    grid: Arc<OccupancyGrid>,
    field: Arc<DistanceField>,
    grid_from_map: Pose,
    regions: Vec<Region>,
    /// For each cell the index of its region; [`NOWHERE`] where it is not free.
    region_of: Vec<u16>,
    tables: TableStore,
    /// How ranges are predicted in each region, within the budget.
    layouts: OnceLock<Vec<TableLayout>>,
    score_pyramid: OnceLock<ScorePyramid>,
    reference_tables: RangeTables,
    #[cfg(feature = "gpu")]
    gpu: OnceLock<Result<Arc<GpuMap>, GpuError>>,
}

/// What predicts the ranges in a region where a set asks for a range table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TableLayout {
    /// A range table with a row for each block of so many cells along a side.
    Table { side: usize },
    /// The CDDT of the whole map.
    Cddt,
    /// No table at all.
    RayMarching,
}

/// Memory that the range tables of a map take at most \[bytes\].
pub const TABLE_BUDGET: usize = 200_000_000;

/// A block of cells in a range table is no larger than a cell of a usual map \[m\].
const LARGEST_BLOCK: f64 = 0.051;

/// A track is nowhere wider than twice this; what is wider lies beside it \[m\].
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
            grid: Arc::new(grid),
            field: Arc::new(field),
            grid_from_map,
            regions,
            region_of,
            tables: TableStore::new(TablePolicy::default(), TABLE_BUDGET),
            layouts: OnceLock::new(),
            score_pyramid: OnceLock::new(),
            reference_tables: RangeTables::default(),
            #[cfg(feature = "gpu")]
            gpu: OnceLock::new(),
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

    /// Grid and distance field, for a localizer that keeps nothing else of the map.
    pub fn shared(&self) -> (Arc<OccupancyGrid>, Arc<DistanceField>) {
        (Arc::clone(&self.grid), Arc::clone(&self.field))
    }

    /// Signed distance from a point of `map` to the nearest wall's face \[m\]; positive in free space, 0 outside
    /// the map.
    pub fn distance(&self, point: [f64; 2]) -> f64 {
        self.field.distance(point)
    }

    /// Range that a laser at `map_from_laser` measures along its x axis \[m\], at most `max_range`; to the wall's
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

    /// How well a scan, given as end points in the frame of `base_link` \[m\], fits the map at a pose in `map`.
    pub fn scan_fit(
        &self,
        points: &[[f32; 2]],
        base_link_from_laser: Pose,
        map_from_base_link: Pose,
    ) -> ScanFit {
        let pose = self.grid_from_map * map_from_base_link;
        let quality = Quality::of_points(self, points, base_link_from_laser, pose);
        ScanFit {
            alignment: quality.alignment,
            residual: quality.residual,
            short_beams: quality.short,
            long_beams: quality.long,
        }
    }

    /// The same map with another policy for tables that are missing, and without those that were built.
    #[must_use]
    pub fn with_table_policy(self, policy: TablePolicy) -> Self {
        Self {
            tables: TableStore::new(policy, self.tables.budget()),
            ..self
        }
    }

    /// The same map with another limit of the memory that range tables take \[bytes\], [`TABLE_BUDGET`] by default, and without those that
    /// were built. Where a table would take more, it has coarser cells, or the CDDT takes its place; see [`TrackMap::table_note`].
    #[must_use]
    pub fn with_table_budget(self, bytes: usize) -> Self {
        Self {
            tables: TableStore::new(self.tables.policy(), bytes),
            layouts: OnceLock::new(),
            ..self
        }
    }

    /// Memory that all range tables may take \[bytes\].
    pub(crate) fn table_budget(&self) -> usize {
        self.tables.budget()
    }

    /// What predicts the ranges in a region where a set asks for a range table. The regions that may hold the car share the budget.
    pub(crate) fn layout(&self, region: usize) -> TableLayout {
        let layouts = self.layouts.get_or_init(|| {
            let largest = ((LARGEST_BLOCK / self.grid.resolution) as usize).max(1);
            let budget = self.tables.budget();
            let bytes = |side: usize, regions: &[usize]| -> usize {
                let cells = regions.iter().map(|i| &self.regions[*i].cells);
                cells
                    .map(|cells| RangeTable::bytes_for(&self.grid, cells, side))
                    .sum()
            };
            let fits = |regions: &[usize]| (1..=largest).find(|side| bytes(*side, regions) <= budget);
            let plausible = self.plausible_regions();
            let shared = fits(&plausible);
            let cddt = OnceLock::new();
            let without = || {
                let fits = *cddt.get_or_init(|| Cddt::bytes_at_most(&self.field) <= budget);
                if fits {
                    TableLayout::Cddt
                } else {
                    TableLayout::RayMarching
                }
            };
            let layout = |region: usize| {
                let side = if plausible.contains(&region) {
                    shared
                } else {
                    fits(&[region])
                };
                side.map_or_else(without, |side| TableLayout::Table { side })
            };
            (0..self.regions.len()).map(layout).collect()
        });
        layouts[region]
    }

    /// A sentence on what the budget for range tables has changed, for the log; None where full tables fit.
    pub fn table_note(&self) -> Option<String> {
        let plausible = self.plausible_regions();
        let worst = plausible
            .iter()
            .map(|region| self.layout(*region))
            .find(|layout| *layout != TableLayout::Table { side: 1 })?;
        let cells = plausible.iter().map(|region| &self.regions[*region].cells);
        let full: usize = cells
            .map(|cells| RangeTable::bytes_for(&self.grid, cells, 1))
            .sum();
        let instead = match worst {
            TableLayout::Table { side } => format!(
                "have cells of {:.1} cm in place of {:.1} cm",
                1e2 * side as f64 * self.grid.resolution,
                1e2 * self.grid.resolution
            ),
            TableLayout::Cddt => "are replaced by a CDDT, which is slower".to_owned(),
            TableLayout::RayMarching => "are replaced by ray marching, which is much slower".to_owned(),
        };
        Some(format!(
            "full range tables of this map take {} MB; with a limit of {} MB they {instead}",
            full.div_ceil(1_000_000),
            self.tables.budget() / 1_000_000
        ))
    }

    /// The tables that localizers wait for, the oldest first; always empty with [`TablePolicy::BuildNow`].
    pub fn pending_tables(&self) -> Vec<TableJob> {
        self.tables.pending().into_iter().map(TableJob).collect()
    }

    /// Builds a table in the caller's thread, and on rayon's. It takes from some milliseconds to a second; localizers go on
    /// meanwhile.
    pub fn build_table(&self, job: TableJob) {
        self.tables.build(job.0, || self.new_table(job.0));
    }

    /// What the reference looks up.
    pub(crate) fn reference_tables(&self) -> &RangeTables {
        &self.reference_tables
    }

    /// Memory that the tables take \[bytes\].
    pub fn table_bytes(&self) -> usize {
        self.tables.bytes() + self.reference_tables.bytes()
    }

    /// Memory that a table takes \[bytes\], known before it is built: exact for range tables, an upper bound for the CDDT.
    pub(crate) fn bytes_for(&self, key: TableKey) -> usize {
        match key {
            TableKey::Ranges { region, .. } => {
                RangeTable::bytes_for(&self.grid, &self.regions[region].cells, self.side(region))
            }
            TableKey::Cddt => Cddt::bytes_at_most(&self.field),
        }
    }

    /// A table from a localizer's thread: built at once or made pending, by the policy.
    pub(crate) fn table(&self, key: TableKey) -> Option<Table> {
        self.tables.get(key, || self.new_table(key))
    }

    /// The map on the graphics card; copied there by the first call.
    #[cfg(feature = "gpu")]
    pub(crate) fn gpu(&self) -> Result<Arc<GpuMap>, GpuError> {
        let copied = self.gpu.get_or_init(|| GpuMap::new(&self.grid).map(Arc::new));
        copied.clone()
    }

    /// The range table of a region; None while another thread has yet to build it.
    pub(crate) fn range_table(&self, region: usize, parameters: TableParameters) -> Option<Arc<RangeTable>> {
        let key = TableKey::Ranges { region, parameters };
        match self.table(key) {
            Some(Table::Ranges(table)) => Some(table),
            _ => None,
        }
    }

    /// The CDDT; None while another thread has yet to build it.
    pub(crate) fn cddt(&self) -> Option<Arc<Cddt>> {
        match self.table(TableKey::Cddt) {
            Some(Table::Cddt(cddt)) => Some(cddt),
            _ => None,
        }
    }

    fn side(&self, region: usize) -> usize {
        match self.layout(region) {
            TableLayout::Table { side } => side,
            // Never asked for.
            TableLayout::Cddt | TableLayout::RayMarching => 1,
        }
    }

    fn new_table(&self, key: TableKey) -> Table {
        match key {
            TableKey::Ranges { region, parameters } => Table::Ranges(Arc::new(RangeTable::new(
                &self.grid,
                &self.field,
                &self.regions[region].cells,
                self.side(region),
                parameters,
            ))),
            TableKey::Cddt => Table::Cddt(Arc::new(Cddt::new(&self.field))),
        }
    }

    /// Whether a pose in `map` lies on the grid.
    pub(crate) fn covers(&self, map_from_base_link: Pose) -> bool {
        let at = self.grid_from_map * map_from_base_link;
        let inside = |v: f64, cells: usize| (0.0..=cells as f64 * self.grid.resolution).contains(&v);
        inside(at.x, self.grid.width) && inside(at.y, self.grid.height)
    }

    pub(crate) fn score_pyramid(&self) -> &ScorePyramid {
        self.score_pyramid
            .get_or_init(|| ScorePyramid::new(&self.grid, &self.field))
    }

    /// Whether a beam from a laser ends where nothing was mapped ([`leaves_map`]). Points in the grid's frame \[m\].
    pub(crate) fn unmapped(&self, laser: [f32; 2], end: [f32; 2]) -> bool {
        leaves_map(&self.grid, &self.field, laser, end)
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

#[cfg(test)]
pub(crate) mod tests {
    use maps::Cell;

    use super::*;
    use crate::Parameters;
    use crate::ranges::Ranges;

    /// A room of 5 x 5 m.
    pub(crate) fn room() -> TrackMap {
        let grid = OccupancyGrid::from_fn(100, 100, 0.05, Pose::IDENTITY, |column, row| {
            match (column, row) {
                (0 | 99, _) | (_, 0 | 99) => Cell::Occupied,
                _ => Cell::Free,
            }
        });
        TrackMap::new(grid).expect("free space")
    }

    /// A table used to be built by the filter's thread that first needed it, with the lock of all tables held.
    #[test]
    fn a_deferred_table_is_pending_until_somebody_builds_it() {
        let map = room().with_table_policy(TablePolicy::Defer);
        let parameters = Parameters::default().sensor.table_parameters();
        for _ in 0..3 {
            assert!(map.range_table(0, parameters).is_none());
        }
        assert_eq!((map.pending_tables().len(), map.table_bytes()), (1, 0));
        map.build_table(map.pending_tables()[0]);
        assert!(map.range_table(0, parameters).is_some());
        assert_eq!(map.pending_tables(), []);
    }

    #[test]
    fn a_table_is_built_at_once_where_results_must_not_depend_on_time() {
        let map = room();
        let parameters = Parameters::default().sensor.table_parameters();
        assert!(map.range_table(0, parameters).is_some());
        assert!(map.cddt().is_some());
        assert_eq!(map.pending_tables(), []);
    }

    /// Cells of 5 mm used to make 730 MB.
    #[test]
    fn tables_stay_within_the_budget_whatever_the_cells_size() {
        let set = Parameters::default();
        let room = |resolution: f64| {
            let grid = OccupancyGrid::from_fn(250, 250, resolution, Pose::IDENTITY, |column, row| {
                match (column, row) {
                    (0 | 249, _) | (_, 0 | 249) => Cell::Occupied,
                    _ => Cell::Free,
                }
            });
            TrackMap::new(grid).expect("free space")
        };
        let ranges = |map: &TrackMap| {
            let sensor = crate::sensor_model::SensorModel::new(&set);
            sensor.ranges(map, Some(0), &set)
        };
        for (resolution, budget, expected) in [
            (0.01, TABLE_BUDGET, TableLayout::Table { side: 1 }),
            (0.01, 9_000_000, TableLayout::Table { side: 2 }),
            (0.01, 1_600_000, TableLayout::Table { side: 5 }),
            (0.06, TABLE_BUDGET, TableLayout::Table { side: 1 }),
            (0.06, 12_000_000, TableLayout::Cddt),
            (0.06, 1_000, TableLayout::RayMarching),
        ] {
            let map = room(resolution).with_table_budget(budget);
            assert_eq!(map.layout(0), expected, "{budget}");
            assert_eq!(map.table_note().is_none(), budget == TABLE_BUDGET, "{budget}");
            assert!(map.table_bytes_for(None, &set) <= budget, "{budget}");
            map.prepare(None, &set);
            assert!(map.table_bytes() <= budget, "{} of {budget}", map.table_bytes());
            let found = match ranges(&map) {
                Ranges::Table(_) => TableLayout::Table { side: map.side(0) },
                Ranges::Cddt(_) => TableLayout::Cddt,
                _ => TableLayout::RayMarching,
            };
            assert_eq!(found, expected, "{budget}");
        }
        // Another set needs a table of its own: the first one makes room.
        let map = room(0.01).with_table_budget(33_000_000);
        for directions in [256, 200, 100] {
            map.range_table(0, TableParameters { directions });
            assert!(map.table_bytes() <= 33_000_000);
        }
    }

    #[test]
    fn a_map_without_walls_is_refused() {
        for cell in [Cell::Free, Cell::Unknown] {
            let grid = OccupancyGrid::new(40, 30, 0.05, Pose::IDENTITY, vec![cell; 40 * 30]);
            let error = TrackMap::new(grid).expect_err("no wall");
            assert_eq!(error.to_string(), "the map has no wall (40 x 30 cells)");
        }
    }
}
