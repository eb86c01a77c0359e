//! How well a scan fits the map at a pose.

use maps::{Cell, DistanceField, OccupancyGrid, Pose};

/// The fit of one scan, or of several, smoothed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScanFit {
    /// Share of the valid beams that end within 0.10 m of a wall (0.05 m and a cell where cells are larger), in [0, 1].
    pub alignment: f64,
    /// Mean over the same beams of min(distance to the nearest wall, 1 m) \[m\].
    pub residual: f64,
    /// Share of the valid beams more than 0.3 m shorter than the map says, in [0, 1].
    pub short_beams: f64,
    /// Share of the valid beams more than 0.3 m longer than the map says, in [0, 1].
    pub long_beams: f64,
}

/// Obstacles are taken to block at most this share of the beams: the alignment of a few free beams must not count as that
/// of a whole scan.
const BLOCKED_AT_MOST: f64 = 0.8;

/// Beams that are looked at.
const BEAMS: usize = 60;

/// Beams whose range is compared with the map's, which costs more.
const CAST: usize = 20;

/// Nearer than this to a wall, and the size of a cell, an end point is on it \[m\].
const ALIGNED: f32 = 0.05;

/// Finer cells than this do not make a laser better \[m\].
const LEAST_CELL: f64 = 0.05;

/// A range this far from the map's is another thing \[m\].
const OTHER: f32 = 0.3;

impl ScanFit {
    /// Judges a scan, given as end points in the frame of `base_link` \[m\], at a pose in the grid's frame, with the grid's
    /// corner as origin. Beams that end where nothing was mapped ([`leaves_map`]) are not valid: they say nothing on the pose.
    /// At most half of a scan is excused so.
    pub fn measure(
        grid: &OccupancyGrid,
        field: &DistanceField,
        points: &[[f32; 2]],
        base_link_from_laser: Pose,
        pose: Pose,
    ) -> Self {
        let cells = 1.0 / field.resolution() as f32;
        let aligned_within = ALIGNED + field.resolution().max(LEAST_CELL) as f32;
        let stride = points.len().div_ceil(BEAMS).max(1);
        let (sin, cos) = pose.heading.sin_cos();
        let (sin, cos) = (sin as f32, cos as f32);
        let (x, y) = (pose.x as f32, pose.y as f32);
        let laser = pose * base_link_from_laser;
        let (lx, ly) = (laser.x as f32, laser.y as f32);
        let (mut count, mut aligned, mut residual, mut unmapped) = (0.0f32, 0.0f32, 0.0f32, 0.0f32);
        let (mut cast, mut short, mut long) = (0.0f32, 0.0f32, 0.0f32);
        for (k, point) in points.iter().step_by(stride).enumerate() {
            let (px, py) = (
                x + cos * point[0] - sin * point[1],
                y + sin * point[0] + cos * point[1],
            );
            let distance = field
                .from_wall(px * cells, py * cells)
                .map_or(1.0, |d| d.min(1.0));
            count += 1.0;
            if distance < aligned_within {
                aligned += 1.0;
            } else if leaves_map(grid, field, [lx, ly], [px, py]) {
                unmapped += 1.0;
                continue;
            }
            residual += distance;
            if k % (BEAMS / CAST) == 0 {
                let (dx, dy) = (px - lx, py - ly);
                let range = dx.hypot(dy).max(1e-3);
                let most = (range + 2.0 * OTHER) * cells;
                let predicted = field.trace([lx * cells, ly * cells], [dx / range, dy / range], most) / cells;
                cast += 1.0;
                short += f32::from(range < predicted - OTHER);
                long += f32::from(range > predicted + OTHER);
            }
        }
        let share = |part: f32, of: f32| f64::from(part / of.max(1.0));
        let valid = count - unmapped.min(0.5 * count);
        Self {
            alignment: share(aligned, valid),
            residual: share(residual, valid),
            short_beams: share(short, cast),
            long_beams: share(long, cast),
        }
    }

    /// Share of the beams that an obstacle blocks, in [0, 1].
    ///
    /// A wrong pose makes as many beams too short as too long. An obstacle only makes beams too short. So the excess of
    /// short beams over long ones is due to obstacles.
    pub fn blocked(&self) -> f64 {
        (self.short_beams - self.long_beams).clamp(0.0, 1.0)
    }

    /// Alignment of the beams that no obstacle blocks, in [0, 1].
    pub fn clear_alignment(&self) -> f64 {
        let free = 1.0 - self.blocked().min(BLOCKED_AT_MOST);
        (self.alignment / free).min(1.0)
    }

    /// Moves by `share` of the way to `other`: one step of a first-order low-pass filter.
    #[must_use]
    pub fn towards(self, other: Self, share: f64) -> Self {
        let step = |from: f64, to: f64| from + share * (to - from);
        Self {
            alignment: step(self.alignment, other.alignment),
            residual: step(self.residual, other.residual),
            short_beams: step(self.short_beams, other.short_beams),
            long_beams: step(self.long_beams, other.long_beams),
        }
    }
}

/// Whether a beam from a laser ends where nothing was mapped, without having met a wall on its way: through an open door,
/// or past where mapping stopped. Such a beam says nothing on where the laser is. Points in the grid's frame \[m\].
pub fn leaves_map(grid: &OccupancyGrid, field: &DistanceField, laser: [f32; 2], end: [f32; 2]) -> bool {
    let cells = 1.0 / grid.resolution as f32;
    let cell = end.map(|v| (v * cells).floor() as i64);
    if grid.cell(cell[0], cell[1]) != Cell::Unknown {
        return false;
    }
    let (dx, dy) = (end[0] - laser[0], end[1] - laser[1]);
    let range = dx.hypot(dy).max(1e-3);
    let direction = [dx / range, dy / range];
    let start = laser.map(|v| v * cells);
    let path = field.trace(start, direction, range * cells);
    let met = [start[0] + path * direction[0], start[1] + path * direction[1]];
    // Past the map's rim there are no walls.
    path >= range * cells || (path > 0.0 && field.sample(met[0], met[1]).is_none())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fit(alignment: f64, short_beams: f64, long_beams: f64) -> ScanFit {
        ScanFit {
            alignment,
            residual: 0.05,
            short_beams,
            long_beams,
        }
    }

    #[test]
    fn beams_that_an_obstacle_blocks_do_not_count() {
        assert!((fit(0.45, 0.5, 0.0).clear_alignment() - 0.9).abs() < 1e-12);
        // A wrong pose: as many beams too short as too long.
        assert!((fit(0.45, 0.3, 0.3).clear_alignment() - 0.45).abs() < 1e-12);
    }

    #[test]
    fn the_alignment_of_a_few_free_beams_does_not_become_that_of_a_scan() {
        let nearly_all_blocked = fit(0.05, 0.95, 0.0);
        assert!((nearly_all_blocked.blocked() - 0.95).abs() < 1e-12);
        assert!((nearly_all_blocked.clear_alignment() - 0.25).abs() < 1e-12);
        assert!(fit(0.9, 0.9, 0.0).clear_alignment() <= 1.0);
    }
}
