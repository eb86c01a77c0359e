//! The step of simulated time.

use std::time::Duration;

/// Length of a tick. It divides the period of every sensor.
pub const TICK: Duration = Duration::from_micros(2500);
