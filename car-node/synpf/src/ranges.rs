//! Predicted ranges, and how accurate each method is.
//!
//! A range ends at a wall's *face*: the contour of the distance field, which passes between the centres of a free and an
//! occupied cell and cuts the corners of the cells. Errors are stated as distances from the faces, since along a ray that
//! grazes a wall any error across it becomes as large as one likes along it. For each method: a range ends within the
//! bound of a face, and the ray up to there is nowhere deeper behind a face than the bound.
//!
//! | method | bound \[cells\] | because |
//! |---|---|---|
//! | CDDT, along one of its 256 directions | 1/4; before the end of a wall seen along up to 2 | lanes are half a cell wide, and a face is extended through the lane |
//! | CDDT, any direction | that, and r * pi / 256 at a range r | half a step between directions |
//! | range table | that of CDDT, 0.71, r * pi / 128 and 1.25 mm | centre of the cell in place of the point; the directions of particle and beam are rounded one by one; ranges are stored in steps of 2.5 mm |
//! | ray marching | 1/4 | interpolation of the field between the cells' centres, with steps of at least a quarter of a cell |
//! | casting on the grid (`maps::OccupancyGrid::cast`, `gpu`) | 1/2 | it ends at the edges of occupied cells, not at faces |
//!
//! A table with blocks of n x n cells adds up to 1.42 (n - 1): the range is for the cell nearest to the middle of the block.
//! A set with fewer directions in the table (`theta_discretization`) adds r * pi / directions.

use std::sync::Arc;

use maps::OccupancyGrid;

use crate::cddt::Cddt;
#[cfg(feature = "gpu")]
use crate::gpu::GpuMap;
use crate::range_table::RangeTable;

/// Where predicted ranges come from in the region that the particles are in.
#[derive(Debug, Clone)]
pub(crate) enum Ranges {
    /// Looked up.
    Table(Arc<RangeTable>),
    /// Marched on the distance field.
    RayMarching,
    /// Marched until the table that the set asks for is built.
    Interim,
    /// Searched for in the sorted crossings with walls.
    Cddt(Arc<Cddt>),
    /// Cast on the grid, cell by cell. No set chooses it: it is what the others are compared with.
    Exact(Arc<OccupancyGrid>),
    /// Cast on a graphics card.
    #[cfg(feature = "gpu")]
    Gpu(Arc<GpuMap>),
}

#[cfg(test)]
mod tests {
    use std::f32::consts::{PI, TAU};

    use maps::{Cell, DistanceField, OccupancyGrid, Pose};
    use rand::rngs::SmallRng;
    use rand::{RngExt, SeedableRng};

    use super::*;
    use crate::cddt::DIRECTIONS;
    use crate::range_table::{TableParameters, UNIT};

    /// Cells along each side of a random map, and the size of a cell \[m\].
    const SIDE: usize = 80;
    const RESOLUTION: f64 = 0.05;
    const LONGEST: f32 = 1000.0;

    /// A room with boxes, some of a single cell, and what is needed to measure ranges in it.
    struct Room {
        grid: OccupancyGrid,
        field: DistanceField,
        faces: Vec<[[f32; 2]; 2]>,
    }

    impl Room {
        fn random(random: &mut SmallRng) -> Self {
            let mut cells = vec![Cell::Free; SIDE * SIDE];
            for (i, cell) in cells.iter_mut().enumerate() {
                let (column, row) = (i % SIDE, i / SIDE);
                if [column, row].into_iter().any(|v| !(3..SIDE - 3).contains(&v)) {
                    *cell = Cell::Occupied;
                }
            }
            for k in 0..16 {
                let most = if k < 8 { 14 } else { 2 };
                let [left, bottom] = [0, 0].map(|_: i32| random.random_range(3..SIDE - 18));
                let [width, height] = [0, 0].map(|_: i32| random.random_range(1..=most));
                for row in bottom..bottom + height {
                    cells[row * SIDE + left..row * SIDE + left + width].fill(Cell::Occupied);
                }
            }
            let grid = OccupancyGrid::new(SIDE, SIDE, RESOLUTION, Pose::IDENTITY, cells);
            let field = DistanceField::new(&grid);
            let faces = field.contour();
            Self { grid, field, faces }
        }

        /// A point in free space \[cells\].
        fn free_point(&self, random: &mut SmallRng) -> [f32; 2] {
            loop {
                let point = [0, 0].map(|_: i32| random.random_range(3.0..SIDE as f32 - 3.0));
                let free = self.grid.cells[point[1] as usize * SIDE + point[0] as usize] == Cell::Free;
                if free
                    && self
                        .field
                        .sample(point[0], point[1])
                        .is_some_and(|s| s.distance > 0.0)
                {
                    return point;
                }
            }
        }

        /// Distance of a point from the nearest face \[cells\].
        fn to_face(&self, point: [f32; 2]) -> f32 {
            let squared = |[a, b]: &[[f32; 2]; 2]| {
                let along = [b[0] - a[0], b[1] - a[1]];
                let aside = [point[0] - a[0], point[1] - a[1]];
                let length = along[0].powi(2) + along[1].powi(2);
                let share = (aside[0] * along[0] + aside[1] * along[1]) / length.max(f32::MIN_POSITIVE);
                let share = share.clamp(0.0, 1.0);
                (aside[0] - share * along[0]).powi(2) + (aside[1] - share * along[1]).powi(2)
            };
            self.faces.iter().map(squared).fold(f32::MAX, f32::min).sqrt()
        }

        /// Where a ray crosses faces, by brute force \[cells\].
        fn crossings(&self, from: [f32; 2], angle: f32) -> Vec<f32> {
            let (sin, cos) = angle.sin_cos();
            let turned = |p: [f32; 2]| {
                let (dx, dy) = (p[0] - from[0], p[1] - from[1]);
                [dx * cos + dy * sin, dy * cos - dx * sin]
            };
            let mut crossings: Vec<f32> = self
                .faces
                .iter()
                .filter_map(|face| {
                    let [a, b] = face.map(turned);
                    let crosses = (a[1] < 0.0) != (b[1] < 0.0);
                    crosses.then(|| a[0] - a[1] * (b[0] - a[0]) / (b[1] - a[1]))
                })
                .filter(|at| *at > 0.0)
                .collect();
            crossings.sort_by(f32::total_cmp);
            crossings
        }

        /// By how much a range is off, as distances from the faces [cells]: how far before a face it ends, and how deep the
        /// ray goes behind one.
        fn error(&self, from: [f32; 2], angle: f32, range: f32) -> [f32; 2] {
            let (sin, cos) = angle.sin_cos();
            let at = |path: f32| self.to_face([from[0] + path * cos, from[1] + path * sin]);
            let crossings = self.crossings(from, angle);
            let passed = crossings.partition_point(|at| *at < range);
            let early = if passed % 2 == 0 { at(range) } else { 0.0 };
            let mut deep = 0.0f32;
            for (begin, end) in crossings
                .iter()
                .step_by(2)
                .zip(crossings.iter().skip(1).step_by(2))
            {
                let mut path = *begin;
                while path < end.min(range) {
                    deep = deep.max(at(path));
                    path += 0.05;
                }
                if (*begin..*end).contains(&range) {
                    deep = deep.max(at(range));
                }
            }
            [early, deep]
        }
    }

    /// Runs `measure` on random rays of random maps, with what `build` makes of each map. It returns the angle that the
    /// range is for \[rad\], the range \[cells\], and the bounds of how early and how deep it may be \[cells\]. Returns the errors
    /// of all rays.
    fn hold<T>(
        seed: u64,
        build: impl Fn(&Room) -> T,
        mut measure: impl FnMut(&T, &Room, [f32; 2], f32) -> (f32, f32, [f32; 2]),
    ) -> Vec<[f32; 2]> {
        let mut random = SmallRng::seed_from_u64(seed);
        let mut errors = Vec::new();
        for _ in 0..12 {
            let room = Room::random(&mut random);
            let built = build(&room);
            for _ in 0..400 {
                let from = room.free_point(&mut random);
                let angle = random.random_range(-PI..PI);
                let (angle, range, bounds) = measure(&built, &room, from, angle);
                let error = room.error(from, angle, range);
                for (error, bound) in error.into_iter().zip(bounds) {
                    assert!(
                        error <= bound,
                        "{error} cells off where {bound} are allowed: range {range} from {from:?} along {angle}, \
                         faces at {:?}",
                        room.crossings(from, angle)
                    );
                }
                errors.push(error);
            }
        }
        errors
    }

    /// What f32 does to places on a map of this size \[cells\].
    const ROUNDING: f32 = 1e-3;

    /// The bounds of a CDDT along its directions: early, deep \[cells\].
    const CDDT: [f32; 2] = [2.02 + ROUNDING, 0.25 + ROUNDING];

    #[test]
    fn a_cddt_is_right_to_a_quarter_of_a_cell_along_its_directions() {
        let build = |room: &Room| Cddt::new(&room.field);
        let errors = hold(1, build, |cddt, _, from, angle| {
            let step = TAU / DIRECTIONS as f32;
            let along = (angle / step).round() * step;
            (along, cddt.range(from, along, LONGEST), CDDT)
        });
        let close = errors.iter().filter(|error| error[0] <= 0.25).count();
        assert!(close * 1000 >= errors.len() * 995, "{close} of {}", errors.len());
    }

    #[test]
    fn a_range_table_is_right_to_its_cell_its_directions_and_its_steps() {
        for (seed, directions, side) in [(2, 256, 1), (3, 100, 1), (6, 256, 3)] {
            let parameters = TableParameters { directions };
            let build = |room: &Room| {
                let free = |i: &u32| room.grid.cells[*i as usize] == Cell::Free;
                let cells: Vec<u32> = (0..(SIDE * SIDE) as u32).filter(free).collect();
                let table = RangeTable::new(&room.grid, &room.field, &cells, side, parameters);
                assert_eq!(table.bytes(), RangeTable::bytes_for(&room.grid, &cells, side));
                table
            };
            let mut random = SmallRng::seed_from_u64(seed);
            hold(seed, build, |table, _, from, angle| {
                // The heading of the particle and the direction of the beam that add up to the angle.
                let beam = random.random_range(-PI..PI);
                let range = table.range(from, angle - beam, beam).expect("in free space");
                let range = range / RESOLUTION as f32;
                let coarse = if directions == 256 {
                    0.0
                } else {
                    PI / f32::from(directions)
                };
                let block = 2f32.sqrt() * (side as f32 - 1.0);
                let aside =
                    block + 0.5f32.sqrt() + range * (PI / 128.0 + coarse) + 0.5 * UNIT / RESOLUTION as f32;
                (angle, range, CDDT.map(|bound| bound + aside))
            });
        }
    }

    #[test]
    fn ray_marching_is_right_to_a_quarter_of_a_cell() {
        hold(
            4,
            |_| (),
            |(), room, from, angle| {
                let range = room.field.trace(from, [angle.cos(), angle.sin()], LONGEST);
                (angle, range, [0.25 + ROUNDING; 2])
            },
        );
    }

    #[test]
    fn casting_on_the_grid_ends_within_half_a_cell_of_a_face() {
        hold(
            5,
            |_| (),
            |(), room, from, angle| {
                let [x, y] = from.map(|v| f64::from(v) * RESOLUTION);
                let range = room.grid.cast(Pose::new(x, y, angle.into()), 1e3) / RESOLUTION;
                (angle, range as f32, [0.5 + ROUNDING; 2])
            },
        );
    }
}
