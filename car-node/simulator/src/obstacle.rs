//! Cars as rectangles: what the laser of another car sees, and what cars collide with.

use maps::Pose;

use crate::{Hit, Surface, Vehicle};

/// A car as a rectangle in `map`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Obstacle {
    /// The middle of the rectangle.
    pub map_from_centre: Pose,
    /// Half its length and half its width \[m\].
    pub half: [f64; 2],
}

impl Obstacle {
    /// The outline of a vehicle where it is.
    pub(crate) fn of(vehicle: &Vehicle) -> Self {
        let p = vehicle.params();
        let centre = p.body[0] / 2.0 - p.rear_overhang;
        Self {
            map_from_centre: vehicle.pose() * Pose::new(centre, 0.0, 0.0),
            half: [p.body[0] / 2.0, p.body[1] / 2.0],
        }
    }

    /// Where a ray meets the rectangle from outside.
    pub(crate) fn cast(&self, origin: [f64; 2], direction: [f64; 2]) -> Option<Hit> {
        let Pose { x, y, heading } = self.map_from_centre;
        let to = [x - origin[0], y - origin[1]];
        let miss = direction[0] * to[1] - direction[1] * to[0];
        let radius = self.half[0].hypot(self.half[1]);
        if miss.abs() > radius || direction[0] * to[0] + direction[1] * to[1] < -radius {
            return None;
        }
        // The slab test, in the frame of the rectangle.
        let (sin, cos) = heading.sin_cos();
        let turn = |v: [f64; 2]| [cos * v[0] + sin * v[1], cos * v[1] - sin * v[0]];
        let (start, along) = (turn(to.map(|v| -v)), turn(direction));
        let (mut enter, mut leave, mut incidence) = (f64::NEG_INFINITY, f64::INFINITY, 1.0);
        for axis in 0..2 {
            let near = (-self.half[axis].copysign(along[axis]) - start[axis]) / along[axis];
            let far = (self.half[axis].copysign(along[axis]) - start[axis]) / along[axis];
            if near > enter {
                (enter, incidence) = (near, along[axis].abs());
            }
            leave = leave.min(far);
        }
        (enter >= 0.0 && enter <= leave).then_some(Hit {
            range: enter,
            incidence,
            surface: Surface::Plain,
        })
    }
}

/// How two rectangles overlap, by the separating axis theorem: the unit vector along which the second must move to
/// part from the first, and how far \[m\]. None where they do not overlap.
pub(crate) fn overlap(boxes: &[Obstacle; 2]) -> Option<([f64; 2], f64)> {
    let [a, b] = boxes.map(|o| o.map_from_centre);
    let between = [b.x - a.x, b.y - a.y];
    let mut best: Option<([f64; 2], f64)> = None;
    for turn in [0.0, std::f64::consts::FRAC_PI_2] {
        for heading in [a.heading, b.heading] {
            let (sin, cos) = (heading + turn).sin_cos();
            let reach: f64 = boxes
                .iter()
                .map(|o| {
                    let (s, c) = (o.map_from_centre.heading - heading - turn).sin_cos();
                    o.half[0] * c.abs() + o.half[1] * s.abs()
                })
                .sum();
            let apart = between[0] * cos + between[1] * sin;
            let depth = reach - apart.abs();
            if depth <= 0.0 {
                return None;
            }
            if best.is_none_or(|(_, least)| depth < least) {
                let side = if apart < 0.0 { -1.0 } else { 1.0 };
                best = Some(([side * cos, side * sin], depth));
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn overlap_gives_direction_and_depth() {
        let at = |x: f64, heading: f64| Obstacle {
            map_from_centre: Pose::new(x, 0.0, heading),
            half: [0.25, 0.14],
        };
        assert!(overlap(&[at(0.0, 0.0), at(0.51, 0.0)]).is_none());
        let (away, depth) = overlap(&[at(0.0, 0.0), at(0.49, 0.0)]).expect("by a centimetre");
        assert!((depth - 0.01).abs() < 1e-9 && (away[0] - 1.0).abs() < 1e-9);
        assert!(overlap(&[at(0.0, 0.0), at(0.38, std::f64::consts::FRAC_PI_2)]).is_some());
        assert!(overlap(&[at(0.0, 0.0), at(0.40, std::f64::consts::FRAC_PI_2)]).is_none());
    }
}
