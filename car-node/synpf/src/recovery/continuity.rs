//! Whether one scan goes on where the one before it left off: the direct evidence of being carried away.
//!
//! Walls that the map has wrong are wrong in every scan alike, so two scans that follow each other agree however old the map
//! is. A car that is picked up sees another place from one scan to the next. So each scan is compared with a scan of a
//! moment ago, moved by odometry, and no map is needed.
//!
//! On logs of the simulator the share of beams that agree is 0.99 and more; after a kidnap it is 0.2 in the
//! median, and above 0.9 only between places of one straight.

use maps::Pose;

use crate::preprocessed_scan::PreprocessedScan;

/// Follows the scans.
#[derive(Debug, Clone, Default)]
pub(crate) struct Continuity {
    /// End points of the scan compared with, in the frame of `base_link` then; empty before the first.
    reference: Vec<[f32; 2]>,
    /// The motion since by odometry, and by the estimate.
    moved: [Pose; 2],
    /// Time since \[s\].
    seconds: f64,
    /// Share of the beams that disagree, as is usual.
    usual: f64,
    /// Nearest and farthest end point of the reference in each direction.
    outline: Vec<[f32; 2]>,
}

/// How a scan goes on from the one before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Continued {
    /// It does, or there are too few beams to know.
    Yes,
    /// It does not.
    Broken {
        /// Log-likelihood ratio of having been carried to having driven.
        ratio: f64,
        /// It has been so for long enough: what comes after is compared with this scan.
        settled: bool,
    },
    /// Too much time or way lies between them.
    Unknown,
}

/// Directions in which the outline is kept: a degree each.
const DIRECTIONS: usize = 360;

/// An end point is compared with those so many directions to both sides: odometry errs in heading, and walls are slanted.
const NEIGHBOURS: usize = 2;

/// A range that differs by less than this agrees \[m\], and by this share of itself.
const TOLERANCE: [f32; 2] = [0.15, 0.02];

/// Points of a reference, and of a scan compared with it.
const POINTS: [usize; 2] = [180, 60];

/// With fewer beams to compare nothing is said.
const FEWEST: usize = 8;

/// Disagreement is never taken for less usual than this: two beams of sixty.
const LEAST_USUAL: f64 = 0.03;

/// Time over which the usual disagreement is learned \[s\].
const LEARNED_OVER: f64 = 2.0;

/// For so long \[s\] and so far \[m\] a scan is kept that those after it do not agree with: one bad scan is no break.
const KEPT: [f64; 2] = [0.4, 1.0];

/// Longer than this \[s\] and farther than this \[m\], the view is another one anyway.
const COMPARABLE: [f64; 2] = [0.6, 2.0];

impl Continuity {
    /// Takes in a scan, the motion since the scan before it by odometry and by the estimate, and the time between them.
    pub(crate) fn push(&mut self, scan: &PreprocessedScan, motions: [Pose; 2], seconds: f64) -> Continued {
        for (moved, motion) in self.moved.iter_mut().zip(motions) {
            *moved = *moved * motion;
        }
        self.seconds += seconds;
        let way = self.moved[0].x.hypot(self.moved[0].y);
        if self.reference.is_empty() || self.seconds > COMPARABLE[0] || way > COMPARABLE[1] {
            let first = self.reference.is_empty();
            self.renew(scan);
            return if first { Continued::Yes } else { Continued::Unknown };
        }
        let laser = scan.base_link_from_laser;
        let usual = self.usual.max(LEAST_USUAL);
        // Exponential about its mean for a car that drives, anything alike for one that was carried.
        let ratio_of = |differing: f64| differing / usual + usual.ln();
        let mut differing = None;
        for moved in self.moved {
            let share =
                agreement(&mut self.outline, &self.reference, moved, scan, laser).map(|share| 1.0 - share);
            differing = [differing, share].into_iter().flatten().reduce(f64::min);
            // One motion under which the scans agree is enough, and odometry's nearly always is one.
            if differing.is_some_and(|differing| ratio_of(differing) <= 0.0) {
                break;
            }
        }
        let Some(differing) = differing else {
            self.renew(scan);
            return Continued::Yes;
        };
        let ratio = ratio_of(differing);
        if ratio <= 0.0 {
            let gain = 1.0 - (-seconds / LEARNED_OVER).exp();
            self.usual += gain * (differing - self.usual);
            self.renew(scan);
            return Continued::Yes;
        }
        let gain = 1.0 - (-seconds / LEARNED_OVER).exp();
        self.usual += gain * (differing.min(4.0 * usual) - self.usual);
        let settled = self.seconds > KEPT[0] || way > KEPT[1];
        if settled {
            self.renew(scan);
        }
        Continued::Broken { ratio, settled }
    }

    /// Starts anew.
    pub(crate) fn clear(&mut self) {
        self.reference.clear();
    }

    /// Compares with this scan from now on.
    fn renew(&mut self, scan: &PreprocessedScan) {
        let stride = scan.points.len().div_ceil(POINTS[0]).max(1);
        self.reference.clear();
        self.reference.extend(scan.points.iter().step_by(stride));
        self.moved = [Pose::IDENTITY; 2];
        self.seconds = 0.0;
    }
}

/// Share of a scan's beams that end where the reference, seen from `moved`, has something; None with too few to compare.
fn agreement(
    outline: &mut Vec<[f32; 2]>,
    reference: &[[f32; 2]],
    moved: Pose,
    scan: &PreprocessedScan,
    laser: Pose,
) -> Option<f64> {
    const NOTHING: [f32; 2] = [f32::INFINITY, 0.0];
    outline.clear();
    outline.resize(DIRECTIONS, NOTHING);
    let then_from_laser = moved * laser;
    let (sin, cos) = (
        then_from_laser.heading.sin() as f32,
        then_from_laser.heading.cos() as f32,
    );
    let (x, y) = (then_from_laser.x as f32, then_from_laser.y as f32);
    for point in reference {
        let (dx, dy) = (point[0] - x, point[1] - y);
        let (direction, range) = polar(cos * dx + sin * dy, cos * dy - sin * dx);
        let [near, far] = &mut outline[direction];
        *near = near.min(range);
        *far = far.max(range);
    }
    let (sin, cos) = (laser.heading.sin() as f32, laser.heading.cos() as f32);
    let (x, y) = (laser.x as f32, laser.y as f32);
    let stride = scan.points.len().div_ceil(POINTS[1]).max(1);
    let (mut known, mut agree) = (0, 0);
    for point in scan.points.iter().step_by(stride) {
        let (dx, dy) = (point[0] - x, point[1] - y);
        let (direction, range) = polar(cos * dx + sin * dy, cos * dy - sin * dx);
        let [mut near, mut far] = NOTHING;
        for k in 0..=2 * NEIGHBOURS {
            let beside = outline[(direction + DIRECTIONS + k - NEIGHBOURS) % DIRECTIONS];
            near = near.min(beside[0]);
            far = far.max(beside[1]);
        }
        if far > 0.0 {
            let tolerance = TOLERANCE[0] + TOLERANCE[1] * range;
            known += 1;
            agree += usize::from(range > near - tolerance && range < far + tolerance);
        }
    }
    (known >= FEWEST).then(|| agree as f64 / known as f64)
}

/// The direction of a point, as an index, and its distance. The arc tangent is good to 0.3 deg, which is less than a
/// neighbouring direction.
#[inline]
fn polar(x: f32, y: f32) -> (usize, f32) {
    use std::f32::consts::{FRAC_PI_2, PI};
    let (ax, ay) = (x.abs(), y.abs());
    let ratio = ax.min(ay) / ax.max(ay).max(1e-9);
    let acute = ratio * (0.9724 - 0.1919 * ratio * ratio);
    let acute = if ay > ax { FRAC_PI_2 - acute } else { acute };
    let angle = if x < 0.0 { PI - acute } else { acute };
    let angle = if y < 0.0 { -angle } else { angle };
    let index = ((angle + PI) * (DIRECTIONS as f32 / (2.0 * PI))) as usize;
    (index.min(DIRECTIONS - 1), (ax * ax + ay * ay).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quality::tests::{room, scan};

    /// Drives at 4 m/s with scans at `rate`, carried by `by` after a second; for how many scans it is broken by more than that.
    fn broken(rate: f64, by: Pose, seen: impl Fn(&mut PreprocessedScan, usize)) -> usize {
        let map = room();
        let mut continuity = Continuity::default();
        let motion = Pose::new(4.0 / rate, 0.0, 0.0);
        let mut pose = Pose::new(3.5, 4.0, 0.2);
        let mut count = 0;
        for step in 0..(1.5 * rate) as usize {
            if step == rate as usize {
                pose = pose * by;
            }
            let mut scan = scan(&map, pose);
            seen(&mut scan, step);
            let continued = continuity.push(&scan, [motion; 2], 1.0 / rate);
            count += usize::from(matches!(continued, Continued::Broken { ratio, .. } if ratio > 5.0));
            pose = pose * motion;
        }
        count
    }

    #[test]
    fn a_car_that_drives_goes_on_and_one_that_is_carried_does_not() {
        let nothing = |_: &mut PreprocessedScan, _| ();
        for rate in [10.0, 20.0, 40.0] {
            assert_eq!(broken(rate, Pose::IDENTITY, nothing), 0, "{rate} Hz");
            let carried = broken(rate, Pose::new(-2.0, 0.5, 2.0), nothing);
            assert!(carried > 0, "{rate} Hz");
        }
    }

    #[test]
    fn what_stands_in_view_is_no_break() {
        let blocked = |scan: &mut PreprocessedScan, step: usize| {
            let count = scan.points.len();
            let from = (step * 3) % count;
            for k in 0..count / 8 {
                let point = &mut scan.points[(from + k) % count];
                *point = point.map(|v| 0.5 * v);
            }
        };
        assert_eq!(broken(40.0, Pose::IDENTITY, blocked), 0);
    }
}
