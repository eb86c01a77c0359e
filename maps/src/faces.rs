//! The faces of walls, and the distance of every cell from them.
//!
//! A face is the line on which the cells' solidity, interpolated between their centres, passes one half. On a map drawn or
//! edited with anti-aliasing it is the wall itself, to a small part of a cell. On a black and white map it is the staircase
//! of cells with its corners cut.
//!
//! Scans are fitted to the distance from this line, not from the cells. Beside a slanting wall, distances to cells have
//! steps, which a fit takes for structure along the wall. On an oval with long straights (`ims`, 6.4 cm cells, anti-aliased
//! walls) such steps are half of the visible structure. There a simulated lap has an RMSE of 2.0 cm with faces, and of
//! 10.9 cm with distances averaged over three grey levels.

use std::ops::Range;

use rayon::prelude::*;

use crate::marching_squares::{CORNERS, zero_lines};

/// A segment of a face: its ends in cells from the centre of cell (0, 0).
type Segment = [[f32; 2]; 2];

/// Passes in which cells take over nearer faces from their neighbours. Of 9.6 million cells among random specks, 0.06 % miss
/// the nearest face after one pass and 0.01 % after two. None of them is within a cell and a half of it.
const LOOKS: usize = 2;

/// The faces of all walls of a grid.
pub(crate) struct Faces {
    width: usize,
    height: usize,
    segments: Vec<Segment>,
    /// The first segment of each square between four cells' centres, row by row, and the end of the last.
    starts: Vec<u32>,
}

impl Faces {
    /// Finds the faces between `width * height` cells. `cell` gives a cell's solidity above that of a face, and whether the
    /// map gives it. A line between cells that are only assumed to lie behind a wall is no face.
    pub(crate) fn new(width: usize, height: usize, cell: impl Fn(usize) -> (f32, bool) + Sync) -> Self {
        let [columns, rows] = [width, height].map(|cells| cells.saturating_sub(1));
        let through_row = |row: usize| {
            let mut segments = Vec::new();
            let counts: Vec<u32> = (0..columns)
                .map(|column| {
                    let before = segments.len();
                    through_square([column, row], width, &cell, &mut segments);
                    (segments.len() - before) as u32
                })
                .collect();
            (segments, counts)
        };
        let found: Vec<_> = (0..rows).into_par_iter().map(through_row).collect();
        let mut segments = Vec::new();
        let mut starts = vec![0];
        for (more, counts) in found {
            segments.extend(more);
            for count in counts {
                starts.push(starts[starts.len() - 1] + count);
            }
        }
        Self {
            width,
            height,
            segments,
            starts,
        }
    }

    /// Distance from each cell's centre to the nearest face \[cells\]. Without a face it exceeds the grid's width.
    pub(crate) fn distances(&self) -> Vec<f32> {
        let touched = |i: usize| {
            let (column, row) = (i % self.width, i / self.width);
            !self.around([column, row]).all(|segments| segments.is_empty())
        };
        let seeds = nearest_cells(self.width, self.height, touched);
        let centre = |i: usize| [(i % self.width) as f32, (i / self.width) as f32];
        let nearer = |i: usize, (nearest, best): (f32, u32), segment: u32| {
            let squared = squared_distance(centre(i), &self.segments[segment as usize]);
            if squared < nearest {
                (squared, segment)
            } else {
                (nearest, best)
            }
        };
        let far = ((self.width + self.height) as f32).powi(2);
        // The nearest face is nearly always one beside the nearest cell that has any...
        let found: Vec<(f32, u32)> = seeds
            .par_iter()
            .enumerate()
            .map(|(i, &seed)| {
                if seed == NONE {
                    return (far, NONE);
                }
                let seed = seed as usize;
                self.around([seed % self.width, seed / self.width])
                    .flatten()
                    .fold((far, NONE), |best, segment| nearer(i, best, segment))
            })
            .collect();
        // ...or one that a neighbour has found, or has from a neighbour of its own.
        let from_neighbours = |found: &[(f32, u32)]| -> Vec<(f32, u32)> {
            let nearest = |i: usize| {
                let (column, row) = (i % self.width, i / self.width);
                let mut best = found[i];
                for row in row.saturating_sub(1)..(row + 2).min(self.height) {
                    for column in column.saturating_sub(1)..(column + 2).min(self.width) {
                        let (_, segment) = found[row * self.width + column];
                        if segment != best.1 && segment != NONE {
                            best = nearer(i, best, segment);
                        }
                    }
                }
                best
            };
            (0..found.len()).into_par_iter().map(nearest).collect()
        };
        let found = (0..LOOKS).fold(found, |found, _| from_neighbours(&found));
        found.into_iter().map(|(squared, _)| squared.sqrt()).collect()
    }

    /// The segments in each of the four squares around a cell's centre.
    fn around(&self, [column, row]: [usize; 2]) -> impl Iterator<Item = Range<u32>> {
        let [columns, rows] = [self.width, self.height].map(|cells| cells.saturating_sub(1));
        let [c, r] = [(column, columns), (row, rows)]
            .map(|(cell, squares)| cell.saturating_sub(1)..(cell + 1).min(squares));
        r.flat_map(move |row| c.clone().map(move |column| row * columns + column))
            .map(|square| self.starts[square]..self.starts[square + 1])
    }
}

/// Appends the faces in one square. Where only one end of a line is on a wall of the map, half of the line counts.
fn through_square(
    [column, row]: [usize; 2],
    width: usize,
    cell: impl Fn(usize) -> (f32, bool),
    segments: &mut Vec<Segment>,
) {
    let corners = CORNERS.map(|[right, up]| cell((row + up) * width + column + right));
    let solid = corners.map(|(excess, _)| excess > 0.0);
    if solid == [solid[0]; 4] {
        return;
    }
    for ends in zero_lines(corners.map(|(excess, _)| excess)) {
        let [from, to] = ends.map(|end| [column as f32 + end.at[0], row as f32 + end.at[1]]);
        let middle = [0.5 * (from[0] + to[0]), 0.5 * (from[1] + to[1])];
        match ends.map(|end| corners[end.positive].1) {
            [true, true] => segments.push([from, to]),
            [true, false] => segments.push([from, middle]),
            [false, true] => segments.push([middle, to]),
            [false, false] => {}
        }
    }
}

fn squared_distance(point: [f32; 2], &[from, to]: &Segment) -> f32 {
    let along = [to[0] - from[0], to[1] - from[1]];
    let aside = [point[0] - from[0], point[1] - from[1]];
    let length = along[0] * along[0] + along[1] * along[1];
    let share = ((aside[0] * along[0] + aside[1] * along[1]) / length.max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
    let (dx, dy) = (aside[0] - share * along[0], aside[1] - share * along[1]);
    dx * dx + dy * dy
}

/// Stands for "no cell".
pub(crate) const NONE: u32 = u32::MAX;

/// For each cell of a grid, row by row, the index of the nearest cell that is `wanted`; [`NONE`] if no cell is. Exact
/// (Felzenszwalb and Huttenlocher, Theory of Computing 8, 2012).
pub(crate) fn nearest_cells(width: usize, height: usize, wanted: impl Fn(usize) -> bool + Sync) -> Vec<u32> {
    // The column of the nearest in a cell's own row...
    let mut in_row = vec![NONE; width * height];
    in_row
        .par_chunks_mut(width.max(1))
        .enumerate()
        .for_each(|(row, nearest)| {
            let mut last = NONE;
            for (column, cell) in nearest.iter_mut().enumerate() {
                if wanted(row * width + column) {
                    last = column as u32;
                }
                *cell = last;
            }
            let mut last = NONE;
            for (column, cell) in nearest.iter_mut().enumerate().rev() {
                let column = column as u32;
                if *cell == column {
                    last = column;
                }
                if last != NONE && (*cell == NONE || last - column < column - *cell) {
                    *cell = last;
                }
            }
        });
    let in_row = transposed(&in_row, width);
    // ...and of those of its column the nearest.
    let mut nearest = vec![NONE; width * height];
    nearest
        .par_chunks_mut(height.max(1))
        .zip(in_row.par_chunks(height.max(1)))
        .enumerate()
        .for_each(|(column, (nearest, in_row))| {
            let squared =
                |row: usize| (in_row[row] != NONE).then(|| (f64::from(in_row[row]) - column as f64).powi(2));
            for (cell, root) in nearest.iter_mut().zip(lower_envelope(height, squared)) {
                *cell = root.map_or(NONE, |row| (row * width) as u32 + in_row[row]);
            }
        });
    transposed(&nearest, height)
}

/// The columns of rows of `width` values, one after the other.
fn transposed<T: Copy + Send + Sync>(values: &[T], width: usize) -> Vec<T> {
    let height = values.len() / width.max(1);
    (0..values.len())
        .into_par_iter()
        .map(|i| values[i % height * width + i / height])
        .collect()
}

/// At each of `count` places on a line, the place whose parabola is lowest there. `height_at` gives a parabola's height at
/// its own place, and None where there is no parabola.
fn lower_envelope(count: usize, height_at: impl Fn(usize) -> Option<f64>) -> Vec<Option<usize>> {
    let mut roots: Vec<(usize, f64)> = Vec::new();
    let mut starts: Vec<f64> = Vec::new();
    for q in 0..count {
        let Some(height) = height_at(q) else { continue };
        let qf = q as f64;
        loop {
            let Some(&(p, lower)) = roots.last() else {
                starts.push(f64::NEG_INFINITY);
                break;
            };
            let pf = p as f64;
            let meet = ((height + qf * qf) - (lower + pf * pf)) / (2.0 * (qf - pf));
            if meet > starts[starts.len() - 1] {
                starts.push(meet);
                break;
            }
            roots.pop();
            starts.pop();
        }
        roots.push((q, height));
    }
    let mut k = 0;
    (0..count)
        .map(|place| {
            while k + 1 < roots.len() && starts[k + 1] < place as f64 {
                k += 1;
            }
            roots.get(k).map(|&(root, _)| root)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn distances_are_to_the_nearest_face(
            greys in proptest::collection::vec(prop_oneof![3 => Just(0u8), 1 => Just(255u8), 1 => any::<u8>()], 15 * 11),
        ) {
            let faces = Faces::new(15, 11, |i| (f32::from(greys[i]) - 127.5, true));
            for (i, distance) in faces.distances().into_iter().enumerate() {
                let centre = [(i % 15) as f32, (i / 15) as f32];
                let nearest = faces.segments.iter().map(|s| squared_distance(centre, s)).fold(f32::MAX, f32::min).sqrt();
                // Farther off it may be one that another cell's centre is nearer to. That cell is at most half a diagonal farther
                // than the nearest face is, and its own face a diagonal from it.
                let off = distance - nearest;
                let most = match nearest {
                    ..1.5 => 1e-4,
                    ..3.0 => 0.25,
                    _ => 1.5 * 2f32.sqrt(),
                };
                prop_assert!((-1e-4..=most).contains(&off), "{distance} {nearest}");
            }
        }

        #[test]
        fn the_nearest_cell_is_the_nearest(wanted in proptest::collection::vec(proptest::bool::weighted(0.05), 13 * 9)) {
            let cells = nearest_cells(13, 9, |i| wanted[i]);
            let squared = |i: usize, j: usize| (i % 13).abs_diff(j % 13).pow(2) + (i / 13).abs_diff(j / 13).pow(2);
            for (i, cell) in cells.into_iter().enumerate() {
                let exact = (0..13 * 9).filter(|&j| wanted[j]).map(|j| squared(i, j)).min();
                let found = (cell != NONE).then_some(cell as usize);
                prop_assert_eq!(found.map(|cell| squared(i, cell)), exact);
                prop_assert!(found.is_none_or(|cell| wanted[cell]));
            }
        }
    }

    #[test]
    fn a_face_that_a_neighbours_neighbour_has_found_is_the_nearest() {
        // Three specks: beside the second, which is hardly a wall, the third one's face is the nearest to some cells.
        let greys = |i: usize| {
            [(30, 101.0), (32, 128.0), (45, 255.0)]
                .iter()
                .find(|(at, _)| *at == i)
                .map_or(0.0, |s| s.1)
        };
        let faces = Faces::new(15, 11, |i| (greys(i) - 127.5, true));
        for (i, distance) in faces.distances().into_iter().enumerate() {
            let centre = [(i % 15) as f32, (i / 15) as f32];
            let nearest = faces
                .segments
                .iter()
                .map(|s| squared_distance(centre, s))
                .fold(f32::MAX, f32::min)
                .sqrt();
            assert!(
                distance - nearest < 0.05 || nearest > 3.0,
                "{centre:?}: {distance} {nearest}"
            );
        }
    }

    #[test]
    fn without_walls_everything_is_far() {
        let faces = Faces::new(5, 4, |_| (-1.0, true));
        assert!(faces.distances().into_iter().all(|distance| distance >= 9.0));
        assert!(Faces::new(0, 0, |_| (1.0, true)).distances().is_empty());
    }
}
