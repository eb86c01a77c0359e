//! A car's parameters: masses, lengths, tyres, motor and servo.

use maps::Pose;
use serde::{Deserialize, Serialize};

use crate::TireParams;
use crate::grip::{GRAVITY, Grip};

/// A 1:10 car with four-wheel drive and a rigid centre shaft, as teams race it. Both axles turn at the motor's speed, so
/// wheel odometry measures the motor's speed.
///
/// The defaults have the paper's mass and wheelbase (3.5 kg, 0.31 m). Inertia and centre of gravity are published
/// values of such cars (O'Kelly et al., *F1TENTH*, 2020). The tyres' shape factors are those of identified F1TENTH tyres;
/// the front is softer than the rear, so the car understeers. The friction comes from the lateral pull in the paper's
/// table I. Load transfer between the axles is modelled; lateral load transfer is not, as in every single-track model. With
/// these tyres' load sensitivity it costs an axle less than 2 % of its grip.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VehicleParams {
    /// Mass \[kg\].
    pub mass: f64,
    /// Moment of inertia about the vertical axis \[kg m^2\].
    pub yaw_inertia: f64,
    /// From the centre of gravity forward to the front axle \[m\].
    pub front_axle: f64,
    /// From the centre of gravity back to the rear axle, which is `base_link` \[m\].
    pub rear_axle: f64,
    /// Height of the centre of gravity \[m\].
    pub cg_height: f64,
    /// Both front tyres.
    pub front_tires: TireParams,
    /// Both rear tyres.
    pub rear_tires: TireParams,
    /// Rolling radius of a wheel \[m\].
    pub wheel_radius: f64,
    /// Inertia of wheels, shafts and rotor, reduced to the wheels \[kg m^2\].
    pub driveline_inertia: f64,
    /// Greatest driving force at the tyres, from the current limit \[N\].
    pub max_drive_force: f64,
    /// Greatest braking force at the tyres, from the regenerative current limit \[N\].
    pub max_brake_force: f64,
    /// Greatest mechanical power at the wheels \[W\].
    pub max_power: f64,
    /// Force of the motor controller per error of wheel speed \[N/(m/s)\].
    pub speed_gain: f64,
    /// Rolling resistance over weight.
    pub rolling_resistance: f64,
    /// Air drag over squared speed \[N/(m/s)^2\].
    pub drag: f64,
    /// Largest steering angle, either way \[rad\].
    pub max_steering: f64,
    /// Fastest change of the steering angle \[rad/s\].
    pub steering_rate: f64,
    /// Error of the servo's centre, left positive \[rad\]. Real cars are trimmed by eye.
    pub steering_offset: f64,
    /// The servo's control gain \[1/s\].
    pub steering_gain: f64,
    /// Length and width of the body \[m\].
    pub body: [f64; 2],
    /// From the rear axle back to the rear bumper \[m\].
    pub rear_overhang: f64,
}

impl Default for VehicleParams {
    fn default() -> Self {
        let tires = TireParams {
            stiffness: 6.0,
            shape: 1.5,
            curvature: 0.2,
            friction: Grip::HQ.friction(),
            nominal_load: 3.5 * GRAVITY / 2.0,
            load_sensitivity: 0.08,
            relaxation_length: 0.06,
        };
        Self {
            mass: 3.5,
            yaw_inertia: 0.058,
            front_axle: 0.162,
            rear_axle: 0.148,
            cg_height: 0.074,
            front_tires: tires,
            rear_tires: TireParams {
                stiffness: 11.0,
                ..tires
            },
            wheel_radius: 0.054,
            driveline_inertia: 1.3e-3,
            max_drive_force: 32.0,
            max_brake_force: 32.0,
            max_power: 260.0,
            speed_gain: 60.0,
            rolling_resistance: 0.02,
            drag: 0.02,
            max_steering: 0.42,
            steering_rate: 6.0,
            steering_offset: 0.0,
            steering_gain: 40.0,
            body: [0.50, 0.28],
            rear_overhang: 0.09,
        }
    }
}

impl VehicleParams {
    /// Distance between the axles \[m\].
    pub fn wheelbase(&self) -> f64 {
        self.front_axle + self.rear_axle
    }

    /// The same car with another grip.
    #[must_use]
    pub fn with_grip(mut self, grip: Grip) -> Self {
        self.front_tires.friction = grip.friction();
        self.rear_tires.friction = grip.friction();
        self
    }

    /// Understeer gradient K \[s^2/m\]. At small lateral acceleration the yaw rate is
    /// `v delta / (wheelbase + K v^2)` (Rajamani, *Vehicle Dynamics and Control*, section 3.3).
    pub fn understeer_gradient(&self) -> f64 {
        let [front, rear] = self.static_loads();
        let front_stiffness = self.front_tires.linear_stiffness(front);
        let rear_stiffness = self.rear_tires.linear_stiffness(rear);
        self.mass / self.wheelbase() * (self.rear_axle / front_stiffness - self.front_axle / rear_stiffness)
    }

    /// Loads of the front and the rear axle at rest \[N\].
    pub fn static_loads(&self) -> [f64; 2] {
        let weight = self.mass * GRAVITY / self.wheelbase();
        [weight * self.rear_axle, weight * self.front_axle]
    }
}

/// The car's outline at a pose of `base_link`: its corners in `map`, counter-clockwise \[m\].
pub fn outline(params: &VehicleParams, map_from_base_link: Pose) -> [[f64; 2]; 4] {
    let (back, half) = (-params.rear_overhang, params.body[1] / 2.0);
    let front = back + params.body[0];
    [[front, -half], [front, half], [back, half], [back, -half]]
        .map(|corner| map_from_base_link.transform(corner))
}
