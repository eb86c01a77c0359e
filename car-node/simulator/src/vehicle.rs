//! The car's dynamics: a single-track model with combined slip, load transfer and a rigid drive line.

use maps::Pose;

use crate::grip::{GRAVITY, Grip};
use crate::{TireParams, VehicleParams, VehicleState};

/// Step of the integration \[s\]. The drive line and the tyres oscillate at about 100 rad/s; with this step the error of a
/// Runge-Kutta step stays far below a micrometre.
const STEP: f64 = 0.001_25;

/// Below this rolling speed a tyre's force is damped \[m/s\]. At rest its slip would otherwise be a spring without a
/// damper (Pacejka, section 8.6).
const LOW_SPEED: f64 = 0.5;

/// Damping of a tyre that stands: slip added per sliding speed \[s/m\]. The car's sideways oscillation on its tyres, at 40
/// rad/s, is damped with a ratio of 0.6.
const STANDING_DAMPING: f64 = 0.5;

/// The driver's command.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Controls {
    /// Set point of the wheel speed \[m/s\].
    pub speed: f64,
    /// Set point of the steering angle, left positive \[rad\].
    pub steering: f64,
}

/// A car in motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Vehicle {
    params: VehicleParams,
    state: VehicleState,
    /// Force that pulls at the centre of gravity, to the left \[N\].
    side_pull: f64,
}

impl Vehicle {
    /// A car at rest with its rear axle at `map_from_base_link`.
    pub fn at_rest(params: VehicleParams, map_from_base_link: Pose) -> Self {
        let mut vehicle = Self {
            params,
            state: VehicleState::default(),
            side_pull: 0.0,
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

    /// Changes the grip.
    pub fn set_grip(&mut self, grip: Grip) {
        self.params = self.params.with_grip(grip);
    }

    /// Pulls at the centre of gravity from now on, to the left of the car \[N\].
    pub fn set_side_pull(&mut self, force: f64) {
        self.side_pull = force;
    }

    /// The state.
    pub fn state(&self) -> &VehicleState {
        &self.state
    }

    /// The state, for forces from outside such as walls.
    pub(crate) fn state_mut(&mut self) -> &mut VehicleState {
        &mut self.state
    }

    /// `map_from_base_link`: the middle of the rear axle.
    pub fn pose(&self) -> Pose {
        let centre = Pose::new(self.state.x, self.state.y, self.state.heading);
        centre * Pose::new(-self.params.rear_axle, 0.0, 0.0)
    }

    /// Velocity of `base_link` in its own frame: forwards \[m/s\], to the left \[m/s\], yaw rate \[rad/s\].
    pub fn twist(&self) -> [f64; 3] {
        let s = &self.state;
        [s.vx, s.vy - self.params.rear_axle * s.yaw_rate, s.yaw_rate]
    }

    /// Velocity of the centre of gravity in `map` \[m/s\].
    pub fn velocity(&self) -> [f64; 2] {
        let s = &self.state;
        let (sin, cos) = s.heading.sin_cos();
        [s.vx * cos - s.vy * sin, s.vx * sin + s.vy * cos]
    }

    /// Moves the car by an offset \[m\] and changes its velocity \[m/s\], both in `map`.
    pub(crate) fn push(&mut self, offset: [f64; 2], velocity: [f64; 2]) {
        let s = &mut self.state;
        let (sin, cos) = s.heading.sin_cos();
        (s.x, s.y) = (s.x + offset[0], s.y + offset[1]);
        s.vx += velocity[0] * cos + velocity[1] * sin;
        s.vy += velocity[1] * cos - velocity[0] * sin;
    }

    /// Integrates over `duration` \[s\], rounded to whole steps of 1.25 ms, at least one.
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

        let front_slip = damped(s.front_slip, front, s.wheel_speed);
        let rear_slip = damped(s.rear_slip, rear, s.wheel_speed);
        let [fx, fy] = p.front_tires.force(front_load, front_slip);
        let [rx, ry] = p.rear_tires.force(rear_load, rear_slip);
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
            vy: (front_y + ry + self.side_pull) / p.mass - s.yaw_rate * s.vx,
            yaw_rate: (p.front_axle * front_y - p.rear_axle * ry) / p.yaw_inertia,
            wheel_speed: (self.motor_force(s.wheel_speed, controls.speed) - rolling - fx - rx)
                / circumference_mass,
            front_slip: slip_rate(&p.front_tires, s.front_slip, front, s.wheel_speed),
            rear_slip: slip_rate(&p.rear_tires, s.rear_slip, rear, s.wheel_speed),
            // The springs follow with a time constant of 30 ms.
            pitch_acceleration: (acceleration - s.pitch_acceleration) / 0.03,
            steering: (steering_error * p.steering_gain).clamp(-p.steering_rate, p.steering_rate),
        }
    }

    /// Loads of the axles under a longitudinal acceleration \[N\].
    fn loads(&self, acceleration: f64) -> [f64; 2] {
        let p = &self.params;
        let [front, rear] = p.static_loads();
        let shift = (p.mass * acceleration * p.cg_height / p.wheelbase()).clamp(-rear, front);
        [front - shift, rear + shift]
    }

    /// The motor controller's force at the tyres \[N\]: proportional to the error, within current and power.
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

/// Speed at which a tyre's tread meets the floor \[m/s\].
fn rolling_speed(axle: [f64; 2], wheel_speed: f64) -> f64 {
    wheel_speed.abs().max(axle[0].abs())
}

/// Velocity of the floor under the tread: along the wheel, across it \[m/s\].
fn sliding_velocity(axle: [f64; 2], wheel_speed: f64) -> [f64; 2] {
    [wheel_speed - axle[0], -axle[1]]
}

/// Time derivative of a tyre's slip: the sliding speed builds it up and rolling releases it. Its steady state is the
/// theoretical slip when driving and the practical slip when braking, so both end at 1. A tyre that stands holds its slip
/// until it slides; then its slip ends at 1, too.
fn slip_rate(tires: &TireParams, slip: [f64; 2], axle: [f64; 2], wheel_speed: f64) -> [f64; 2] {
    let sliding = sliding_velocity(axle, wheel_speed);
    let released = rolling_speed(axle, wheel_speed).max(sliding[0].hypot(sliding[1]).min(LOW_SPEED));
    [0, 1].map(|k| (sliding[k] - released * slip[k]) / tires.relaxation_length)
}

/// The slip that makes the force, with the damping of a tyre that hardly rolls.
fn damped(slip: [f64; 2], axle: [f64; 2], wheel_speed: f64) -> [f64; 2] {
    let standing = 1.0 - rolling_speed(axle, wheel_speed) / LOW_SPEED;
    if standing <= 0.0 {
        return slip;
    }
    let sliding = sliding_velocity(axle, wheel_speed);
    [0, 1].map(|k| slip[k] + STANDING_DAMPING * standing * sliding[k])
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
    fn a_car_at_rest_stays_where_it_is() {
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
    fn the_servo_keeps_its_rate_and_its_range() {
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
            // The axles do not reach their peaks together, and a lighter one grips a little better.
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
            // The best brake is as strong as the tyres. With a stronger one the wheels lock.
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
    fn coasting_distance_is_that_of_the_resistance() {
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
    fn the_drive_line_never_adds_energy() {
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
