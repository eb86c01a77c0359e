//! Poses and velocities in the plane, as messages hold them.

use serde::{Deserialize, Serialize};

/// A pose in the plane.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Pose2 {
    /// Position \[m\].
    pub x: f64,
    /// Position \[m\].
    pub y: f64,
    /// Direction of the x axis, in `[-pi, pi)` \[rad\].
    pub heading: f64,
}

/// A velocity in the frame of `base_link`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Twist2 {
    /// Forward speed \[m/s\].
    pub linear_x: f64,
    /// Speed to the left \[m/s\].
    pub linear_y: f64,
    /// Yaw rate, left positive \[rad/s\].
    pub angular: f64,
}

/// The upper triangle of a pose's covariance, in the frame of the pose's position.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Covariance {
    /// Variance of x \[m^2\].
    pub xx: f32,
    /// Covariance of x and y \[m^2\].
    pub xy: f32,
    /// Covariance of x and heading \[m rad\].
    pub xh: f32,
    /// Variance of y \[m^2\].
    pub yy: f32,
    /// Covariance of y and heading \[m rad\].
    pub yh: f32,
    /// Variance of the heading \[rad^2\].
    pub hh: f32,
}
