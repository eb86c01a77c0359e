//! A driver's parameters.

use std::time::Duration;

use serde::{Deserialize, Serialize};

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
