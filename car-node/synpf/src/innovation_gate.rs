//! The innovation gate: which corrections of the prediction are believed.
//!
//! A fit finds the nearest place where many end points lie on walls. Where people, cars or changed walls fill the view, that may be
//! a place to which the car cannot have come since the scan before. So a correction that the prediction's covariance does
//! not explain (Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation*, section 5.4) needs one
//! of two reasons. Either the scan fits there as scans usually do: wheels have slipped, or the car was hit. Or scans ask for
//! the same place for a while: what stands in view goes by, a wrong pose stays.

use maps::Pose;
use nalgebra::{Matrix3, Vector3};

use crate::estimate::Estimate;
use crate::recovery::InDoubt;

/// What the gate knows of the scans so far.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct InnovationGate {
    /// Share of the end points that usually lie on walls.
    usual_fit: f64,
    refused: Option<Refused>,
}

/// The correction that the latest scans have asked for in vain.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Refused {
    /// From the prediction to the place.
    correction: Pose,
    /// Way over which they have \[m\].
    way: f64,
}

/// Share of the usual fit that makes a correction believable.
const AS_USUAL: f64 = 0.9;

/// The usual fit is never taken for less: many places fit as well as a pose that fits badly.
const LEAST_USUAL: f64 = 0.7;

/// Way over which the usual fit rises and falls to what scans show \[m\]: what stands in view only lowers it.
const RISES_OVER: f64 = 2.0;
const FALLS_OVER: f64 = 20.0;

/// Squared Mahalanobis distance that one correction of a hundred exceeds (three degrees of freedom).
const UNLIKELY: f64 = 11.3;

/// Smaller corrections are believed whatever the covariance says \[m\], \[rad\]: a cell of the map.
const NEAR: [f64; 2] = [0.02, 0.006];

/// After so long a way on which scans ask for one place it is believed [m]: half the depth of what one obstacle hides.
const BELIEVED_AFTER: f64 = 1.0;

/// Corrections that differ by less lead to one place \[m\], \[rad\].
const SAME: [f64; 2] = [0.2, 0.1];

impl Default for InnovationGate {
    fn default() -> Self {
        Self {
            usual_fit: LEAST_USUAL,
            refused: None,
        }
    }
}

impl InnovationGate {
    /// Whether the estimate may move from `predicted`, of this covariance, to `found`, where this share of the end points lies on
    /// walls.
    pub(crate) fn passes(
        &self,
        predicted: &Estimate,
        covariance: &Matrix3<f64>,
        found: Pose,
        on_walls: f64,
    ) -> bool {
        on_walls >= AS_USUAL * self.usual_fit.max(LEAST_USUAL)
            || is_likely(predicted.pose, covariance, found)
            || self.refused.is_some_and(|refused| {
                refused.way > BELIEVED_AFTER && is_same(refused.correction, found.since(predicted.pose))
            })
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

    /// Takes in the correction that a scan was refused, or that it was refused none, after `driven` \[m\].
    pub(crate) fn note_refused(&mut self, correction: Option<Pose>, driven: f64) {
        self.refused = correction.map(|correction| {
            let before = self
                .refused
                .filter(|refused| is_same(refused.correction, correction));
            let way = before.map_or(0.0, |refused| refused.way + driven.abs());
            Refused { correction, way }
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

fn is_same(a: Pose, b: Pose) -> bool {
    a.distance(b) < SAME[0] && maps::wrap_angle(a.heading - b.heading).abs() < SAME[1]
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

    fn passes(gate: &InnovationGate, to: Pose, on_walls: f64) -> bool {
        gate.passes(&known(), &known().covariance, to, on_walls)
    }

    #[test]
    fn a_leap_needs_a_scan_that_fits_as_usual() {
        let mut gate = InnovationGate::default();
        (0..100).for_each(|_| gate.learn_fit(0.95, 0.1));
        assert!(passes(&gate, Pose::new(0.02, 0.02, 0.0), 0.4));
        assert!(!passes(&gate, ASIDE, 0.6));
        assert!(passes(&gate, ASIDE, 0.9));
        assert!(!passes(&gate, Pose::new(0.0, 0.0, 0.6), 0.6));
    }

    #[test]
    fn a_pose_that_is_hardly_known_may_go_anywhere() {
        let wide = Matrix3::from_diagonal(&Vector3::new(0.25, 0.25, 0.1));
        assert!(InnovationGate::default().passes(&known(), &wide, ASIDE, 0.1));
    }

    #[test]
    fn a_place_that_scans_ask_for_all_along_is_believed() {
        let mut gate = InnovationGate::default();
        for step in 0..12 {
            assert!(!passes(&gate, ASIDE, 0.5), "after {step} steps");
            gate.note_refused(Some(ASIDE), 0.1);
        }
        assert!(passes(&gate, ASIDE, 0.5));
        assert!(
            gate.doubt(Pose::IDENTITY)
                .is_some_and(|doubt| doubt.probability > 0.49)
        );
        // Another place is none of it.
        assert!(!passes(&gate, Pose::new(0.4, 0.0, 0.0), 0.5));
    }

    #[test]
    fn places_that_change_from_scan_to_scan_are_not() {
        let mut gate = InnovationGate::default();
        for step in 0..40 {
            let aside = if step % 2 == 0 { 0.3 } else { -0.3 };
            let place = Pose::new(0.0, aside, 0.0);
            assert!(!passes(&gate, place, 0.5));
            gate.note_refused(Some(place), 0.1);
        }
        gate.note_refused(None, 0.1);
        assert_eq!(gate.doubt(Pose::IDENTITY), None);
    }
}
