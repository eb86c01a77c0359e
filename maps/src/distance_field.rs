//! A signed distance field whose zero lies on the walls' faces, to a fraction of a cell.
//!
//! The distance is negative in walls and behind them, and positive elsewhere. A field of distances to cell *centres* would
//! pull every fit half a cell into a filled wall: 2.5 cm on a common map, several times the laser's resolution. Walls
//! drawn by the hits of a laser are thin, and the laser saw them at their middle. On such a map (the bundled `club`) the
//! error of the pose is 1.3 cm with the zero in the middle, and 1.5 cm with it on the face.
//!
//! Only occupied cells are walls. Where mapping stopped, at an open door or a side corridor, free space borders on
//! unknown space and there is no wall. Taken for walls, such lines pull the fit of a scan along a real corridor by up
//! to 0.2 m. The sign gives the side of the wall, and the distance is to the nearest wall alone. The field therefore jumps
//! where unknown space behind a wall borders on unknown space beyond a door.

use rayon::prelude::*;

use crate::faces::{Faces, NONE, nearest_cells};
use crate::marching_squares::{CORNERS, Crossing, zero_lines};
use crate::{Cell, OccupancyGrid, Pose};

/// Signed distance to the nearest wall's face, sampled at the cells' centres and interpolated between them.
#[derive(Debug, Clone)]
pub struct DistanceField {
    width: usize,
    height: usize,
    resolution: f64,
    grid_from_map: Pose,
    /// Signed distance at each cell's centre \[m\].
    values: Vec<f32>,
    /// Distance of the zero from the face, into the wall \[m\]; empty if it lies on the face everywhere.
    inwards: Vec<f32>,
}

/// The field at one point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Signed distance \[m\].
    pub distance: f32,
    /// Its gradient along the *grid's* axes, of length about 1.
    pub gradient: [f32; 2],
}

impl DistanceField {
    /// Builds the field: the distance from each cell's centre to the nearest face. Where walls are thin, the zero moves to
    /// their middle.
    pub fn new(grid: &OccupancyGrid) -> Self {
        let solidity = solidity(grid);
        let behind = behind_walls(grid, &solidity);
        let faces = Faces::new(grid.width, grid.height, |i| match solidity[i] {
            Some(solid) => (f32::from(solid) - FACE, true),
            None => (if behind[i] { FACE } else { -FACE }, false),
        });
        let resolution = grid.resolution as f32;
        let mut values = faces.distances();
        for (i, value) in values.iter_mut().enumerate() {
            let inside = behind[i] || solidity[i].is_some_and(|solid| f32::from(solid) > FACE);
            *value *= if inside { -resolution } else { resolution };
        }
        let inwards = if behind.contains(&true) {
            centre_thin_walls(grid, &behind, &mut values)
        } else {
            Vec::new()
        };
        Self {
            width: grid.width,
            height: grid.height,
            resolution: grid.resolution,
            grid_from_map: grid.origin.inverse(),
            values,
            inwards,
        }
    }

    /// The field and its gradient at a point in grid coordinates \[cells\]; None outside the grid.
    #[inline]
    pub fn sample(&self, u: f32, v: f32) -> Option<Sample> {
        let (u, v) = (u - 0.5, v - 0.5);
        if !(u >= 0.0 && v >= 0.0 && u < (self.width - 1) as f32 && v < (self.height - 1) as f32) {
            return None;
        }
        let (column, row) = (u as usize, v as usize);
        let (fu, fv) = (u - column as f32, v - row as f32);
        let i = row * self.width + column;
        let (a, b) = (self.values[i], self.values[i + 1]);
        let (c, d) = (self.values[i + self.width], self.values[i + self.width + 1]);
        let (low, high) = (a + (b - a) * fu, c + (d - c) * fu);
        let scale = 1.0 / self.resolution as f32;
        Some(Sample {
            distance: low + (high - low) * fv,
            gradient: [((b - a) + ((d - c) - (b - a)) * fv) * scale, (high - low) * scale],
        })
    }

    /// The sample of the cell that contains a point in grid coordinates \[cells\], in metres; None outside the grid.
    #[inline]
    pub fn nearest(&self, u: f32, v: f32) -> Option<f32> {
        if !(u >= 0.0 && v >= 0.0) {
            return None;
        }
        let (column, row) = (u as usize, v as usize);
        (column < self.width && row < self.height).then(|| self.values[row * self.width + column])
    }

    /// Distance from the wall's near face, on either side of it, of the cell that contains a point in grid coordinates
    /// \[cells\], in metres; None outside the grid.
    #[inline]
    pub fn from_wall(&self, u: f32, v: f32) -> Option<f32> {
        if !(u >= 0.0 && v >= 0.0) {
            return None;
        }
        let (column, row) = (u as usize, v as usize);
        let inside = column < self.width && row < self.height;
        inside.then(|| {
            let i = row * self.width + column;
            (self.values[i] - self.inwards.get(i).copied().unwrap_or(0.0)).abs()
        })
    }

    /// Path from `start` along the unit vector `direction` to the first wall's face \[cells\], at most `longest`
    /// (sphere tracing; Hart, The Visual Computer 12, 1996). 0 if the start is not in free space.
    pub fn trace(&self, start: [f32; 2], direction: [f32; 2], longest: f32) -> f32 {
        let cells = 1.0 / self.resolution as f32;
        let (mut path, mut before) = (0.0, None::<(f32, f32)>);
        while path < longest {
            let point = [start[0] + path * direction[0], start[1] + path * direction[1]];
            let Some(sample) = self.sample(point[0], point[1]) else {
                // Within half a cell of the border, or outside.
                return path;
            };
            let distance = sample.distance * cells;
            if distance <= 0.0 {
                // Between the last step and this one the field is nearly linear.
                return before
                    .map_or(0.0, |(p, d)| p + (path - p) * d / (d - distance))
                    .min(longest);
            }
            before = Some((path, distance));
            // At least a quarter of a cell, for speed along walls. Walls are thicker than that.
            path += distance.max(0.25);
        }
        longest
    }

    /// The walls' faces: segments of the field's zero line in grid coordinates \[cells\], in no order.
    pub fn contour(&self) -> Vec<[[f32; 2]; 2]> {
        let mut segments = Vec::new();
        for row in 0..self.height.saturating_sub(1) {
            for column in 0..self.width.saturating_sub(1) {
                let corners =
                    CORNERS.map(|[right, up]| self.values[(row + up) * self.width + column + right]);
                let place = |crossing: Crossing| {
                    [
                        column as f32 + 0.5 + crossing.at[0],
                        row as f32 + 0.5 + crossing.at[1],
                    ]
                };
                segments.extend(zero_lines(corners).map(|ends| ends.map(place)));
            }
        }
        segments
    }

    /// The samples, at the cells' centres, in the order of the grid's cells \[m\].
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// Signed distance at a point of `map` \[m\]; 0 outside the grid.
    pub fn distance(&self, point: [f64; 2]) -> f64 {
        let [u, v] = self
            .grid_from_map
            .transform(point)
            .map(|x| (x / self.resolution) as f32);
        self.sample(u, v).map_or(0.0, |sample| f64::from(sample.distance))
    }

    /// The transform from `map` to the grid's corner; divide by [`DistanceField::resolution`] for cells.
    pub fn grid_from_map(&self) -> Pose {
        self.grid_from_map
    }

    /// Edge of a cell \[m\].
    pub fn resolution(&self) -> f64 {
        self.resolution
    }
}

/// How solid a cell is on a wall's face, from 0 to 255.
const FACE: f32 = 127.5;

/// The directions to the cells around a cell: these four, and the opposite ones.
const HALF_AROUND: [(i64, i64); 4] = [(1, 0), (1, 1), (0, 1), (-1, 1)];

/// Solidity of each cell, 0 to 255; None for unknown cells. The grey of a cell counts where it lies on a wall's face: an
/// unknown cell between a free and an occupied one, or an occupied one beside a darker one. Other occupied cells are solid,
/// however pale the map is. On a map without occupied cells, unknown cells are solid.
pub fn solidity(grid: &OccupancyGrid) -> Vec<Option<u8>> {
    let unknown = (!grid.cells.contains(&Cell::Occupied)).then_some(u8::MAX);
    let solid = |i: usize| {
        let (column, row) = ((i % grid.width) as i64, (i / grid.width) as i64);
        let mut opposite = HALF_AROUND
            .iter()
            .map(|(dc, dr)| [(column + dc, row + dr), (column - dc, row - dr)]);
        let cell = |(column, row): (i64, i64)| grid.cell(column, row);
        let occupancy = grid.occupancy[i];
        match grid.cells[i] {
            Cell::Free => Some(occupancy),
            Cell::Unknown => {
                let between = opposite.any(|pair| {
                    matches!(
                        pair.map(cell),
                        [Cell::Free, Cell::Occupied] | [Cell::Occupied, Cell::Free]
                    )
                });
                if between { Some(occupancy) } else { unknown }
            }
            Cell::Occupied => {
                let darker = |(column, row)| {
                    cell((column, row)) == Cell::Occupied
                        && grid.occupancy[row as usize * grid.width + column as usize] > occupancy
                };
                Some(if opposite.flatten().any(darker) {
                    occupancy
                } else {
                    u8::MAX
                })
            }
        }
    };
    (0..grid.cells.len()).into_par_iter().map(solid).collect()
}

/// A point this far behind a wall still counts as a hit of it \[m\].
const SHADOW: f64 = 0.1;

/// The unknown cells right behind a wall: those on a straight line from a free cell through occupied ones. Beside the end of
/// a wall, as at a door, there are none.
fn behind_walls(grid: &OccupancyGrid, solidity: &[Option<u8>]) -> Vec<bool> {
    let mut behind = vec![false; solidity.len()];
    let shadow = (SHADOW / grid.resolution).ceil() as i64;
    let thickest = THICK as i64 + 1;
    for i in (0..solidity.len()).filter(|&i| grid.cells[i] == Cell::Occupied) {
        let (column, row) = ((i % grid.width) as i64, (i / grid.width) as i64);
        for (dc, dr) in [(1, 0), (-1, 0), (0, 1), (0, -1)] {
            let at = |steps: i64| (column + steps * dc, row + steps * dr);
            let cell = |steps| grid.cell(at(steps).0, at(steps).1);
            if cell(-1) != Cell::Free {
                continue;
            }
            let Some(back) = (1..thickest).find(|&steps| cell(steps) != Cell::Occupied) else {
                continue;
            };
            for (column, row) in (back..back + shadow).map(at) {
                let inside =
                    (0..grid.width as i64).contains(&column) && (0..grid.height as i64).contains(&row);
                let index = row * grid.width as i64 + column;
                if !inside || solidity[index as usize].is_some() {
                    break;
                }
                behind[index as usize] = true;
            }
        }
    }
    behind
}

/// Walls of up to this many cells were drawn by the hits of a laser, which scatter about the true face.
const THIN: f32 = 2.0;

/// Walls from this many cells on are filled: their face is their edge.
const THICK: f32 = 4.0;

/// Moves the field's zero from a thin wall's near face to its middle. Returns the distance moved, for each cell \[m\].
fn centre_thin_walls(grid: &OccupancyGrid, behind: &[bool], values: &mut [f32]) -> Vec<f32> {
    let resolution = grid.resolution as f32;
    let to_behind = distances(grid, |i| behind[i]);
    let to_front = distances(grid, |i| !behind[i]);
    let centred = |(i, value): (usize, &mut f32)| {
        let back = if behind[i] {
            0.5 - to_front[i]
        } else {
            to_behind[i] - 0.5
        };
        let thickness = (back - *value / resolution).max(0.0);
        let thin = ((THICK - thickness) / (THICK - THIN)).clamp(0.0, 1.0);
        let inwards = 0.5 * thin * thickness * resolution;
        *value += inwards;
        inwards
    };
    values.iter_mut().enumerate().map(centred).collect()
}

/// Distance in cells from each cell's centre to that of the nearest cell that is `wanted`.
fn distances(grid: &OccupancyGrid, wanted: impl Fn(usize) -> bool + Sync) -> Vec<f32> {
    let width = grid.width;
    let far = (width + grid.height) as f32;
    let nearest = nearest_cells(width, grid.height, wanted);
    let distance = |(i, cell): (usize, u32)| {
        if cell == NONE {
            return far;
        }
        let cell = cell as usize;
        let [columns, rows] = [
            (cell % width).abs_diff(i % width),
            (cell / width).abs_diff(i / width),
        ];
        (columns as f32).hypot(rows as f32)
    };
    nearest.into_iter().enumerate().map(distance).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A drawn map: `#` wall, `.` free, `?` unknown, top line first, cells of 1 m.
    fn drawn(rows: &[&str]) -> OccupancyGrid {
        let cells = rows
            .iter()
            .rev()
            .flat_map(|row| row.chars())
            .map(|c| match c {
                '#' => Cell::Occupied,
                '?' => Cell::Unknown,
                _ => Cell::Free,
            })
            .collect();
        OccupancyGrid::new(rows[0].len(), rows.len(), 1.0, Pose::IDENTITY, cells)
    }

    #[test]
    fn zero_lies_on_the_face() {
        let field = DistanceField::new(&drawn(&["......##", "......##", "......##"]));
        for x in [3.0, 4.5, 6.0, 6.4] {
            assert!((field.distance([x, 1.5]) - (6.0 - x)).abs() < 1e-6, "at {x}");
        }
        let sample = field.sample(5.0, 1.5).expect("inside the grid");
        assert!((sample.gradient[0] + 1.0).abs() < 1e-6 && sample.gradient[1].abs() < 1e-6);
    }

    #[test]
    fn grey_moves_the_face_within_its_cell() {
        let mut grid = drawn(&["...###", "...###", "...###"]);
        for (grey, half) in [(255u8, 0.5), (191, 1.0), (128, 1.5)] {
            for i in [3, 9, 15] {
                grid.occupancy[i] = grey;
            }
            // Where the grey between a white cell's centre at 2.5 and this one's at 3.5 is half black.
            let face = 2.5 + 127.5 / f64::from(grey);
            let distance = DistanceField::new(&grid).distance([2.0, 1.5]);
            assert!((distance - (face - 2.0)).abs() < 1e-5, "{distance} at {grey}");
            assert!((face - 2.0 - 0.5 - half).abs() < 0.51, "{face}");
        }
    }

    #[test]
    fn the_contour_is_the_face() {
        let segments = DistanceField::new(&drawn(&["......##", "......##", "......##"])).contour();
        assert_eq!(segments.len(), 2);
        assert!(
            segments
                .iter()
                .flatten()
                .all(|point| (point[0] - 6.0).abs() < 1e-6),
            "{segments:?}"
        );
        // Two blocks that touch at a corner.
        let saddle = DistanceField::new(&drawn(&["##..", "##..", "..##", "..##"])).contour();
        assert!(saddle.len() >= 4);
    }

    #[test]
    fn a_pale_wall_is_a_wall() {
        let mut grid = drawn(&["....##", "....##", "....##"]);
        grid.occupancy
            .iter_mut()
            .filter(|occupancy| **occupancy == 255)
            .for_each(|grey| *grey = 180);
        assert!((DistanceField::new(&grid).distance([2.0, 1.5]) - 2.0).abs() < 1e-6);
    }

    #[test]
    fn the_middle_of_a_thin_wall_is_its_face_and_the_front_of_a_filled_one() {
        let distances = |row: &str| {
            let field = DistanceField::new(&drawn(&[row; 7]));
            [1.5, 3.5, 4.5].map(|x| field.distance([x, 3.5]))
        };
        let close = |[a, b, c]: [f64; 3], [d, e, f]: [f64; 3]| {
            assert!(
                (a - d).abs().max((b - e).abs()).max((c - f).abs()) < 1e-6,
                "{a} {b} {c}"
            );
        };
        close(distances("...#??????????"), [2.0, 0.0, -1.0]);
        close(distances("...##?????????"), [2.5, 0.5, -0.5]);
        close(distances("...####???????"), [1.5, -0.5, -1.5]);
    }

    #[test]
    fn the_border_of_mapped_space_is_no_wall() {
        let rows = [
            "...#????", "...#????", "....????", "....????", "....????", "...#????", "...#????",
        ];
        let field = DistanceField::new(&drawn(&rows));
        for x in [3.0f64, 4.0, 5.0] {
            let to_the_jamb = (x - x.clamp(3.5, 4.0)).hypot(1.5);
            let distance = field.distance([x, 3.5]);
            assert!((distance - to_the_jamb).abs() < 0.3, "{distance} at {x}");
        }
        assert!(field.distance([4.5, 6.0]) < -0.5, "behind the wall");
        assert!(field.from_wall(2.5, 6.5).is_some_and(|d| (d - 0.5).abs() < 1e-6));
        let in_the_door = |p: &[f32; 2]| p[0] > 3.6 && (2.1..4.9).contains(&p[1]);
        let faces = field.contour();
        assert!(!faces.iter().flatten().any(in_the_door), "{faces:?}");
        let through_the_door = field.trace([1.5, 3.5], [1.0, 0.0], 5.0);
        assert!((through_the_door - 5.0).abs() < 1e-6);
    }

    #[test]
    fn without_occupied_cells_unknown_ones_are_walls() {
        let field = DistanceField::new(&drawn(&["...???", "...???", "...???"]));
        assert!((field.distance([1.5, 1.5]) - 1.5).abs() < 1e-6);
    }

    proptest! {
        #[test]
        fn traced_and_cast_ranges_agree(x in 2.0..18.0, y in 2.0..10.0, heading in -3.1f64..3.1) {
            let grid = OccupancyGrid::from_fn(20, 12, 1.0, Pose::IDENTITY, |column, row| match (column, row) {
                (0 | 19, _) | (_, 0 | 11) => Cell::Occupied,
                _ => Cell::Free,
            });
            let field = DistanceField::new(&grid);
            let exact = grid.cast(Pose::new(x, y, heading), 50.0);
            let traced = field.trace([x as f32, y as f32], [heading.cos() as f32, heading.sin() as f32], 50.0);
            // Faces cut the corners off from half a cell before them, and interpolation rounds off as much.
            let end = [x + exact * heading.cos(), y + exact * heading.sin()];
            let corner = (end[0] - 1.0).min(19.0 - end[0]).max((end[1] - 1.0).min(11.0 - end[1])) < 1.6;
            let tolerance = if corner { 1.5 } else { 0.02 };
            prop_assert!((exact - f64::from(traced)).abs() < tolerance, "{exact} {traced}");
        }

        #[test]
        fn a_slanting_wall_has_no_steps(slope in -1.0f64..1.0, at in 7.0f64..9.0) {
            // A half plane, each cell as grey as it is covered.
            let side = |x: f64, y: f64| (x - at - slope * (y - 8.0)) / 1f64.hypot(slope);
            let mut grid = OccupancyGrid::new(16, 16, 1.0, Pose::IDENTITY, vec![Cell::Free; 256]);
            for i in 0..256 {
                let fine = (0..400).filter(|k| {
                    let within = |part: usize| (part as f64 + 0.5) / 20.0;
                    side((i % 16) as f64 + within(k % 20), (i / 16) as f64 + within(k / 20)) > 0.0
                });
                let covered = fine.count() as f64 / 400.0;
                grid.occupancy[i] = (255.0 * covered).round() as u8;
                grid.cells[i] = if covered > 0.65 { Cell::Occupied } else if covered < 0.2 { Cell::Free } else { Cell::Unknown };
            }
            let field = DistanceField::new(&grid);
            for i in 0..256 {
                let [x, y] = [i % 16, i / 16].map(|cell| cell as f64 + 0.5);
                // Away from the grid's edges, where the wall ends.
                if side(x, y).abs() < 2.0 && (4.0..12.0).contains(&y) {
                    let off = field.distance([x, y]) + side(x, y);
                    // What it costs that coverage is not linear across a cell.
                    prop_assert!(off.abs() < 0.11, "{off} at {x}, {y}");
                }
            }
        }
    }
}
