//! A steady turn: steering and sideslip that give a lateral acceleration. The driver's model of the car.

use crate::{TireParams, VehicleParams};

/// Largest share of a tyre's peak force that is used. Nearer to the peak, slip grows much and force little, and the
/// tyre answers late when less force is needed.
const USABLE: f64 = 0.82;

/// Steering and sideslip of a turn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turn {
    /// Steering angle \[rad\].
    pub steering: f64,
    /// Direction in which the rear axle moves, seen from the car \[rad\]. The tail slides outwards, so the nose points
    /// into the turn.
    pub sideslip: f64,
}

impl VehicleParams {
    /// Steering and sideslip at `speed` \[m/s\] for a `lateral` acceleration \[m/s^2\], an acceleration `along` the car \[m/s^2\]
    /// and a `yaw_acceleration` \[rad/s^2\]. Computed from the tyres' whole curve. A demand beyond the grip is cut to a
    /// share of the tyres' peak force. This is the look-up table of MAP (Becker, Imholz et al., ICRA 2023), computed on
    /// demand.
    pub fn turn(&self, speed: f64, lateral: f64, along: f64, yaw_acceleration: f64) -> Turn {
        let speed = speed.max(0.1);
        let yaw_rate = lateral / speed;
        let [front, rear] = self.static_loads();
        let shift = (self.mass * along * self.cg_height / self.wheelbase()).clamp(-rear, front);
        let weight = front + rear;
        // Each axle gives the side force that its lever arm demands, and of the force along a share by its load.
        let couple = self.yaw_inertia * yaw_acceleration / self.wheelbase();
        let slip = |tires: &TireParams, load: f64, arm: f64, couple: f64| {
            let across = self.mass * lateral * arm / self.wheelbase() + couple;
            let force = across.hypot(self.mass * along * load / weight);
            // Theoretical slip is the tangent of the slip angle, apart from the wheels' own slip along.
            let usable = force.min(USABLE * tires.peak(load));
            tires.slip_for(load, usable) * across / force.max(1e-9)
        };
        let front = slip(
            &self.front_tires,
            (front - shift).max(1.0),
            self.rear_axle,
            couple,
        );
        let rear = slip(
            &self.rear_tires,
            (rear + shift).max(1.0),
            self.front_axle,
            -couple,
        );
        let front_heading = (self.wheelbase() * yaw_rate - speed * rear).atan2(speed);
        Turn {
            steering: (front_heading + front.atan()).clamp(-self.max_steering, self.max_steering),
            sideslip: -rear.atan(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Controls, Vehicle};
    use maps::Pose;

    #[test]
    fn the_steering_for_a_turn_gives_that_turn() {
        let params = VehicleParams::default();
        for (speed, lateral) in [(2.0, 2.0), (3.0, 4.0), (5.0, 5.0), (6.0, -6.0)] {
            let steering = params.turn(speed, lateral, 0.0, 0.0).steering;
            let mut vehicle = Vehicle::at_rest(params, Pose::IDENTITY);
            vehicle.drive(Controls { speed, steering: 0.0 }, 5.0);
            vehicle.drive(Controls { speed, steering }, 5.0);
            let s = vehicle.state();
            let reached = s.vx * s.yaw_rate;
            // The formula leaves out the tyres' rolling and driving share of the grip.
            assert!(
                (reached / lateral - 1.0).abs() < 0.1,
                "{speed} m/s: wanted {lateral}, got {reached}"
            );
        }
    }
}
