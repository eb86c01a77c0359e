//! The paper's grip test: a car at rest is pulled sideways until it slides.

use maps::Pose;
use serde::Serialize;

use crate::{Controls, Vehicle, VehicleParams};

/// Increase of the pull from one step to the next \[N\].
const FORCE_STEP: f64 = 0.1;

/// Duration of each step \[s\].
const HOLD: f64 = 0.5;

/// A car that moves sideways by more than this during a step slides \[m\]. Before that it only leans on its tyres.
const SLIDES: f64 = 0.01;

/// The result of a grip test.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GripTest {
    /// The greatest pull that the tyres hold \[N\].
    pub held_n: f64,
    /// How far the tyres have given way sideways under it \[m\].
    pub deflection_m: f64,
    /// Sideways speed of the car \[m/s\] after half a second at the next step, 0.1 N more.
    pub sliding_mps: f64,
}

impl GripTest {
    /// Pulls at the car's centre of gravity, to the left, in steps of 0.1 N and half a second. The wheels point straight on, the
    /// motor holds them.
    pub fn of(params: &VehicleParams) -> Self {
        let mut vehicle = Vehicle::at_rest(*params, Pose::IDENTITY);
        let mut held = 0.0;
        // No car slides later than at twice its weight.
        let most = (2.0 * params.mass * crate::grip::GRAVITY / FORCE_STEP) as usize;
        for step in 1..=most {
            let before = vehicle.state().y;
            let pull = step as f64 * FORCE_STEP;
            vehicle.set_side_pull(pull);
            vehicle.drive(Controls::default(), HOLD);
            let s = vehicle.state();
            if (s.y - before).abs() > SLIDES {
                return Self {
                    held_n: held,
                    deflection_m: before,
                    sliding_mps: vehicle.velocity()[1],
                };
            }
            held = pull;
        }
        Self {
            held_n: held,
            deflection_m: vehicle.state().y,
            sliding_mps: 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Grip;

    /// A standing car used to creep under any pull: its tyres were damped by rolling that did not take place.
    #[test]
    fn the_car_stands_until_the_paper_s_lateral_pull_and_then_slides() {
        for grip in [Grip::HQ, Grip::LQ] {
            let test = GripTest::of(&VehicleParams::default().with_grip(grip));
            // The tyre with more load grips a little worse for its load, and slides first.
            assert!((test.held_n - grip.lateral_pull).abs() < 0.2, "{test:?}");
            assert!((0.001..0.03).contains(&test.deflection_m), "{test:?}");
            assert!(test.sliding_mps > 0.1, "{test:?}");
        }
    }

    #[test]
    fn a_car_that_is_let_go_comes_to_rest() {
        let mut vehicle = Vehicle::at_rest(VehicleParams::default(), Pose::IDENTITY);
        vehicle.set_side_pull(15.0);
        vehicle.drive(Controls::default(), 1.0);
        let at = vehicle.state().y;
        vehicle.drive(Controls::default(), 5.0);
        assert!((vehicle.state().y - at).abs() < 1e-6, "it creeps");
        vehicle.set_side_pull(0.0);
        vehicle.drive(Controls::default(), 1.0);
        assert!(vehicle.velocity()[1].abs() < 1e-9);
        assert!(
            vehicle.state().y.abs() < 0.5 * at,
            "the tyres spring back from {at} to {}",
            vehicle.state().y
        );
    }
}
