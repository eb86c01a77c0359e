//! Submaps painted over each other (`cartographer/io/submap_painter.cc`): each darkens or brightens what is below it by its
//! log odds, smoothly between its cells.

use std::collections::BTreeMap;

use super::{Submap, SubmapId};
use crate::raster::check_size;
use crate::{Cell, OccupancyGrid, Pose};

/// Cells around what the submaps cover.
const MARGIN: f64 = 5.0;
/// Grey where nothing is known.
const UNKNOWN: f64 = 128.0;
/// Thresholds of `map_saver`, as shares of black.
const OCCUPIED: f64 = 0.65;
const FREE: f64 = 0.196;

/// A pixel while it is painted.
#[derive(Clone, Copy)]
struct Pixel {
    grey: f32,
    /// How much of what is known covers it, in \[0, 1\].
    known: f32,
}

pub(super) fn paint(submaps: &BTreeMap<SubmapId, Submap>) -> Result<OccupancyGrid, String> {
    let painted = || submaps.values().filter(|submap| !submap.log_odds.is_empty());
    let resolution = painted()
        .map(|submap| submap.resolution)
        .fold(f64::INFINITY, f64::min);
    if !resolution.is_finite() {
        return Err("it has no submap with a known cell".into());
    }
    let corners = painted().flat_map(Submap::corners);
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for corner in corners {
        for k in 0..2 {
            low[k] = low[k].min(corner[k]);
            high[k] = high[k].max(corner[k]);
        }
    }
    let low = low.map(|v| v - MARGIN * resolution);
    let [width, height] = [0, 1].map(|k| ((high[k] - low[k]) / resolution + MARGIN).ceil());
    check_size(width as u64, height as u64)?;
    let (width, height) = (width as usize, height as usize);
    let origin = Pose::new(low[0], low[1], 0.0);
    let empty = Pixel {
        grey: UNKNOWN as f32,
        known: 0.0,
    };
    let mut pixels = vec![empty; width * height];
    for submap in painted() {
        let submap_from_map = submap.corner.inverse();
        let corners = submap
            .corners()
            .map(|corner| [0, 1].map(|k| (corner[k] - low[k]) / resolution));
        let bound = |k: usize, cells: usize| {
            let least = corners.iter().map(|c| c[k]).fold(f64::INFINITY, f64::min);
            let most = corners.iter().map(|c| c[k]).fold(f64::NEG_INFINITY, f64::max);
            (
                (least.floor() - 1.0).max(0.0) as usize,
                ((most.ceil() + 1.0).max(0.0) as usize).min(cells),
            )
        };
        let ((left, right), (bottom, top)) = (bound(0, width), bound(1, height));
        for row in bottom..top {
            for column in left..right {
                let centre = [column, row].map(|v| (v as f64 + 0.5) * resolution);
                let at = submap_from_map.transform(origin.transform(centre));
                submap.brush(at).onto(&mut pixels[row * width + column]);
            }
        }
    }
    let (cells, occupancy) = pixels.into_iter().map(cell).unzip();
    Ok(OccupancyGrid {
        width,
        height,
        resolution,
        origin,
        cells,
        occupancy,
    })
}

/// State and grey of a cell, as `map_server` reads them from the image.
fn cell(pixel: Pixel) -> (Cell, u8) {
    let grey = f64::from(pixel.grey).round().clamp(0.0, 255.0);
    let dark = 1.0 - grey / 255.0;
    let cell = match dark {
        _ if pixel.known <= 0.0 => Cell::Unknown,
        dark if dark > OCCUPIED => Cell::Occupied,
        dark if dark < FREE => Cell::Free,
        _ => Cell::Unknown,
    };
    (cell, 255 - grey as u8)
}

/// What a submap adds to a pixel.
#[derive(Clone, Copy, Default)]
struct Brush {
    /// Added grey.
    value: f32,
    /// How much of what is below it covers, in \[0, 1\].
    alpha: f32,
    known: f32,
}

impl Brush {
    /// Occupied cells cover what is below, free ones add to it.
    fn of(log_odds: u8) -> Self {
        if log_odds == 0 {
            return Self::default();
        }
        let delta = 128.0 - f32::from(log_odds);
        Self {
            value: delta.max(0.0),
            alpha: (-delta).max(0.0) / 255.0,
            known: 1.0,
        }
    }

    fn onto(self, pixel: &mut Pixel) {
        if self.known > 0.0 {
            pixel.grey = (self.value + (1.0 - self.alpha) * pixel.grey).min(255.0);
            pixel.known = pixel.known.max(self.known);
        }
    }
}

impl Submap {
    /// The corners of its known cells in `map`.
    fn corners(&self) -> [[f64; 2]; 4] {
        let (along_x, along_y) = (
            self.height as f64 * self.resolution,
            self.width as f64 * self.resolution,
        );
        [[0.0, 0.0], [-along_x, 0.0], [0.0, -along_y], [-along_x, -along_y]]
            .map(|corner| self.corner.transform(corner))
    }

    /// What it adds at a point of its own frame, between the four cells around it.
    fn brush(&self, at: [f64; 2]) -> Brush {
        // Columns lead towards -y, rows towards -x.
        let [u, v] = [-at[1], -at[0]].map(|d| d / self.resolution - 0.5);
        let (column, row) = (u.floor(), v.floor());
        let (across, down) = ((u - column) as f32, (v - row) as f32);
        let mut sum = Brush::default();
        for (dx, dy, weight) in [
            (0, 0, (1.0 - across) * (1.0 - down)),
            (1, 0, across * (1.0 - down)),
            (0, 1, (1.0 - across) * down),
            (1, 1, across * down),
        ] {
            let (x, y) = (column as i64 + dx, row as i64 + dy);
            let inside = (0..self.width as i64).contains(&x) && (0..self.height as i64).contains(&y);
            let brush = if inside {
                Brush::of(self.log_odds[y as usize * self.width + x as usize])
            } else {
                Brush::default()
            };
            sum.value += weight * brush.value;
            sum.alpha += weight * brush.alpha;
            sum.known += weight * brush.known;
        }
        sum
    }
}
