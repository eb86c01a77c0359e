//! Refinement: the whole scan fitted to the distance field, around what was predicted.
//!
//! Gauss-Newton on the signed distances of the end points, with a robust weight per beam and the prediction as a
//! prior (the fit of a mean to the map after Peng et al., Complexity 2018/2327637; the prior makes it an iterated
//! Kalman filter). Where the scan says nothing, along a featureless straight, the prior stays, and so does its
//! covariance: it says in which direction nothing was learned.

use maps::{DistanceField, Pose};
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use crate::calibration::WallCalibration;
use crate::estimate::Estimate;
use crate::validation::Check;

/// Parameters of the refinement.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct RefinementParameters {
    /// Whether the estimate is refined; else it is the particles' weighted mean.
    pub refine: bool,
    /// Most end points that are fitted; more are thinned out evenly.
    pub refine_beams: usize,
    /// Most Gauss-Newton steps.
    pub refine_iterations: usize,
    /// Standard deviation of an end point's distance to its wall \[m\]: laser, and the grain of a map of 5 cm cells. Where they
    /// are seen to scatter by more, that counts.
    pub refine_sigma: f64,
    /// Distance from a wall at which an end point counts a quarter \[m\]; farther ones are opponents. At 0.1 an opponent
    /// that blocks the view for seconds pulls the pose half a metre off; on maps that fit badly that reach does better.
    pub refine_reach: f64,
    /// How many neighbouring end points err together, and so count as one.
    pub refine_correlation: f64,
    /// Share of the particles that are drawn around the refined estimate when resampling.
    pub refine_feedback: f64,
    /// How fast the offset of the map's walls is learned, and the end points' scatter about them: the distance driven until
    /// 63 % of it are known \[m\]; 0 takes the walls to stand where the map says, and end points to scatter by `refine_sigma`.
    pub wall_offset_distance: f64,
}

impl Default for RefinementParameters {
    fn default() -> Self {
        Self {
            refine: true,
            refine_beams: 540,
            refine_iterations: 8,
            refine_sigma: 0.03,
            refine_reach: 0.06,
            refine_correlation: 4.0,
            refine_feedback: 0.1,
            wall_offset_distance: 3.0,
        }
    }
}

impl RefinementParameters {
    pub(crate) fn validate(&self, check: &mut Check) {
        check.range("refine_beams", self.refine_beams as f64, 10.0, 10_000.0);
        check.range("refine_iterations", self.refine_iterations as f64, 1.0, 100.0);
        check.range("refine_sigma", self.refine_sigma, 1e-3, 1.0);
        check.range("refine_reach", self.refine_reach, 1e-3, 2.0);
        check.range("refine_correlation", self.refine_correlation, 1.0, 1000.0);
        check.range("refine_feedback", self.refine_feedback, 0.0, 0.5);
        check.range("wall_offset_distance", self.wall_offset_distance, 0.0, 1e4);
    }
}

/// The sums of one Gauss-Newton step.
struct Normal {
    information: Matrix3<f64>,
    gradient: Vector3<f64>,
}

/// The fit of a scan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ScanMatch {
    /// The pose, with the covariance of a filter that trusts end points by `refine_sigma`: what the next fit goes by.
    pub(crate) estimate: Estimate,
    /// Covariance of the pose with end points that scatter, and err together, as they were seen to. `refine_sigma` leaves room
    /// for what a map has wrong, which most of it has not; and errors that all scans of a stretch share do not average out.
    pub(crate) covariance: Matrix3<f64>,
}

/// [`match_scan`] for where the filter's covariance is enough.
pub(crate) fn refine(
    field: &DistanceField,
    points: &[[f32; 2]],
    start: Pose,
    prior: &Estimate,
    walls: WallCalibration,
    parameters: &RefinementParameters,
) -> Estimate {
    match_scan(field, points, start, prior, &prior.covariance, walls, parameters).estimate
}

/// Fits the end points to the field around `prior`, starting from `start`. `seen` is the prior's covariance as
/// [`ScanMatch::covariance`] has it.
pub(crate) fn match_scan(
    field: &DistanceField,
    points: &[[f32; 2]],
    start: Pose,
    prior: &Estimate,
    seen: &Matrix3<f64>,
    walls: WallCalibration,
    parameters: &RefinementParameters,
) -> ScanMatch {
    let stride = points.len().div_ceil(parameters.refine_beams).max(1);
    let sigma = parameters.refine_sigma.max(walls.scatter);
    // Errors that end points share widen the covariance alone: a fit that goes by them follows odometry for seconds, which
    // errs by more than most maps do (docs/localizer.md).
    let correlation = parameters.refine_correlation;
    let weight = 1.0 / (sigma.powi(2) * (correlation / stride as f64).max(1.0));
    let least_reach = parameters.refine_reach * sigma / parameters.refine_sigma;
    let prior_information = regular_inverse(&prior.covariance);
    // A start that may be far off looks farther at first.
    let uncertain = (prior.covariance[(0, 0)] + prior.covariance[(1, 1)])
        .sqrt()
        .min(0.5);
    let mut reach = least_reach.max(uncertain);
    let mut pose = start;
    let mut information = prior_information;
    for _ in 0..parameters.refine_iterations {
        let normal = accumulate(field, points, stride, pose, walls.offset as f32, reach as f32);
        information = normal.information * weight + prior_information;
        let off = Vector3::new(
            pose.x - prior.pose.x,
            pose.y - prior.pose.y,
            maps::wrap_angle(pose.heading - prior.pose.heading),
        );
        let gradient = normal.gradient * weight + prior_information * off;
        let Some(step) = information.cholesky().map(|root| root.solve(&gradient)) else {
            break;
        };
        // No further than the field is anything like linear.
        let length = step[0].hypot(step[1]);
        let step = step * (0.3 / length.max(0.3)).min(0.1 / step[2].abs().max(0.1));
        pose = Pose::new(pose.x - step[0], pose.y - step[1], pose.heading - step[2]);
        let settled = length < SETTLED[0] && step[2].abs() < SETTLED[1];
        if settled && reach <= least_reach {
            break;
        }
        reach = (reach * 0.5).max(least_reach);
    }
    let covariance = regular_inverse(&information);
    // The covariance of an update whose gain supposes other noise than there is (Joseph's form, in information).
    let seen_by_scan = information - prior_information;
    let gain = covariance * seen_by_scan;
    let share = Matrix3::from_diagonal(&Vector3::from_fn(|axis, _| {
        if walls.scatter <= 0.0 {
            return 1.0;
        }
        let together = walls.correlation_within(memory(gain[(axis, axis)]));
        (walls.scatter / sigma) * (together / correlation).max(1.0).sqrt()
    }));
    let noise = prior_information * seen * prior_information + share * seen_by_scan * share;
    ScanMatch {
        estimate: Estimate { pose, covariance },
        covariance: covariance * noise * covariance,
    }
}

/// Steps smaller than this end the fit \[m\], \[rad\]: with each the step shrinks to a tenth or less.
const SETTLED: [f64; 2] = [1e-3, 5e-4];

/// The gain of a direction changes along a track, and an estimate holds the errors of where it was less: so many times the memory
/// that the present gain has. At 1 a covariance on ragged and bent maps is half as large as it should be; without a bound
/// headings on sound maps are said to be half as certain as they are.
const VARYING_GAIN: f64 = 4.0;

/// Scans whose errors an estimate holds that follows each of them by `gain`: an error that all scans have in common grows by no
/// more than this over what it is when they err independently.
fn memory(gain: f64) -> f64 {
    let gain = gain.clamp(1e-3, 1.0);
    VARYING_GAIN * (2.0 - gain) / gain
}

/// The inverse of a symmetric matrix that may be singular to rounding.
fn regular_inverse(matrix: &Matrix3<f64>) -> Matrix3<f64> {
    let floor = Matrix3::from_diagonal(&Vector3::new(1e-12, 1e-12, 1e-12));
    (matrix + floor)
        .cholesky()
        .map_or_else(|| Matrix3::identity() * 1e6, |root| root.inverse())
}

/// One pass over the end points.
fn accumulate(
    field: &DistanceField,
    points: &[[f32; 2]],
    stride: usize,
    pose: Pose,
    offset: f32,
    reach: f32,
) -> Normal {
    let cells = 1.0 / field.resolution() as f32;
    let (sin, cos) = pose.heading.sin_cos();
    let (sin, cos) = (sin as f32, cos as f32);
    // Relative to the pose's cell, so that f32 resolves a micrometre anywhere on a map.
    let (x, y) = (pose.x as f32, pose.y as f32);
    let inverse_reach = 1.0 / reach;
    let mut sums = [0.0f32; 9];
    for point in points.iter().step_by(stride) {
        let (dx, dy) = (cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]);
        let Some(sample) = field.sample((x + dx) * cells, (y + dy) * cells) else {
            continue;
        };
        let distance = sample.distance - offset;
        let ratio = distance * inverse_reach;
        // Geman-McClure: a quarter at `reach`, next to nothing beyond three times it.
        let w = 1.0 / (1.0 + ratio * ratio);
        let w = w * w;
        let [gx, gy] = sample.gradient;
        // Steeper than distances are: the field jumps here, and there is no wall.
        let w = if gx * gx + gy * gy > 2.5 { 0.0 } else { w };
        let gh = dx * gy - dy * gx;
        let (wx, wy, wh, d) = (w * gx, w * gy, w * gh, distance);
        for (sum, term) in sums.iter_mut().zip([
            wx * gx,
            wx * gy,
            wx * gh,
            wy * gy,
            wy * gh,
            wh * gh,
            wx * d,
            wy * d,
            wh * d,
        ]) {
            *sum += term;
        }
    }
    let [xx, xy, xh, yy, yh, hh, bx, by, bh] = sums.map(f64::from);
    Normal {
        information: Matrix3::new(xx, xy, xh, xy, yy, yh, xh, yh, hh),
        gradient: Vector3::new(bx, by, bh),
    }
}

/// How well the end points fit at a pose: the mean robust weight, in [0, 1].
pub(crate) fn fit(field: &DistanceField, points: &[[f32; 2]], most: usize, pose: Pose, reach: f32) -> f64 {
    fit_by(field, points, most, pose, reach, |weight, _| weight)
}

/// The same with a say in the weights, which are given with where the beams end, in the grid's frame \[m\].
pub(crate) fn fit_by(
    field: &DistanceField,
    points: &[[f32; 2]],
    most: usize,
    pose: Pose,
    reach: f32,
    judged: impl Fn(f32, [f32; 2]) -> f32,
) -> f64 {
    let stride = points.len().div_ceil(most).max(1);
    let cells = 1.0 / field.resolution() as f32;
    let (sin, cos) = pose.heading.sin_cos();
    let (sin, cos) = (sin as f32, cos as f32);
    let (x, y) = (pose.x as f32, pose.y as f32);
    let (mut sum, mut count) = (0.0f32, 0);
    for point in points.iter().step_by(stride) {
        let (dx, dy) = (cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]);
        let end = [x + dx, y + dy];
        count += 1;
        let weight = field
            .nearest(end[0] * cells, end[1] * cells)
            .map_or(0.0, |distance| {
                let ratio = distance / reach;
                1.0 / (1.0 + ratio * ratio)
            });
        sum += judged(weight, end);
    }
    f64::from(sum) / f64::from(count.max(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use maps::{Cell, OccupancyGrid};

    /// A room of 10 x 6 m in cells of 5 cm; `open` leaves the short walls 20 m away, out of the laser's sight.
    fn room(open: bool) -> DistanceField {
        let width = if open { 1000 } else { 200 };
        let cell = |column: usize, row: usize| match (column, row) {
            (_, 0 | 119) => Cell::Occupied,
            (column, _) if column == 0 || column == width - 1 => Cell::Occupied,
            _ => Cell::Free,
        };
        DistanceField::new(&OccupancyGrid::from_fn(width, 120, 0.05, Pose::IDENTITY, cell))
    }

    /// What a laser of 20 m sees all around, in its own frame.
    fn scan(field: &DistanceField, pose: Pose) -> Vec<[f32; 2]> {
        let start = [(pose.x / 0.05) as f32, (pose.y / 0.05) as f32];
        (0..720)
            .filter_map(|i| {
                let angle = f64::from(i) * 0.5f64.to_radians();
                let direction = pose.heading + angle;
                let range = field.trace(start, [direction.cos() as f32, direction.sin() as f32], 400.0);
                (range < 400.0).then(|| {
                    [
                        range * 0.05 * angle.cos() as f32,
                        range * 0.05 * angle.sin() as f32,
                    ]
                })
            })
            .collect()
    }

    /// Fitted from a start that is 0.2 m and 0.1 rad unsure.
    fn fitted(field: &DistanceField, points: &[[f32; 2]], start: Pose) -> Estimate {
        let prior = Estimate {
            pose: start,
            covariance: Matrix3::from_diagonal(&Vector3::new(0.04, 0.04, 0.01)),
        };
        refine(
            field,
            points,
            start,
            &prior,
            WallCalibration::default(),
            &RefinementParameters::default(),
        )
    }

    #[test]
    fn a_start_a_hand_off_ends_on_the_truth() {
        let field = room(false);
        let truth = Pose::new(4.0, 2.0, 0.4);
        let start = Pose::new(4.1, 1.92, 0.45);
        let found = fitted(&field, &scan(&field, truth), start);
        assert!(found.pose.distance(truth) < 0.002, "{found:?}");
        assert!((found.pose.heading - truth.heading).abs() < 5e-4);
        assert!(found.covariance[(0, 0)].sqrt() < 0.02);
    }

    #[test]
    fn opponents_do_not_pull() {
        let field = room(false);
        let truth = Pose::new(4.0, 2.0, 0.4);
        let mut points = scan(&field, truth);
        for point in &mut points[100..220] {
            *point = point.map(|v| v * 0.5);
        }
        let start = Pose::new(4.03, 1.98, 0.41);
        let found = fitted(&field, &points, start);
        assert!(found.pose.distance(truth) < 0.01, "{found:?}");
    }

    #[test]
    fn along_a_featureless_straight_nothing_is_learned_and_the_covariance_says_so() {
        let field = room(true);
        let truth = Pose::new(25.0, 2.0, 0.0);
        let start = Pose::new(25.1, 2.05, 0.02);
        let found = fitted(&field, &scan(&field, truth), start);
        assert!(
            (found.pose.y - 2.0).abs() < 0.002 && found.pose.heading.abs() < 1e-3,
            "{found:?}"
        );
        assert!(
            (found.pose.x - 25.1).abs() < 0.01,
            "the prior stays along the straight"
        );
        assert!((found.covariance[(0, 0)].sqrt() - 0.2).abs() < 0.02);
        assert!(found.covariance[(1, 1)].sqrt() < 0.02);
    }

    #[test]
    fn errors_that_end_points_share_widen_the_covariance_and_do_not_loosen_the_fit() {
        let field = room(false);
        let pose = Pose::new(4.0, 2.0, 0.4);
        let points = scan(&field, pose);
        let covariance = Matrix3::from_diagonal(&Vector3::new(0.04, 0.04, 0.01));
        let prior = Estimate { pose, covariance };
        let parameters = RefinementParameters::default();
        let matched = |walls| match_scan(&field, &points, pose, &prior, &covariance, walls, &parameters);
        let sound = matched(WallCalibration::with_correlation(1.0));
        let shared = matched(WallCalibration::with_correlation(100.0));
        let ratio = |of: fn(&ScanMatch) -> f64| of(&shared) / of(&sound);
        let gain = ratio(|found| found.estimate.covariance[(0, 0)]);
        let known = ratio(|found| found.covariance[(0, 0)]);
        assert!((gain - 1.0).abs() < 1e-12, "{gain}");
        // Of the scans that share an error, an estimate that follows each of them holds few.
        assert!(known > 1.2 && known < 40.0, "{known}");
    }

    #[test]
    fn no_points_leave_the_prior() {
        let start = Pose::new(4.0, 2.0, 0.4);
        let found = fitted(&room(false), &[], start);
        assert!(found.pose.distance(start) < 1e-9);
    }
}
