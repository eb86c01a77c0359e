//! The scan-to-map tracker: an iterated Kalman filter on the pose, predicted by odometry and fitted to the map.
//!
//! The pose comes from here: a fit of the whole scan around the prediction. The particles guard it. Where they explain the
//! scan clearly better than the prediction does, the scan is fitted around them instead.

use localizer::Stamp;
use maps::{DistanceField, Pose};
use nalgebra::{Matrix3, Vector3};

use crate::calibration::WallCalibration;
use crate::estimate::Estimate;
use crate::motion_model::MotionParameters;
use crate::particle_filter::Weighted;
use crate::scan_matcher::{RefinementParameters, fit, refine};
use crate::track_map::TrackMap;

/// The estimate, and when it is true.
#[derive(Debug, Clone)]
pub(crate) struct Tracker {
    pub(crate) estimate: Estimate,
    /// When it is true, and odometry's pose then; None until it is known.
    pub(crate) at: Option<(Stamp, Pose)>,
}

/// What the fit of a scan came to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fit {
    pub(crate) estimate: Estimate,
    /// Whether it started from the prediction; else from the particles.
    pub(crate) from_prediction: bool,
}

/// How far odometry may have gone wrong between two scans.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Uncertainty {
    /// By how much the noise is wider than tuned.
    pub(crate) factor: f64,
    /// While wheels spin or lock: the car's speed before [m/s]. Wheels that lock stand still, and the car slides on.
    pub(crate) sliding: Option<f64>,
}

/// How far the speed of wheels that spin or lock may be off, as a share of it.
const SPINNING_SPEED_ERROR: f64 = 0.6;

/// Reach at which predictions are compared by their fit [m].
const FIT_REACH: f32 = 0.15;

/// By how much the particles' mean must fit better than the estimate's own prediction to be preferred.
const FIT_MARGIN: f64 = 0.08;

impl Tracker {
    /// Nothing is known: anywhere that a car can be.
    pub(crate) fn unknown(map: &TrackMap) -> Self {
        Self {
            estimate: anywhere(map),
            at: None,
        }
    }

    /// Keeps the pose, for want of a better one, and allows the car to be anywhere.
    pub(crate) fn forget(&mut self, map: &TrackMap) {
        self.estimate.covariance = anywhere(map).covariance;
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

/// The scan fitted around the prediction, or around the particles where they explain it better.
pub(crate) fn fit_scan(
    field: &DistanceField,
    points: &[[f32; 2]],
    predicted: &Estimate,
    weighted: &Weighted,
    walls: WallCalibration,
    parameters: &RefinementParameters,
) -> Fit {
    let particles = Estimate {
        pose: weighted.particles.mean,
        covariance: weighted.particles.covariance,
    };
    if !parameters.refine || !weighted.sound {
        return Fit {
            estimate: particles,
            from_prediction: false,
        };
    }
    let share_on_walls = |estimate: &Estimate| fit(field, points, 60, estimate.pose, FIT_REACH);
    let matched = |prior: &Estimate| refine(field, points, prior.pose, prior, walls, parameters);
    let from_predicted = matched(predicted);
    let (before, after) = (share_on_walls(predicted), share_on_walls(&from_predicted));
    if share_on_walls(&particles) > before.max(after) + FIT_MARGIN {
        let from_particles = matched(&Estimate {
            covariance: particles.covariance + Matrix3::identity() * 1e-4,
            ..particles
        });
        if share_on_walls(&from_particles) > after + FIT_MARGIN {
            return Fit {
                estimate: from_particles,
                from_prediction: false,
            };
        }
    }
    // A fit that made things worse has run away.
    let estimate = if after + FIT_MARGIN < before {
        *predicted
    } else {
        from_predicted
    };
    Fit {
        estimate,
        from_prediction: true,
    }
}

/// Covariance of odometry's error over a motion, in the frame of its start.
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
    let steady = p.diffusion_xy.powi(2) * seconds;
    Matrix3::from_diagonal(&Vector3::new(
        (along * factor).powi(2) + steady,
        (p.odometry_side_error * distance * factor).powi(2) + steady,
        (p.odometry_yaw_error * motion.heading * factor).powi(2) + p.diffusion_heading.powi(2) * seconds,
    ))
}
