//! The driver: follows a raceline on the *estimated* pose, so that a bad estimate costs lap time.

use std::time::Duration;

use maps::{Pose, Raceline, wrap_angle};

use crate::manoeuvre::ManoeuvrePlanner;
use crate::pursuit::Pursuit;
use crate::{Ahead, Controls, DriverParams, Estimate, Manoeuvre, VehicleParams};

/// Follows the line by pursuit, and turns the car round where it points the wrong way.
#[derive(Debug, Clone)]
pub struct Driver {
    pursuit: Pursuit,
    manoeuvre: ManoeuvrePlanner,
}

impl Driver {
    /// A driver whose model of the car is `vehicle`.
    pub fn new(params: DriverParams, vehicle: VehicleParams) -> Self {
        Self {
            pursuit: Pursuit::new(&params, &vehicle),
            manoeuvre: ManoeuvrePlanner::new(),
        }
    }

    /// What the driver is doing.
    pub fn manoeuvre(&self) -> Manoeuvre {
        self.manoeuvre.manoeuvre()
    }

    /// The driver's parameters.
    pub fn params(&self) -> &DriverParams {
        self.pursuit.params()
    }

    /// Ends manoeuvres, after the car was put back on the line. The trim stays, because the servo is the same.
    pub fn reset(&mut self) {
        self.manoeuvre = ManoeuvrePlanner::new();
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
        let pursuit = &mut self.pursuit;
        // The pose when the command takes effect. The rear axle slips sideways.
        let age = (now.as_secs_f64() - estimate.time.as_secs_f64()).clamp(0.0, 0.2);
        let horizon = age + pursuit.params().delay.as_secs_f64();
        let before = line.project([estimate.pose.x, estimate.pose.y]);
        let sideslip = pursuit.sideslip(estimate.speed, before.s, line);
        let velocity = [estimate.speed, estimate.speed * sideslip.tan(), estimate.yaw_rate];
        let pose = estimate.pose * Pose::exp(velocity.map(|rate| rate * horizon));
        let position = line.project([pose.x, pose.y]);
        let heading_error = wrap_angle(pose.heading - position.heading);
        self.manoeuvre.update(now, estimate.speed, heading_error);
        if let Some(controls) = self
            .manoeuvre
            .controls(pursuit.vehicle().max_steering, heading_error)
        {
            return controls;
        }
        let speed = pursuit.speed(estimate.speed, position.s, position.d, heading_error, ahead, line);
        self.manoeuvre.note_progress(now, estimate.speed, speed);
        let steering = pursuit.steering(estimate, pose, sideslip, position.s, line);
        pursuit.learn_trim(estimate.speed, position.d);
        Controls { speed, steering }
    }
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
            (sum, driver.pursuit.trim())
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
            assert_eq!(driver.pursuit.trim() != 0.0, known, "at {x} m");
        }
        // A lasting offset saturates the trim.
        let estimate = at(Pose::new(4.05, 0.0, PI / 2.0), 3.0);
        for _ in 0..10_000 {
            driver.drive(Duration::ZERO, Some(&estimate), None, &line);
        }
        assert!(
            (driver.pursuit.trim() - crate::pursuit::MOST_TRIM).abs() < 1e-12,
            "{}",
            driver.pursuit.trim()
        );
        // The recovery crew carries the car and leaves its servo as it is.
        driver.reset();
        assert!(driver.pursuit.trim() > 0.0);
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
