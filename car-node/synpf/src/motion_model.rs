//! Motion models: how a particle moves when odometry reports a motion.
//!
//! All four keep the sign of the motion. Their noise depends on the motion and its duration, not on the number of
//! messages that it came in: the parameters refer to the motion in one [`MotionParameters::noise_interval`], and the
//! variances of the intervals add up.

use maps::Pose;
use serde::{Deserialize, Serialize};

use crate::motion_noise::MotionNoise;
use crate::validation::Check;

/// Which motion model moves the particles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MotionModel {
    /// Rotate, drive, rotate. The rotation noise falls with speed, because a fast car cannot turn on the spot (Stahl et
    /// al., IV 2019).
    Tum,
    /// Rotate, drive, rotate (Probabilistic Robotics, table 5.6; AMCL's `diff-corrected`).
    Amcl,
    /// Noise on forward, sideways and turning motion; the sideways noise grows with the distance driven (the reference's
    /// `arc`).
    Arc,
    /// Constant noise on forward, sideways and turning motion (Walsh and Karaman, ICRA 2018).
    Mit,
}

/// Parameters of the motion models.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct MotionParameters {
    /// Which model.
    pub motion_model: MotionModel,
    /// The interval that the parameters of the four models refer to \[s\]: one message of odometry at 50 Hz.
    pub noise_interval: f64,
    /// The noise of each model.
    #[serde(flatten)]
    pub noise: MotionNoise,
    /// Noise on the position that every model adds [m/sqrt(s)], so that copies of a particle separate.
    pub diffusion_xy: f64,
    /// Noise on the heading that every model adds [rad/sqrt(s)].
    pub diffusion_heading: f64,
    /// Error of odometry's speed that remains once slip is learned, as a share of the speed [m/m]; for the fitted estimate.
    pub odometry_speed_error: f64,
    /// Sideways motion that odometry misses, as a share of the distance [m/m]; for the fitted estimate.
    pub odometry_side_error: f64,
    /// Error of odometry's turn as a share of the turn [rad/rad]; for the fitted estimate.
    pub odometry_yaw_error: f64,
    /// Learn the wheels' slip where the scan fixes the position, and correct odometry by it; for the fitted estimate.
    pub learn_slip: bool,
    /// Let the noise grow with the estimated slip.
    pub adaptive: bool,
    /// Turn by the gyroscope's yaw rate instead of odometry's where there is a gyroscope.
    pub use_imu: bool,
}

impl Default for MotionParameters {
    fn default() -> Self {
        Self {
            motion_model: MotionModel::Tum,
            noise_interval: 0.02,
            noise: MotionNoise::default(),
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
        self.noise.validate(check);
        check.range("diffusion_xy", self.diffusion_xy, 0.0, 1.0);
        check.range("diffusion_heading", self.diffusion_heading, 0.0, 1.0);
        check.range("odometry_speed_error", self.odometry_speed_error, 1e-3, 2.0);
        check.range("odometry_side_error", self.odometry_side_error, 1e-3, 2.0);
        check.range("odometry_yaw_error", self.odometry_yaw_error, 1e-3, 2.0);
    }
}

/// The distribution of one motion, from which each particle draws its own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Motion {
    /// Turn by `rot1`, drive `trans` along the new heading, turn by `rot2`.
    Polar {
        /// Means of rot1 \[rad\], trans \[m\], rot2 \[rad\].
        mean: [f32; 3],
        /// Standard deviations of the same.
        sigma: [f32; 3],
    },
    /// Move by x, y \[m\] in the car's frame, then turn.
    Body {
        /// Means of x \[m\], y \[m\], turn \[rad\].
        mean: [f32; 3],
        /// Standard deviations of the same.
        sigma: [f32; 3],
    },
}

impl Motion {
    /// The motion `delta` of `base_link` over `dt` \[s\]. `widen` scales the noise of the model; 1 leaves it as tuned.
    pub(crate) fn new(delta: Pose, dt: f64, widen: f64, parameters: &MotionParameters) -> Self {
        // Each interval has its share of the motion, and the variances of the intervals add up.
        let intervals = (dt / parameters.noise_interval).max(1e-3);
        let grow = intervals.sqrt() * widen;
        let per = |value: f64| value.abs() / intervals;
        let floor_xy = parameters.diffusion_xy * dt.max(0.0).sqrt();
        let floor_heading = parameters.diffusion_heading * dt.max(0.0).sqrt();
        let with_floor = |sigma: f64, floor: f64| (sigma * grow).hypot(floor) as f32;
        match parameters.motion_model {
            MotionModel::Tum | MotionModel::Amcl => {
                let p = &parameters.noise;
                let (rot1, trans, rot2) = rotate_drive_rotate(delta);
                let (step, turn1, turn2) = (per(trans), per(rot1), per(rot2));
                let (sigma1, sigma2, sigma_trans) = if parameters.motion_model == MotionModel::Tum {
                    let slow = p.alpha_2_tum / step.max(p.lam_thresh);
                    (
                        p.alpha_1_tum * turn1 + slow,
                        p.alpha_1_tum * turn2 + slow,
                        p.alpha_3_tum * step + p.alpha_4_tum * (turn1 + turn2),
                    )
                } else {
                    let [turn1, turn2, step] = [turn1, turn2, step].map(|v| v * v);
                    (
                        (p.alpha_1_amcl * turn1 + p.alpha_2_amcl * step).sqrt(),
                        (p.alpha_1_amcl * turn2 + p.alpha_2_amcl * step).sqrt(),
                        (p.alpha_3_amcl * step + p.alpha_4_amcl * (turn1 + turn2)).sqrt(),
                    )
                };
                Self::Polar {
                    mean: [rot1, trans, rot2].map(|v| v as f32),
                    sigma: [
                        with_floor(sigma1, floor_heading),
                        with_floor(sigma_trans, floor_xy),
                        with_floor(sigma2, floor_heading),
                    ],
                }
            }
            MotionModel::Arc => {
                let p = &parameters.noise;
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
                    with_floor(parameters.noise.motion_dispersion_x, floor_xy),
                    with_floor(parameters.noise.motion_dispersion_y, floor_xy),
                    with_floor(parameters.noise.motion_dispersion_theta, floor_heading),
                ],
            },
        }
    }
}

/// A motion as a rotation, a translation and a rotation (Probabilistic Robotics, table 5.6).
///
/// A car that reverses has a negative translation, where the table turns the car around and back. A car that hardly
/// moves has one rotation.
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
        Motion::new(delta, dt, 1.0, &parameters)
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

    /// `amcl` used to add standard deviations where table 5.6 and AMCL add variances.
    #[test]
    fn amcl_adds_variances_as_table_5_6_does() {
        // sample(b^2) of the table has the variance b^2. A turn of 0.3 rad, 0.4 m straight on, a turn of -0.1 rad:
        let (rot1, trans, rot2) = (0.3f64, 0.4f64, -0.1f64);
        let delta = Pose::new(trans * rot1.cos(), trans * rot1.sin(), rot1 + rot2);
        let parameters = MotionParameters {
            motion_model: MotionModel::Amcl,
            noise: MotionNoise {
                alpha_1_amcl: 0.2,
                alpha_2_amcl: 0.3,
                alpha_3_amcl: 0.5,
                alpha_4_amcl: 0.7,
                ..MotionNoise::default()
            },
            diffusion_xy: 0.0,
            diffusion_heading: 0.0,
            ..MotionParameters::default()
        };
        let Motion::Polar { sigma, .. } = Motion::new(delta, parameters.noise_interval, 1.0, &parameters)
        else {
            panic!("rotate, drive, rotate");
        };
        let expected = [
            0.2 * rot1 * rot1 + 0.3 * trans * trans,
            0.5 * trans * trans + 0.7 * (rot1 * rot1 + rot2 * rot2),
            0.2 * rot2 * rot2 + 0.3 * trans * trans,
        ];
        for (sigma, variance) in sigma.into_iter().zip(expected) {
            assert!(
                (f64::from(sigma).powi(2) / variance - 1.0).abs() < 1e-5,
                "{sigma}"
            );
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
}
