//! Walls from a map's cells.

use maps::{OccupancyGrid, solidity};

use crate::{Surface, Wall};

/// The contours between free cells and all others, by marching squares (Lorensen and Cline, 1987, in two dimensions)
/// on the free share of each 3 x 3 block of cells, so that the cells' staircase becomes a line.
///
/// Each wall is one segment: rays and outlines need no more order.
pub(crate) fn contours(grid: &OccupancyGrid) -> Vec<Wall> {
    let (width, height) = (grid.width as i64, grid.height as i64);
    // Nobody drives where the map does not say, so a wall closes it off.
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
    // A binomial kernel leaves straight walls where they are and rounds corners by less than a cell.
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
            // Corners of a square between four cell centres, counter-clockwise.
            let corners = [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(dc, dr)| {
                let (c, r) = (column + dc, row + dr);
                ([c as f64 + 0.5, r as f64 + 0.5], at(&share, c, r) - 0.5)
            });
            let crossings: Vec<[f64; 2]> = (0..4)
                .filter_map(|i| {
                    let ((a, va), (b, vb)) = (corners[i], corners[(i + 1) % 4]);
                    ((va < 0.0) != (vb < 0.0)).then(|| {
                        let t = va / (va - vb);
                        grid.to_map([a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])])
                    })
                })
                .collect();
            // Two crossings, or four at a saddle: the pairing there matters to nobody.
            walls.extend(crossings.chunks_exact(2).map(|pair| Wall {
                surface: Surface::Plain,
                points: pair.to_vec(),
            }));
        }
    }
    walls
}
