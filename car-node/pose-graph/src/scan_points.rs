//! End points turned and moved: what all matchers do with a scan.

use maps::Pose;

/// A point transformed by a pose \[m\].
#[inline]
pub(crate) fn transformed([sin, cos]: [f64; 2], pose: Pose, point: [f32; 2]) -> [f64; 2] {
    let [x, y] = point.map(f64::from);
    [pose.x + cos * x - sin * y, pose.y + sin * x + cos * y]
}

/// All points transformed by a pose \[m\].
pub(crate) fn transform_all(points: &[[f32; 2]], pose: Pose) -> Vec<[f64; 2]> {
    let (sin, cos) = pose.heading.sin_cos();
    points
        .iter()
        .map(|&point| transformed([sin, cos], pose, point))
        .collect()
}

/// The turn by which the farthest point moves by a cell \[rad\] (Olson, ICRA 2009).
pub(crate) fn angular_step(points: &[[f32; 2]], resolution: f64) -> f64 {
    let farthest = points
        .iter()
        .map(|[x, y]| f64::from(x.hypot(*y)))
        .fold(3.0 * resolution, f64::max);
    0.99 * (1.0 - 0.5 * (resolution / farthest).powi(2)).acos()
}
