//! The car's dynamics: a single-track model with combined slip, load transfer and a rigid drive line.

use maps::{Pose, wrap_angle};
use serde::{Deserialize, Serialize};

use crate::TireParams;

/// Gravity [m/s^2].
pub(crate) const GRAVITY: f64 = 9.81;

/// Step of the integration [s]: the drive line against the tyres rings at about 100 rad/s, which a Runge-Kutta step
/// of this length follows with an error far below a micrometre.
const STEP: f64 = 0.001_25;

/// Below this rolling speed [m/s] a tyre's slip is damped as if it rolled at it; at rest the slip would otherwise
/// be a spring without a damper (Pacejka, section 8.6).
const LOW_SPEED: f64 = 0.5;

/// A 1:10 car on a four-wheel-drive chassis with a rigid centre shaft, as teams race it: both axles turn at the motor's
/// speed, so wheel odometry *is* motor speed.
///
/// The defaults are a car of the paper's weight and wheelbase (3.5 kg, 0.31 m); inertia and centre of gravity are
/// those published for such cars (O'Kelly et al., *F1TENTH*, 2020); tyre shape factors those of identified F1TENTH
/// tyres (front softer than rear: the car understeers), friction from the lateral pull of the paper's table I. Load moves
/// between the axles; what bends move from side to side is left out, as in every single-track model: with these tyres'
/// load sensitivity it costs an axle less than 2 % of its grip.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VehicleParams {
    /// Mass [kg].
    pub mass: f64,
    /// Moment of inertia about the vertical axis [kg m^2].
    pub yaw_inertia: f64,
    /// From the centre of gravity forward to the front axle [m].
    pub front_axle: f64,
    /// From the centre of gravity back to the rear axle, which is `base_link` [m].
    pub rear_axle: f64,
    /// Height of the centre of gravity [m].
    pub cg_height: f64,
    /// Both front tyres.
    pub front_tires: TireParams,
    /// Both rear tyres.
    pub rear_tires: TireParams,
    /// Rolling radius of a wheel [m].
    pub wheel_radius: f64,
    /// Inertia of wheels, shafts and rotor, seen at the wheels [kg m^2].
    pub driveline_inertia: f64,
    /// Greatest driving force at the tyres, from the current limit [N].
    pub max_drive_force: f64,
    /// Greatest braking force at the tyres, from the regenerative current limit [N].
    pub max_brake_force: f64,
    /// Greatest mechanical power at the wheels [W].
    pub max_power: f64,
    /// Force of the motor controller per error of wheel speed [N/(m/s)].
    pub speed_gain: f64,
    /// Rolling resistance over weight.
    pub rolling_resistance: f64,
    /// Air drag over squared speed [N/(m/s)^2].
    pub drag: f64,
    /// Largest steering angle, either way [rad].
    pub max_steering: f64,
    /// Fastest change of the steering angle [rad/s].
    pub steering_rate: f64,
    /// Angle by which the servo's centre is off, left positive: cars are trimmed by eye [rad].
    pub steering_offset: f64,
    /// The servo's control gain [1/s].
    pub steering_gain: f64,
    /// Length and width of the body [m].
    pub body: [f64; 2],
    /// From the rear axle back to the rear bumper [m].
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
    /// Distance between the axles [m].
    pub fn wheelbase(&self) -> f64 {
        self.front_axle + self.rear_axle
    }

    /// The same car on another floor or other tyres.
    #[must_use]
    pub fn with_grip(mut self, grip: Grip) -> Self {
        self.front_tires.friction = grip.friction();
        self.rear_tires.friction = grip.friction();
        self
    }

    /// Understeer gradient K [s^2/m]: at small lateral acceleration the car turns at
    /// `v delta / (wheelbase + K v^2)` (Rajamani, *Vehicle Dynamics and Control*, section 3.3).
    pub fn understeer_gradient(&self) -> f64 {
        let [front, rear] = self.static_loads();
        let front_stiffness = self.front_tires.linear_stiffness(front);
        let rear_stiffness = self.rear_tires.linear_stiffness(rear);
        self.mass / self.wheelbase() * (self.rear_axle / front_stiffness - self.front_axle / rear_stiffness)
    }

    /// Loads of the front and the rear axle at rest [N].
    pub fn static_loads(&self) -> [f64; 2] {
        let weight = self.mass * GRAVITY / self.wheelbase();
        [weight * self.rear_axle, weight * self.front_axle]
    }

    /// How the car turns at `speed` [m/s] with `lateral` acceleration [m/s^2] while it gains or loses speed by `along`
    /// [m/s^2] and turns ever faster by `yaw_acceleration` [rad/s^2], from the tyres' whole curve; what grip cannot give is
    /// cut to a share of the tyres' peak. It is the look-up table of MAP (Becker, Imholz et al., ICRA 2023), computed when
    /// asked for.
    pub fn turn(&self, speed: f64, lateral: f64, along: f64, yaw_acceleration: f64) -> Turn {
        let speed = speed.max(0.1);
        let yaw_rate = lateral / speed;
        let [front, rear] = self.static_loads();
        let shift = (self.mass * along * self.cg_height / self.wheelbase()).clamp(-rear, front);
        let weight = front + rear;
        // Each axle makes its share of the side force, and of the force along, as much as it is loaded.
        let couple = self.yaw_inertia * yaw_acceleration / self.wheelbase();
        let slip = |tires: &TireParams, load: f64, arm: f64, couple: f64| {
            let across = self.mass * lateral * arm / self.wheelbase() + couple;
            let force = across.hypot(self.mass * along * load / weight);
            // Theoretical slip is the tangent of the slip angle, but for the wheels' own slip along.
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

/// Share of a tyre's peak force that is asked for: closer to the peak, slip grows much and force no more, and a tyre that
/// was steered so far answers late when less is needed.
const USABLE: f64 = 0.82;

/// A turn, as the tyres make it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turn {
    /// Steering angle that makes it [rad].
    pub steering: f64,
    /// Direction in which the rear axle moves, seen from the car [rad]: it slips out of the turn, so the nose points in.
    pub sideslip: f64,
}

/// How well the tyres hold, as the paper measures it: pulling the standing car sideways.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Grip {
    /// Force at which a car of 3.5 kg slides sideways [N].
    pub lateral_pull: f64,
}

impl Grip {
    /// Clean tyres: high-quality odometry (paper, table I).
    pub const HQ: Self = Self { lateral_pull: 26.0 };
    /// Taped tyres: low-quality odometry (paper, table I).
    pub const LQ: Self = Self { lateral_pull: 19.0 };

    /// Friction coefficient.
    pub fn friction(self) -> f64 {
        self.lateral_pull / (3.5 * GRAVITY)
    }
}

/// What the driver asks of the car.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Controls {
    /// Wheel speed that the motor controller shall hold [m/s].
    pub speed: f64,
    /// Steering angle that the servo shall hold, left positive [rad].
    pub steering: f64,
}

/// Everything that moves.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct VehicleState {
    /// Position of the centre of gravity in `map` [m].
    pub x: f64,
    /// Position of the centre of gravity in `map` [m].
    pub y: f64,
    /// Heading, not wrapped [rad].
    pub heading: f64,
    /// Speed of the centre of gravity, forwards [m/s].
    pub vx: f64,
    /// Speed of the centre of gravity, to the left [m/s].
    pub vy: f64,
    /// Yaw rate, left positive [rad/s].
    pub yaw_rate: f64,
    /// Speed of the wheels' circumference [m/s].
    pub wheel_speed: f64,
    /// Slip of the front tyres, longitudinal and lateral, as far as it has built up.
    pub front_slip: [f64; 2],
    /// Slip of the rear tyres.
    pub rear_slip: [f64; 2],
    /// Longitudinal acceleration as the springs have followed it [m/s^2]: it shifts load between the axles.
    pub pitch_acceleration: f64,
    /// Steering angle of the front wheels [rad].
    pub steering: f64,
}

const SIZE: usize = 13;

impl VehicleState {
    fn array(&self) -> [f64; SIZE] {
        let (front, rear) = (self.front_slip, self.rear_slip);
        [
            self.x,
            self.y,
            self.heading,
            self.vx,
            self.vy,
            self.yaw_rate,
            self.wheel_speed,
            front[0],
            front[1],
            rear[0],
            rear[1],
            self.pitch_acceleration,
            self.steering,
        ]
    }

    fn from_array(a: [f64; SIZE]) -> Self {
        Self {
            x: a[0],
            y: a[1],
            heading: a[2],
            vx: a[3],
            vy: a[4],
            yaw_rate: a[5],
            wheel_speed: a[6],
            front_slip: [a[7], a[8]],
            rear_slip: [a[9], a[10]],
            pitch_acceleration: a[11],
            steering: a[12],
        }
    }

    /// `self + rate * time`.
    fn advanced(&self, rate: &Self, time: f64) -> Self {
        let (state, rate) = (self.array(), rate.array());
        Self::from_array(std::array::from_fn(|i| state[i] + rate[i] * time))
    }
}

/// A car in motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Vehicle {
    params: VehicleParams,
    state: VehicleState,
}

impl Vehicle {
    /// A car at rest with its rear axle at `map_from_base_link`.
    pub fn at_rest(params: VehicleParams, map_from_base_link: Pose) -> Self {
        let mut vehicle = Self {
            params,
            state: VehicleState::default(),
        };
        vehicle.place(map_from_base_link);
        vehicle
    }

    /// Puts the car somewhere else, at rest.
    pub fn place(&mut self, map_from_base_link: Pose) {
        let [x, y] = map_from_base_link.transform([self.params.rear_axle, 0.0]);
        self.state = VehicleState {
            x,
            y,
            heading: map_from_base_link.heading,
            ..VehicleState::default()
        };
    }

    /// The car's parameters.
    pub fn params(&self) -> &VehicleParams {
        &self.params
    }

    /// Other tyres, or another floor, from now on.
    pub fn set_grip(&mut self, grip: Grip) {
        self.params = self.params.with_grip(grip);
    }

    /// The state.
    pub fn state(&self) -> &VehicleState {
        &self.state
    }

    /// For what acts on the car from outside: walls.
    pub(crate) fn state_mut(&mut self) -> &mut VehicleState {
        &mut self.state
    }

    /// `map_from_base_link`: the middle of the rear axle.
    pub fn pose(&self) -> Pose {
        let centre = Pose::new(self.state.x, self.state.y, self.state.heading);
        centre * Pose::new(-self.params.rear_axle, 0.0, 0.0)
    }

    /// Velocity of `base_link` in its own frame: forwards [m/s], to the left [m/s], yaw rate [rad/s].
    pub fn twist(&self) -> [f64; 3] {
        let s = &self.state;
        [s.vx, s.vy - self.params.rear_axle * s.yaw_rate, s.yaw_rate]
    }

    /// Velocity of the centre of gravity in `map` [m/s].
    pub fn velocity(&self) -> [f64; 2] {
        let s = &self.state;
        let (sin, cos) = s.heading.sin_cos();
        [s.vx * cos - s.vy * sin, s.vx * sin + s.vy * cos]
    }

    /// Pushed from outside: moved by an offset [m], and its velocity changed [m/s], both in `map`.
    pub(crate) fn push(&mut self, offset: [f64; 2], velocity: [f64; 2]) {
        let s = &mut self.state;
        let (sin, cos) = s.heading.sin_cos();
        (s.x, s.y) = (s.x + offset[0], s.y + offset[1]);
        s.vx += velocity[0] * cos + velocity[1] * sin;
        s.vy += velocity[1] * cos - velocity[0] * sin;
    }

    /// Lets `duration` [s] pass (rounded to whole steps of 1.25 ms, at least one).
    pub fn drive(&mut self, controls: Controls, duration: f64) {
        let steps = (duration / STEP).round().max(1.0) as usize;
        for _ in 0..steps {
            self.step(controls);
        }
    }

    /// One classical Runge-Kutta step.
    fn step(&mut self, controls: Controls) {
        let s = self.state;
        let k1 = self.rate(&s, controls);
        let k2 = self.rate(&s.advanced(&k1, STEP / 2.0), controls);
        let k3 = self.rate(&s.advanced(&k2, STEP / 2.0), controls);
        let k4 = self.rate(&s.advanced(&k3, STEP), controls);
        let (k1, k2, k3, k4) = (k1.array(), k2.array(), k3.array(), k4.array());
        let mean = VehicleState::from_array(std::array::from_fn(|i| {
            (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]) / 6.0
        }));
        self.state = s.advanced(&mean, STEP);
        let limit = self.params.max_steering;
        self.state.steering = self.state.steering.clamp(-limit, limit);
    }

    /// Time derivative of the state.
    fn rate(&self, s: &VehicleState, controls: Controls) -> VehicleState {
        let p = &self.params;
        let (sin, cos) = s.steering.sin_cos();
        let [front_load, rear_load] = self.loads(s.pitch_acceleration);

        // Velocities of the axles, each in its wheels' frame.
        let front = [s.vx, s.vy + p.front_axle * s.yaw_rate];
        let front = [front[0] * cos + front[1] * sin, front[1] * cos - front[0] * sin];
        let rear = [s.vx, s.vy - p.rear_axle * s.yaw_rate];

        let [fx, fy] = p.front_tires.force(front_load, s.front_slip);
        let [rx, ry] = p.rear_tires.force(rear_load, s.rear_slip);
        // The front force in the car's frame.
        let [front_x, front_y] = [fx * cos - fy * sin, fx * sin + fy * cos];

        let drag = p.drag * s.vx * s.vx.abs();
        let acceleration = (front_x + rx - drag) / p.mass;
        let rolling = p.rolling_resistance * p.mass * GRAVITY * (s.wheel_speed / 0.05).tanh();
        let circumference_mass = p.driveline_inertia / (p.wheel_radius * p.wheel_radius);

        let (sin_heading, cos_heading) = s.heading.sin_cos();
        let asked = controls.steering + p.steering_offset;
        let steering_error = asked.clamp(-p.max_steering, p.max_steering) - s.steering;
        VehicleState {
            x: s.vx * cos_heading - s.vy * sin_heading,
            y: s.vx * sin_heading + s.vy * cos_heading,
            heading: s.yaw_rate,
            vx: acceleration + s.yaw_rate * s.vy,
            vy: (front_y + ry) / p.mass - s.yaw_rate * s.vx,
            yaw_rate: (p.front_axle * front_y - p.rear_axle * ry) / p.yaw_inertia,
            wheel_speed: (self.motor_force(s.wheel_speed, controls.speed) - rolling - fx - rx)
                / circumference_mass,
            front_slip: slip_rate(&p.front_tires, s.front_slip, front, s.wheel_speed),
            rear_slip: slip_rate(&p.rear_tires, s.rear_slip, rear, s.wheel_speed),
            // The springs follow within some 30 ms.
            pitch_acceleration: (acceleration - s.pitch_acceleration) / 0.03,
            steering: (steering_error * p.steering_gain).clamp(-p.steering_rate, p.steering_rate),
        }
    }

    /// Loads of the axles [N] when braking or driving shifts them.
    fn loads(&self, acceleration: f64) -> [f64; 2] {
        let p = &self.params;
        let [front, rear] = p.static_loads();
        let shift = (p.mass * acceleration * p.cg_height / p.wheelbase()).clamp(-rear, front);
        [front - shift, rear + shift]
    }

    /// The motor controller's force at the tyres [N]: proportional to the error, within current and power.
    fn motor_force(&self, wheel_speed: f64, command: f64) -> f64 {
        let p = &self.params;
        let wanted = p.speed_gain * (command - wheel_speed);
        let power_limit = p.max_power / wheel_speed.abs().max(0.1);
        let drives = wanted * wheel_speed >= 0.0;
        let limit = if drives {
            p.max_drive_force.min(power_limit)
        } else {
            p.max_brake_force
        };
        wanted.clamp(-limit, limit)
    }
}

/// Time derivative of a tyre's slip: the tread is carried along by the sliding speed and released by rolling. Its steady
/// state is the theoretical slip when driving and the practical slip when braking, so both end at 1.
fn slip_rate(tires: &TireParams, slip: [f64; 2], axle: [f64; 2], wheel_speed: f64) -> [f64; 2] {
    let rolling = wheel_speed.abs().max(axle[0].abs()).max(LOW_SPEED);
    [
        (wheel_speed - axle[0] - rolling * slip[0]) / tires.relaxation_length,
        (-axle[1] - rolling * slip[1]) / tires.relaxation_length,
    ]
}

/// The car's outline at a pose of `base_link`: its corners in `map`, counter-clockwise [m].
pub fn outline(params: &VehicleParams, map_from_base_link: Pose) -> [[f64; 2]; 4] {
    let (back, half) = (-params.rear_overhang, params.body[1] / 2.0);
    let front = back + params.body[0];
    [[front, -half], [front, half], [back, half], [back, -half]]
        .map(|corner| map_from_base_link.transform(corner))
}

impl From<&VehicleState> for Pose {
    /// The pose of the centre of gravity.
    fn from(state: &VehicleState) -> Self {
        Self::new(state.x, state.y, wrap_angle(state.heading))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Drives until everything that settles has settled.
    fn settled(params: &VehicleParams, speed: f64, steering: f64) -> Vehicle {
        let mut vehicle = Vehicle::at_rest(*params, Pose::IDENTITY);
        vehicle.drive(Controls { speed, steering: 0.0 }, 5.0);
        vehicle.drive(Controls { speed, steering }, 5.0);
        vehicle
    }

    #[test]
    fn a_car_left_alone_stays_where_it_is() {
        let mut vehicle = Vehicle::at_rest(VehicleParams::default(), Pose::new(1.0, 2.0, 3.0));
        vehicle.drive(Controls::default(), 10.0);
        assert!(vehicle.pose().distance(Pose::new(1.0, 2.0, 3.0)) < 1e-9);
    }

    #[test]
    fn a_steady_turn_follows_the_understeer_gradient() {
        // Lateral acceleration below 1 m/s^2, where the tyres are linear.
        for (speed, steering) in [(1.0, 0.15), (2.0, 0.05), (3.0, 0.02), (4.0, 0.01)] {
            let params = VehicleParams::default();
            let vehicle = settled(&params, speed, steering);
            let v = vehicle.state().vx;
            let expected = v * steering / (params.wheelbase() + params.understeer_gradient() * v * v);
            let ratio = vehicle.state().yaw_rate / expected;
            assert!((ratio - 1.0).abs() < 0.02, "at {speed} m/s: {ratio}");
        }
    }

    #[test]
    fn a_step_of_the_steering_answers_as_the_linear_single_track_model_does() {
        // The yaw rate's step response in closed form (Rajamani, section 2.3; Riekert and Schunck, 1940), on tyres and a
        // servo with next to no lag of their own; what is left of it shifts the time.
        let (speed, steering, lag) = (6.0, 0.004, 0.01 / 6.0 + 1.0 / 400.0);
        let mut params = VehicleParams {
            steering_gain: 400.0,
            steering_rate: 1000.0,
            ..VehicleParams::default()
        };
        params.front_tires.relaxation_length = 0.01;
        params.rear_tires.relaxation_length = 0.01;
        let mut vehicle = settled(&params, speed, 0.0);

        let v = vehicle.state().vx;
        let (m, inertia, a, b) = (
            params.mass,
            params.yaw_inertia,
            params.front_axle,
            params.rear_axle,
        );
        let [front, rear] = params.static_loads();
        let (front, rear) = (
            params.front_tires.linear_stiffness(front),
            params.rear_tires.linear_stiffness(rear),
        );
        let decay = f64::midpoint(
            (front + rear) / (m * v),
            (a * a * front + b * b * rear) / (inertia * v),
        );
        let natural =
            front * rear * (a + b).powi(2) / (m * inertia * v * v) + (b * rear - a * front) / inertia;
        let ringing = (natural - decay * decay).sqrt();
        let settles_at = v * steering / (params.wheelbase() + params.understeer_gradient() * v * v);
        let begins_with = a * front * steering / inertia;
        let expected = |t: f64| {
            let sine = (begins_with - decay * settles_at) / ringing;
            let (sin, cos) = (ringing * t).sin_cos();
            settles_at + (-decay * t).exp() * (sine * sin - settles_at * cos)
        };
        for i in 1..100 {
            vehicle.drive(Controls { speed, steering }, STEP);
            let t = f64::from(i) * STEP - lag;
            if t > 2.0 * lag {
                let off = vehicle.state().yaw_rate - expected(t);
                assert!(
                    off.abs() < 0.03 * settles_at,
                    "after {t} s: {off} of {settles_at} rad/s"
                );
            }
        }
    }

    #[test]
    fn the_servo_turns_no_faster_and_no_further_than_it_can() {
        let params = VehicleParams::default();
        let mut vehicle = Vehicle::at_rest(params, Pose::IDENTITY);
        let all = Controls {
            speed: 0.0,
            steering: 1.0,
        };
        vehicle.drive(all, 0.05);
        let turned = vehicle.state().steering;
        assert!(
            (turned / (0.05 * params.steering_rate) - 1.0).abs() < 0.02,
            "{turned}"
        );
        vehicle.drive(all, 1.0);
        assert!((vehicle.state().steering - params.max_steering).abs() < 1e-6);
    }

    #[test]
    fn the_car_understeers() {
        assert!(VehicleParams::default().understeer_gradient() > 0.0);
    }

    #[test]
    fn the_steering_for_a_turn_gives_that_turn() {
        let params = VehicleParams::default();
        for (speed, lateral) in [(2.0, 2.0), (3.0, 4.0), (5.0, 5.0), (6.0, -6.0)] {
            let vehicle = settled(&params, speed, params.turn(speed, lateral, 0.0, 0.0).steering);
            let s = vehicle.state();
            let reached = s.vx * s.yaw_rate;
            // The formula leaves out the tyres' rolling and driving share of the grip.
            assert!(
                (reached / lateral - 1.0).abs() < 0.1,
                "{speed} m/s: wanted {lateral}, got {reached}"
            );
        }
    }

    #[test]
    fn lateral_acceleration_ends_at_the_paper_s_lateral_pull() {
        for grip in [Grip::HQ, Grip::LQ] {
            let params = VehicleParams::default().with_grip(grip);
            let mut vehicle = settled(&params, 4.0, 0.0);
            let velocity = |vehicle: &Vehicle| {
                let s = vehicle.state();
                let (sin, cos) = s.heading.sin_cos();
                [s.vx * cos - s.vy * sin, s.vx * sin + s.vy * cos]
            };
            // The steering is turned slowly, until the car slides.
            let mut greatest: f64 = 0.0;
            for i in 0..500 {
                let before = velocity(&vehicle);
                let steering = 0.0005 * f64::from(i);
                vehicle.drive(Controls { speed: 4.0, steering }, 0.02);
                let after = velocity(&vehicle);
                let acceleration = (after[0] - before[0]).hypot(after[1] - before[1]) / 0.02;
                greatest = greatest.max(acceleration * params.mass);
            }
            // The axles do not peak together, and a lighter one grips a little better.
            assert!(
                (0.95..1.02).contains(&(greatest / grip.lateral_pull)),
                "{greatest} N of {} N",
                grip.lateral_pull
            );
        }
    }

    #[test]
    fn braking_distance_is_that_of_the_friction_coefficient() {
        for grip in [Grip::HQ, Grip::LQ] {
            // The best brake is as strong as the tyres, and no stronger: then the wheels would lock.
            let distance = |share: f64| {
                let params = VehicleParams {
                    max_brake_force: share * grip.lateral_pull,
                    drag: 0.0,
                    ..VehicleParams::default().with_grip(grip)
                };
                let mut vehicle = settled(&params, 6.0, 0.0);
                let (from, v) = (vehicle.state().x, vehicle.state().vx);
                while vehicle.state().vx > 0.01 {
                    vehicle.drive(Controls::default(), STEP);
                }
                (vehicle.state().x - from) * 2.0 * grip.friction() * GRAVITY / (v * v)
            };
            let best = (70..110)
                .map(|percent| distance(f64::from(percent) / 100.0))
                .fold(9.0, f64::min);
            assert!((0.99..1.08).contains(&best), "{best} times v^2 / (2 mu g)");
            assert!(distance(2.0) > 1.05 * best, "locked wheels brake worse");
        }
    }

    #[test]
    fn hard_braking_locks_the_wheels_and_odometry_sees_a_shorter_way() {
        let mut vehicle = settled(&VehicleParams::default().with_grip(Grip::LQ), 6.0, 0.0);
        vehicle.drive(Controls::default(), 0.3);
        let s = vehicle.state();
        assert!(
            s.wheel_speed < 0.7 * s.vx,
            "wheels {}, car {}",
            s.wheel_speed,
            s.vx
        );
    }

    #[test]
    fn hard_driving_spins_the_wheels() {
        let mut vehicle = Vehicle::at_rest(VehicleParams::default().with_grip(Grip::LQ), Pose::IDENTITY);
        let full = Controls {
            speed: 8.0,
            steering: 0.0,
        };
        vehicle.drive(full, 0.3);
        let s = vehicle.state();
        assert!(
            s.wheel_speed > 1.3 * s.vx,
            "wheels {}, car {}",
            s.wheel_speed,
            s.vx
        );
    }

    #[test]
    fn coasting_ends_where_resistance_says() {
        // Rolling resistance only: distance = v^2 / (2 c g), the turning parts adding to the mass.
        let params = VehicleParams {
            drag: 0.0,
            max_drive_force: 1e-9,
            max_brake_force: 1e-9,
            ..VehicleParams::default()
        };
        let mut vehicle = Vehicle::at_rest(params, Pose::IDENTITY);
        (vehicle.state.vx, vehicle.state.wheel_speed) = (3.0, 3.0);
        vehicle.drive(Controls::default(), 60.0);
        let rotating = params.driveline_inertia / params.wheel_radius.powi(2) / params.mass;
        let expected = 9.0 * (1.0 + rotating) / (2.0 * params.rolling_resistance * GRAVITY);
        assert!((vehicle.state().x - params.rear_axle) / expected - 1.0 < 0.02);
        assert!((vehicle.state().x - params.rear_axle) / expected - 1.0 > -0.02);
    }

    #[test]
    fn the_drive_line_never_makes_energy() {
        // With the motor off, kinetic energy only falls, whatever the steering does.
        let params = VehicleParams {
            max_drive_force: 1e-9,
            max_brake_force: 1e-9,
            ..VehicleParams::default()
        };
        let mut vehicle = Vehicle::at_rest(params, Pose::IDENTITY);
        (vehicle.state.vx, vehicle.state.wheel_speed) = (6.0, 6.0);
        let energy = |vehicle: &Vehicle| {
            let s = vehicle.state();
            let wheels = params.driveline_inertia * (s.wheel_speed / params.wheel_radius).powi(2);
            (params.mass * (s.vx * s.vx + s.vy * s.vy) + params.yaw_inertia * s.yaw_rate.powi(2) + wheels)
                / 2.0
        };
        let mut before = energy(&vehicle);
        for i in 0..200 {
            let steering = if i % 40 < 20 { 0.4 } else { -0.4 };
            vehicle.drive(Controls { speed: 0.0, steering }, 0.02);
            let now = energy(&vehicle);
            // The tyres' deflection stores a little, and gives it back.
            assert!(now < before + 0.05, "step {i}: {before} J to {now} J");
            before = before.min(now);
        }
    }
}
