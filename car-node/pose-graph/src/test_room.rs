//! A small room for the tests of the matchers.

use maps::Pose;

use crate::probability_grid::ProbabilityGrid;

/// Walls of a room of 6 m x 4 m without symmetry \[m\]: ends of segments along an axis.
const WALLS: [[[f64; 2]; 2]; 8] = [
    [[0.2, 0.2], [5.8, 0.2]],
    [[5.8, 0.2], [5.8, 3.8]],
    [[0.2, 3.8], [5.8, 3.8]],
    [[0.2, 0.2], [0.2, 3.8]],
    [[4.5, 0.2], [4.5, 1.4]],
    [[4.5, 1.4], [5.8, 1.4]],
    [[0.2, 2.9], [1.3, 2.9]],
    [[1.3, 2.9], [1.3, 3.8]],
];

fn distance([x, y]: [f64; 2]) -> f64 {
    let to = |[from, to]: [[f64; 2]; 2]| (x - x.clamp(from[0], to[0])).hypot(y - y.clamp(from[1], to[1]));
    WALLS.into_iter().map(to).fold(f64::INFINITY, f64::min)
}

/// The room, in cells of 5 cm.
pub(crate) fn room_grid() -> ProbabilityGrid {
    let centre = |i: usize| [i % 120, i / 120].map(|v| (v as f64 + 0.5) * 0.05);
    let probability = |i: usize| 0.1 + 0.8 * (1.0 - distance(centre(i)) / 0.075).max(0.0);
    ProbabilityGrid::from_probabilities(120, 0.05, (0..120 * 80).map(|i| Some(probability(i))))
}

/// What a laser at `pose` sees all around, in its own frame \[m\].
pub(crate) fn room_scan(pose: Pose) -> Vec<[f32; 2]> {
    (0..360)
        .map(|i| {
            let angle = f64::from(i).to_radians();
            let (sin, cos) = (pose.heading + angle).sin_cos();
            let mut range = 0.0;
            for _ in 0..1000 {
                range += distance([pose.x + range * cos, pose.y + range * sin]).max(1e-4);
                if distance([pose.x + range * cos, pose.y + range * sin]) < 2e-4 {
                    break;
                }
            }
            [(range * angle.cos()) as f32, (range * angle.sin()) as f32]
        })
        .collect()
}
