//! The scan-to-map tracker: an iterated Kalman filter on the pose, predicted by odometry and fitted to the map.
//!
//! The pose comes from here: a fit of the whole scan around the prediction. The particles guard it. Where they explain the
//! scan clearly better than the prediction does, the scan is fitted around them instead.

use localizer::Stamp;
use maps::{DistanceField, Pose};
use nalgebra::{Matrix3, Vector3};

use crate::calibration::WallCalibration;
use crate::estimate::{Estimate, carry, rotation};
use crate::innovation_gate::{InnovationGate, Verdict};
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
    /// Covariance of the pose (rows) with the shares by which odometry errs at present (columns: along, aside, turn).
    pub(crate) with_drift: Matrix3<f64>,
    /// The same at the prediction.
    predicted_with_drift: Matrix3<f64>,
    /// Which corrections are believed.
    pub(crate) gate: InnovationGate,
    /// Motion and time \[s\] of the prediction.
    pub(crate) since_before: (Pose, f64),
    /// Odometry alone since the last scan that fitted as scans usually do.
    reckoned: Reckoned,
}

/// An estimate that odometry carries on.
#[derive(Debug, Clone, Copy)]
struct Reckoned {
    estimate: Estimate,
    /// See [`Tracker::with_drift`].
    with_drift: Matrix3<f64>,
}

impl Reckoned {
    fn from(estimate: Estimate) -> Self {
        Self {
            estimate,
            with_drift: Matrix3::zeros(),
        }
    }

    /// Carries it on by `motion`, with odometry's noise.
    fn advance(&mut self, motion: Pose, steady: &Matrix3<f64>, drift: &Drift) {
        let Self { estimate, with_drift } = self;
        let moved = estimate.moved(motion, steady);
        let by = rotation(estimate.pose.heading) * drift.by;
        let carried = carry(estimate.pose, moved.pose) * *with_drift;
        let mixed = carried * by.transpose();
        *with_drift = (carried + by * drift.variance) * drift.kept;
        *estimate = moved;
        estimate.covariance += by * drift.variance * by.transpose() + mixed + mixed.transpose();
    }
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
    /// Whether the car is there whatever odometry says; see [`Verdict::Believed`].
    pub(crate) believed: bool,
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
    /// Odometry is silent, and the car is carried on at the twist of the scan before.
    pub(crate) carried: bool,
}

/// For so long odometry errs by the same share \[s\]: a bend, a braking.
const LASTING: f64 = 0.5;

/// Wheels that slide err anew in each of these \[s\].
const NOISE_INTERVAL: f64 = 0.025;

/// Shorter intervals between scans count as this \[s\].
const SHORTEST: f64 = 1e-3;

/// How far the speed of wheels that spin or lock may be off, as a share of it.
const SPINNING_SPEED_ERROR: f64 = 0.6;

/// What a twist that is carried on misses: acceleration [m/s^2], [rad/s^2], and what was wrong with it [m/s], [rad/s]. A coefficient
/// of friction of 1; a car that turns in.
const CARRIED_ACCELERATION: [f64; 2] = [10.0, 30.0];
const CARRIED_ERROR: [f64; 2] = [0.2, 0.3];

/// Where the scans do not tell a speed that is carried on, it errs as one of at least this [m/s].
const CARRIED_SPEED: f64 = 1.0;

/// By how much more odometry may err while tyres are near their limit, for what corrections may add up to.
const SLIDING_FACTOR: f64 = 3.0;

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
            with_drift: Matrix3::zeros(),
            predicted_with_drift: Matrix3::zeros(),
            gate: InnovationGate::default(),
            since_before: (Pose::IDENTITY, 0.0),
            reckoned: Reckoned::from(estimate),
        }
    }

    /// Goes on from this estimate.
    pub(crate) fn set(&mut self, estimate: Estimate) {
        self.estimate = estimate;
        self.covariance = estimate.covariance;
        self.sweep_error = Matrix3::zeros();
        self.with_drift = Matrix3::zeros();
        self.gate = InnovationGate::default();
        self.reckoned = Reckoned::from(estimate);
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
        &mut self,
        motion: Pose,
        seconds: f64,
        uncertainty: Uncertainty,
        parameters: &MotionParameters,
    ) -> Estimate {
        self.since_before = (motion, seconds);
        let steady = steady_noise(motion, seconds, uncertainty, parameters);
        let drift = Drift::new(motion, seconds, uncertainty, parameters);
        if self.gate.grips() {
            self.reckoned.advance(motion, &steady, &drift);
        } else {
            let sliding = Uncertainty {
                factor: uncertainty.factor.max(SLIDING_FACTOR),
                ..uncertainty
            };
            let drift = Drift::new(motion, seconds, sliding, parameters);
            self.reckoned.advance(motion, &steady, &drift);
        }
        let mut own = Reckoned {
            estimate: self.estimate,
            with_drift: self.with_drift,
        };
        own.advance(motion, &steady, &drift);
        self.predicted_with_drift = own.with_drift;
        own.estimate
    }

    /// The estimate has moved on from `predicted` by a fit.
    pub(crate) fn update(&mut self, predicted: &Estimate, fit: &Fit) {
        self.estimate = fit.estimate;
        self.covariance = fit.covariance;
        if fit.believed {
            self.reckoned = Reckoned::from(self.posterior());
        }
        self.with_drift = if fit.from_prediction {
            // What is left of the prediction's error, of which the scan took its share away.
            predicted
                .covariance
                .cholesky()
                .map_or_else(Matrix3::zeros, |root| {
                    fit.estimate.covariance * root.solve(&self.predicted_with_drift)
                })
        } else {
            Matrix3::zeros()
        };
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
            believed: true,
            on_walls,
        };
        let judge = |found: &Estimate, on_walls| {
            self.gate.judge(
                (predicted, seen),
                &self.reckoned.estimate,
                found.pose,
                on_walls,
                self.since_before,
            )
        };
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
                let verdict = judge(&from_particles.estimate, share);
                if verdict != Verdict::Refused {
                    return Fit {
                        believed: verdict == Verdict::Believed,
                        ..fit(from_particles, false, share)
                    };
                }
                refused = Some(from_particles.estimate.pose);
            }
        }
        let kept = ScanMatch {
            estimate: *predicted,
            covariance: *seen,
        };
        let verdict = judge(&from_predicted.estimate, after);
        if verdict == Verdict::Refused {
            let refused = refused.or(Some(from_predicted.estimate.pose));
            return Fit {
                refused,
                held: true,
                believed: false,
                ..fit(kept, true, before)
            };
        }
        // A fit that made things worse has run away.
        let fit = if after + FIT_MARGIN < before {
            fit(kept, true, before)
        } else {
            fit(from_predicted, true, after)
        };
        Fit {
            refused,
            believed: verdict == Verdict::Believed,
            ..fit
        }
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

/// Covariance of what of odometry's error is new with each motion, in the frame of its start.
fn steady_noise(
    motion: Pose,
    seconds: f64,
    uncertainty: Uncertainty,
    parameters: &MotionParameters,
) -> Matrix3<f64> {
    let p = parameters;
    let distance = motion.x.hypot(motion.y);
    let along = uncertainty.sliding.map_or(0.0, |speed| {
        let error = p.odometry_speed_error.max(SPINNING_SPEED_ERROR);
        (error * distance.max(speed.abs() * seconds) * uncertainty.factor).powi(2)
            / (seconds.max(SHORTEST) / NOISE_INTERVAL)
    });
    let steady_xy = p.diffusion_xy.powi(2) * seconds;
    let steady_heading = p.diffusion_heading.powi(2) * seconds;
    let carried = if uncertainty.carried {
        [0, 1].map(|i| (0.5 * CARRIED_ACCELERATION[i] * seconds + CARRIED_ERROR[i]) * seconds)
    } else {
        [0.0; 2]
    };
    let [carried_xy, carried_heading] = carried.map(|error| error * error);
    Matrix3::from_diagonal(&Vector3::new(
        steady_xy + along + carried_xy,
        steady_xy + carried_xy,
        steady_heading + carried_heading,
    ))
}

/// How odometry's present error moves the pose.
struct Drift {
    /// The pose's error by each share: of the way along and aside, and of the turn. In the frame of the motion's start.
    by: Matrix3<f64>,
    /// Variances of the shares.
    variance: Matrix3<f64>,
    /// What is left of their deviation at the end of the motion.
    kept: f64,
}

impl Drift {
    /// The shares follow a Gauss-Markov process of first order (Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to
    /// Tracking and Navigation*, section 8.2) with the time constant [`LASTING`]. Over long ways odometry errs by
    /// `odometry_*_error` in each such time anew, whatever the laser's rate.
    fn new(motion: Pose, seconds: f64, uncertainty: Uncertainty, parameters: &MotionParameters) -> Self {
        let p = parameters;
        let mut distance = motion.x.hypot(motion.y);
        let mut speed_error = p.odometry_speed_error;
        if uncertainty.carried {
            // Between walls that look the same everywhere the speed is what it was before them.
            speed_error = speed_error.max(SPINNING_SPEED_ERROR);
            distance = distance.max(CARRIED_SPEED * seconds);
        }
        let shares = Vector3::new(speed_error, p.odometry_side_error, p.odometry_yaw_error)
            * (uncertainty.factor * std::f64::consts::FRAC_1_SQRT_2);
        Self {
            by: Matrix3::from_diagonal(&Vector3::new(
                distance.copysign(motion.x),
                distance,
                motion.heading,
            )),
            variance: Matrix3::from_diagonal(&shares.component_mul(&shares)),
            kept: (-seconds / LASTING).exp(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at_rest() -> Tracker {
        Tracker {
            estimate: Estimate {
                pose: Pose::IDENTITY,
                covariance: Matrix3::zeros(),
            },
            covariance: Matrix3::zeros(),
            sweep_error: Matrix3::zeros(),
            at: None,
            with_drift: Matrix3::zeros(),
            predicted_with_drift: Matrix3::zeros(),
            gate: InnovationGate::default(),
            since_before: (Pose::IDENTITY, 0.0),
            reckoned: Reckoned::from(Estimate {
                pose: Pose::IDENTITY,
                covariance: Matrix3::zeros(),
            }),
        }
    }

    /// The covariance after two seconds of an S at 5 m/s, in so many steps.
    fn after_drive(steps: usize, uncertainty: Uncertainty) -> Matrix3<f64> {
        let seconds = 2.0 / steps as f64;
        let mut tracker = at_rest();
        for step in 0..steps {
            let yaw_rate = if 2 * step < steps { 1.5 } else { -1.5 };
            let motion = Pose::exp([5.0 * seconds, 0.0, yaw_rate * seconds]);
            tracker.estimate = tracker.predict(motion, seconds, uncertainty, &MotionParameters::default());
            tracker.with_drift = tracker.predicted_with_drift;
        }
        tracker.estimate.covariance
    }

    const GRIPPING: Uncertainty = Uncertainty {
        factor: 1.0,
        sliding: None,
        carried: false,
    };

    /// As white noise in each scan's interval, a laser at 10 Hz had twice the standard deviations of one at 40 Hz.
    #[test]
    fn a_drive_ends_equally_uncertain_with_lasers_of_all_rates() {
        let sliding = Uncertainty {
            factor: 2.0,
            sliding: Some(5.0),
            carried: false,
        };
        for uncertainty in [GRIPPING, sliding] {
            let usual = after_drive(80, uncertainty);
            // 10, 20, 100 and 200 Hz.
            for steps in [20, 40, 200, 400] {
                let other = after_drive(steps, uncertainty);
                for i in 0..3 {
                    let ratio = (other[(i, i)] / usual[(i, i)]).sqrt();
                    assert!((ratio - 1.0).abs() < 0.05, "{steps} steps, {i}: {ratio}");
                }
            }
        }
    }

    /// A share that lasts moves the pose in proportion to the way; over long ways shares cancel in part.
    #[test]
    fn odometry_errs_by_its_share_over_a_short_way_and_by_less_over_a_long_one() {
        let parameters = MotionParameters {
            diffusion_xy: 0.0,
            ..MotionParameters::default()
        };
        let share = |seconds: f64| {
            let mut tracker = at_rest();
            for _ in 0..(seconds / 0.005).round() as usize {
                let motion = Pose::new(0.025, 0.0, 0.0);
                tracker.estimate = tracker.predict(motion, 0.005, GRIPPING, &parameters);
                tracker.with_drift = tracker.predicted_with_drift;
            }
            tracker.estimate.covariance[(0, 0)].sqrt() / (5.0 * seconds)
        };
        let expected = parameters.odometry_speed_error * std::f64::consts::FRAC_1_SQRT_2;
        assert!((share(0.025) / expected - 1.0).abs() < 0.05, "{}", share(0.025));
        // Variance of the mean of a Gauss-Markov process over T: 2 tau / T for T far above tau.
        let long = (2.0 * LASTING / 10.0f64).sqrt();
        assert!(
            (share(10.0) / expected / long - 1.0).abs() < 0.05,
            "{}",
            share(10.0)
        );
    }

    #[test]
    fn a_scan_that_tells_the_pose_takes_the_drifts_share_of_it_away() {
        let mut tracker = at_rest();
        let motion = Pose::new(0.5, 0.0, 0.0);
        let predicted = tracker.predict(motion, 0.1, GRIPPING, &MotionParameters::default());
        let before = tracker.predicted_with_drift[(0, 0)];
        assert!(before > 0.0);
        let certain = Fit {
            estimate: Estimate {
                covariance: predicted.covariance * 0.01,
                ..predicted
            },
            covariance: predicted.covariance * 0.01,
            from_prediction: true,
            refused: None,
            held: false,
            believed: true,
            on_walls: 1.0,
        };
        tracker.update(&predicted, &certain);
        assert!((tracker.with_drift[(0, 0)] / before - 0.01).abs() < 1e-9);
    }
}
