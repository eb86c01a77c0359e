//! Pursuit of a raceline: the speed to hold and the steering angle.

use maps::{Pose, Raceline};

use crate::{DriverParams, Estimate, VehicleParams};

/// A car ahead on the line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ahead {
    /// From bumper to bumper \[m\].
    pub gap: f64,
    /// Its speed \[m/s\].
    pub speed: f64,
}

/// Model- and acceleration-based pursuit (Becker, Imholz et al., ICRA 2023). The look-ahead point demands a lateral
/// acceleration, and a model of the car's tyres gives the steering angle for it. Pure pursuit steers too little at
/// speed, because tyres slip.
#[derive(Debug, Clone)]
pub(crate) struct Pursuit {
    params: DriverParams,
    /// The driver's model of the car.
    vehicle: VehicleParams,
    /// Learnt steering angle that drives the car straight \[rad\].
    trim: f64,
}

/// Below this speed the tyres hardly slip sideways \[m/s\].
const SLIPPING: f64 = 0.5;
/// Largest trim \[rad\].
pub(crate) const MOST_TRIM: f64 = 0.05;
/// The trim is learnt within this distance of the line \[m\]. Larger distances have other causes.
const NEAR: f64 = 0.1;
/// Deceleration behind a car ahead \[m/s^2\]: what taped tyres can give in a bend.
pub(crate) const BRAKE_BEHIND: f64 = 2.0;
/// Extra gap to a car that stands \[m\]. It falls to zero at `SPEED_OF_TRAFFIC`.
const BACKING_UP: f64 = 0.8;
/// A car at this speed or above will not reverse \[m/s\].
const SPEED_OF_TRAFFIC: f64 = 2.0;

impl Pursuit {
    /// The driver's model of the car is `vehicle`. No trim is learnt yet.
    pub(crate) fn new(params: &DriverParams, vehicle: &VehicleParams) -> Self {
        Self {
            params: *params,
            vehicle: *vehicle,
            trim: 0.0,
        }
    }

    /// The driver's parameters.
    pub(crate) fn params(&self) -> &DriverParams {
        &self.params
    }

    /// The driver's model of the car.
    pub(crate) fn vehicle(&self) -> &VehicleParams {
        &self.vehicle
    }

    /// Learnt steering angle that drives the car straight \[rad\].
    #[cfg(test)]
    pub(crate) fn trim(&self) -> f64 {
        self.trim
    }

    /// Speed to hold \[m/s\].
    pub(crate) fn speed(
        &self,
        speed: f64,
        s: f64,
        d: f64,
        heading_error: f64,
        ahead: Option<Ahead>,
        line: &Raceline,
    ) -> f64 {
        let p = &self.params;
        let there = line.at(s + speed.max(0.0) * p.speed_lookahead).speed * p.speed_scale;
        // A decimetre and ten degrees are normal, because the car slips.
        let error = (d.abs() - 0.1).max(0.0) + (heading_error.abs() - 0.2).max(0.0);
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
    pub(crate) fn sideslip(&self, speed: f64, s: f64, line: &Raceline) -> f64 {
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
    pub(crate) fn steering(
        &self,
        estimate: &Estimate,
        pose: Pose,
        sideslip: f64,
        s: f64,
        line: &Raceline,
    ) -> f64 {
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
    pub(crate) fn learn_trim(&mut self, speed: f64, d: f64) {
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
