//! The scan-to-map tracker: an iterated Kalman filter on the pose, predicted by odometry and fitted to the map.
//!
//! The pose comes from here: a fit of the whole scan around the prediction. The particles guard it. Where they explain the
//! scan clearly better than the prediction does, the scan is fitted around them instead.

use localizer::Stamp;
use maps::{DistanceField, Pose};
use nalgebra::{Matrix3, Vector3};

use crate::calibration::WallCalibration;
use crate::estimate::Estimate;
use crate::innovation_gate::InnovationGate;
use crate::motion_model::MotionParameters;
use crate::particle_filter::Weighted;
use crate::scan_matcher::{RefinementParameters, ScanMatch, fit as share_on_walls, match_scan};
use crate::track_map::TrackMap;

/// The estimate, and when it is true.
#[derive(Debug, Clone)]
pub(crate) struct Tracker {
    /// What the next prediction starts from.
    pub(crate) estimate: Estimate,
    /// Covariance of its pose as far as is known; see [`ScanMatch::covariance`].
    pub(crate) covariance: Matrix3<f64>,
    /// What the latest scan's beams, brought to one time, add to it; of no weight for the next scan.
    pub(crate) sweep_error: Matrix3<f64>,
    /// When it is true, and odometry's pose then; None until it is known.
    pub(crate) at: Option<(Stamp, Pose)>,
    /// Which corrections are believed.
    pub(crate) gate: InnovationGate,
}

/// What the fit of a scan came to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fit {
    pub(crate) estimate: Estimate,
    /// See [`ScanMatch::covariance`].
    pub(crate) covariance: Matrix3<f64>,
    /// Whether it started from the prediction; else from the particles.
    pub(crate) from_prediction: bool,
    /// A pose that the scan fits better at, but where the car can hardly be.
    pub(crate) refused: Option<Pose>,
    /// Whether the whole scan was left out for that.
    pub(crate) held: bool,
    /// Share of the end points that lie on walls there, in [0, 1].
    pub(crate) on_walls: f64,
}

/// How far odometry may have gone wrong between two scans.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Uncertainty {
    /// By how much the noise is wider than tuned.
    pub(crate) factor: f64,
    /// While wheels spin or lock: the car's speed before [m/s]. Wheels that lock stand still, and the car slides on.
    pub(crate) sliding: Option<f64>,
}

/// The interval that the shares in `odometry_*_error` refer to [s]: that of a laser at 40 Hz.
const NOISE_INTERVAL: f64 = 0.025;

/// For so long odometry errs by the same share [s]: a bend, a braking. Beyond, errors are as good as independent.
const LASTING: f64 = 0.5;

/// Shorter intervals between scans count as this \[s\].
const SHORTEST: f64 = 1e-3;

/// How far the speed of wheels that spin or lock may be off, as a share of it.
const SPINNING_SPEED_ERROR: f64 = 0.6;

/// Reach at which predictions are compared by their fit \[m\].
const FIT_REACH: f32 = 0.15;

/// By how much the particles' mean must fit better than the estimate's own prediction to be preferred.
const FIT_MARGIN: f64 = 0.08;

impl Tracker {
    /// Nothing is known: anywhere that a car can be.
    pub(crate) fn unknown(map: &TrackMap) -> Self {
        let estimate = anywhere(map);
        Self {
            estimate,
            covariance: estimate.covariance,
            sweep_error: Matrix3::zeros(),
            at: None,
            gate: InnovationGate::default(),
        }
    }

    /// Goes on from this estimate.
    pub(crate) fn set(&mut self, estimate: Estimate) {
        self.estimate = estimate;
        self.covariance = estimate.covariance;
        self.sweep_error = Matrix3::zeros();
        self.gate = InnovationGate::default();
    }

    /// The pose with what is known of its uncertainty.
    pub(crate) fn posterior(&self) -> Estimate {
        Estimate {
            pose: self.estimate.pose,
            covariance: self.covariance + self.sweep_error,
        }
    }

    /// Keeps the pose, for want of a better one, and allows the car to be anywhere.
    pub(crate) fn forget(&mut self, map: &TrackMap) {
        self.set(Estimate {
            pose: self.estimate.pose,
            ..anywhere(map)
        });
    }

    /// The estimate carried on by `motion` over `seconds`, with odometry's noise.
    pub(crate) fn predict(
        &self,
        motion: Pose,
        seconds: f64,
        uncertainty: Uncertainty,
        parameters: &MotionParameters,
    ) -> Estimate {
        self.estimate
            .moved(motion, &process_noise(motion, seconds, uncertainty, parameters))
    }

    /// The covariance as far as is known, carried on as `predicted` was; it grows by as much.
    pub(crate) fn predicted_covariance(&self, predicted: &Estimate) -> Matrix3<f64> {
        let motion = predicted.pose.since(self.estimate.pose);
        let carried = |covariance: Matrix3<f64>| {
            let from = Estimate {
                covariance,
                ..self.estimate
            };
            from.moved(motion, &Matrix3::zeros()).covariance
        };
        let grown = predicted.covariance - carried(self.estimate.covariance);
        carried(self.covariance) + grown
    }

    /// The scan fitted around the prediction, or around the particles where they explain it better.
    pub(crate) fn fit_scan(
        &self,
        field: &DistanceField,
        points: &[[f32; 2]],
        predicted: &Estimate,
        weighted: &Weighted,
        walls: WallCalibration,
        parameters: &RefinementParameters,
    ) -> Fit {
        let seen = &self.predicted_covariance(predicted);
        let particles = Estimate {
            pose: weighted.particles.mean,
            covariance: weighted.particles.covariance,
        };
        let on_walls = |estimate: &Estimate| share_on_walls(field, points, 60, estimate.pose, FIT_REACH);
        let fit = |found: ScanMatch, from_prediction, on_walls| Fit {
            estimate: found.estimate,
            covariance: found.covariance,
            from_prediction,
            refused: None,
            held: false,
            on_walls,
        };
        let passes = |found: &Estimate, on_walls| self.gate.passes(predicted, seen, found.pose, on_walls);
        let unchanged = |estimate: Estimate| ScanMatch {
            estimate,
            covariance: estimate.covariance,
        };
        if !parameters.refine || !weighted.sound {
            return fit(unchanged(particles), false, 0.0);
        }
        let matched =
            |prior: &Estimate, seen| match_scan(field, points, prior.pose, prior, seen, walls, parameters);
        let from_predicted = matched(predicted, seen);
        let (before, after) = (on_walls(predicted), on_walls(&from_predicted.estimate));
        let mut refused = None;
        if on_walls(&particles) > before.max(after) + FIT_MARGIN {
            let covariance = particles.covariance + Matrix3::identity() * 1e-4;
            let around = Estimate {
                covariance,
                ..particles
            };
            let from_particles = matched(&around, &covariance);
            let share = on_walls(&from_particles.estimate);
            if share > after + FIT_MARGIN {
                if passes(&from_particles.estimate, share) {
                    return fit(from_particles, false, share);
                }
                refused = Some(from_particles.estimate.pose);
            }
        }
        let kept = ScanMatch {
            estimate: *predicted,
            covariance: *seen,
        };
        if !passes(&from_predicted.estimate, after) {
            let refused = refused.or(Some(from_predicted.estimate.pose));
            return Fit {
                refused,
                held: true,
                ..fit(kept, true, before)
            };
        }
        // A fit that made things worse has run away.
        let fit = if after + FIT_MARGIN < before {
            fit(kept, true, before)
        } else {
            fit(from_predicted, true, after)
        };
        Fit { refused, ..fit }
    }
}

/// Mean and covariance of all places on the map that may hold a car, at any heading.
fn anywhere(map: &TrackMap) -> Estimate {
    let (width, resolution) = (map.grid().width, map.grid().resolution);
    let regions = map.plausible_regions();
    let (mut count, mut sum, mut squares) = (0.0, [0.0; 2], [0.0; 3]);
    for &cell in regions.iter().flat_map(|&region| &map.regions()[region].cells) {
        let (x, y) = ((cell as usize % width) as f64, (cell as usize / width) as f64);
        count += 1.0;
        sum = [sum[0] + x, sum[1] + y];
        squares = [squares[0] + x * x, squares[1] + x * y, squares[2] + y * y];
    }
    let [x, y] = sum.map(|sum| sum / count);
    let [xx, xy, yy] = squares.map(|square| square / count);
    let area = resolution * resolution;
    let (xx, xy, yy) = ((xx - x * x) * area, (xy - x * y) * area, (yy - y * y) * area);
    // A heading spread evenly over the circle.
    let heading = std::f64::consts::PI.powi(2) / 3.0;
    Estimate {
        pose: Pose::new((x + 0.5) * resolution, (y + 0.5) * resolution, 0.0),
        covariance: Matrix3::new(xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, heading),
    }
}

/// Covariance of odometry's error over a motion, in the frame of its start.
///
/// Odometry errs by the same share for [`LASTING`]: a scan each 0.1 s leaves it four times the way to err on that one each
/// 0.025 s does. A faster laser sees no more of it: below [`NOISE_INTERVAL`] variances add up, as those of white noise do.
fn process_noise(
    motion: Pose,
    seconds: f64,
    uncertainty: Uncertainty,
    parameters: &MotionParameters,
) -> Matrix3<f64> {
    let p = parameters;
    let Uncertainty { factor, sliding } = uncertainty;
    let distance = motion.x.hypot(motion.y);
    let along = match sliding {
        Some(speed) => p.odometry_speed_error.max(SPINNING_SPEED_ERROR) * distance.max(speed.abs() * seconds),
        None => p.odometry_speed_error * distance,
    };
    let across = p.odometry_side_error * distance;
    let turn = p.odometry_yaw_error * motion.heading;
    // n intervals that err independently, each with its share of the motion: n (error / n)^2.
    let seconds = seconds.max(SHORTEST);
    let intervals = (seconds / NOISE_INTERVAL).min((seconds / LASTING).max(1.0));
    let grown = |error: f64| (error * factor).powi(2) / intervals;
    let steady_xy = p.diffusion_xy.powi(2) * seconds;
    let steady_heading = p.diffusion_heading.powi(2) * seconds;
    Matrix3::from_diagonal(&Vector3::new(
        grown(along) + steady_xy,
        grown(across) + steady_xy,
        grown(turn) + steady_heading,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The covariance after two seconds of an S at 5 m/s, in so many steps.
    fn after_drive(steps: usize, uncertainty: Uncertainty) -> Matrix3<f64> {
        let seconds = 2.0 / steps as f64;
        let mut tracker = Tracker {
            estimate: Estimate {
                pose: Pose::IDENTITY,
                covariance: Matrix3::zeros(),
            },
            covariance: Matrix3::zeros(),
            sweep_error: Matrix3::zeros(),
            at: None,
            gate: InnovationGate::default(),
        };
        for step in 0..steps {
            let yaw_rate = if 2 * step < steps { 1.5 } else { -1.5 };
            let motion = Pose::exp([5.0 * seconds, 0.0, yaw_rate * seconds]);
            tracker.estimate = tracker.predict(motion, seconds, uncertainty, &MotionParameters::default());
        }
        tracker.estimate.covariance
    }

    const GRIPPING: Uncertainty = Uncertainty {
        factor: 1.0,
        sliding: None,
    };

    #[test]
    fn a_drive_ends_equally_uncertain_with_a_faster_laser() {
        let sliding = Uncertainty {
            factor: 2.0,
            sliding: Some(5.0),
        };
        for uncertainty in [GRIPPING, sliding] {
            let usual = after_drive(80, uncertainty);
            let other = after_drive(200, uncertainty);
            for i in 0..3 {
                let ratio = (other[(i, i)] / usual[(i, i)]).sqrt();
                assert!((ratio - 1.0).abs() < 0.04, "{i}: {ratio}");
            }
        }
    }

    /// As white noise, a scan each 0.1 s left half the sigma of the share that odometry errs by, and NEES at 24 for 2.
    #[test]
    fn a_slow_laser_leaves_odometry_the_share_that_it_errs_by() {
        let parameters = MotionParameters {
            diffusion_xy: 0.0,
            ..MotionParameters::default()
        };
        let share = |seconds: f64| {
            let way = 5.0 * seconds;
            process_noise(Pose::new(way, 0.0, 0.0), seconds, GRIPPING, &parameters)[(0, 0)].sqrt() / way
        };
        for seconds in [0.025, 0.1, 0.25, 0.5] {
            assert!((share(seconds) / parameters.odometry_speed_error - 1.0).abs() < 1e-9);
        }
        // Over longer ways errors cancel in part.
        assert!((share(2.0) / share(0.5) - 0.5).abs() < 1e-9);
    }
}
