//! How a scan speaks for a pose, knowing that beams can be blocked and that walls can have changed.
//!
//! A beam that ends on a wall of the map speaks for the pose. One that ends elsewhere is explained in another way: something
//! stands in view, or the wall has changed. Neither is rare, and both come in pieces as large as a car or a wall, which every
//! beam and every scan sees again. So what counts between two poses is not the sum over beams and scans, but how many
//! different pieces of wall the one explains and the other does not.

use maps::Pose;

use crate::preprocessed_scan::PreprocessedScan;
use crate::scan_matcher::fit_by;
use crate::track_map::TrackMap;

/// Neighbouring beams err together: a score counts this many as independent.
pub(crate) const INDEPENDENT: f64 = 20.0;

/// Beams that the score looks at.
const SCORED: usize = 60;

/// Beams that are sorted into pieces.
const SORTED: usize = 120;

/// Edge of a piece of wall \[m\].
const PIECE: f32 = 0.5;

/// Weight of a beam that says nothing.
const NEUTRAL: f32 = 0.5;

/// A range that differs by more than this from the map's is another thing \[m\].
const OTHER: f32 = 0.3;

/// What a beam says of a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Explained {
    /// It ends on this piece of a wall.
    Wall(u32),
    /// It ends in front of the wall: something may stand in view.
    Blocked,
    /// It passes through a wall, or ends beside it.
    Not,
    /// It ends where nothing was mapped, or not clearly on a wall nor off it.
    Unclear,
}

/// Sorts the beams of a scan at a pose in the grid's frame. `reach` is how far from a wall an end point may lie \[m\].
pub(crate) fn explain(
    map: &TrackMap,
    scan: &PreprocessedScan,
    pose: Pose,
    reach: f32,
    out: &mut Vec<Explained>,
) {
    out.clear();
    let field = map.field();
    let cells = 1.0 / field.resolution() as f32;
    let stride = scan.points.len().div_ceil(SORTED).max(1);
    let (sin, cos) = (pose.heading.sin() as f32, pose.heading.cos() as f32);
    let (x, y) = (pose.x as f32, pose.y as f32);
    let laser = pose * scan.base_link_from_laser;
    let laser = [laser.x as f32, laser.y as f32];
    out.extend(scan.points.iter().step_by(stride).map(|point| {
        let end = [
            x + cos * point[0] - sin * point[1],
            y + sin * point[0] + cos * point[1],
        ];
        let off = field
            .from_wall(end[0] * cells, end[1] * cells)
            .unwrap_or(f32::INFINITY);
        if off < reach {
            return Explained::Wall(piece(end));
        }
        if off < 2.0 * reach || map.unmapped(laser, end) {
            return Explained::Unclear;
        }
        let (dx, dy) = (end[0] - laser[0], end[1] - laser[1]);
        let range = dx.hypot(dy).max(1e-3);
        let far = (range + 2.0 * OTHER) * cells;
        let free = field.trace(laser.map(|v| v * cells), [dx / range, dy / range], far) / cells;
        if range < free - OTHER {
            Explained::Blocked
        } else {
            Explained::Not
        }
    }));
}

/// The piece of wall at a point of the grid \[m\].
fn piece(at: [f32; 2]) -> u32 {
    let [u, v] = at.map(|v| ((v / PIECE) as i32).clamp(0, 0xffff) as u32);
    u << 16 | v
}

/// Pieces of wall that speak for one of two poses, each counted once.
#[derive(Debug, Clone, Default)]
pub(crate) struct Pieces(Vec<Seen>);

/// A piece of wall that was seen.
#[derive(Debug, Clone, Copy)]
struct Seen {
    piece: u32,
    /// Beams that ended on it: one alone may be noise.
    beams: u32,
    /// How much it counts, at most 1.
    weight: f32,
    /// How far the car had driven when it was last seen \[m\].
    at: f32,
}

/// So many beams show a piece of wall.
const SHOWN: u32 = 2;

impl Pieces {
    /// A beam ended on this piece after so much driving.
    pub(crate) fn add(&mut self, piece: u32, weight: f32, at: f32) {
        match self.0.iter_mut().find(|seen| seen.piece == piece) {
            Some(seen) => {
                seen.beams += 1;
                seen.weight = seen.weight.max(weight);
                seen.at = at;
            }
            None => self.0.push(Seen {
                piece,
                beams: 1,
                weight,
                at,
            }),
        }
    }

    /// Forgets what was last seen before the car had driven so far.
    pub(crate) fn forget_before(&mut self, at: f32) {
        self.0.retain(|seen| seen.at >= at);
    }

    /// How many there are.
    pub(crate) fn count(&self) -> f64 {
        let shown = self.0.iter().filter(|seen| seen.beams >= SHOWN);
        shown.map(|seen| f64::from(seen.weight)).sum()
    }
}

/// How well a scan's end points lie on walls at a pose, in [0, 1]: what scores are made of. A beam that ends where nothing
/// was mapped speaks neither for the pose nor against it.
pub(crate) fn fit_of(map: &TrackMap, scan: &PreprocessedScan, pose: Pose) -> f64 {
    let laser = pose * scan.base_link_from_laser;
    let laser = [laser.x as f32, laser.y as f32];
    fit_by(map.field(), &scan.points, SCORED, pose, 0.08, |weight, end| {
        if weight < NEUTRAL && map.unmapped(laser, end) {
            NEUTRAL
        } else {
            weight
        }
    })
}

/// Log-likelihood of a scan at a pose: the robust fit of its end points.
pub(crate) fn score(map: &TrackMap, scan: &PreprocessedScan, pose: Pose) -> f64 {
    let on_track = map.field().nearest(
        (pose.x / map.grid().resolution) as f32,
        (pose.y / map.grid().resolution) as f32,
    );
    if on_track.is_none_or(|distance| distance <= 0.0) {
        return INDEPENDENT * 0.02f64.ln();
    }
    INDEPENDENT * fit_of(map, scan, pose).max(0.02).ln()
}
