//! Walls from a map's cells.

use maps::{CORNERS, OccupancyGrid, solidity, zero_lines};

use crate::{Surface, Wall};

/// The contours between free cells and all others. They run where the free share of each 3 x 3 block of cells is one
/// half, so that the staircase of cells becomes a line.
///
/// Each wall is one segment. Rays and outlines need no order.
pub(crate) fn contours(grid: &OccupancyGrid) -> Vec<Wall> {
    let (width, height) = (grid.width as i64, grid.height as i64);
    // Unknown cells count as walls, so that no car drives into them.
    let free: Vec<f64> = solidity(grid)
        .into_iter()
        .map(|solid| solid.map_or(0.0, |solid| 1.0 - f64::from(solid) / 255.0))
        .collect();
    let at = |values: &[f64], column: i64, row: i64| {
        let inside = (0..width).contains(&column) && (0..height).contains(&row);
        if inside {
            values[(row * width + column) as usize]
        } else {
            0.0
        }
    };
    // A binomial kernel keeps straight walls in place and rounds corners by less than a cell.
    let mut share = vec![0.0; free.len()];
    for row in 0..height {
        for column in 0..width {
            let mut sum = 0.0;
            for (dr, wr) in [(-1, 1.0), (0, 2.0), (1, 1.0)] {
                for (dc, wc) in [(-1, 1.0), (0, 2.0), (1, 1.0)] {
                    sum += wr * wc * at(&free, column + dc, row + dr);
                }
            }
            share[(row * width + column) as usize] = sum / 16.0;
        }
    }
    let mut walls = Vec::new();
    for row in -1..height {
        for column in -1..width {
            let corners =
                CORNERS.map(|[right, up]| (at(&share, column + right as i64, row + up as i64) - 0.5) as f32);
            walls.extend(zero_lines(corners).map(|ends| {
                Wall {
                    surface: Surface::Plain,
                    points: ends
                        .map(|end| {
                            let [u, v] = end.at.map(f64::from);
                            grid.to_map([column as f64 + 0.5 + u, row as f64 + 0.5 + v])
                        })
                        .to_vec(),
                }
            }));
        }
    }
    walls
}
