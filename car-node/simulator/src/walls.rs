//! The true walls: line segments that the lidar measures and the car hits, with an index for rays.

use maps::OccupancyGrid;

use crate::contour::contours;
use crate::{Hit, Surface, Wall};

/// Edge of a cell of the index \[m\].
const CELL: f64 = 0.5;

#[derive(Debug, Clone, Copy, PartialEq)]
struct Segment {
    from: [f64; 2],
    along: [f64; 2],
    surface: Surface,
}

/// All walls of a track, indexed for rays.
#[derive(Debug, Clone, PartialEq)]
pub struct Walls {
    polylines: Vec<Wall>,
    segments: Vec<Segment>,
    /// Lower left corner of the index \[m\].
    corner: [f64; 2],
    columns: usize,
    rows: usize,
    /// Where each index cell's list starts in `listed`, and one end more.
    starts: Vec<u32>,
    listed: Vec<u32>,
}

impl Walls {
    /// Indexes walls. Segments with points that are not finite are left out.
    pub fn new(walls: Vec<Wall>) -> Self {
        let segments: Vec<Segment> = walls
            .iter()
            .flat_map(|wall| {
                wall.points.windows(2).map(|pair| Segment {
                    from: pair[0],
                    along: [pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]],
                    surface: wall.surface,
                })
            })
            .filter(|s| s.from.iter().chain(&s.along).all(|v| v.is_finite()))
            .collect();
        let mut low = [f64::INFINITY; 2];
        let mut high = [f64::NEG_INFINITY; 2];
        for s in &segments {
            for axis in 0..2 {
                low[axis] = low[axis].min(s.from[axis]).min(s.from[axis] + s.along[axis]);
                high[axis] = high[axis].max(s.from[axis]).max(s.from[axis] + s.along[axis]);
            }
        }
        if segments.is_empty() {
            (low, high) = ([0.0; 2], [0.0; 2]);
        }
        let corner = low.map(|v| v - CELL);
        let [columns, rows] = [0, 1].map(|axis| ((high[axis] - corner[axis]) / CELL) as usize + 2);
        let mut lists = vec![Vec::new(); columns * rows];
        for (i, s) in segments.iter().enumerate() {
            let [[c0, c1], [r0, r1]] = [0, 1].map(|axis| {
                let ends = [s.from[axis], s.from[axis] + s.along[axis]];
                [ends[0].min(ends[1]), ends[0].max(ends[1])].map(|v| ((v - corner[axis]) / CELL) as usize)
            });
            for row in r0..=r1 {
                for column in c0..=c1 {
                    let centre = [column, row].map(|v| (v as f64 + 0.5) * CELL);
                    if passes(s, [centre[0] + corner[0], centre[1] + corner[1]]) {
                        lists[row * columns + column].push(i as u32);
                    }
                }
            }
        }
        let mut starts = vec![0];
        let mut listed = Vec::new();
        for list in lists {
            listed.extend(list);
            starts.push(listed.len() as u32);
        }
        Self {
            polylines: walls,
            segments,
            corner,
            columns,
            rows,
            starts,
            listed,
        }
    }

    /// The walls of a map, for tracks without measured walls: the contours between free cells and all others, smoothed
    /// over a cell or two.
    pub fn from_grid(grid: &OccupancyGrid) -> Self {
        Self::new(contours(grid))
    }

    /// The polylines.
    pub fn polylines(&self) -> &[Wall] {
        &self.polylines
    }

    /// The first wall that a ray from `origin` \[m\] along the unit vector `direction` meets within `max_range` \[m\].
    pub fn cast(&self, origin: [f64; 2], direction: [f64; 2], max_range: f64) -> Option<Hit> {
        let mut best: Option<(f64, u32)> = None;
        let mut limit = max_range;
        self.along_ray(origin, direction, max_range, |listed, exit| {
            for &i in listed {
                if let Some(range) = meet(&self.segments[i as usize], origin, direction)
                    && range < limit
                {
                    limit = range;
                    best = Some((range, i));
                }
            }
            // Everything in a later cell is further away than the far side of this one.
            limit > exit
        });
        best.map(|(range, i)| {
            let Segment { along, surface, .. } = self.segments[i as usize];
            let across = direction[0] * along[1] - direction[1] * along[0];
            Hit {
                range,
                incidence: (across / along[0].hypot(along[1])).abs().min(1.0),
                surface,
            }
        })
    }

    /// The wall that crosses one of the sides of a convex outline, if any: its direction, as a unit vector.
    pub fn touching(&self, outline: &[[f64; 2]]) -> Option<[f64; 2]> {
        outline.iter().enumerate().find_map(|(i, &from)| {
            let to = outline[(i + 1) % outline.len()];
            let [dx, dy] = [to[0] - from[0], to[1] - from[1]];
            let length = dx.hypot(dy);
            let direction = [dx / length, dy / length];
            let mut found = None;
            self.along_ray(from, direction, length, |listed, _| {
                found = listed.iter().find_map(|&i| {
                    let segment = &self.segments[i as usize];
                    let range = meet(segment, from, direction)?;
                    let size = segment.along[0].hypot(segment.along[1]);
                    (range <= length).then(|| segment.along.map(|v| v / size))
                });
                found.is_none()
            });
            found
        })
    }

    /// Calls `visit` with each index cell's segments along a ray, and where the ray leaves the cell \[m\], until it
    /// returns false (Amanatides and Woo, *A Fast Voxel Traversal Algorithm*, 1987).
    fn along_ray(
        &self,
        origin: [f64; 2],
        direction: [f64; 2],
        max_range: f64,
        mut visit: impl FnMut(&[u32], f64) -> bool,
    ) {
        let at = [
            (origin[0] - self.corner[0]) / CELL,
            (origin[1] - self.corner[1]) / CELL,
        ];
        // Also false for NaN. Outside the index there are no walls.
        if !(at[0] >= 0.0 && at[1] >= 0.0 && at[0] < self.columns as f64 && at[1] < self.rows as f64) {
            return;
        }
        let mut cell = at.map(|v| v as usize);
        let size = [self.columns, self.rows];
        let per_cell = direction.map(|v| CELL / v.abs());
        let mut next = [0, 1].map(|axis| {
            let inside = at[axis] - cell[axis] as f64;
            let ahead = if direction[axis] > 0.0 {
                1.0 - inside
            } else {
                inside
            };
            if direction[axis] == 0.0 {
                f64::INFINITY
            } else {
                ahead * per_cell[axis]
            }
        });
        loop {
            let axis = usize::from(next[1] < next[0]);
            let exit = next[axis];
            let index = cell[1] * self.columns + cell[0];
            let listed = &self.listed[self.starts[index] as usize..self.starts[index + 1] as usize];
            if !visit(listed, exit) || exit > max_range {
                return;
            }
            next[axis] += per_cell[axis];
            if direction[axis] > 0.0 {
                cell[axis] += 1;
            } else {
                // Below zero wraps to a huge number, which ends the ray just as well.
                cell[axis] = cell[axis].wrapping_sub(1);
            }
            if cell[axis] >= size[axis] {
                return;
            }
        }
    }
}

/// True if a segment may pass through the index cell around `centre`: exact to within a nanometre.
fn passes(s: &Segment, centre: [f64; 2]) -> bool {
    let [dx, dy] = s.along;
    let offset = dx * (centre[1] - s.from[1]) - dy * (centre[0] - s.from[0]);
    offset.abs() <= (dx.abs() + dy.abs()) * (CELL / 2.0 + 1e-9)
}

/// Where a ray meets a segment \[m\].
fn meet(s: &Segment, origin: [f64; 2], direction: [f64; 2]) -> Option<f64> {
    let [ax, ay] = s.along;
    let [ox, oy] = [s.from[0] - origin[0], s.from[1] - origin[1]];
    let denominator = direction[0] * ay - direction[1] * ax;
    let range = (ox * ay - oy * ax) / denominator;
    let fraction = (ox * direction[1] - oy * direction[0]) / denominator;
    // A parallel ray divides by zero, and no comparison with NaN or infinity holds on both sides.
    (range >= 0.0 && (0.0..=1.0).contains(&fraction) && range.is_finite()).then_some(range)
}

#[cfg(test)]
mod tests {
    use super::*;
    use maps::{Cell, Pose};
    use proptest::prelude::*;

    fn square(half: f64) -> Wall {
        Wall {
            surface: Surface::Plain,
            points: vec![
                [-half, -half],
                [half, -half],
                [half, half],
                [-half, half],
                [-half, -half],
            ],
        }
    }

    #[test]
    fn rays_measure_a_room() {
        let walls = Walls::new(vec![square(2.0)]);
        let hit = walls.cast([0.5, 0.0], [1.0, 0.0], 30.0).expect("a wall");
        assert!((hit.range - 1.5).abs() < 1e-12);
        assert!((hit.incidence - 1.0).abs() < 1e-12);
        let slanted = std::f64::consts::FRAC_1_SQRT_2;
        let hit = walls.cast([0.0, 1.0], [slanted, slanted], 30.0).expect("a wall");
        assert!((hit.range - 2.0_f64.sqrt()).abs() < 1e-12);
        assert!((hit.incidence - slanted).abs() < 1e-12);
        assert_eq!(walls.cast([0.0, 0.0], [1.0, 0.0], 1.9), None);
        assert_eq!(walls.cast([f64::NAN, 0.0], [1.0, 0.0], 9.0), None);
    }

    #[test]
    fn an_outline_touches_the_wall_that_it_crosses() {
        let walls = Walls::new(vec![square(2.0)]);
        let at = |x: f64| [[x - 0.1, -0.1], [x + 0.1, -0.1], [x + 0.1, 0.1], [x - 0.1, 0.1]];
        assert_eq!(walls.touching(&at(1.8)), None);
        let along = walls.touching(&at(1.95)).expect("a wall");
        assert!(along[0].abs() < 1e-12 && (along[1].abs() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn walls_of_a_map_are_its_contours() {
        // A free room of 2 m x 1 m in a map of 5 cm cells.
        let grid = OccupancyGrid::from_fn(60, 40, 0.05, Pose::IDENTITY, |column, row| {
            if (10..50).contains(&column) && (10..30).contains(&row) {
                Cell::Free
            } else {
                Cell::Occupied
            }
        });
        let walls = Walls::from_grid(&grid);
        for (direction, expected) in [
            ([1.0, 0.0], 1.0),
            ([-1.0, 0.0], 1.0),
            ([0.0, 1.0], 0.5),
            ([0.0, -1.0], 0.5),
        ] {
            let hit = walls.cast([1.5, 1.0], direction, 10.0).expect("a wall");
            assert!(
                (hit.range - expected).abs() < 0.01,
                "{direction:?}: {}",
                hit.range
            );
        }
    }

    proptest! {
        #[test]
        fn the_index_misses_nothing(
            points in proptest::collection::vec((-4.0..4.0, -4.0..4.0).prop_map(|(x, y)| [x, y]), 2..30),
            origin in (-4.0..4.0, -4.0..4.0).prop_map(|(x, y)| [x, y]),
            angle in -3.2..3.2_f64,
        ) {
            let walls = Walls::new(vec![square(5.0), Wall { surface: Surface::Black, points }]);
            let direction = [angle.cos(), angle.sin()];
            let found = walls.cast(origin, direction, 30.0).map(|hit| hit.range);
            let scanned = walls
                .segments
                .iter()
                .filter_map(|s| meet(s, origin, direction))
                .fold(f64::INFINITY, f64::min);
            prop_assert!((found.expect("the room is closed") - scanned).abs() < 1e-9);
        }
    }
}
