//! The non-linear scan matcher: least squares between the end points and the grid (Hess et al., ICRA 2016, equation CS).

use maps::Pose;
use nalgebra::{Matrix2, Matrix3, SymmetricEigen, Vector2, Vector3};

use crate::probability_grid::ProbabilityGrid;
use crate::scan_points::transformed;

/// Weights of the matcher.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MatchWeights {
    pub(crate) occupied_space: f64,
    /// [1/m].
    pub(crate) translation: f64,
    /// [1/rad].
    pub(crate) rotation: f64,
    pub(crate) max_num_iterations: usize,
}

/// The sums of the least-squares problem at one pose.
struct Normal {
    cost: f64,
    information: Matrix3<f64>,
    gradient: Vector3<f64>,
}

/// The problem: a scan, the grid that it is held against, and the pose that it is held to.
struct Problem<'a> {
    grid: &'a ProbabilityGrid,
    points: &'a [[f32; 2]],
    /// Position of the prediction, and heading where the search begins.
    target: Pose,
    weights: MatchWeights,
}

impl Problem<'_> {
    fn at(&self, pose: Pose) -> Normal {
        let (sin, cos) = pose.heading.sin_cos();
        let weight = self.weights.occupied_space.powi(2) / self.points.len().max(1) as f64;
        let (mut cost, mut information, mut gradient) = (0.0, Matrix3::zeros(), Vector3::zeros());
        for &point in self.points {
            let end = transformed([sin, cos], pose, point);
            let sample = self.grid.sample(end);
            let residual = 1.0 - sample.probability;
            let [gx, gy] = sample.gradient;
            let row = Vector3::new(-gx, -gy, gx * (end[1] - pose.y) - gy * (end[0] - pose.x));
            cost += residual * residual;
            information += row * row.transpose();
            gradient += row * residual;
        }
        (cost, information, gradient) = (cost * weight, information * weight, gradient * weight);
        let off = Vector3::new(
            pose.x - self.target.x,
            pose.y - self.target.y,
            maps::wrap_angle(pose.heading - self.target.heading),
        );
        let (translation, rotation) = (self.weights.translation.powi(2), self.weights.rotation.powi(2));
        for (k, weight) in [translation, translation, rotation].into_iter().enumerate() {
            cost += weight * off[k] * off[k];
            information[(k, k)] += weight;
            gradient[k] += weight * off[k];
        }
        Normal {
            cost,
            information,
            gradient,
        }
    }
}

/// A step that changes the cost by a smaller share than this ends the search.
const SETTLED: f64 = 1e-6;

/// Fits the points to the grid from `start`, held to the position of `prediction` and the heading of `start`
/// (Levenberg-Marquardt).
pub(crate) fn nonlinear_match(
    grid: &ProbabilityGrid,
    points: &[[f32; 2]],
    prediction: Pose,
    start: Pose,
    weights: MatchWeights,
) -> Pose {
    let problem = Problem {
        grid,
        points,
        target: Pose::new(prediction.x, prediction.y, start.heading),
        weights,
    };
    let (mut pose, mut damping) = (start, 1e-4);
    let mut normal = problem.at(pose);
    for _ in 0..weights.max_num_iterations {
        let diagonal = normal.information.diagonal().map(|v| damping * v.max(1e-9));
        let damped = normal.information + Matrix3::from_diagonal(&diagonal);
        let Some(root) = damped.cholesky() else { break };
        let step = root.solve(&normal.gradient);
        let next = Pose::new(pose.x - step[0], pose.y - step[1], pose.heading - step[2]);
        let at_next = problem.at(next);
        if at_next.cost < normal.cost {
            let settled = normal.cost - at_next.cost < SETTLED * normal.cost;
            (pose, normal) = (next, at_next);
            damping = (damping / 3.0).max(1e-9);
            if settled {
                break;
            }
        } else {
            damping *= 4.0;
            if damping > 1e8 || step.norm() < 1e-8 {
                break;
            }
        }
    }
    pose
}

/// By how much each direction of the map counts in a match: the square root of the information that the end points have of it,
/// as a share of that of the best known direction. Along a straight without features that is close to nothing.
pub(crate) fn shape_of_information(grid: &ProbabilityGrid, points: &[[f32; 2]], pose: Pose) -> Matrix2<f64> {
    let (sin, cos) = pose.heading.sin_cos();
    let mut information = Matrix2::zeros();
    for &point in points {
        let gradient = Vector2::from(grid.sample(transformed([sin, cos], pose, point)).gradient);
        information += gradient * gradient.transpose();
    }
    let eigen = SymmetricEigen::new(information);
    let most = eigen.eigenvalues.max();
    if most.is_nan() || most <= 0.0 {
        return Matrix2::identity();
    }
    let share = eigen.eigenvalues.map(|value| (value.max(0.0) / most).sqrt());
    eigen.eigenvectors * Matrix2::from_diagonal(&share) * eigen.eigenvectors.transpose()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_room::{room_grid, room_scan};

    const WEIGHTS: MatchWeights = MatchWeights {
        occupied_space: 20.0,
        translation: 1.0,
        rotation: 1.0,
        max_num_iterations: 50,
    };

    #[test]
    fn the_gradient_is_that_of_the_cost() {
        let grid = room_grid();
        let points = room_scan(Pose::new(3.0, 2.0, 0.5));
        let problem = Problem {
            grid: &grid,
            points: &points,
            target: Pose::new(3.02, 1.97, 0.52),
            weights: WEIGHTS,
        };
        let pose = Pose::new(3.03, 2.02, 0.49);
        let normal = problem.at(pose);
        let step = 1e-6;
        for k in 0..3 {
            let mut by = [0.0; 3];
            by[k] = step;
            let ahead = Pose::new(pose.x + by[0], pose.y + by[1], pose.heading + by[2]);
            let behind = Pose::new(pose.x - by[0], pose.y - by[1], pose.heading - by[2]);
            let slope = (problem.at(ahead).cost - problem.at(behind).cost) / (4.0 * step);
            let expected = normal.gradient[k];
            assert!(
                (slope - expected).abs() < 1e-4 * expected.abs().max(1.0),
                "{k}: {slope} {expected}"
            );
        }
    }

    #[test]
    fn a_start_a_few_centimetres_off_ends_on_the_truth() {
        let grid = room_grid();
        let truth = Pose::new(3.0, 2.0, 0.5);
        let start = Pose::new(3.05, 1.96, 0.53);
        let found = nonlinear_match(&grid, &room_scan(truth), start, start, WEIGHTS);
        assert!(found.distance(truth) < 0.01, "{found:?}");
        assert!((found.heading - truth.heading).abs() < 0.005, "{found:?}");
    }

    #[test]
    fn without_points_the_prediction_stays() {
        let start = Pose::new(3.05, 1.96, 0.53);
        let found = nonlinear_match(&room_grid(), &[], start, start, WEIGHTS);
        assert!(found.distance(start) < 1e-9);
    }

    #[test]
    fn along_a_straight_wall_there_is_little_information() {
        let grid = room_grid();
        let pose = Pose::new(3.0, 2.0, 0.5);
        let all = room_scan(pose);
        // Of the wall at the bottom alone.
        let end = |point: &[f32; 2]| pose.transform(point.map(f64::from));
        let wall: Vec<[f32; 2]> = all
            .iter()
            .filter(|point| end(point)[1] < 0.25 && (1.0..4.0).contains(&end(point)[0]))
            .copied()
            .collect();
        assert!(wall.len() > 20, "{}", wall.len());
        let shape = shape_of_information(&grid, &wall, pose);
        assert!(shape[(0, 0)] < 0.1 && shape[(1, 1)] > 0.99, "{shape}");
        let whole = shape_of_information(&grid, &all, pose);
        assert!(whole[(0, 0)] > 0.4 && whole[(1, 1)] > 0.4, "{whole}");
        assert_eq!(shape_of_information(&grid, &[], pose), Matrix2::identity());
    }
}
