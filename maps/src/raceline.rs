//! Racelines: the path that the car should follow, with its speeds.

use crate::polyline::PolylineTree;
use crate::wrap_angle;

/// One point of a raceline.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RacelinePoint {
    /// Arc length from the start line \[m\].
    pub s: f64,
    /// Position in `map` \[m\].
    pub x: f64,
    /// Position in `map` \[m\].
    pub y: f64,
    /// Direction of travel, 0 along x, in `[-pi, pi)` \[rad\].
    pub heading: f64,
    /// Curvature, left positive \[1/m\].
    pub curvature: f64,
    /// Speed to drive \[m/s\].
    pub speed: f64,
}

/// Position of a point relative to a raceline.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackPosition {
    /// Arc length of the nearest point of the line, in `[0, length)` \[m\].
    pub s: f64,
    /// Signed distance from the line, left positive \[m\].
    pub d: f64,
    /// The line's heading there \[rad\].
    pub heading: f64,
}

/// Why points make no raceline; `index` counts from 0.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum RacelineFault {
    /// Fewer than three points.
    #[error("{0} points where a closed line needs at least 3")]
    TooFew(usize),
    /// A NaN or an infinity.
    #[error("point {index} has a value that is not finite")]
    NotFinite {
        /// Which point.
        index: usize,
    },
    /// Arc length must grow from point to point.
    #[error("point {index}: s = {s} m is not greater than {previous} m before it")]
    Unordered {
        /// Which point.
        index: usize,
        /// Its arc length \[m\].
        s: f64,
        /// That of the point before \[m\].
        previous: f64,
    },
    /// A speed is negative.
    #[error("point {index}: speed {speed} m/s is negative")]
    NegativeSpeed {
        /// Which point.
        index: usize,
        /// Its speed \[m/s\].
        speed: f64,
    },
}

impl RacelineFault {
    /// The point at fault, if it is a single one.
    pub fn index(&self) -> Option<usize> {
        match *self {
            Self::TooFew(_) => None,
            Self::NotFinite { index } | Self::Unordered { index, .. } | Self::NegativeSpeed { index, .. } => {
                Some(index)
            }
        }
    }
}

/// A closed raceline.
///
/// ```
/// use maps::Raceline;
/// let square = Raceline::through(&[[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]], 2.0)?;
/// let position = square.project([1.0, 0.5]);
/// assert_eq!((position.s, position.d), (1.0, 0.5));
/// assert_eq!(square.length(), 16.0);
/// # Ok::<(), maps::RacelineFault>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Raceline {
    /// At least three points, `s` strictly increasing from 0.
    points: Vec<RacelinePoint>,
    /// Length of a lap, the closing segment included \[m\].
    length: f64,
    vertices: Vec<[f64; 2]>,
    tree: PolylineTree,
}

impl Raceline {
    /// A closed line through `points`, in order of travel. The first point's `s` becomes 0. A last point that
    /// repeats the first closes the line and is dropped.
    pub fn new(mut points: Vec<RacelinePoint>) -> Result<Self, RacelineFault> {
        check(&points)?;
        let start = points[0].s;
        for point in &mut points {
            point.s -= start;
            point.heading = wrap_angle(point.heading);
        }
        let gap = |a: &RacelinePoint, b: &RacelinePoint| (a.x - b.x).hypot(a.y - b.y);
        let (first, last) = (points[0], points[points.len() - 1]);
        let spacing = last.s / (points.len() - 1) as f64;
        let length = if gap(&first, &last) < 0.05 * spacing {
            points.pop();
            last.s
        } else {
            last.s + gap(&first, &last)
        };
        if points.len() < 3 {
            return Err(RacelineFault::TooFew(points.len()));
        }
        let vertices: Vec<_> = points.iter().map(|p| [p.x, p.y]).collect();
        Ok(Self {
            tree: PolylineTree::new(&vertices),
            points,
            length,
            vertices,
        })
    }

    /// A closed line through positions of `map` \[m\] in order of travel, driven at one `speed` \[m/s\]. Arc length,
    /// headings and curvatures come from the positions.
    pub fn through(positions: &[[f64; 2]], speed: f64) -> Result<Self, RacelineFault> {
        let geometry = Geometry::of(positions);
        let points = positions.iter().enumerate().map(|(i, &[x, y])| RacelinePoint {
            s: geometry.s[i],
            x,
            y,
            heading: geometry.heading[i],
            curvature: geometry.curvature[i],
            speed,
        });
        Self::new(points.collect())
    }

    /// The points, in order of travel.
    pub fn points(&self) -> &[RacelinePoint] {
        &self.points
    }

    /// Length of a lap \[m\].
    pub fn length(&self) -> f64 {
        self.length
    }

    /// The position of `point` of `map` \[m\] relative to the line: exact at any distance, in about 0.2 us.
    pub fn project(&self, point: [f64; 2]) -> TrackPosition {
        let nearest = self.tree.nearest(&self.vertices, point);
        let (from, to, span) = self.segment(nearest.segment);
        let [dx, dy] = [to.x - from.x, to.y - from.y];
        let left = dx * (point[1] - from.y) - dy * (point[0] - from.x);
        TrackPosition {
            s: self.wrap(from.s + nearest.fraction * span),
            d: nearest.distance_squared.sqrt().copysign(left),
            heading: wrap_angle(from.heading + nearest.fraction * wrap_angle(to.heading - from.heading)),
        }
    }

    /// The line at arc length `s` \[m\], interpolated between the points. `s` may lie outside a lap.
    pub fn at(&self, s: f64) -> RacelinePoint {
        let s = self.wrap(s);
        let index = self.points.partition_point(|p| p.s <= s).max(1) - 1;
        let (from, to, span) = self.segment(index);
        let t = (s - from.s) / span;
        let mix = |a: f64, b: f64| a + t * (b - a);
        RacelinePoint {
            s,
            x: mix(from.x, to.x),
            y: mix(from.y, to.y),
            heading: wrap_angle(from.heading + t * wrap_angle(to.heading - from.heading)),
            curvature: mix(from.curvature, to.curvature),
            speed: mix(from.speed, to.speed),
        }
    }

    /// The same arc length within a lap, in `[0, length)` \[m\].
    pub fn wrap(&self, s: f64) -> f64 {
        let wrapped = s.rem_euclid(self.length);
        // A tiny negative `s` rounds up to the length itself.
        if wrapped < self.length { wrapped } else { 0.0 }
    }

    /// The shorter way along the line from arc length `from` to `to`, in `[-length / 2, length / 2)` \[m\].
    pub fn advance(&self, from: f64, to: f64) -> f64 {
        let half = self.length / 2.0;
        self.wrap(to - from + half) - half
    }

    /// The ends of a segment and the arc length between them \[m\].
    fn segment(&self, index: usize) -> (&RacelinePoint, &RacelinePoint, f64) {
        let from = &self.points[index];
        match self.points.get(index + 1) {
            Some(to) => (from, to, to.s - from.s),
            None => (from, &self.points[0], self.length - from.s),
        }
    }
}

fn check(points: &[RacelinePoint]) -> Result<(), RacelineFault> {
    if points.len() < 3 {
        return Err(RacelineFault::TooFew(points.len()));
    }
    for (index, p) in points.iter().enumerate() {
        let values = [p.s, p.x, p.y, p.heading, p.curvature, p.speed];
        if !values.iter().all(|v| v.is_finite()) {
            return Err(RacelineFault::NotFinite { index });
        }
        if p.speed < 0.0 {
            return Err(RacelineFault::NegativeSpeed {
                index,
                speed: p.speed,
            });
        }
    }
    for (index, pair) in points.windows(2).enumerate() {
        let [previous, s] = [pair[0].s, pair[1].s];
        if s <= previous {
            return Err(RacelineFault::Unordered {
                index: index + 1,
                s,
                previous,
            });
        }
    }
    Ok(())
}

/// Arc length, heading and curvature of a closed line, computed from its positions.
pub(crate) struct Geometry {
    /// Length of the polyline up to here \[m\].
    pub(crate) s: Vec<f64>,
    /// Direction of the circle through the neighbours, here \[rad\].
    pub(crate) heading: Vec<f64>,
    /// Curvature of that circle, left positive \[1/m\].
    pub(crate) curvature: Vec<f64>,
}

impl Geometry {
    pub(crate) fn of(positions: &[[f64; 2]]) -> Self {
        let n = positions.len();
        let mut geometry = Self {
            s: Vec::with_capacity(n),
            heading: Vec::with_capacity(n),
            curvature: Vec::with_capacity(n),
        };
        let mut s = 0.0;
        for (i, &here) in positions.iter().enumerate() {
            let (before, after) = (positions[(i + n - 1) % n], positions[(i + 1) % n]);
            let incoming = [here[0] - before[0], here[1] - before[1]];
            let outgoing = [after[0] - here[0], after[1] - here[1]];
            let (a, b) = (incoming[0].hypot(incoming[1]), outgoing[0].hypot(outgoing[1]));
            let direction = incoming[1].atan2(incoming[0]);
            let turn = wrap_angle(outgoing[1].atan2(outgoing[0]) - direction);
            // The tangent of a circle splits the turn in the ratio of the chords.
            let share = if a + b > 0.0 { a / (a + b) } else { 0.5 };
            let chord = (after[0] - before[0]).hypot(after[1] - before[1]);
            geometry.s.push(s);
            geometry.heading.push(wrap_angle(direction + turn * share));
            // The circumscribed circle's diameter is the chord over the sine of the opposite angle.
            geometry.curvature.push(if chord > 0.0 {
                2.0 * turn.sin() / chord
            } else {
                0.0
            });
            s += b;
        }
        geometry
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::{FRAC_PI_2, TAU};

    /// A circle about the origin, driven counter-clockwise from (radius, 0).
    fn circle(radius: f64, points: usize) -> Raceline {
        let positions: Vec<_> = (0..points)
            .map(|i| TAU * i as f64 / points as f64)
            .map(|angle| [radius * angle.cos(), radius * angle.sin()])
            .collect();
        Raceline::through(&positions, 3.0).expect("a valid line")
    }

    #[test]
    fn a_circle_has_its_curvature_and_heading() {
        let line = circle(2.0, 400);
        assert!((line.length() - 2.0 * TAU).abs() < 1e-3);
        for point in line.points() {
            assert!((point.curvature - 0.5).abs() < 1e-9);
            let tangent = point.y.atan2(point.x) + FRAC_PI_2;
            assert!(wrap_angle(point.heading - tangent).abs() < 1e-9);
        }
    }

    #[test]
    fn left_of_the_line_is_positive() {
        let line = circle(2.0, 400);
        assert!((line.project([1.5, 0.0]).d - 0.5).abs() < 1e-3);
        assert!((line.project([2.5, 0.0]).d + 0.5).abs() < 1e-3);
    }

    #[test]
    fn arc_length_is_continuous_at_the_start() {
        let line = circle(2.0, 400);
        for s in [-0.01, 0.0, 0.01, line.length() - 0.01] {
            let point = line.at(s);
            assert!(line.advance(s, line.project([point.x, point.y]).s).abs() < 1e-9);
        }
        assert!((line.advance(line.length() - 0.1, 0.2) - 0.3).abs() < 1e-9);
        assert!((line.at(-1e-18).s - 0.0).abs() < 1e-12);
    }

    #[test]
    fn a_repeated_first_point_closes_the_line() {
        let mut points = circle(2.0, 100).points().to_vec();
        points.push(RacelinePoint {
            s: 2.0 * TAU,
            ..points[0]
        });
        let line = Raceline::new(points).expect("a valid line");
        assert_eq!(line.points().len(), 100);
        assert!((line.length() - 2.0 * TAU).abs() < 1e-12);
    }

    #[test]
    fn faults_name_the_point() {
        let points = circle(2.0, 10).points().to_vec();
        let with = |change: fn(&mut Vec<RacelinePoint>)| {
            let mut points = points.clone();
            change(&mut points);
            Raceline::new(points).expect_err("a fault").to_string()
        };
        assert!(with(|p| p.truncate(2)).contains("2 points"));
        assert!(with(|p| p[4].x = f64::NAN).contains("point 4"));
        assert!(with(|p| p[5].s = p[4].s).contains("point 5"));
        assert!(with(|p| p[6].speed = -1.0).contains("point 6"));
    }

    proptest! {
        #[test]
        fn a_point_beside_the_line_projects_back(s in 0.0..12.5, d in -1.0..1.0_f64) {
            let line = circle(2.0, 2000);
            let at = line.at(s);
            let (sin, cos) = at.heading.sin_cos();
            let position = line.project([at.x - d * sin, at.y + d * cos]);
            // Seen from 1 m away, a corner of the polyline (3.1 mrad) hides 3.1 mm of the line.
            prop_assert!(line.advance(at.s, position.s).abs() < 3.2e-3);
            prop_assert!((position.d - d).abs() < 1e-3);
            prop_assert!(wrap_angle(position.heading - at.heading).abs() < 3.2e-3);
        }
    }
}
