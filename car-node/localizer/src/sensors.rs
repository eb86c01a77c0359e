//! What the sensors deliver: scans, odometry, yaw rates.

use maps::Pose;
use serde::{Deserialize, Serialize};

use crate::Stamp;

/// One sweep of a planar laser scanner, as `sensor_msgs/LaserScan` has it.
#[derive(Debug, Clone, PartialEq)]
pub struct Scan {
    /// When the first beam was measured.
    pub stamp: Stamp,
    /// Direction of the first beam in the laser's frame \[rad\].
    pub angle_min: f64,
    /// Angle from one beam to the next, signed \[rad\].
    pub angle_increment: f64,
    /// Time from one beam to the next; 0 when the whole scan has one time \[s\].
    pub time_increment: f64,
    /// Time from one scan to the next, as the scanner states it \[s\]; None or 0 when it does not.
    pub scan_time: Option<f64>,
    /// Direction of the last beam, as the scanner states it \[rad\]; None when it does not.
    pub angle_max: Option<f64>,
    /// Readings below this are no measurement \[m\].
    pub range_min: f64,
    /// Readings from here on mean "nothing in range" \[m\].
    pub range_max: f64,
    /// One reading per beam \[m\]; NaN and infinities are allowed and mean "no return".
    pub ranges: Vec<f32>,
}

impl Scan {
    /// Time from the first beam to the last \[s\].
    pub fn sweep(&self) -> f64 {
        self.time_increment * self.ranges.len().saturating_sub(1) as f64
    }

    /// Least reading that is a measurement \[m\]: `range_min`; 0.1 m where that is none. No laser of this kind measures nearer than 0.05 m,
    /// and drivers that state no least range mark beams without a return by smaller readings.
    pub fn nearest(&self) -> f64 {
        if self.range_min > 0.0 {
            self.range_min.max(0.01)
        } else {
            0.1
        }
    }
}

/// A velocity in the frame of `base_link`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Twist {
    /// Forward speed [m/s].
    pub linear_x: f64,
    /// Speed to the left [m/s].
    pub linear_y: f64,
    /// Yaw rate, left positive [rad/s].
    pub angular: f64,
}

/// One message of wheel odometry, as `nav_msgs/Odometry` has it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Odometry {
    /// When it was true.
    pub stamp: Stamp,
    /// `odom_from_base_link`: drifts, but does not jump.
    pub pose: Pose,
    /// Velocity at that time.
    pub twist: Twist,
}

impl Odometry {
    /// The odometry of another frame of the same rigid car: of the one at `frame` in the frame that this is for.
    #[must_use]
    pub fn carried_to(self, frame: Pose) -> Self {
        let (sin, cos) = frame.heading.sin_cos();
        let Twist {
            linear_x,
            linear_y,
            angular,
        } = self.twist;
        // The velocity of that point, in the directions of the old frame.
        let (x, y) = (linear_x - angular * frame.y, linear_y + angular * frame.x);
        Self {
            stamp: self.stamp,
            pose: self.pose * frame,
            twist: Twist {
                linear_x: cos * x + sin * y,
                linear_y: cos * y - sin * x,
                angular,
            },
        }
    }
}

/// A gyroscope's reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct YawRate {
    /// When it was true.
    pub stamp: Stamp,
    /// Yaw rate, left positive [rad/s].
    pub rate: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_ahead_of_the_axle_moves_sideways_in_a_bend() {
        let axle = Odometry {
            stamp: Stamp(1),
            pose: Pose::new(1.0, 2.0, 0.5),
            twist: Twist {
                linear_x: 3.0,
                linear_y: 0.0,
                angular: 2.0,
            },
        };
        let ahead = axle.carried_to(Pose::new(0.2, 0.0, 0.0));
        assert!((ahead.twist.linear_x - 3.0).abs() < 1e-12 && (ahead.twist.linear_y - 0.4).abs() < 1e-12);
        let back = ahead.carried_to(Pose::new(-0.2, 0.0, 0.0));
        assert!(back.pose.distance(axle.pose) < 1e-12 && back.twist.linear_y.abs() < 1e-12);
        // A frame that looks to the left sees forward motion as motion to the right.
        let left = axle.carried_to(Pose::new(0.0, 0.0, std::f64::consts::FRAC_PI_2));
        assert!(left.twist.linear_x.abs() < 1e-12 && (left.twist.linear_y + 3.0).abs() < 1e-12);
    }
}
