//! The real-time correlative scan matcher (Olson, "Real-Time Correlative Scan Matching", ICRA 2009): every candidate pose
//! around the prediction is scored.

use maps::Pose;

use crate::parameters::PoseGraphParameters;
use crate::probability_grid::{LEAST, MOST, ProbabilityGrid};
use crate::scan_points::{angular_step, transformed};

/// The best of the candidates around `prediction`. A candidate's score is the mean probability of the cells in which the
/// points end, less with its distance from the prediction.
pub(crate) fn correlative_match(
    grid: &ProbabilityGrid,
    points: &[[f32; 2]],
    prediction: Pose,
    parameters: &PoseGraphParameters,
) -> Pose {
    if points.is_empty() {
        return prediction;
    }
    let resolution = grid.resolution();
    let step = angular_step(points, resolution);
    let turns = (parameters.correlative_angular_search_window / step).ceil() as i64;
    let steps = (parameters.correlative_linear_search_window / resolution).ceil() as i64;
    let (mut best, mut best_score) = (prediction, f64::NEG_INFINITY);
    let side = (2 * steps + 1) as usize;
    let mut sums = vec![0; side * side];
    let per_step = (MOST - LEAST) / (ProbabilityGrid::STEPS * points.len() as f64);
    for turn in -turns..=turns {
        let angle = turn as f64 * step;
        let turned = Pose::new(prediction.x, prediction.y, prediction.heading + angle);
        let (sin, cos) = turned.heading.sin_cos();
        sums.fill(0);
        for &point in points {
            let [column, row] = grid.cell(transformed([sin, cos], turned, point));
            for (j, sums) in (-steps..).zip(sums.chunks_exact_mut(side)) {
                grid.add_row([column - steps, row + j], sums);
            }
        }
        let offsets = (-steps..=steps).flat_map(|j| (-steps..=steps).map(move |i| [i, j]));
        for (&sum, [i, j]) in sums.iter().zip(offsets) {
            let [x, y] = [i, j].map(|v| v as f64 * resolution);
            let cost = x.hypot(y) * parameters.correlative_translation_delta_cost_weight
                + angle.abs() * parameters.correlative_rotation_delta_cost_weight;
            let score = (LEAST + f64::from(sum) * per_step) * (-cost * cost).exp();
            if score > best_score {
                best_score = score;
                best = Pose::new(turned.x + x, turned.y + y, turned.heading);
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_room::{room_grid, room_scan};

    #[test]
    fn the_best_candidate_is_within_a_cell_and_a_step_of_the_truth() {
        let grid = room_grid();
        let truth = Pose::new(3.0, 2.0, 0.5);
        let points = room_scan(truth);
        let start = Pose::new(3.08, 1.93, 0.7);
        let found = correlative_match(&grid, &points, start, &PoseGraphParameters::default());
        assert!(found.distance(truth) < 0.05, "{found:?}");
        assert!((found.heading - truth.heading).abs() < 0.02, "{found:?}");
    }

    #[test]
    fn without_points_the_prediction_stays() {
        let start = Pose::new(1.0, 2.0, 0.5);
        let found = correlative_match(&room_grid(), &[], start, &PoseGraphParameters::default());
        assert_eq!(found, start);
    }
}
