//! Slip that the localizer has learned: how much less far, and how much more sideways, the car goes than its wheels say.
//!
//! Three numbers, estimated together with the pose. Where the walls tell the place, they are learned; along a featureless
//! straight, where only odometry tells the distance, they are applied. The scan knows nothing of them, so they are
//! corrected by their correlation with the pose alone (a Kalman filter with the slip in its state, computed in two
//! parts).

use maps::Pose;
use nalgebra::{Matrix3, Vector3};

use crate::estimate::{Estimate, carry};

/// What slip depends on at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Drive {
    /// Acceleration of the wheels [m/s^2].
    pub(crate) acceleration: f64,
    /// Lateral acceleration by wheels and gyroscope [m/s^2].
    pub(crate) lateral: f64,
}

/// Slip of tyres that are not at their limit, where it grows with the force (Pacejka, *Tire and Vehicle Dynamics*,
/// section 1.2).
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SlipModel {
    /// Share of the distance that odometry is long by, whatever the car does (a worn wheel); the same per wheel acceleration
    /// [s^2/m]; tangent of the sideslip, out of the bend, per lateral acceleration [s^2/m].
    mean: Vector3<f64>,
    covariance: Matrix3<f64>,
    /// Covariance of these three (rows) with the pose (columns).
    with_pose: Matrix3<f64>,
    /// Time since the wheels last spun or locked \[s\].
    gripping: f64,
}

/// Standard deviations before anything is known.
const UNKNOWN: [f64; 3] = [0.03, 0.006, 0.008];
/// How fast the floor and the tyres change, per square root of a second.
const CHANGE: [f64; 3] = [0.003, 0.001, 0.0005];
/// Wheels that gain or lose more than this [m/s^2] spin or lock: no tyre drives a car so...
const SPINNING: f64 = 8.0;
/// ...and go on to for a while \[s\].
const SPUN: f64 = 0.5;
/// A correction of more than this many standard deviations is no slip of tyres within their limit: wheels that spin or
/// lock, a collision, a marshal.
const UNEXPECTED: f64 = 2.5;
/// More is no slip of a car that can be driven.
const MOST: [f64; 3] = [0.15, 0.03, 0.03];

impl Default for SlipModel {
    fn default() -> Self {
        let variance = UNKNOWN.map(|sigma| sigma * sigma);
        Self {
            mean: Vector3::zeros(),
            covariance: Matrix3::from_diagonal(&Vector3::from(variance)),
            with_pose: Matrix3::zeros(),
            gripping: SPUN,
        }
    }
}

impl SlipModel {
    /// Share of the wheels' distance that was no motion of the car.
    pub(crate) fn share(&self, drive: Drive) -> f64 {
        (self.mean[0] + self.mean[1] * drive.acceleration).clamp(-0.3, 0.3)
    }

    /// The motion of a car whose wheels and gyroscope say `[x, y, turn]` (\[m\], \[m\], \[rad\] along an arc).
    pub(crate) fn corrected(&self, [x, y, turn]: [f64; 3], drive: Drive) -> [f64; 3] {
        // Driving force makes the wheels turn too far forwards, whichever way the car goes.
        let lost = self.mean[0] * x + self.mean[1] * drive.acceleration * x.abs();
        let limit = 0.3 * x.abs();
        let aside = (self.mean[2] * drive.lateral).clamp(-0.3, 0.3) * x.abs();
        [x - lost.clamp(-limit, limit), y - aside, turn]
    }

    /// Whether the wheels spin or lock, or did so just now: then they say little of the distance.
    pub(crate) fn spinning(&self) -> bool {
        self.gripping < SPUN
    }

    /// The pose has jumped, or is another's: what is known of it says nothing of the slip.
    pub(crate) fn forget_pose(&mut self) {
        self.with_pose = Matrix3::zeros();
    }

    /// The estimate was moved on from `from` to `predicted` by a motion of `distance` \[m\], which the slip was taken out of:
    /// adds what is unknown of the slip to the pose's covariance.
    pub(crate) fn advance(
        &mut self,
        from: Pose,
        predicted: &mut Estimate,
        distance: f64,
        drive: Drive,
        seconds: f64,
    ) {
        self.gripping += seconds;
        if drive.acceleration.abs() > SPINNING {
            self.gripping = 0.0;
        }
        let to = predicted.pose;
        let heading = from.heading + 0.5 * maps::wrap_angle(to.heading - from.heading);
        let (sin, cos) = heading.sin_cos();
        let along = Vector3::new(cos, sin, 0.0);
        let left = Vector3::new(-sin, cos, 0.0);
        let way = distance.abs();
        let pose_by_slip = Matrix3::from_columns(&[
            along * -distance,
            along * (-drive.acceleration * way),
            left * (-drive.lateral * way),
        ]);
        let moved = carry(from, to);
        let mixed = pose_by_slip * self.with_pose * moved.transpose();
        predicted.covariance +=
            pose_by_slip * self.covariance * pose_by_slip.transpose() + mixed + mixed.transpose();
        self.with_pose = self.with_pose * moved.transpose() + self.covariance * pose_by_slip.transpose();
        for i in 0..3 {
            let grown = self.covariance[(i, i)] + CHANGE[i].powi(2) * seconds;
            self.covariance[(i, i)] = grown.min(UNKNOWN[i].powi(2));
        }
    }

    /// A scan has moved the estimate from `predicted` to `found`: what correlates with the pose moves along.
    pub(crate) fn learn(&mut self, predicted: &Estimate, found: &Estimate) {
        let Some(root) = predicted.covariance.cholesky() else {
            return self.forget_pose();
        };
        let learned = predicted.covariance - found.covariance;
        let expected = (learned[(0, 0)] + learned[(1, 1)]).max(1e-6).sqrt();
        let surprise = found.pose.distance(predicted.pose) > UNEXPECTED * expected;
        if surprise || self.spinning() {
            return self.forget_pose();
        }
        let gain = self.with_pose * root.inverse();
        let moved = Vector3::new(
            found.pose.x - predicted.pose.x,
            found.pose.y - predicted.pose.y,
            maps::wrap_angle(found.pose.heading - predicted.pose.heading),
        );
        let covariance = self.covariance - gain * learned * gain.transpose();
        let mean = self.mean + gain * moved;
        let sound = mean.iter().all(|v| v.is_finite()) && (0..3).all(|i| covariance[(i, i)] > 1e-12);
        if !sound {
            *self = Self::default();
            return;
        }
        self.mean = Vector3::from_fn(|i, _| mean[i].clamp(-MOST[i], MOST[i]));
        self.covariance = (covariance + covariance.transpose()) * 0.5;
        self.with_pose = gain * found.covariance;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A car on a straight, its wheels long by 2 % and by 1 % per m/s^2. `seen` says in which steps the walls tell its
    /// place. Returns the model, the estimate and the true place at the end.
    fn drive(steps: usize, seen: impl Fn(usize) -> bool) -> (SlipModel, Estimate, f64) {
        let mut model = SlipModel::default();
        let known = Matrix3::from_diagonal(&Vector3::new(1e-4, 1e-4, 1e-6));
        let mut estimate = Estimate {
            pose: Pose::IDENTITY,
            covariance: known,
        };
        let mut place = 0.0;
        for step in 0..steps {
            let acceleration = if step % 40 < 20 { 3.0 } else { -3.0 };
            let drive = Drive {
                acceleration,
                lateral: 0.0,
            };
            let wheels = 0.1;
            place += wheels * (1.0 - 0.02 - 0.01 * acceleration);
            let motion = Pose::exp(model.corrected([wheels, 0.0, 0.0], drive));
            let noise = Matrix3::from_diagonal(&Vector3::new(1e-6, 1e-6, 1e-8));
            let mut predicted = estimate.moved(motion, &noise);
            model.advance(estimate.pose, &mut predicted, wheels, drive, 0.025);
            estimate = predicted;
            if seen(step) {
                let information = predicted.covariance.try_inverse().expect("regular");
                let at_wall = Matrix3::from_diagonal(&Vector3::new(1e4, 1e4, 1e6));
                let covariance = (information + at_wall).try_inverse().expect("regular");
                let share = covariance * at_wall;
                let off = Vector3::new(place - predicted.pose.x, 0.0, 0.0);
                let moved = share * off;
                estimate = Estimate {
                    pose: Pose::new(predicted.pose.x + moved[0], 0.0, 0.0),
                    covariance,
                };
                model.learn(&predicted, &estimate);
            }
        }
        (model, estimate, place)
    }

    #[test]
    fn slip_is_learned_where_the_place_is_seen() {
        let (model, _, _) = drive(400, |_| true);
        // The walls are good for 1 cm, and 400 steps are 40 m.
        assert!((model.mean[0] - 0.02).abs() < 0.002, "{:?}", model.mean);
        assert!((model.mean[1] - 0.01).abs() < 0.001, "{:?}", model.mean);
    }

    #[test]
    fn what_was_learned_counts_the_distance_where_nothing_is_seen() {
        // 30 m blind: raw odometry would be 60 cm off at their end.
        let (_, estimate, place) = drive(700, |step| step < 400);
        let off = estimate.pose.x - place;
        assert!(off.abs() < 0.06, "{off}");
        // The covariance owns up to it, within four sigma.
        assert!(off.abs() < 4.0 * estimate.covariance[(0, 0)].sqrt());
    }

    #[test]
    fn a_place_seen_again_corrects_distance_and_slip_together() {
        let (model, estimate, place) = drive(301, |step| step == 300);
        assert!((estimate.pose.x - place).abs() < 0.03);
        assert!(model.covariance[(0, 0)].sqrt() < 0.5 * UNKNOWN[0]);
        assert!((model.mean[0] - 0.02).abs() < 0.01, "{:?}", model.mean);
    }
}
