//! The track coordinate: arc length along the raceline, in cells of equal length.

use maps::{Raceline, TrackPosition};
use protocol::{Cell, MapReply};

/// A raceline divided into cells, from a car's map.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackLine {
    /// Name of the map.
    pub name: String,
    /// Identifies the map's name and raceline: equal for cars that drive on the same line.
    pub key: String,
    /// Length of a lap, by the car's own definition \[m\].
    pub length: f64,
    /// Number of cells.
    pub cells: usize,
    line: Raceline,
    walls: Walls,
}

/// The walls near the line, and the distance from them.
#[derive(Debug, Clone, PartialEq)]
struct Walls {
    /// Runs of wall in a row of the map, as `[x0, y0, x1, y1]` \[m\].
    runs: Vec<[f32; 4]>,
    /// Width of a run \[m\].
    width: f64,
    /// Lower left node of the distances \[m\].
    corner: [f64; 2],
    /// Distance between two nodes \[m\].
    step: f64,
    columns: usize,
    rows: usize,
    /// Distance of each node from the nearest wall, at most [`TrackLine::FAR`] \[m\].
    distances: Vec<f32>,
}

impl TrackLine {
    /// Length of a cell that is aimed at \[m\].
    const CELL: f64 = 0.25;
    /// Fewest and most cells.
    const CELLS: std::ops::RangeInclusive<usize> = 40..=400;
    /// Greatest distance from a wall that is told apart \[m\].
    pub const FAR: f64 = 1.0;
    /// Walls further from the line's bounding box are left out \[m\].
    const MARGIN: f64 = 4.0;
    /// Most nodes of distances.
    const MAX_NODES: f64 = 4e6;
    /// Shortest distance between nodes \[m\].
    const MIN_STEP: f64 = 0.03;
    /// Most faces of walls, and most runs that are drawn. A map with more is not compared with scans.
    const MAX_FACES: usize = 100_000;

    /// The line of a car's map; None without a raceline that a car can drive along.
    pub fn of(map: &MapReply) -> Option<Self> {
        let raceline = map.raceline.as_ref()?;
        let points: Vec<[f64; 2]> = raceline.points.iter().map(|p| p.map(f64::from)).collect();
        let line = Raceline::through(&points, 1.0).ok()?;
        let length = raceline.length;
        if !(length.is_finite() && length > 0.0 && line.length() > 0.0) {
            return None;
        }
        let wanted = (length / Self::CELL).round() as usize;
        // FNV-1a over what identifies the line.
        let mut hash = 0xcbf2_9ce4_8422_2325_u64;
        for byte in raceline.points.iter().flatten().flat_map(|v| v.to_le_bytes()) {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
        Some(Self {
            name: map.name.clone(),
            key: format!(
                "{}-{:08x}",
                file_name(&map.name),
                hash as u32 ^ (hash >> 32) as u32
            ),
            length,
            cells: wanted.clamp(*Self::CELLS.start(), *Self::CELLS.end()),
            walls: Walls::of(map, &points),
            line,
        })
    }

    /// Length of a cell \[m\].
    pub fn cell(&self) -> f64 {
        self.length / self.cells as f64
    }

    /// The position of a point relative to the line.
    pub fn project(&self, point: [f64; 2]) -> TrackPosition {
        let mut position = self.line.project(point);
        position.s *= self.length / self.line.length();
        position
    }

    /// Direction of the line at arc length `s` \[rad\].
    pub fn heading(&self, s: f64) -> f64 {
        self.line.at(s * self.line.length() / self.length).heading
    }

    /// The point of the line at arc length `s` \[m\].
    pub fn point(&self, s: f64) -> [f64; 2] {
        let point = self.line.at(s * self.line.length() / self.length);
        [point.x, point.y]
    }

    /// Distance of a point from the nearest face of a wall that the map draws, at most [`TrackLine::FAR`] \[m\]. None far from the
    /// track.
    pub fn from_wall(&self, [x, y]: [f64; 2]) -> Option<f64> {
        let walls = &self.walls;
        let (u, v) = (
            (x - walls.corner[0]) / walls.step,
            (y - walls.corner[1]) / walls.step,
        );
        if !(u >= 0.0 && v >= 0.0) {
            return None;
        }
        let (column, row) = (u as usize, v as usize);
        if column + 1 >= walls.columns || row + 1 >= walls.rows {
            return None;
        }
        let at = |c: usize, r: usize| f64::from(walls.distances[r * walls.columns + c]);
        let (fu, fv) = (u.fract(), v.fract());
        let below = at(column, row) * (1.0 - fu) + at(column + 1, row) * fu;
        let above = at(column, row + 1) * (1.0 - fu) + at(column + 1, row + 1) * fu;
        Some(below * (1.0 - fv) + above * fv)
    }

    /// The walls near the line as runs `[x0, y0, x1, y1]` \[m\], and their width \[m\].
    pub(crate) fn wall_runs(&self) -> (&[[f32; 4]], f64) {
        (&self.walls.runs, self.walls.width)
    }
}

/// A name that every file system takes.
fn file_name(name: &str) -> String {
    let plain = |c: char| {
        if c.is_ascii_alphanumeric() || c == '-' {
            c
        } else {
            '_'
        }
    };
    name.chars().take(40).map(plain).collect()
}

impl Walls {
    fn of(map: &MapReply, line: &[[f64; 2]]) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for point in line {
            for axis in 0..2 {
                low[axis] = low[axis].min(point[axis] - TrackLine::MARGIN);
                high[axis] = high[axis].max(point[axis] + TrackLine::MARGIN);
            }
        }
        let size = [high[0] - low[0], high[1] - low[1]];
        let step = map
            .resolution
            .max(TrackLine::MIN_STEP)
            .max((size[0] * size[1] / TrackLine::MAX_NODES).sqrt());
        let [columns, rows] = size.map(|size| (size / step).ceil() + 1.0);
        // A line that is absurdly long and narrow.
        let possible = columns * rows <= 2.0 * TrackLine::MAX_NODES;
        let [columns, rows] = [columns, rows].map(|count| if possible { count as usize } else { 0 });
        let mut walls = Self {
            runs: Vec::new(),
            width: map.resolution,
            corner: low,
            step,
            columns,
            rows,
            distances: vec![TrackLine::FAR as f32; columns * rows],
        };
        if possible {
            walls.draw(map);
        }
        walls
    }

    /// Adds the map's walls: its occupied cells, or, where it has none, the unknown ones. Distances are those from the
    /// faces, between wall and free space, which is what a laser sees.
    fn draw(&mut self, map: &MapReply) {
        let wall = if map
            .runs
            .iter()
            .any(|(cell, length)| *cell == Cell::Occupied && *length > 0)
        {
            Cell::Occupied
        } else {
            Cell::Unknown
        };
        let (sin, cos) = map.origin.heading.sin_cos();
        let in_map = |column: f64, row: f64| {
            let (u, v) = (column * map.resolution, row * map.resolution);
            [map.origin.x + cos * u - sin * v, map.origin.y + sin * u + cos * v]
        };
        let width = map.width.max(1) as usize;
        let high = [
            self.corner[0] + (self.columns - 1) as f64 * self.step,
            self.corner[1] + (self.rows - 1) as f64 * self.step,
        ];
        let low = self.corner;
        let near = |[x, y]: [f64; 2]| x > low[0] && y > low[1] && x < high[0] && y < high[1];
        let (mut runs, mut faces) = (Vec::new(), Vec::new());
        let mut add = |[a, b]: [[f64; 2]; 2]| {
            // One more than can be used tells that there are too many.
            if near(a) && near(b) && faces.len() <= TrackLine::MAX_FACES {
                faces.push([a, b]);
            }
        };
        // The row below, and the row that is being read.
        let (mut below, mut row_cells) = (vec![Cell::Unknown; width], Vec::with_capacity(width));
        let mut row = 0_usize;
        for &(cell, length) in &map.runs {
            let mut left = length as usize;
            while left > 0 {
                let from = row_cells.len();
                let take = left.min(width - from);
                row_cells.resize(from + take, cell);
                left -= take;
                if cell == wall {
                    let middle = row as f64 + 0.5;
                    let [a, b] = [in_map(from as f64, middle), in_map((from + take) as f64, middle)];
                    if (near(a) || near(b)) && runs.len() < TrackLine::MAX_FACES {
                        runs.push([a[0] as f32, a[1] as f32, b[0] as f32, b[1] as f32]);
                    }
                }
                if row_cells.len() == width {
                    let face =
                        |a: Cell, b: Cell| (a == wall && b == Cell::Free) || (a == Cell::Free && b == wall);
                    for column in 0..width {
                        let here = row_cells[column];
                        let (c, r) = (column as f64, row as f64);
                        if face(below[column], here) {
                            add([in_map(c, r), in_map(c + 1.0, r)]);
                        }
                        if column > 0 && face(row_cells[column - 1], here) {
                            add([in_map(c, r), in_map(c, r + 1.0)]);
                        }
                    }
                    std::mem::swap(&mut below, &mut row_cells);
                    row_cells.clear();
                    row += 1;
                }
            }
        }
        self.runs = runs;
        if faces.len() > TrackLine::MAX_FACES {
            (self.columns, self.rows) = (0, 0);
            self.distances = Vec::new();
        } else {
            for [a, b] in faces {
                self.stamp(a, b);
            }
        }
    }

    /// Lowers the distances around a face.
    fn stamp(&mut self, a: [f64; 2], b: [f64; 2]) {
        let range = |axis: usize, count: usize| {
            let (low, high) = (a[axis].min(b[axis]), a[axis].max(b[axis]));
            let first = ((low - TrackLine::FAR - self.corner[axis]) / self.step)
                .ceil()
                .max(0.0) as usize;
            let last = ((high + TrackLine::FAR - self.corner[axis]) / self.step)
                .floor()
                .max(0.0) as usize;
            first..(last + 1).min(count)
        };
        let (columns, rows) = (range(0, self.columns), range(1, self.rows));
        let [dx, dy] = [b[0] - a[0], b[1] - a[1]];
        let length = (dx * dx + dy * dy).max(1e-12);
        for row in rows {
            let y = self.corner[1] + row as f64 * self.step - a[1];
            for column in columns.clone() {
                let x = self.corner[0] + column as f64 * self.step - a[0];
                let share = ((x * dx + y * dy) / length).clamp(0.0, 1.0);
                let distance = (x - share * dx).hypot(y - share * dy) as f32;
                let known = &mut self.distances[row * self.columns + column];
                *known = known.min(distance);
            }
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use protocol::{MapRaceline, Pose2};
    use std::f64::consts::TAU;

    /// A ring of walls at 2 and 4 m about a line of radius 3 m. `gone` removes wall cells.
    pub(in super::super) fn ring(gone: impl Fn([f64; 2]) -> bool) -> MapReply {
        const CELLS: u32 = 200;
        const CELL: f64 = 0.05;
        let half = f64::from(CELLS) * CELL / 2.0;
        let cell = |i: u32| {
            let at = |k: u32| (f64::from(k) + 0.5) * CELL - half;
            let point = [at(i % CELLS), at(i / CELLS)];
            let off = (point[0].hypot(point[1]) - 3.0).abs();
            match off {
                off if off < 0.975 => Cell::Free,
                off if off < 1.03 && !gone(point) => Cell::Occupied,
                _ => Cell::Unknown,
            }
        };
        let point = |i: u32| {
            let (sin, cos) = (f64::from(i) / 360.0 * TAU).sin_cos();
            [(3.0 * cos) as f32, (3.0 * sin) as f32]
        };
        MapReply {
            name: "ring".into(),
            width: CELLS,
            height: CELLS,
            resolution: CELL,
            origin: Pose2 {
                x: -half,
                y: -half,
                heading: 0.0,
            },
            runs: MapReply::pack((0..CELLS * CELLS).map(cell)),
            raceline: Some(MapRaceline {
                length: 3.0 * TAU,
                points: (0..360).map(point).collect(),
            }),
        }
    }

    #[test]
    fn distances_are_those_to_the_nearest_drawn_wall() {
        let line = TrackLine::of(&ring(|_| false)).expect("a line");
        assert_eq!(line.cells, 75);
        for (r, expected) in [(3.0, 0.97), (3.97, 0.0), (3.7, 0.27), (4.3, 0.33)] {
            for degrees in 0..36 {
                let (sin, cos) = (f64::from(degrees) * 10.0_f64).to_radians().sin_cos();
                let distance = line.from_wall([r * cos, r * sin]).expect("near");
                assert!((distance - expected).abs() < 0.06, "{r}: {distance}");
            }
        }
        assert_eq!(line.from_wall([100.0, 0.0]), None);
    }

    #[test]
    fn absurd_lines_and_maps_are_not_compared_and_take_no_memory() {
        let mut map = ring(|_| false);
        if let Some(line) = &mut map.raceline {
            line.points = vec![[0.0, 0.0], [1e30, 0.0], [1e30, 1.0]];
            line.length = 1e30;
        }
        let line = TrackLine::of(&map);
        assert!(line.is_none_or(|line| line.from_wall([0.0, 0.0]).is_none() && line.cells == 400));
        // A chess board has more faces than any hall.
        let mut map = ring(|_| false);
        (map.width, map.height, map.resolution) = (2000, 2000, 0.005);
        map.runs = MapReply::pack((0..4_000_000_u32).map(|i| {
            let odd = (i % 2000 + i / 2000) % 2 == 1;
            if odd { Cell::Occupied } else { Cell::Free }
        }));
        let line = TrackLine::of(&map).expect("a line");
        assert_eq!(line.from_wall([3.0, 0.0]), None);
        assert!(line.wall_runs().0.len() <= TrackLine::MAX_FACES);
    }

    #[test]
    fn a_map_without_a_line_has_no_laps() {
        let mut map = ring(|_| false);
        map.raceline = None;
        assert!(TrackLine::of(&map).is_none());
        let mut map = ring(|_| false);
        if let Some(line) = &mut map.raceline {
            line.length = 0.0;
        }
        assert!(TrackLine::of(&map).is_none());
    }
}
