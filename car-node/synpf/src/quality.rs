//! How well a scan fits the map at a pose: what an engineer, and the health state, judge by.

use maps::Pose;

use crate::TrackMap;
use crate::beams::ReadyScan;

/// The fit of one scan at one pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Quality {
    /// Share of valid beams that end within 0.10 m of a wall.
    pub(crate) alignment: f64,
    /// Mean of min(distance to the nearest wall, 1 m) [m].
    pub(crate) residual: f64,
    /// Share of beams more than 0.3 m shorter than the map says.
    pub(crate) short: f64,
    /// Share of beams more than 0.3 m longer than the map says.
    pub(crate) long: f64,
}

/// Beams that are looked at.
const BEAMS: usize = 60;

/// Beams whose range is compared with the map's, which costs more.
const CAST: usize = 20;

/// Nearer than this to a wall an end point is on it [m].
const ALIGNED: f32 = 0.10;

/// A range this far from the map's is another thing [m].
const OTHER: f32 = 0.3;

impl Quality {
    /// Alignment of the beams that nothing in view has cut short. A wrong pose makes beams short and long alike, an
    /// opponent only makes them short: so it is those in excess of the long ones that do not count.
    pub(crate) fn clear_alignment(&self) -> f64 {
        let blocked = (self.short - self.long).clamp(0.0, 0.8);
        (self.alignment / (1.0 - blocked)).min(1.0)
    }

    /// Judges a scan at a pose in the grid's frame.
    pub(crate) fn new(map: &TrackMap, scan: &ReadyScan, pose: Pose, base_link_from_laser: Pose) -> Self {
        let field = map.field();
        let cells = 1.0 / field.resolution() as f32;
        let stride = scan.points.len().div_ceil(BEAMS).max(1);
        let (sin, cos) = pose.heading.sin_cos();
        let (sin, cos) = (sin as f32, cos as f32);
        let (x, y) = (pose.x as f32, pose.y as f32);
        let laser = pose * base_link_from_laser;
        let (lx, ly) = (laser.x as f32, laser.y as f32);
        let (mut count, mut aligned, mut residual) = (0.0f32, 0.0f32, 0.0f32);
        let (mut cast, mut short, mut long) = (0.0f32, 0.0f32, 0.0f32);
        for (k, point) in scan.points.iter().step_by(stride).enumerate() {
            let (px, py) = (
                x + cos * point[0] - sin * point[1],
                y + sin * point[0] + cos * point[1],
            );
            let distance = field
                .from_wall(px * cells, py * cells)
                .map_or(1.0, |d| d.min(1.0));
            count += 1.0;
            residual += distance;
            if distance < ALIGNED {
                aligned += 1.0;
            }
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
        Self {
            alignment: share(aligned, count),
            residual: share(residual, count),
            short: share(short, cast),
            long: share(long, cast),
        }
    }
}
