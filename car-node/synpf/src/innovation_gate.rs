//! The innovation gate: which corrections of the prediction are believed.
//!
//! A fit finds the nearest place where many end points lie on walls. Where people, cars or changed walls fill the view, that may be
//! a place to which the car cannot have come. So a correction that odometry's errors do not explain (Bar-Shalom, Li and
//! Kirubarajan, *Estimation with Applications to Tracking and Navigation*, section 5.4) is refused. That holds for one correction,
//! and for all of them since a scan last fitted as scans usually do: many small ones drag a pose along as well.
//!
//! Such a correction needs one of two reasons. Either the scan fits there as scans usually do, and the car can have moved so far
//! since a scan last moved the pose: tyres near their limit slide, and a car that grips can be hit. Or scans ask for the same place for a while: what stands in view goes by, a wrong
//! pose stays.
//!
//! Where hardly more than half of a view lies on walls, no fit is believed for fitting as usual, and odometry's errors are those that it
//! has shown ([`OdometryDrift`]), as far as they are small.

use maps::Pose;
use nalgebra::{Matrix3, Vector3};

use crate::estimate::{Estimate, are_near};
use crate::odometry_drift::{Fitted, OdometryDrift};
use crate::recovery::InDoubt;

/// What the gate knows of the scans so far.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct InnovationGate {
    /// Share of the end points that usually lie on walls.
    usual_fit: f64,
    /// Time since a scan last moved the pose \[s\].
    held: f64,
    /// Time since the tyres were last near their limit \[s\].
    gripping: f64,
    refused: Option<Refused>,
    drift: OdometryDrift,
}

/// The correction that the latest scans have asked for in vain.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Refused {
    /// From the prediction to the place that the first of them asked for, where that is by now.
    correction: Pose,
    /// Way over which they have \[m\].
    way: f64,
}

/// What becomes of a correction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// Odometry may have erred so much; whether the car is there remains to be seen.
    Likely,
    /// The car is there, whatever odometry says.
    Believed,
    /// The car can hardly be there.
    Refused,
}

/// Share of the usual fit that makes a correction believable.
const AS_USUAL: f64 = 0.9;

/// For a leap the usual fit is taken for no less: many places fit as well as a pose that fits badly.
const LEAST_USUAL: f64 = 0.7;

/// Way over which the usual fit rises and falls to what scans show \[m\]: what stands in view only lowers it.
const RISES_OVER: f64 = 2.0;
const FALLS_OVER: f64 = 20.0;

/// Squared Mahalanobis distance that one correction of a hundred exceeds (three degrees of freedom).
const UNLIKELY: f64 = 11.3;

/// Smaller corrections are believed whatever the covariance says \[m\], \[rad\]: a cell of the map.
const NEAR: [f64; 2] = [0.02, 0.006];

/// How fast a car whose tyres grip may move other than its odometry says [m/s]: another car hits it.
const FASTEST: f64 = 3.0;

/// From this acceleration on tyres may slide [m/s^2]: those of the paper's slippery car do at 5.4 (19 N on 3.5 kg, section III).
const SLIDING: f64 = 4.5;

/// Where so many end points lie on walls, a car that slides may be anywhere near.
const CLEAR_VIEW: f64 = 0.9;

/// A slide lasts so long \[s\].
const SLID: f64 = 0.5;

/// After so long a way on which scans ask for one place it is believed [m]: half the depth of what one obstacle hides.
const BELIEVED_AFTER: f64 = 1.0;

/// Where fewer end points lie on walls, people and cars fill the view. Points up to 0.3 m beside a wall count in part, so that this is
/// about half of them.
const FILLED: f64 = 0.6;

/// In such a view a place is believed after this way \[m\]: people stand along a whole bend.
const BELIEVED_AFTER_FILLED: f64 = 4.0;

/// Corrections that differ by less lead to one place \[m\], \[rad\].
const SAME: [f64; 2] = [0.2, 0.1];

impl Default for InnovationGate {
    fn default() -> Self {
        Self {
            usual_fit: LEAST_USUAL,
            held: 0.0,
            gripping: 0.0,
            refused: None,
            drift: OdometryDrift::default(),
        }
    }
}

impl InnovationGate {
    /// Whether the estimate may move from `predicted`, of this covariance, to `found`, where this share of the end points lies on
    /// walls. `reckoned` is where odometry alone has carried the latest pose that was believed. `motion` and `seconds` are those
    /// since the scan before.
    pub(crate) fn judge(
        &self,
        (predicted, covariance): (&Estimate, &Matrix3<f64>),
        reckoned: &Estimate,
        found: Pose,
        on_walls: f64,
        (motion, seconds): (Pose, f64),
    ) -> Verdict {
        let usual = on_walls >= AS_USUAL * self.usual_fit;
        let drift = if on_walls < FILLED {
            self.drift
                .covariances(self.grips(), motion, [predicted.pose, reckoned.pose])
        } else {
            None
        };
        let by_reckoning = is_likely(reckoned.pose, &reckoned.covariance, found);
        let explained = match &drift {
            Some([own, whole]) => {
                by_reckoning
                    && is_likely(predicted.pose, own, found)
                    && is_likely(reckoned.pose, whole, found)
            }
            None => usual || by_reckoning,
        };
        let usual = usual && drift.is_none();
        if is_likely(predicted.pose, covariance, found) && explained {
            return if usual { Verdict::Believed } else { Verdict::Likely };
        }
        let correction = found.since(predicted.pose);
        let asked = self
            .refused
            .filter(|refused| are_near(carried(refused.correction, motion), correction, SAME));
        let spread = (covariance[(0, 0)] + covariance[(1, 1)]).sqrt();
        let slid = !self.grips() && on_walls > CLEAR_VIEW;
        let possible =
            slid || found.distance(predicted.pose) < FASTEST * (self.held + seconds) + 3.0 * spread;
        // Many places fit as well as a pose that usually fits badly.
        let fits = usual && on_walls >= AS_USUAL * LEAST_USUAL;
        let long = if drift.is_some() {
            BELIEVED_AFTER_FILLED
        } else {
            BELIEVED_AFTER
        };
        let asked_for_long = asked.is_some_and(|refused| refused.way > long);
        if fits && possible || asked_for_long {
            Verdict::Believed
        } else {
            Verdict::Refused
        }
    }

    /// Whether the tyres have been far from their limit for a while.
    pub(crate) fn grips(&self) -> bool {
        self.gripping > SLID
    }

    /// Takes in a fit where this share of the end points lies on walls, and odometry's motion and the time \[s\] since the scan before.
    pub(crate) fn learn_drift(
        &mut self,
        pose: Pose,
        on_walls: f64,
        (held, believed): (bool, bool),
        since_before: (Pose, f64),
    ) {
        let fitted = Fitted {
            pose,
            held,
            believed,
            usual: on_walls >= AS_USUAL * self.usual_fit,
        };
        self.drift.learn(fitted, self.gripping > 0.0, since_before);
    }

    /// Takes in the share of the end points that lie on walls at the estimate, after `driven` \[m\].
    pub(crate) fn learn_fit(&mut self, on_walls: f64, driven: f64) {
        let over = if on_walls > self.usual_fit {
            RISES_OVER
        } else {
            FALLS_OVER
        };
        let gain = 1.0 - (-driven.abs() / over).exp();
        self.usual_fit += gain * (on_walls - self.usual_fit);
    }

    /// Takes in the correction that a scan was refused, if any, and whether the whole scan was left out. `motion` and `seconds` are
    /// those since the scan before.
    pub(crate) fn note(
        &mut self,
        refused: Option<Pose>,
        held: bool,
        (motion, seconds): (Pose, f64),
        acceleration: f64,
    ) {
        self.gripping = if acceleration > SLIDING {
            0.0
        } else {
            self.gripping + seconds
        };
        self.held = if held { self.held + seconds } else { 0.0 };
        let before = self.refused.map(|before| Refused {
            correction: carried(before.correction, motion),
            way: before.way + motion.x.abs(),
        });
        self.refused = refused.map(|correction| {
            before
                .filter(|before| are_near(before.correction, correction, SAME))
                .unwrap_or(Refused { correction, way: 0.0 })
        });
    }

    /// The doubt about a pose that scans want elsewhere.
    pub(crate) fn doubt(&self, pose: Pose) -> Option<InDoubt> {
        let refused = self.refused.filter(|refused| refused.way > 0.0)?;
        Some(InDoubt {
            probability: 0.5 * (refused.way / BELIEVED_AFTER).min(1.0),
            rival: Some(pose * refused.correction),
        })
    }
}

/// A correction in the frame of the next prediction, of a pose that moved on with it.
fn carried(correction: Pose, motion: Pose) -> Pose {
    motion.inverse() * correction * motion
}

fn is_likely(predicted: Pose, covariance: &Matrix3<f64>, found: Pose) -> bool {
    let off = Vector3::new(
        found.x - predicted.x,
        found.y - predicted.y,
        maps::wrap_angle(found.heading - predicted.heading),
    );
    let near = off[0].hypot(off[1]) < NEAR[0] && off[2].abs() < NEAR[1];
    near || covariance
        .cholesky()
        .is_none_or(|root| off.dot(&root.solve(&off)) < UNLIKELY)
}

#[cfg(test)]
mod tests {
    use super::*;

    const ASIDE: Pose = Pose {
        x: 0.0,
        y: 0.3,
        heading: 0.0,
    };

    /// Known to 1 cm and 0.5 deg.
    fn known() -> Estimate {
        Estimate {
            pose: Pose::IDENTITY,
            covariance: Matrix3::from_diagonal(&Vector3::new(1e-4, 1e-4, 7.6e-5)),
        }
    }

    /// A laser at 40 Hz in a car at 4 m/s.
    const STEP: (Pose, f64) = (
        Pose {
            x: 0.1,
            y: 0.0,
            heading: 0.0,
        },
        0.025,
    );

    /// What the gate says of a move from a known pose, which odometry explains no better.
    fn judged(gate: &InnovationGate, to: Pose, on_walls: f64) -> Verdict {
        gate.judge((&known(), &known().covariance), &known(), to, on_walls, STEP)
    }

    /// A gate that has seen walls all along.
    fn in_a_sound_map() -> InnovationGate {
        let mut gate = InnovationGate::default();
        for _ in 0..100 {
            gate.learn_fit(0.95, 0.1);
            gate.note(None, false, STEP, 0.0);
        }
        gate
    }

    #[test]
    fn a_car_that_slides_in_a_clear_view_may_leap() {
        let mut gate = in_a_sound_map();
        assert_eq!(judged(&gate, ASIDE, 0.95), Verdict::Refused);
        gate.note(None, false, STEP, 6.0);
        assert_eq!(judged(&gate, ASIDE, 0.95), Verdict::Believed);
        // Cars that drive along look like walls.
        assert_eq!(judged(&gate, ASIDE, 0.88), Verdict::Refused);
    }

    /// People along a bend looked like its wall: the pose turned by 2 deg in a scan, which the set's odometry allows.
    #[test]
    fn in_a_filled_view_odometry_errs_as_it_has_shown() {
        let mut gate = in_a_sound_map();
        let loose = Matrix3::from_diagonal(&Vector3::new(2e-4, 2e-4, 1e-3));
        let judged = |gate: &InnovationGate, turn: f64, on_walls| {
            let found = Pose::new(0.01, 0.0, turn);
            gate.judge(
                (&known(), &loose),
                &Estimate {
                    covariance: loose,
                    ..known()
                },
                found,
                on_walls,
                STEP,
            )
        };
        assert_eq!(judged(&gate, 0.035, 0.5), Verdict::Likely, "nothing is known yet");
        let mut pose = Pose::IDENTITY;
        for _ in 0..80 {
            pose = pose * STEP.0;
            gate.learn_drift(pose, 0.95, (false, true), STEP);
        }
        assert_eq!(judged(&gate, 0.035, 0.5), Verdict::Refused);
        assert_eq!(judged(&gate, 0.005, 0.5), Verdict::Likely);
        assert_eq!(
            judged(&gate, 0.035, 0.7),
            Verdict::Likely,
            "most of the view are walls"
        );
    }

    #[test]
    fn a_leap_needs_a_scan_that_fits_as_usual() {
        let gate = in_a_sound_map();
        let pushed = Pose::new(0.0, 0.1, 0.0);
        assert_eq!(judged(&gate, Pose::new(0.02, 0.02, 0.0), 0.4), Verdict::Likely);
        assert_eq!(judged(&gate, pushed, 0.6), Verdict::Refused);
        assert_eq!(judged(&gate, pushed, 0.9), Verdict::Believed);
        assert_eq!(judged(&gate, Pose::new(0.0, 0.0, 0.6), 0.6), Verdict::Refused);
    }

    /// Where a wall is missing, a scan fits nearly as usual further back, where the wall was still there.
    #[test]
    fn a_leap_that_no_car_makes_in_the_time_is_refused_until_it_could_have() {
        let mut gate = in_a_sound_map();
        let mut refused = 0;
        while judged(&gate, ASIDE, 0.9) == Verdict::Refused {
            gate.note(Some(ASIDE), true, STEP, 0.0);
            refused += 1;
        }
        // 0.3 m at 3 m/s, less what the covariance allows.
        assert_eq!(refused, 3);
        // While scans move the pose, it may not leap.
        gate.note(Some(ASIDE), false, STEP, 0.0);
        assert_eq!(judged(&gate, ASIDE, 0.9), Verdict::Refused);
    }

    #[test]
    fn corrections_that_add_up_to_more_than_odometry_errs_are_refused() {
        let gate = in_a_sound_map();
        let back = Pose::new(-0.02, 0.0, 0.0);
        let wide = Matrix3::from_diagonal(&Vector3::new(0.01, 0.01, 0.01));
        let reckoned = Estimate {
            pose: Pose::new(0.5, 0.0, 0.0),
            covariance: wide,
        };
        let judged = |on_walls| {
            let own = (&known(), &known().covariance);
            gate.judge(own, &reckoned, back, on_walls, STEP)
        };
        assert_eq!(judged(0.6), Verdict::Refused);
        // A scan that fits as usual knows better than odometry.
        assert_eq!(judged(0.9), Verdict::Believed);
    }

    #[test]
    fn a_pose_that_is_hardly_known_may_go_anywhere() {
        let wide = Estimate {
            covariance: Matrix3::from_diagonal(&Vector3::new(0.25, 0.25, 0.1)),
            ..known()
        };
        let gate = InnovationGate::default();
        let verdict = gate.judge((&wide, &wide.covariance), &wide, ASIDE, 0.1, STEP);
        assert_eq!(verdict, Verdict::Likely);
    }

    #[test]
    fn a_place_that_scans_ask_for_all_along_is_believed() {
        let mut gate = InnovationGate::default();
        for step in 0..12 {
            assert_eq!(judged(&gate, ASIDE, 0.5), Verdict::Refused, "after {step} steps");
            gate.note(Some(ASIDE), false, STEP, 0.0);
        }
        assert_eq!(judged(&gate, ASIDE, 0.5), Verdict::Believed);
        assert!(
            gate.doubt(Pose::IDENTITY)
                .is_some_and(|doubt| doubt.probability > 0.49)
        );
        // Another place is none of it.
        assert_eq!(judged(&gate, Pose::new(0.4, 0.0, 0.0), 0.5), Verdict::Refused);
    }

    #[test]
    fn places_that_change_from_scan_to_scan_are_not() {
        let mut gate = InnovationGate::default();
        for step in 0..40 {
            let aside = if step % 2 == 0 { 0.3 } else { -0.3 };
            let place = Pose::new(0.0, aside, 0.0);
            assert_eq!(judged(&gate, place, 0.5), Verdict::Refused);
            gate.note(Some(place), false, STEP, 0.0);
        }
        gate.note(None, false, STEP, 0.0);
        assert_eq!(gate.doubt(Pose::IDENTITY), None);
    }

    /// The end of a wall stays behind while the car drives on: what it asks for grows with the way.
    #[test]
    fn a_place_that_falls_behind_is_not() {
        let mut gate = InnovationGate::default();
        for step in 0..40 {
            let place = Pose::new(-0.3 - 0.1 * f64::from(step), 0.0, 0.0);
            assert_eq!(judged(&gate, place, 0.5), Verdict::Refused, "after {step} steps");
            gate.note(Some(place), false, STEP, 0.0);
        }
    }

    /// The truth is seen from a wrong pose in a direction that turns with the car.
    #[test]
    fn a_place_is_the_same_though_the_car_turns() {
        let mut gate = InnovationGate::default();
        let step = (Pose::exp([0.1, 0.0, 0.1]), 0.025);
        let mut wrong = known();
        let mut right = ASIDE;
        let mut believed = false;
        for _ in 0..14 {
            let own = (&wrong, &wrong.covariance);
            believed = gate.judge(own, &wrong, right, 0.5, step) == Verdict::Believed;
            gate.note(Some(right.since(wrong.pose)), false, step, 0.0);
            wrong.pose = wrong.pose * step.0;
            right = right * step.0;
        }
        assert!(believed);
    }
}
