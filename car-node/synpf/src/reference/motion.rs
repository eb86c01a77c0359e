//! The reference's motion models, one tick of odometry at a time.

use maps::{Pose, wrap_angle};
use rand::rngs::SmallRng;
use rand_distr::{Distribution, StandardNormal};

use super::parameters::{ReferenceMotionModel, ReferenceParameters};

/// One tick of odometry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Step {
    /// The motion in the frame of its start.
    pub(super) motion: Pose,
    /// The motion before it.
    pub(super) before: Pose,
    /// How long it took \[s\].
    pub(super) seconds: f64,
    /// Odometry's forward speed at its end [m/s].
    pub(super) speed: f64,
}

/// The interval that the noise parameters refer to once they no longer count messages [s]: one message at 50 Hz.
const NOISE_INTERVAL: f64 = 0.02;
/// Shorter motions per message are thrown away, and have no direction \[m\].
const DEADBAND: f64 = 0.01;
/// A car that is slower than this reverses [m/s].
const REVERSING: f64 = -0.05;
/// The noise is wider by this in reverse.
const REVERSE_SPREAD: f64 = 1.1;

/// Draws a particle's motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Motion {
    /// Nothing moves.
    None,
    /// Turn by the first, drive the second along the new heading turned by `offset`, turn by the third.
    Polar {
        mean: [f64; 3],
        sigma: [f64; 3],
        offset: f64,
    },
    /// Drive `x` along an arc that turns by the third, then move `y` sideways.
    Arc {
        mean: [f64; 3],
        sigma: [f64; 3],
        mirrored: bool,
    },
    /// Move in the car's frame, then add noise along the map's axes.
    Body { mean: [f64; 3], sigma: [f64; 3] },
}

impl Motion {
    pub(super) fn new(step: &Step, parameters: &ReferenceParameters) -> Self {
        let defects = parameters.defects;
        // As if the motion had come in messages of the usual interval, whose variances add up.
        let messages = if defects.defect_noise_per_message {
            1.0
        } else {
            (step.seconds / NOISE_INTERVAL).max(1e-3)
        };
        match parameters.motion_model {
            ReferenceMotionModel::Tum | ReferenceMotionModel::Amcl => polar(step, messages, parameters),
            ReferenceMotionModel::Arc => arc(step, messages, parameters),
            ReferenceMotionModel::Default => {
                let sigma = [
                    parameters.noise.motion_dispersion_x,
                    parameters.noise.motion_dispersion_y,
                    parameters.noise.motion_dispersion_theta,
                ];
                Self::Body {
                    mean: components(step.action(parameters)),
                    sigma: sigma.map(|v| v * messages.sqrt()),
                }
            }
        }
    }

    /// Moves a particle's x, y \[m\] and heading \[rad\].
    pub(super) fn apply(&self, [x, y, heading]: [f64; 3], rng: &mut SmallRng) -> [f64; 3] {
        let mut draw = |mean: [f64; 3], sigma: [f64; 3]| {
            [0, 1, 2].map(|i| {
                let normal: f64 = StandardNormal.sample(rng);
                mean[i] + sigma[i] * normal
            })
        };
        match *self {
            Self::None => [x, y, heading],
            Self::Polar { mean, sigma, offset } => {
                let [rot1, trans, rot2] = draw(mean, sigma);
                let (sin, cos) = (heading + rot1 + offset).sin_cos();
                [x + trans * cos, y + trans * sin, heading + rot1 + rot2]
            }
            Self::Arc {
                mean,
                sigma,
                mirrored,
            } => {
                let [forward, sideways, turn] = draw(mean, sigma);
                let [x, y] = along_arc([x, y], heading, forward, turn, mirrored);
                let (sin, cos) = (heading + turn).sin_cos();
                [x - sideways * sin, y + sideways * cos, heading + turn]
            }
            Self::Body { mean, sigma } => {
                let [nx, ny, nh] = draw([0.0; 3], sigma);
                let (sin, cos) = heading.sin_cos();
                [
                    x + cos * mean[0] - sin * mean[1] + nx,
                    y + sin * mean[0] + cos * mean[1] + ny,
                    heading + mean[2] + nh,
                ]
            }
        }
    }
}

impl Step {
    /// The motion that `arc` and `default` apply.
    fn action(&self, parameters: &ReferenceParameters) -> Pose {
        if parameters.defects.defect_late_odometry {
            self.before
        } else {
            self.motion
        }
    }
}

fn components(pose: Pose) -> [f64; 3] {
    [pose.x, pose.y, pose.heading]
}

/// The models `tum` and `amcl`.
fn polar(step: &Step, messages: f64, parameters: &ReferenceParameters) -> Motion {
    let defects = parameters.defects;
    let Pose { x, y, heading } = step.motion;
    let trans = x.hypot(y);
    if defects.defect_deadband && trans < DEADBAND {
        return Motion::None;
    }
    let (offset, spread) = if step.speed < REVERSING {
        (std::f64::consts::PI, REVERSE_SPREAD)
    } else {
        (0.0, 1.0)
    };
    let rot1 = if trans > DEADBAND {
        wrap_angle(y.atan2(x) - offset)
    } else {
        0.0
    };
    let rot2 = wrap_angle(heading - rot1);
    let (fold1, fold2) = (folded(rot1), folded(rot2));
    let mean = if defects.defect_unsigned_rotation {
        [fold1, trans, fold2]
    } else {
        [rot1, trans, rot2]
    };
    let (turn1, drive, turn2) = (fold1 / messages, trans / messages, fold2 / messages);
    let p = &parameters.noise;
    let sigma = if parameters.motion_model == ReferenceMotionModel::Amcl {
        [
            p.alpha_1_amcl * turn1 + p.alpha_2_amcl * drive,
            p.alpha_3_amcl * drive + p.alpha_4_amcl * (turn1 + turn2),
            p.alpha_1_amcl * turn2 + p.alpha_2_amcl * drive,
        ]
    } else {
        let slow = p.alpha_2_tum / drive.max(p.lam_thresh);
        [
            p.alpha_1_tum * turn1 + slow,
            p.alpha_3_tum * drive + p.alpha_4_tum * (turn1 + turn2),
            p.alpha_1_tum * turn2 + slow,
        ]
    };
    let sigma = sigma.map(|v| v * spread * messages.sqrt());
    let bias = if defects.defect_biased_translation {
        0.5 * sigma[1]
    } else {
        0.0
    };
    Motion::Polar {
        mean: [mean[0], mean[1] + bias, mean[2]],
        sigma,
        offset,
    }
}

/// The size of a rotation, to the nearer of straight ahead and straight back \[rad\].
fn folded(rotation: f64) -> f64 {
    let size = rotation.abs();
    size.min(std::f64::consts::PI - size)
}

fn arc(step: &Step, messages: f64, parameters: &ReferenceParameters) -> Motion {
    let p = &parameters.noise;
    let mean = components(step.action(parameters));
    let [x, y, turn] = mean.map(|v| v.abs() / messages);
    let from_x = p.motion_dispersion_arc_xy * (x - p.motion_dispersion_arc_xy_min_x).max(0.0);
    let sigma = [
        (p.motion_dispersion_arc_x * x).max(p.motion_dispersion_arc_x_min),
        (p.motion_dispersion_arc_y * y + from_x)
            .max(p.motion_dispersion_arc_y_min)
            .min(p.motion_dispersion_arc_y_max),
        (p.motion_dispersion_arc_theta * turn).max(p.motion_dispersion_arc_theta_min),
    ];
    Motion::Arc {
        mean,
        sigma: sigma.map(|v| v * messages.sqrt()),
        mirrored: parameters.defects.defect_mirrored_arc,
    }
}

/// The end of an arc of length `forward` that turns by `turn`.
fn along_arc([x, y]: [f64; 2], heading: f64, forward: f64, turn: f64, mirrored: bool) -> [f64; 2] {
    if !mirrored {
        let end = Pose::new(x, y, heading) * Pose::exp([forward, 0.0, turn]);
        return [end.x, end.y];
    }
    // The signed radius and the side of the centre both change sign with the turn.
    let turn = if turn == 0.0 { f64::MIN_POSITIVE } else { turn };
    let radius = forward / turn;
    let side = heading + std::f64::consts::FRAC_PI_2.copysign(turn);
    let centre = [x + radius * side.cos(), y + radius * side.sin()];
    let from_centre = (y - centre[1]).atan2(x - centre[0]) + turn;
    let end = [
        centre[0] + radius * from_centre.cos(),
        centre[1] + radius * from_centre.sin(),
    ];
    if end[0].is_finite() && end[1].is_finite() {
        end
    } else {
        [x + forward * heading.cos(), y + forward * heading.sin()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    fn step(motion: Pose, speed: f64) -> Step {
        Step {
            motion,
            before: Pose::IDENTITY,
            seconds: 0.02,
            speed,
        }
    }

    fn mended(model: ReferenceMotionModel) -> ReferenceParameters {
        let mut parameters = ReferenceParameters {
            motion_model: model,
            ..ReferenceParameters::default()
        };
        parameters.defects.defect_unsigned_rotation = false;
        parameters.defects.defect_biased_translation = false;
        parameters.defects.defect_late_odometry = false;
        parameters.defects.defect_mirrored_arc = false;
        parameters
    }

    /// Mean of the particles that start at a pose.
    fn mean_of(motion: &Motion, from: Pose) -> [f64; 3] {
        let mut rng = SmallRng::seed_from_u64(1);
        let count = 100_000;
        let mut sum = [0.0; 3];
        for _ in 0..count {
            let moved = motion.apply([from.x, from.y, from.heading], &mut rng);
            for (sum, value) in sum.iter_mut().zip(moved) {
                *sum += value / f64::from(count);
            }
        }
        sum
    }

    #[test]
    fn mended_models_follow_odometry() {
        for model in [
            ReferenceMotionModel::Tum,
            ReferenceMotionModel::Arc,
            ReferenceMotionModel::Default,
        ] {
            for turn in [0.05, -0.05] {
                let delta = Pose::exp([0.1, 0.0, turn]);
                let [x, y, heading] =
                    mean_of(&Motion::new(&step(delta, 5.0), &mended(model)), Pose::IDENTITY);
                // Five standard deviations of a mean of 100 000 draws of 0.1 m and 0.25 rad.
                let expected = [delta.x, delta.y, delta.heading];
                for (value, wanted) in [x, y, heading].into_iter().zip(expected) {
                    assert!(
                        (value - wanted).abs() < 5e-3,
                        "{model:?} {turn}: {value} {wanted}"
                    );
                }
            }
        }
    }

    #[test]
    fn right_turns_predict_left_and_steps_are_half_again_as_long() {
        let parameters = ReferenceParameters::default();
        let right = Pose::exp([0.1, 0.0, -0.1]);
        let [x, y, heading] = mean_of(&Motion::new(&step(right, 5.0), &parameters), Pose::IDENTITY);
        assert!(heading > 0.09 && y > 0.003, "{y} {heading}");
        assert!((0.148..0.156).contains(&x), "{x}");
    }

    #[test]
    fn slow_motion_is_thrown_away() {
        let slow = step(Pose::new(0.009, 0.0, 0.1), 0.45);
        assert_eq!(Motion::new(&slow, &ReferenceParameters::default()), Motion::None);
        let mut parameters = ReferenceParameters::default();
        parameters.defects.defect_deadband = false;
        assert_ne!(Motion::new(&slow, &parameters), Motion::None);
    }

    #[test]
    fn in_reverse_the_car_goes_back_with_wider_noise() {
        let back = step(Pose::new(-0.05, 0.0, 0.0), -2.5);
        let Motion::Polar { mean, sigma, offset } = Motion::new(&back, &mended(ReferenceMotionModel::Tum))
        else {
            panic!("a polar model");
        };
        assert!(mean[0].abs() < 1e-9 && mean[2].abs() < 1e-9, "{mean:?}");
        assert!((offset - std::f64::consts::PI).abs() < 1e-12);
        assert!((sigma[1] - 1.1 * 0.05).abs() < 1e-12, "{sigma:?}");
    }

    #[test]
    fn the_arc_s_centre_is_mirrored_in_right_turns_alone() {
        let at = |turn: f64| along_arc([0.0, 0.0], 0.0, 0.1, turn, true);
        let [x, y] = at(0.05);
        assert!((x - 0.1).abs() < 1e-3 && (y - 0.0025).abs() < 1e-4);
        assert!(at(-0.05)[1] > 3.0, "twice the radius off");
    }

    #[test]
    fn noise_counts_messages_as_shipped_and_time_when_mended() {
        let whole = Step {
            seconds: 0.04,
            ..step(Pose::new(0.2, 0.0, 0.0), 5.0)
        };
        let sigma = |parameters: &ReferenceParameters| match Motion::new(&whole, parameters) {
            Motion::Polar { sigma, .. } => sigma[1],
            _ => f64::NAN,
        };
        let mut parameters = ReferenceParameters::default();
        assert!((sigma(&parameters) - 0.2).abs() < 1e-12);
        parameters.defects.defect_noise_per_message = false;
        // Two messages of 0.1 m.
        assert!((sigma(&parameters) - 0.1 * 2f64.sqrt()).abs() < 1e-12);
    }
}
