//! The raceline of minimum curvature between walls.

use maps::{Raceline, RacelineFault};

use super::ring::Ring;
use super::spline::{normals, resample};
use crate::Walls;

/// Distance between the points that are optimised \[m\].
const SPACING: f64 = 0.25;
/// Distance between the points of the finished line \[m\].
const FINE: f64 = 0.1;
/// Rounds of optimising and resampling. More rounds change millimetres.
const ROUNDS: usize = 6;
/// Walls further away than this are ignored \[m\].
const REACH: f64 = 5.0;

/// Why no raceline was found.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum LineError {
    /// The walls leave less room than the margins need.
    #[error(
        "at ({x:.2}, {y:.2}) m only {room:.2} m lie between the walls, and the margins need {needed:.2} m"
    )]
    TooNarrow {
        /// Where \[m\].
        x: f64,
        /// Where \[m\].
        y: f64,
        /// Width there \[m\].
        room: f64,
        /// Twice the margin \[m\].
        needed: f64,
    },
    /// The points make no closed line.
    #[error(transparent)]
    Line(#[from] RacelineFault),
}

/// The closed line of least squared curvature that keeps `margin` \[m\] from all walls, found from a line between them. Its
/// speed is 1 m/s.
///
/// Heilmeier et al., *Minimum curvature trajectory planning and control for an autonomous race car*, 2019: each point
/// moves along its normal, curvature is linear in the moves, and the quadratic programme with bounds is solved again
/// around its result. It is solved by projected Newton steps (Bertsekas, 1982).
pub fn minimum_curvature(start: &[[f64; 2]], walls: &Walls, margin: f64) -> Result<Raceline, LineError> {
    let mut points = resample(start, SPACING);
    for _ in 0..ROUNDS {
        let normals = normals(&points);
        let bounds = room(&points, &normals, walls, margin)?;
        let moves = solve(&points, &normals, &bounds);
        for (i, point) in points.iter_mut().enumerate() {
            *point = [0, 1].map(|axis| point[axis] + moves[i] * normals[i][axis]);
        }
        points = resample(&points, SPACING);
    }
    let curve = super::spline::closed_curve(&points, FINE);
    Ok(Raceline::through(&curve, 1.0)?)
}

/// How far each point may move along its normal: to the right (negative) and to the left \[m\].
fn room(
    points: &[[f64; 2]],
    normals: &[[f64; 2]],
    walls: &Walls,
    margin: f64,
) -> Result<Vec<[f64; 2]>, LineError> {
    let n = points.len();
    let reach = |i: usize, side: f64| {
        let direction = normals[i].map(|v| v * side);
        walls
            .cast(points[i], direction, REACH)
            .map_or(REACH, |hit| hit.range)
    };
    let raw: Vec<[f64; 2]> = (0..n).map(|i| [reach(i, -1.0), reach(i, 1.0)]).collect();
    (0..n)
        .map(|i| {
            // Posts between two points count, too.
            let nearby = [n - 2, n - 1, 0, 1, 2].map(|k| raw[(i + k) % n]);
            let least = |side: usize| nearby.iter().map(|room| room[side]).fold(REACH, f64::min);
            let [right, left] = [least(0), least(1)];
            if right + left < 2.0 * margin {
                return Err(LineError::TooNarrow {
                    x: points[i][0],
                    y: points[i][1],
                    room: right + left,
                    needed: 2.0 * margin,
                });
            }
            // A line that is too close already has to move away.
            Ok([
                (margin - right).min(left - margin),
                (left - margin).max(margin - right),
            ])
        })
        .collect()
}

/// The moves that minimise the sum of squared curvatures.
fn solve(points: &[[f64; 2]], normals: &[[f64; 2]], bounds: &[[f64; 2]]) -> Vec<f64> {
    let n = points.len();
    let dot = |a: [f64; 2], b: [f64; 2]| a[0] * b[0] + a[1] * b[1];
    // Curvature at i is the second difference of the points along the normal there: constant + row * moves.
    let mut hessian = Ring::diagonal(n, 1e-6);
    let mut linear = vec![0.0; n];
    for i in 0..n {
        let (before, after) = ((i + n - 1) % n, (i + 1) % n);
        let stencil = [(before, 1.0), (i, -2.0), (after, 1.0)];
        let constant: f64 = stencil.iter().map(|&(k, w)| w * dot(points[k], normals[i])).sum();
        let row = stencil.map(|(k, w)| (k, w * dot(normals[k], normals[i])));
        for (k, w) in row {
            linear[k] += w * constant;
        }
        hessian.add_square(before, row.map(|(_, w)| w));
    }
    let clamped = |moves: &[f64]| -> Vec<f64> {
        let pairs = moves.iter().zip(bounds);
        pairs.map(|(v, [least, most])| v.clamp(*least, *most)).collect()
    };
    let sum = |a: &[f64], b: &[f64]| -> f64 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
    let cost = |moves: &[f64]| 0.5 * sum(moves, &hessian.times(moves)) + sum(&linear, moves);
    let mut moves = clamped(&vec![0.0; n]);
    for _ in 0..30 {
        let gradient: Vec<f64> = hessian
            .times(&moves)
            .iter()
            .zip(&linear)
            .map(|(a, b)| a + b)
            .collect();
        // Points at a bound that the gradient pushes against stay. All others take a Newton step.
        let held: Vec<bool> = (0..n)
            .map(|i| {
                moves[i] <= bounds[i][0] && gradient[i] > 0.0 || moves[i] >= bounds[i][1] && gradient[i] < 0.0
            })
            .collect();
        let Some(back) = hessian.solve(&gradient, &held) else {
            break;
        };
        let before = cost(&moves);
        let mut length = 1.0;
        let improved = loop {
            let next: Vec<f64> = moves
                .iter()
                .zip(&back)
                .map(|(v, step)| v - length * step)
                .collect();
            let next = clamped(&next);
            let gain = before - cost(&next);
            if gain > 0.0 {
                moves = next;
                break gain > 1e-9 * before.abs();
            }
            length /= 2.0;
            if length < 1e-4 {
                break false;
            }
        };
        if !improved {
            break;
        }
    }
    moves
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Surface, Wall};

    /// A rectangular corridor of 2 m around a block of 8 m x 2 m.
    fn corridor() -> (Walls, Vec<[f64; 2]>) {
        let rectangle = |x: f64, y: f64| vec![[-x, -y], [x, -y], [x, y], [-x, y], [-x, -y]];
        let wall = |points| Wall {
            surface: Surface::Plain,
            points,
        };
        let walls = Walls::new(vec![wall(rectangle(4.0, 1.0)), wall(rectangle(6.0, 3.0))]);
        (walls, rectangle(5.0, 2.0)[..4].to_vec())
    }

    #[test]
    fn cuts_corners_and_keeps_its_distance() {
        let (walls, centre) = corridor();
        let line = minimum_curvature(&centre, &walls, 0.4).expect("room enough");
        let sharpest = line
            .points()
            .iter()
            .map(|p| p.curvature.abs())
            .fold(0.0, f64::max);
        // The roundest end that fits between the walls is a half circle of 2.6 m. The line comes close to it.
        assert!(sharpest < 0.75, "{sharpest}");
        for p in line.points() {
            for i in 0..36 {
                let (sin, cos) = (f64::from(i) * 0.1745).sin_cos();
                assert!(walls.cast([p.x, p.y], [cos, sin], 0.33).is_none(), "{p:?}");
            }
        }
    }

    #[test]
    fn says_where_it_is_too_narrow() {
        let (walls, centre) = corridor();
        let error = minimum_curvature(&centre, &walls, 1.2).expect_err("2 m are not 2.4 m");
        assert!(error.to_string().contains("need 2.40 m"), "{error}");
    }
}
