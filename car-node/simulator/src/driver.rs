//! The driver: follows a raceline on the *estimated* pose, so that a bad estimate costs lap time.

use std::time::Duration;

use maps::{Pose, Raceline, wrap_angle};
use serde::{Deserialize, Serialize};

use crate::{Controls, VehicleParams};

/// A driver's parameters.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriverParams {
    /// From one command to the next.
    pub period: Duration,
    /// From a command to the start of its effect (radio, controller, servo). The driver predicts the car over this time.
    pub delay: Duration,
    /// Look-ahead distance at standstill \[m\].
    pub lookahead_base: f64,
    /// Look-ahead distance per speed \[s\].
    pub lookahead_gain: f64,
    /// The line's curvature is read this far ahead in time \[s\], because servo, tyres and inertia delay the car.
    pub steering_lead: f64,
    /// Steering per difference between the line's yaw rate and the car's \[s\].
    pub yaw_damping: f64,
    /// Time constant with which the driver learns the offset of the servo's centre \[s\]. Infinite: it never learns it.
    pub trim_time: f64,
    /// Least and most look-ahead \[m\].
    pub lookahead_range: [f64; 2],
    /// Speed over the raceline's own.
    pub speed_scale: f64,
    /// The raceline's speed is read this far ahead in time \[s\], because the car reacts late.
    pub speed_lookahead: f64,
    /// Largest commanded speed above the wheels' speed \[m/s\]. With the motor controller's gain this is the force that the
    /// tyres can transmit; with more, the wheels spin.
    pub traction: f64,
    /// Share of the speed given up per metre of distance from the line \[1/m\].
    pub error_slowdown: f64,
    /// Distance to keep from a car ahead, bumper to bumper \[m\].
    pub gap: f64,
}

impl Default for DriverParams {
    fn default() -> Self {
        Self {
            period: Duration::from_millis(20),
            delay: Duration::from_millis(20),
            lookahead_base: 0.25,
            lookahead_gain: 0.14,
            steering_lead: 0.154,
            yaw_damping: 0.02,
            trim_time: 5.0,
            lookahead_range: [0.6, 3.0],
            speed_scale: 1.0,
            speed_lookahead: 0.10,
            traction: 0.45,
            error_slowdown: 0.5,
            gap: 0.8,
        }
    }
}

/// The localizer's estimate, as the driver uses it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Time of the estimate, since the start of the race.
    pub time: Duration,
    /// `map_from_base_link`.
    pub pose: Pose,
    /// Forward speed \[m/s\].
    pub speed: f64,
    /// Yaw rate \[rad/s\].
    pub yaw_rate: f64,
}

/// A car ahead on the line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ahead {
    /// From bumper to bumper \[m\].
    pub gap: f64,
    /// Its speed \[m/s\].
    pub speed: f64,
}

/// What the driver is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Manoeuvre {
    /// Following the raceline.
    Racing,
    /// Coming to rest, because the car points the wrong way or does not move.
    Stopping,
    /// Going backwards with the wheel turned, until the given time.
    Reversing(Duration),
    /// Going forwards with the wheel turned, until the given time.
    Turning(Duration),
}

/// Model- and acceleration-based pursuit (Becker, Imholz et al., ICRA 2023). The look-ahead point demands a lateral
/// acceleration, and a model of the car's tyres gives the steering angle for it. Pure pursuit steers too little at
/// speed, because tyres slip.
#[derive(Debug, Clone)]
pub struct Driver {
    params: DriverParams,
    /// The driver's model of the car.
    vehicle: VehicleParams,
    manoeuvre: Manoeuvre,
    /// Since when the car has not moved although commanded to.
    stuck_since: Option<Duration>,
    /// Learnt steering angle that drives the car straight \[rad\].
    trim: f64,
}

/// Beyond this heading error the car is turned round at walking speed \[rad\].
const LOST_HEADING: f64 = 1.4;
/// Below this heading error a turning manoeuvre ends \[rad\].
const FOUND_HEADING: f64 = 0.7;
/// Below this speed the tyres hardly slip sideways \[m/s\].
const SLIPPING: f64 = 0.5;
/// Speed of manoeuvres \[m/s\].
const WALKING: f64 = 0.8;
/// Duration of one leg of a manoeuvre.
const LEG: Duration = Duration::from_millis(900);
/// Largest trim \[rad\].
const MOST_TRIM: f64 = 0.05;
/// The trim is learnt within this distance of the line \[m\]. Larger distances have other causes.
const NEAR: f64 = 0.1;
/// Deceleration behind a car ahead \[m/s^2\]: what taped tyres can give in a bend.
pub(crate) const BRAKE_BEHIND: f64 = 2.0;
/// Extra gap to a car that stands \[m\]. It falls to zero for one that moves at `SPEED_OF_TRAFFIC` \[m/s\].
const BACKING_UP: f64 = 0.8;
const SPEED_OF_TRAFFIC: f64 = 2.0;
/// A car that has not moved for this long is stuck.
const STUCK: Duration = Duration::from_millis(1500);

impl Driver {
    /// A driver whose model of the car is `vehicle`.
    pub fn new(params: DriverParams, vehicle: VehicleParams) -> Self {
        Self {
            params,
            vehicle,
            manoeuvre: Manoeuvre::Racing,
            stuck_since: None,
            trim: 0.0,
        }
    }

    /// What the driver is doing.
    pub fn manoeuvre(&self) -> Manoeuvre {
        self.manoeuvre
    }

    /// The driver's parameters.
    pub fn params(&self) -> &DriverParams {
        &self.params
    }

    /// Ends manoeuvres, after the car was put back on the line. The trim stays, because the servo is the same.
    pub fn reset(&mut self) {
        self.manoeuvre = Manoeuvre::Racing;
        self.stuck_since = None;
    }

    /// The command at `now`. Without an estimate the command is to stand.
    pub fn drive(
        &mut self,
        now: Duration,
        estimate: Option<&Estimate>,
        ahead: Option<Ahead>,
        line: &Raceline,
    ) -> Controls {
        let Some(estimate) = estimate.filter(|e| e.pose.is_finite()) else {
            return Controls::default();
        };
        // The pose when the command takes effect. The rear axle slips sideways.
        let age = (now.as_secs_f64() - estimate.time.as_secs_f64()).clamp(0.0, 0.2);
        let horizon = age + self.params.delay.as_secs_f64();
        let before = line.project([estimate.pose.x, estimate.pose.y]);
        let sideslip = self.sideslip(estimate.speed, before.s, line);
        let velocity = [estimate.speed, estimate.speed * sideslip.tan(), estimate.yaw_rate];
        let pose = estimate.pose * Pose::exp(velocity.map(|rate| rate * horizon));
        let position = line.project([pose.x, pose.y]);
        let off_heading = wrap_angle(pose.heading - position.heading);
        self.decide(now, estimate.speed, off_heading);
        match self.manoeuvre {
            Manoeuvre::Racing => {
                let speed = self.speed(estimate.speed, position.s, position.d, off_heading, ahead, line);
                self.note_progress(now, estimate.speed, speed);
                let steering = self.steering(estimate, pose, sideslip, position.s, line);
                self.learn_trim(estimate.speed, position.d);
                Controls { speed, steering }
            }
            Manoeuvre::Stopping => Controls::default(),
            // Both legs turn the nose towards the line's heading.
            Manoeuvre::Reversing(_) => Controls {
                speed: -WALKING,
                steering: self.vehicle.max_steering.copysign(off_heading),
            },
            Manoeuvre::Turning(_) => Controls {
                speed: WALKING,
                steering: -self.vehicle.max_steering.copysign(off_heading),
            },
        }
    }

    /// Chooses the manoeuvre.
    fn decide(&mut self, now: Duration, speed: f64, off_heading: f64) {
        let stuck = self.stuck_since.is_some_and(|since| now > since + STUCK);
        self.manoeuvre = match self.manoeuvre {
            Manoeuvre::Racing if off_heading.abs() > LOST_HEADING || stuck => Manoeuvre::Stopping,
            Manoeuvre::Stopping if speed.abs() < 0.2 => Manoeuvre::Reversing(now + LEG),
            Manoeuvre::Reversing(until) if now > until => Manoeuvre::Turning(now + LEG),
            Manoeuvre::Turning(until) if now > until || off_heading.abs() < FOUND_HEADING => {
                if off_heading.abs() < FOUND_HEADING {
                    Manoeuvre::Racing
                } else {
                    Manoeuvre::Reversing(now + LEG)
                }
            }
            same => same,
        };
        if self.manoeuvre != Manoeuvre::Racing {
            self.stuck_since = None;
        }
    }

    fn note_progress(&mut self, now: Duration, speed: f64, wanted: f64) {
        if wanted > 0.3 && speed.abs() < 0.1 {
            self.stuck_since.get_or_insert(now);
        } else {
            self.stuck_since = None;
        }
    }

    /// Speed to hold \[m/s\].
    fn speed(
        &self,
        speed: f64,
        s: f64,
        d: f64,
        off_heading: f64,
        ahead: Option<Ahead>,
        line: &Raceline,
    ) -> f64 {
        let p = &self.params;
        let there = line.at(s + speed.max(0.0) * p.speed_lookahead).speed * p.speed_scale;
        // A decimetre and ten degrees are normal, because the car slips.
        let error = (d.abs() - 0.1).max(0.0) + (off_heading.abs() - 0.2).max(0.0);
        let wanted = there * (1.0 - p.error_slowdown * error).clamp(0.3, 1.0);
        let wanted = wanted.min(speed.max(0.0) + p.traction);
        ahead.map_or(wanted, |ahead| wanted.min(self.behind(ahead)))
    }

    /// Speed that avoids running into a car ahead \[m/s\].
    fn behind(&self, ahead: Ahead) -> f64 {
        let speed = ahead.speed.max(0.0);
        // A car that stands may have to reverse.
        let gap = self.params.gap + BACKING_UP * (1.0 - speed / SPEED_OF_TRAFFIC).max(0.0);
        let room = ahead.gap - gap;
        let close = speed + 1.5 * room;
        let far = (speed * speed + 2.0 * BRAKE_BEHIND * room.max(0.0)).sqrt();
        close.min(far).max(0.0)
    }

    /// Direction in which the rear axle moves, relative to a car that drives along the line at `s` \[rad\]. It is computed
    /// from the line: feedback of the measured yaw rate would amplify a yaw oscillation.
    fn sideslip(&self, speed: f64, s: f64, line: &Raceline) -> f64 {
        if speed < SLIPPING {
            return 0.0;
        }
        let lateral = speed * speed * line.at(s).curvature;
        self.vehicle
            .turn(speed, lateral, self.along(s, line), 0.0)
            .sideslip
    }

    /// Acceleration along the line that its speed profile demands \[m/s^2\].
    fn along(&self, s: f64, line: &Raceline) -> f64 {
        const REACH: f64 = 0.2;
        let gain = line.at(s + REACH).speed.powi(2) - line.at(s - REACH).speed.powi(2);
        gain / (4.0 * REACH) * self.params.speed_scale.powi(2)
    }

    /// Yaw acceleration that the line's curvature demands \[rad/s^2\].
    fn turning_in(&self, s: f64, line: &Raceline) -> f64 {
        const REACH: f64 = 0.3;
        let yaw_rate = |s| {
            let there = line.at(s);
            there.speed * there.curvature
        };
        let per_metre = (yaw_rate(s + REACH) - yaw_rate(s - REACH)) / (2.0 * REACH);
        line.at(s).speed * per_metre * self.params.speed_scale.powi(2)
    }

    /// Steering angle \[rad\], from the line's curvature and the correction towards the look-ahead point.
    fn steering(&self, estimate: &Estimate, pose: Pose, sideslip: f64, s: f64, line: &Raceline) -> f64 {
        let p = &self.params;
        let speed = estimate.speed.max(0.5);
        let lookahead = self.lookahead(speed);
        let target = line.at(s + lookahead);
        let course = Pose::new(pose.x, pose.y, pose.heading + sideslip);
        // A car on the line would cut the bend towards the same point. Only the difference is an error.
        let here = line.at(s);
        let on_line = Pose::new(here.x, here.y, here.heading);
        let ahead = line.at(s + speed * p.steering_lead);
        let towards = |from: Pose| arc_to(from, [target.x, target.y]);
        let curvature = ahead.curvature + towards(course) - towards(on_line);
        let along = self.along(s + speed * p.steering_lead, line);
        let lateral = speed * speed * curvature;
        let turn = self
            .vehicle
            .turn(speed, lateral, along, self.turning_in(ahead.s, line));
        // The yaw rate shows a sliding tail before the position does.
        let now = line.project([estimate.pose.x, estimate.pose.y]);
        let yaw_error = speed * line.at(now.s).curvature - estimate.yaw_rate;
        turn.steering + self.trim + p.yaw_damping * yaw_error
    }

    /// Distance to the look-ahead point on the line \[m\].
    fn lookahead(&self, speed: f64) -> f64 {
        let p = &self.params;
        let [least, most] = p.lookahead_range;
        (p.lookahead_base + p.lookahead_gain * speed).clamp(least, most)
    }

    /// Adds a share of the steering that corrects the distance `d` \[m\] to the trim: integral action (Astrom and Murray,
    /// *Feedback Systems*, section 11.1). It integrates `d` rather than the steering, which the tyres limit in bends.
    fn learn_trim(&mut self, speed: f64, d: f64) {
        if speed < SLIPPING || d.abs() > NEAR {
            return;
        }
        let asked = -2.0 * d / self.lookahead(speed).powi(2) * self.vehicle.wheelbase();
        let share = self.params.period.as_secs_f64() / self.params.trim_time;
        self.trim = (self.trim + share * asked).clamp(-MOST_TRIM, MOST_TRIM);
    }
}

/// Curvature of the circle that starts along `from` and goes through a point \[1/m\].
fn arc_to(from: Pose, point: [f64; 2]) -> f64 {
    let [x, y] = from.inverse().transform(point);
    2.0 * y / (x * x + y * y).max(0.01)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Vehicle;
    use std::f64::consts::{PI, TAU};

    fn circle() -> Raceline {
        let positions: Vec<_> = (0..300)
            .map(|i| TAU * f64::from(i) / 300.0)
            .map(|a| [4.0 * a.cos(), 4.0 * a.sin()])
            .collect();
        Raceline::through(&positions, 3.0).expect("a valid line")
    }

    fn at(pose: Pose, speed: f64) -> Estimate {
        Estimate {
            time: Duration::ZERO,
            pose,
            speed,
            yaw_rate: 0.0,
        }
    }

    fn driver() -> Driver {
        Driver::new(DriverParams::default(), VehicleParams::default())
    }

    #[test]
    fn steers_back_to_the_line_from_either_side() {
        let line = circle();
        let on_line = |x: f64| {
            let estimate = at(Pose::new(x, 0.0, PI / 2.0), 3.0);
            driver()
                .drive(Duration::ZERO, Some(&estimate), None, &line)
                .steering
        };
        assert!(on_line(4.5) > on_line(4.0) && on_line(4.0) > on_line(3.5));
        assert!(on_line(4.0) > 0.0, "the line turns left");
    }

    #[test]
    fn the_offset_of_the_servo_is_learnt() {
        // A car with the servo's centre 0.01 rad to the left on a circle, on its true pose.
        let line = circle();
        let offset = |trim_time: f64| {
            let params = DriverParams {
                trim_time,
                ..DriverParams::default()
            };
            let car = VehicleParams {
                steering_offset: 0.01,
                ..VehicleParams::default()
            };
            let mut driver = Driver::new(params, car);
            let mut vehicle = Vehicle::at_rest(car, Pose::new(4.0, 0.0, PI / 2.0));
            let mut sum = 0.0;
            for i in 0..2000 {
                let now = params.period * i;
                let [speed, _, yaw_rate] = vehicle.twist();
                let pose = vehicle.pose();
                let estimate = Estimate {
                    time: now,
                    pose,
                    speed,
                    yaw_rate,
                };
                let controls = driver.drive(now, Some(&estimate), None, &line);
                vehicle.drive(controls, params.period.as_secs_f64());
                if i >= 1500 {
                    sum += line.project([pose.x, pose.y]).d / 500.0;
                }
            }
            (sum, driver.trim)
        };
        let (untrimmed, none) = offset(f64::INFINITY);
        let (trimmed, trim) = offset(DriverParams::default().trim_time);
        assert!(untrimmed > 0.004 && none.abs() < 1e-12, "{untrimmed} m");
        // The trim also takes up other errors of the driver's model.
        assert!(trimmed.abs() < 0.001, "{trimmed} m");
        assert!((trim + 0.01).abs() < 0.005, "{trim} rad");
    }

    #[test]
    fn far_off_the_line_no_trim_is_learnt() {
        let line = circle();
        let mut driver = driver();
        for (x, known) in [(4.5, false), (3.5, false), (4.05, true)] {
            let estimate = at(Pose::new(x, 0.0, PI / 2.0), 3.0);
            driver.drive(Duration::ZERO, Some(&estimate), None, &line);
            assert_eq!(driver.trim != 0.0, known, "at {x} m");
        }
        // A lasting offset saturates the trim.
        let estimate = at(Pose::new(4.05, 0.0, PI / 2.0), 3.0);
        for _ in 0..10_000 {
            driver.drive(Duration::ZERO, Some(&estimate), None, &line);
        }
        assert!((driver.trim - MOST_TRIM).abs() < 1e-12, "{}", driver.trim);
        // The recovery crew carries the car and leaves its servo as it is.
        driver.reset();
        assert!(driver.trim > 0.0);
    }

    #[test]
    fn stands_without_an_estimate() {
        let lost = at(
            Pose {
                x: f64::NAN,
                y: 0.0,
                heading: 0.0,
            },
            3.0,
        );
        for estimate in [None, Some(&lost)] {
            let controls = driver().drive(Duration::ZERO, estimate, None, &circle());
            assert_eq!(controls, Controls::default());
        }
    }

    #[test]
    fn keeps_away_from_a_car_ahead() {
        let line = circle();
        let estimate = at(Pose::new(4.0, 0.0, PI / 2.0), 3.0);
        let speed = |gap, speed| {
            let ahead = Ahead { gap, speed };
            driver()
                .drive(Duration::ZERO, Some(&estimate), Some(ahead), &line)
                .speed
        };
        assert!(speed(0.2, 2.0) < 2.0 && speed(1.0, 2.0) > 2.0 && speed(9.0, 2.0) > 2.5);
        // One that stands may have to reverse.
        assert!(speed(1.5, 0.0) <= 0.0 && speed(1.7, 0.0) > 0.0);
    }

    #[test]
    fn a_spun_car_stops_then_turns_round() {
        let line = circle();
        let mut driver = driver();
        let backwards = Pose::new(4.0, 0.0, -PI / 2.0);
        let mut drive = |ms: u64, speed| {
            let now = Duration::from_millis(ms);
            let estimate = Estimate {
                time: now,
                ..at(backwards, speed)
            };
            driver.drive(now, Some(&estimate), None, &line)
        };
        assert_eq!(drive(0, 2.0), Controls::default());
        drive(500, 0.0);
        assert!(drive(600, 0.0).speed < 0.0);
        drive(1500, 0.0);
        assert!(drive(1600, 0.0).speed > 0.0);
    }
}
