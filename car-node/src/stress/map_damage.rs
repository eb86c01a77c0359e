//! Defects of the map.

use std::f64::consts::TAU;

use maps::{Cell, OccupancyGrid, Pose};
use rand::RngExt;
use rand::rngs::SmallRng;

use super::catalogue::{Defect, DefectKind, Grade};

/// A map that was moved as a whole: where a point of the right map is on the damaged one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Warp {
    /// Bent by waves of this amplitude \[m\] and wave number \[rad/m\].
    Bent {
        /// Amplitude \[m\].
        amplitude: f64,
        /// Wave number \[rad/m\].
        wave: f64,
    },
    /// Scaled about a point \[m\].
    Scaled {
        /// The point that stays \[m\].
        about: [f64; 2],
        /// The factor.
        factor: f64,
    },
}

impl Warp {
    fn point(self, [x, y]: [f64; 2]) -> [f64; 2] {
        match self {
            Self::Bent { amplitude, wave } => [
                x + amplitude * (wave * y + 0.3).sin(),
                y + amplitude * (wave * x + 1.1).sin(),
            ],
            Self::Scaled { about, factor } => [
                about[0] + factor * (x - about[0]),
                about[1] + factor * (y - about[1]),
            ],
        }
    }

    /// The point that is moved to this one, by fixed-point iteration.
    fn inverse(self, to: [f64; 2]) -> [f64; 2] {
        let mut from = to;
        for _ in 0..8 {
            let moved = self.point(from);
            from = [from[0] + to[0] - moved[0], from[1] + to[1] - moved[1]];
        }
        from
    }

    /// The pose that has the same walls around it on the damaged map.
    pub fn pose(self, pose: Pose) -> Pose {
        const STEP: f64 = 0.05;
        let ahead = |by: f64| self.point(pose.transform([by, 0.0]));
        let ([x, y], [x1, y1], [x0, y0]) = (self.point([pose.x, pose.y]), ahead(STEP), ahead(-STEP));
        Pose::new(x, y, (y1 - y0).atan2(x1 - x0))
    }
}

/// Ways along the path beside which walls are changed, as shares of its length, and the side: 1 is left.
const PLACES: [(f64, f64); 6] = [
    (0.15, 1.0),
    (0.4, -1.0),
    (0.65, 1.0),
    (0.85, -1.0),
    (0.28, -1.0),
    (0.52, 1.0),
];

/// Length of a stretch of wall that is moved \[m\].
const STRETCH: f64 = 3.0;

/// Damages a map beside the `path` of the car. None for a defect that is none of the map.
pub fn damage(
    grid: &OccupancyGrid,
    defect: Defect,
    path: &[Pose],
    random: &mut SmallRng,
) -> Option<(OccupancyGrid, Option<Warp>)> {
    let size = defect.size();
    let mut damaged = grid.clone();
    match defect.kind {
        DefectKind::WallMissing => {
            let places = if defect.grade == Grade::Severe { 4 } else { 1 };
            for place in wall_places(grid, path).into_iter().take(places) {
                for index in stretch(grid, &place, size / places as f64) {
                    set(&mut damaged, index, Cell::Free);
                }
            }
        }
        DefectKind::WallMoved => {
            let places = [1, 3, 6][defect.grade as usize];
            for (number, place) in wall_places(grid, path).into_iter().take(places).enumerate() {
                // Alternately outwards and inwards.
                let by = size / 100.0 * if number % 2 == 0 { 1.0 } else { -1.0 };
                shift(grid, &mut damaged, &place, by);
            }
        }
        DefectKind::RaggedWalls => {
            for index in 0..grid.cells.len() {
                if at_face(grid, index) && random.random_range(0.0..100.0) < size {
                    let other = match grid.cells[index] {
                        Cell::Occupied => Cell::Free,
                        _ => Cell::Occupied,
                    };
                    set(&mut damaged, index, other);
                }
            }
        }
        DefectKind::ThickWalls => {
            for _ in 0..size as usize {
                let before = damaged.clone();
                for index in 0..before.cells.len() {
                    if before.cells[index] != Cell::Occupied && at_face(&before, index) {
                        set(&mut damaged, index, Cell::Occupied);
                    }
                }
            }
        }
        DefectKind::CoarseCells => damaged = coarse(grid, size as usize),
        DefectKind::BentMap => {
            let extent = (grid.width.max(grid.height) as f64 * grid.resolution).min(60.0);
            let warp = Warp::Bent {
                amplitude: size / 100.0,
                wave: TAU / extent.max(1.0),
            };
            return Some((resampled(grid, warp, size / 100.0), Some(warp)));
        }
        DefectKind::ScaledMap => {
            let factor = 1.0 + size / 100.0;
            damaged.resolution *= factor;
            let about = [grid.origin.x, grid.origin.y];
            return Some((damaged, Some(Warp::Scaled { about, factor })));
        }
        DefectKind::Specks => {
            for index in 0..grid.cells.len() {
                if random.random_range(0.0..100.0) < size {
                    let other = match grid.cells[index] {
                        Cell::Occupied => Cell::Free,
                        _ => Cell::Occupied,
                    };
                    set(&mut damaged, index, other);
                }
            }
        }
        _ => return None,
    }
    Some((damaged, None))
}

fn set(grid: &mut OccupancyGrid, index: usize, cell: Cell) {
    grid.cells[index] = cell;
    grid.occupancy[index] = match cell {
        Cell::Free => 0,
        Cell::Unknown => 128,
        Cell::Occupied => 255,
    };
}

/// The index of the cell that contains a point of `map` \[m\]; None outside the grid.
fn index_at(grid: &OccupancyGrid, point: [f64; 2]) -> Option<usize> {
    let [column, row] = grid.to_grid(point).map(f64::floor);
    let inside = (0.0..grid.width as f64).contains(&column) && (0.0..grid.height as f64).contains(&row);
    inside.then(|| row as usize * grid.width + column as usize)
}

/// The middle of a cell in `map` \[m\].
fn middle(grid: &OccupancyGrid, index: usize) -> [f64; 2] {
    let (column, row) = (index % grid.width, index / grid.width);
    grid.to_map([column as f64 + 0.5, row as f64 + 0.5])
}

/// True for a wall's cell beside another, or another beside a wall's.
fn at_face(grid: &OccupancyGrid, index: usize) -> bool {
    let (column, row) = ((index % grid.width) as i64, (index / grid.width) as i64);
    let wall = grid.cells[index] == Cell::Occupied;
    (-1..=1).any(|dx| {
        (-1..=1).any(|dy| {
            let (x, y) = (column + dx, row + dy);
            let inside = (0..grid.width as i64).contains(&x) && (0..grid.height as i64).contains(&y);
            inside && (grid.cell(x, y) == Cell::Occupied) != wall
        })
    })
}

/// A point on a wall beside the path; its heading is that of the path, turned to the side of the wall.
#[derive(Debug, Clone, Copy)]
struct WallPlace {
    point: [f64; 2],
    /// Away from the path, of length 1.
    out: [f64; 2],
}

/// The walls beside the path at [`PLACES`], without those that are too far off.
fn wall_places(grid: &OccupancyGrid, path: &[Pose]) -> Vec<WallPlace> {
    /// A wall is looked for within this distance of the path \[m\].
    const REACH: f64 = 6.0;
    let mut ways = vec![0.0];
    for pair in path.windows(2) {
        ways.push(ways[ways.len() - 1] + pair[0].distance(pair[1]));
    }
    let length = ways[ways.len() - 1];
    let beside = |&(share, side): &(f64, f64)| {
        let pose = path.get(ways.partition_point(|way| *way < share * length))?;
        let (sin, cos) = pose.heading.sin_cos();
        let out = [-sin * side, cos * side];
        let steps = (REACH / (0.5 * grid.resolution)).ceil() as usize;
        (0..steps)
            .map(|step| 0.5 * grid.resolution * step as f64)
            .map(|way| [pose.x + out[0] * way, pose.y + out[1] * way])
            .find(|point| grid.at(*point) == Cell::Occupied)
            .map(|point| WallPlace { point, out })
    };
    PLACES.iter().filter_map(beside).collect()
}

/// The cells of a wall within half a `length` along it \[m\] and 0.8 m across.
fn stretch(grid: &OccupancyGrid, place: &WallPlace, length: f64) -> Vec<usize> {
    let [ox, oy] = place.out;
    (0..grid.cells.len())
        .filter(|index| grid.cells[*index] == Cell::Occupied)
        .filter(|index| {
            let [x, y] = middle(grid, *index);
            let [dx, dy] = [x - place.point[0], y - place.point[1]];
            (-oy * dx + ox * dy).abs() < length / 2.0 && (ox * dx + oy * dy).abs() < 0.8
        })
        .collect()
}

/// Moves a stretch of wall outwards by `by` \[m\].
fn shift(grid: &OccupancyGrid, damaged: &mut OccupancyGrid, place: &WallPlace, by: f64) {
    let cells = stretch(grid, place, STRETCH);
    for index in &cells {
        set(damaged, *index, Cell::Free);
    }
    for index in cells {
        // A quarter of a cell apart, so that rounding leaves no hole.
        let [x, y] = middle(grid, index);
        for part in [-0.25, 0.25] {
            let way = by + part * grid.resolution;
            let to = [x + place.out[0] * way, y + place.out[1] * way];
            if let Some(index) = index_at(damaged, to) {
                set(damaged, index, Cell::Occupied);
            }
        }
    }
}

/// The same map in cells that are `times` larger: a wall where any of the cells had one.
fn coarse(grid: &OccupancyGrid, times: usize) -> OccupancyGrid {
    let cell = |column: usize, row: usize| {
        let columns = column * times..((column + 1) * times).min(grid.width);
        let rows = row * times..((row + 1) * times).min(grid.height);
        let cells = rows.flat_map(|row| columns.clone().map(move |column| row * grid.width + column));
        let mut coarse = Cell::Unknown;
        for cell in cells.map(|index| grid.cells[index]) {
            match cell {
                Cell::Occupied => return Cell::Occupied,
                Cell::Free => coarse = Cell::Free,
                Cell::Unknown => {}
            }
        }
        coarse
    };
    OccupancyGrid::from_fn(
        grid.width.div_ceil(times),
        grid.height.div_ceil(times),
        grid.resolution * times as f64,
        grid.origin,
        cell,
    )
}

/// The map under a warp, with a margin \[m\] for what is moved across its edge.
fn resampled(grid: &OccupancyGrid, warp: Warp, margin: f64) -> OccupancyGrid {
    let pad = (margin / grid.resolution).ceil() as usize + 1;
    let shift = -(pad as f64) * grid.resolution;
    let (width, height) = (grid.width + 2 * pad, grid.height + 2 * pad);
    let unknown = OccupancyGrid::from_fn(
        width,
        height,
        grid.resolution,
        grid.origin * Pose::new(shift, shift, 0.0),
        |_, _| Cell::Unknown,
    );
    let mut bent = unknown;
    for index in 0..bent.cells.len() {
        let from = warp.inverse(middle(&bent, index));
        if let Some(source) = index_at(grid, from) {
            bent.cells[index] = grid.cells[source];
            bent.occupancy[index] = grid.occupancy[source];
        }
    }
    bent
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    /// A corridor of 20 m along x between walls at y = 0 and y = 4 m, three cells thick.
    fn corridor() -> OccupancyGrid {
        OccupancyGrid::from_fn(400, 120, 0.05, Pose::new(0.0, -1.0, 0.0), |_, row| match row {
            17..20 | 100..103 => Cell::Occupied,
            20..100 => Cell::Free,
            _ => Cell::Unknown,
        })
    }

    fn damaged(text: &str) -> (OccupancyGrid, Option<Warp>) {
        let path: Vec<Pose> = (0..100)
            .map(|i| Pose::new(2.0 + 0.16 * f64::from(i), 2.0, 0.0))
            .collect();
        let choice: super::super::DefectChoice = text.parse().expect("a defect");
        damage(&corridor(), choice.one(), &path, &mut SmallRng::seed_from_u64(1)).expect("of the map")
    }

    fn walls(grid: &OccupancyGrid) -> usize {
        grid.cells.iter().filter(|cell| **cell == Cell::Occupied).count()
    }

    #[test]
    fn walls_are_missing_over_the_length_that_the_grade_names() {
        let before = walls(&corridor());
        let missing = |grade: &str| before - walls(&damaged(&format!("wall-missing:{grade}")).0);
        // Three cells thick, 20 cells a metre.
        assert!(missing("mild").abs_diff(3 * 20 * 3) <= 6);
        assert!(missing("medium").abs_diff(6 * 20 * 3) <= 6);
        assert!(
            missing("severe").abs_diff(24 * 20 * 3) <= 200,
            "{}",
            missing("severe")
        );
    }

    #[test]
    fn a_moved_wall_stands_as_much_further_out() {
        let (grid, _) = damaged("wall-moved:mild");
        // The first place is at 15 % of the way, to the left: the face was at y = 4 m.
        let face = |x: f64| {
            (0..80)
                .map(|step| 3.0 + 0.025 * f64::from(step))
                .find(|y| grid.at([x, *y]) == Cell::Occupied)
                .expect("a wall")
        };
        assert!((face(4.4) - 4.1).abs() < 0.03, "{}", face(4.4));
        assert!((face(12.0) - 4.0).abs() < 0.03, "{}", face(12.0));
    }

    #[test]
    fn coarse_cells_keep_every_wall() {
        let (grid, warp) = damaged("coarse-cells:severe");
        assert_eq!((grid.width, grid.height, warp), (100, 30, None));
        assert!((grid.resolution - 0.2).abs() < 1e-12);
        assert_eq!(grid.at([10.0, 4.1]), Cell::Occupied);
        assert_eq!(grid.at([10.0, 2.0]), Cell::Free);
    }

    #[test]
    fn the_walls_of_a_bent_map_are_where_the_warp_moves_them() {
        for text in ["bent-map:severe", "scaled-map:severe"] {
            let (grid, warp) = damaged(text);
            let warp = warp.expect("moved");
            for x in [3.0, 9.0, 15.0] {
                let face = warp.point([x, 4.075]);
                assert_eq!(grid.at(face), Cell::Occupied, "{text} {x}");
                let inside = warp.point([x, 3.9]);
                assert_eq!(grid.at(inside), Cell::Free, "{text} {x}");
                let back = warp.inverse(face);
                assert!((back[0] - x).abs() < 1e-6 && (back[1] - 4.075).abs() < 1e-6);
                let pose = warp.pose(Pose::new(x, 2.0, 0.3));
                assert!((pose.heading - 0.3).abs() < 0.2);
            }
        }
    }

    #[test]
    fn ragged_walls_and_specks_change_the_share_that_the_grade_names() {
        let before = corridor();
        let changed = |text: &str| {
            let (grid, _) = damaged(text);
            grid.cells
                .iter()
                .zip(&before.cells)
                .filter(|(a, b)| a != b)
                .count() as f64
        };
        let faces = (0..before.cells.len()).filter(|i| at_face(&before, *i)).count() as f64;
        assert!((changed("ragged-walls:medium") / faces - 0.3).abs() < 0.03);
        let all = before.cells.len() as f64;
        assert!((changed("specks:severe") / all - 0.05).abs() < 0.01);
        assert!(walls(&damaged("thick-walls:mild").0) > walls(&before));
    }

    #[test]
    fn a_path_without_walls_leaves_the_map_as_it_is() {
        let empty = OccupancyGrid::from_fn(40, 40, 0.05, Pose::IDENTITY, |_, _| Cell::Free);
        for text in ["wall-missing", "wall-moved", "ragged-walls", "thick-walls"] {
            let choice: super::super::DefectChoice = text.parse().expect("a defect");
            for path in [&[][..], &[Pose::IDENTITY][..]] {
                let mut random = SmallRng::seed_from_u64(1);
                let (grid, _) = damage(&empty, choice.one(), path, &mut random).expect("of the map");
                assert_eq!(grid, empty, "{text}");
            }
        }
    }
}
