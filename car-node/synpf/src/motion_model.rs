//! Motion models: how a particle moves when odometry says that the car did.
//!
//! All four are signed, and their noise depends on the motion and the time, not on how many messages it came in:
//! the alphas act on the motion per [`MotionParameters::noise_interval`], and variances add up over the intervals.

use maps::Pose;
use serde::{Deserialize, Serialize};

use crate::defects::Defects;
use crate::validation::Check;

/// Which motion model moves the particles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MotionModel {
    /// Rotate, drive, rotate, with a rotation noise that shrinks with speed (Stahl et al., IV 2019): a fast car
    /// cannot turn on the spot.
    Tum,
    /// Rotate, drive, rotate (Probabilistic Robotics, table 5.6), as in AMCL.
    Amcl,
    /// Noise on forward, sideways and turning motion, the sideways noise growing with the distance driven.
    Arc,
    /// Noise on forward, sideways and turning motion, in proportion or constant (Walsh and Karaman, ICRA 2018).
    Mit,
}

/// Parameters of the motion models.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct MotionParameters {
    /// Which model.
    pub motion_model: MotionModel,
    /// The interval that the alphas and dispersions refer to [s]: one message of 50 Hz odometry.
    pub noise_interval: f64,
    /// `tum`: rotation noise from rotation [rad/rad].
    pub alpha_1_tum: f64,
    /// `tum`: rotation noise from slowness [rad m].
    pub alpha_2_tum: f64,
    /// `tum`: translation noise from translation [m/m].
    pub alpha_3_tum: f64,
    /// `tum`: translation noise from rotation [m/rad].
    pub alpha_4_tum: f64,
    /// `tum`: translation per interval below which `alpha_2_tum` stops growing [m].
    pub lam_thresh: f64,
    /// `amcl`: rotation noise from rotation [rad/rad].
    pub alpha_1_amcl: f64,
    /// `amcl`: rotation noise from translation [rad/m].
    pub alpha_2_amcl: f64,
    /// `amcl`: translation noise from translation [m/m].
    pub alpha_3_amcl: f64,
    /// `amcl`: translation noise from rotation [m/rad].
    pub alpha_4_amcl: f64,
    /// `arc`: forward noise from forward motion [m/m].
    pub motion_dispersion_arc_x: f64,
    /// `arc`: sideways noise from sideways motion [m/m].
    pub motion_dispersion_arc_y: f64,
    /// `arc`: turning noise from turning [rad/rad].
    pub motion_dispersion_arc_theta: f64,
    /// `arc`: sideways noise from forward motion [m/m].
    pub motion_dispersion_arc_xy: f64,
    /// `arc`: least forward noise [m].
    pub motion_dispersion_arc_x_min: f64,
    /// `arc`: least sideways noise [m].
    pub motion_dispersion_arc_y_min: f64,
    /// `arc`: most sideways noise [m].
    pub motion_dispersion_arc_y_max: f64,
    /// `arc`: least turning noise [rad].
    pub motion_dispersion_arc_theta_min: f64,
    /// `arc`: forward motion below which it adds no sideways noise [m].
    pub motion_dispersion_arc_xy_min_x: f64,
    /// `mit`: forward noise [m].
    pub motion_dispersion_x: f64,
    /// `mit`: sideways noise [m].
    pub motion_dispersion_y: f64,
    /// `mit`: turning noise [rad].
    pub motion_dispersion_theta: f64,
    /// Noise on the position that is always there [m/sqrt(s)], so that particles never become one.
    pub diffusion_xy: f64,
    /// Noise on the heading that is always there [rad/sqrt(s)].
    pub diffusion_heading: f64,
    /// How far odometry's speed may be off beyond the slip that was learned, as a share of it [m/m]; for the refined
    /// estimate.
    pub odometry_speed_error: f64,
    /// Sideways motion that odometry does not see, as a share of the distance [m/m]; for the refined estimate.
    pub odometry_side_error: f64,
    /// How far odometry's turning may be off, as a share of it [rad/rad]; for the refined estimate.
    pub odometry_yaw_error: f64,
    /// Learn the wheels' slip where the walls tell the place, and take it out of odometry; for the refined estimate.
    pub learn_slip: bool,
    /// Let the noise grow with the slip that the filter sees.
    pub adaptive: bool,
    /// Turn by the gyroscope's yaw rate, where there is one, in place of odometry's.
    pub use_imu: bool,
}

impl Default for MotionParameters {
    fn default() -> Self {
        Self {
            motion_model: MotionModel::Tum,
            noise_interval: 0.02,
            alpha_1_tum: 0.3,
            alpha_2_tum: 0.002,
            alpha_3_tum: 0.3,
            alpha_4_tum: 0.05,
            lam_thresh: 0.1,
            alpha_1_amcl: 0.5,
            alpha_2_amcl: 0.5,
            alpha_3_amcl: 0.3,
            alpha_4_amcl: 0.1,
            motion_dispersion_arc_x: 0.3,
            motion_dispersion_arc_y: 0.5,
            motion_dispersion_arc_theta: 0.5,
            motion_dispersion_arc_xy: 0.2,
            motion_dispersion_arc_x_min: 0.01,
            motion_dispersion_arc_y_min: 0.01,
            motion_dispersion_arc_y_max: 1.0,
            motion_dispersion_arc_theta_min: 0.01,
            motion_dispersion_arc_xy_min_x: 0.02,
            motion_dispersion_x: 0.05,
            motion_dispersion_y: 0.025,
            motion_dispersion_theta: 0.05,
            diffusion_xy: 0.02,
            diffusion_heading: 0.1,
            odometry_speed_error: 0.06,
            odometry_side_error: 0.15,
            odometry_yaw_error: 0.5,
            learn_slip: true,
            adaptive: false,
            use_imu: true,
        }
    }
}

impl MotionParameters {
    pub(crate) fn validate(&self, check: &mut Check) {
        check.range("noise_interval", self.noise_interval, 1e-3, 1.0);
        for (key, value) in [
            ("alpha_1_tum", self.alpha_1_tum),
            ("alpha_2_tum", self.alpha_2_tum),
            ("alpha_3_tum", self.alpha_3_tum),
            ("alpha_4_tum", self.alpha_4_tum),
            ("alpha_1_amcl", self.alpha_1_amcl),
            ("alpha_2_amcl", self.alpha_2_amcl),
            ("alpha_3_amcl", self.alpha_3_amcl),
            ("alpha_4_amcl", self.alpha_4_amcl),
            ("motion_dispersion_arc_x", self.motion_dispersion_arc_x),
            ("motion_dispersion_arc_y", self.motion_dispersion_arc_y),
            ("motion_dispersion_arc_theta", self.motion_dispersion_arc_theta),
            ("motion_dispersion_arc_xy", self.motion_dispersion_arc_xy),
            ("motion_dispersion_arc_x_min", self.motion_dispersion_arc_x_min),
            ("motion_dispersion_arc_y_min", self.motion_dispersion_arc_y_min),
            ("motion_dispersion_arc_y_max", self.motion_dispersion_arc_y_max),
            (
                "motion_dispersion_arc_theta_min",
                self.motion_dispersion_arc_theta_min,
            ),
            (
                "motion_dispersion_arc_xy_min_x",
                self.motion_dispersion_arc_xy_min_x,
            ),
            ("motion_dispersion_x", self.motion_dispersion_x),
            ("motion_dispersion_y", self.motion_dispersion_y),
            ("motion_dispersion_theta", self.motion_dispersion_theta),
        ] {
            check.range(key, value, 0.0, 10.0);
        }
        check.range("lam_thresh", self.lam_thresh, 1e-3, 10.0);
        check.range("diffusion_xy", self.diffusion_xy, 0.0, 1.0);
        check.range("diffusion_heading", self.diffusion_heading, 0.0, 1.0);
        check.range("odometry_speed_error", self.odometry_speed_error, 1e-3, 2.0);
        check.range("odometry_side_error", self.odometry_side_error, 1e-3, 2.0);
        check.range("odometry_yaw_error", self.odometry_yaw_error, 1e-3, 2.0);
    }
}

/// The distribution of one motion, ready to be drawn from once per particle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Motion {
    /// Turn by `rot1`, drive `trans` along the new heading, turn by `rot2`.
    Polar {
        /// Means of rot1 [rad], trans [m], rot2 [rad].
        mean: [f32; 3],
        /// Standard deviations of the same.
        sigma: [f32; 3],
    },
    /// Move by x, y [m] in the car's frame, then turn.
    Body {
        /// Means of x [m], y [m], turn [rad].
        mean: [f32; 3],
        /// Standard deviations of the same.
        sigma: [f32; 3],
    },
}

impl Motion {
    /// The motion `delta` of `base_link` over `dt` [s]. `widen` scales the noise (1 as tuned).
    pub(crate) fn new(
        delta: Pose,
        dt: f64,
        widen: f64,
        parameters: &MotionParameters,
        defects: Defects,
    ) -> Self {
        // Variances add up over the intervals; each interval sees its share of the motion.
        let intervals = if defects.defect_noise_per_message {
            1.0
        } else {
            (dt / parameters.noise_interval).max(1e-3)
        };
        let grow = intervals.sqrt() * widen;
        let per = |value: f64| value.abs() / intervals;
        let floor_xy = parameters.diffusion_xy * dt.max(0.0).sqrt();
        let floor_heading = parameters.diffusion_heading * dt.max(0.0).sqrt();
        let with_floor = |sigma: f64, floor: f64| (sigma * grow).hypot(floor) as f32;
        match parameters.motion_model {
            MotionModel::Tum | MotionModel::Amcl => {
                let (rot1, trans, rot2) = rotate_drive_rotate(delta);
                let (step, turn1, turn2) = (per(trans), per(rot1), per(rot2));
                let (sigma1, sigma2, sigma_trans) = if parameters.motion_model == MotionModel::Tum {
                    let slow = parameters.alpha_2_tum / step.max(parameters.lam_thresh);
                    (
                        parameters.alpha_1_tum * turn1 + slow,
                        parameters.alpha_1_tum * turn2 + slow,
                        parameters.alpha_3_tum * step + parameters.alpha_4_tum * (turn1 + turn2),
                    )
                } else {
                    (
                        parameters.alpha_1_amcl * turn1 + parameters.alpha_2_amcl * step,
                        parameters.alpha_1_amcl * turn2 + parameters.alpha_2_amcl * step,
                        parameters.alpha_3_amcl * step + parameters.alpha_4_amcl * (turn1 + turn2),
                    )
                };
                let mut mean = [rot1, trans, rot2];
                if defects.defect_unsigned_rotation {
                    mean = [rot1.abs(), trans, rot2.abs()];
                }
                if defects.defect_biased_translation {
                    mean[1] += 0.5 * sigma_trans * grow * trans.signum();
                }
                Self::Polar {
                    mean: mean.map(|v| v as f32),
                    sigma: [
                        with_floor(sigma1, floor_heading),
                        with_floor(sigma_trans, floor_xy),
                        with_floor(sigma2, floor_heading),
                    ],
                }
            }
            MotionModel::Arc => {
                let p = parameters;
                let (x, y, turn) = (per(delta.x), per(delta.y), per(delta.heading));
                let from_x = if x > p.motion_dispersion_arc_xy_min_x {
                    p.motion_dispersion_arc_xy * x
                } else {
                    0.0
                };
                let sigma_y = (p.motion_dispersion_arc_y * y + from_x).clamp(
                    p.motion_dispersion_arc_y_min.min(p.motion_dispersion_arc_y_max),
                    p.motion_dispersion_arc_y_max,
                );
                Self::Body {
                    mean: [delta.x, delta.y, delta.heading].map(|v| v as f32),
                    sigma: [
                        with_floor(
                            (p.motion_dispersion_arc_x * x).max(p.motion_dispersion_arc_x_min),
                            floor_xy,
                        ),
                        with_floor(sigma_y, floor_xy),
                        with_floor(
                            (p.motion_dispersion_arc_theta * turn).max(p.motion_dispersion_arc_theta_min),
                            floor_heading,
                        ),
                    ],
                }
            }
            MotionModel::Mit => Self::Body {
                mean: [delta.x, delta.y, delta.heading].map(|v| v as f32),
                sigma: [
                    with_floor(parameters.motion_dispersion_x, floor_xy),
                    with_floor(parameters.motion_dispersion_y, floor_xy),
                    with_floor(parameters.motion_dispersion_theta, floor_heading),
                ],
            },
        }
    }
}

/// A motion as a turn, a straight and a turn (Probabilistic Robotics, table 5.6), signed: a car that reverses
/// drives a negative straight, and one that hardly moves turns once.
fn rotate_drive_rotate(delta: Pose) -> (f64, f64, f64) {
    let distance = delta.x.hypot(delta.y);
    if distance < 1e-4 {
        return (0.0, 0.0, delta.heading);
    }
    let (rot1, trans) = if delta.x >= 0.0 {
        (delta.y.atan2(delta.x), distance)
    } else {
        ((-delta.y).atan2(-delta.x), -distance)
    };
    (rot1, trans, maps::wrap_angle(delta.heading - rot1))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn motion(model: MotionModel, delta: Pose, dt: f64) -> Motion {
        let parameters = MotionParameters {
            motion_model: model,
            ..MotionParameters::default()
        };
        Motion::new(delta, dt, 1.0, &parameters, Defects::default())
    }

    /// Where a particle at the origin goes without noise.
    fn mean(motion: Motion) -> Pose {
        match motion {
            Motion::Polar {
                mean: [rot1, trans, rot2],
                ..
            } => {
                let (rot1, trans, rot2) = (f64::from(rot1), f64::from(trans), f64::from(rot2));
                Pose::new(trans * rot1.cos(), trans * rot1.sin(), rot1 + rot2)
            }
            Motion::Body {
                mean: [x, y, turn], ..
            } => Pose::new(x.into(), y.into(), turn.into()),
        }
    }

    const MODELS: [MotionModel; 4] = [
        MotionModel::Tum,
        MotionModel::Amcl,
        MotionModel::Arc,
        MotionModel::Mit,
    ];

    #[test]
    fn without_noise_every_model_follows_odometry() {
        let motions = [
            Pose::new(0.2, 0.01, 0.1),
            Pose::new(0.2, -0.01, -0.1),
            Pose::new(-0.1, 0.02, 0.05),
            Pose::new(0.0, 0.0, -0.2),
            Pose::IDENTITY,
        ];
        for model in MODELS {
            for delta in motions {
                let at = mean(motion(model, delta, 0.025));
                assert!(
                    at.distance(delta) < 1e-6 && (at.heading - delta.heading).abs() < 1e-6,
                    "{model:?} {delta:?}"
                );
            }
        }
    }

    #[test]
    fn noise_does_not_depend_on_how_many_messages_a_motion_came_in() {
        for model in MODELS {
            let sigma = |motion| match motion {
                Motion::Polar { sigma, .. } | Motion::Body { sigma, .. } => sigma,
            };
            let whole = sigma(motion(model, Pose::new(0.4, 0.0, 0.0), 0.1));
            let part = sigma(motion(model, Pose::new(0.04, 0.0, 0.0), 0.01));
            for (whole, part) in whole.iter().zip(part) {
                assert!(
                    (whole - part * 10f32.sqrt()).abs() < 1e-3 * whole.max(1e-3),
                    "{model:?}: {whole} {part}"
                );
            }
        }
    }

    #[test]
    fn unsigned_rotations_predict_left_where_the_car_goes_right() {
        let defects = Defects {
            defect_unsigned_rotation: true,
            ..Defects::default()
        };
        let right = Pose::new(0.2, -0.01, -0.1);
        let at = mean(Motion::new(
            right,
            0.025,
            1.0,
            &MotionParameters::default(),
            defects,
        ));
        assert!(at.y > 0.0);
    }
}
