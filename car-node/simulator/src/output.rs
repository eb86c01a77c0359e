//! What the world reports: sensor messages, the truth, and incidents.

use std::time::Duration;

use maps::{Pose, TrackPosition};

use crate::{Gyro, Odometry, Scan};

/// A message of one car.
#[derive(Debug, Clone, PartialEq)]
pub struct Output {
    /// Index of the car, in the order of the setups.
    pub car: usize,
    /// When the message arrives, since the start of the race. A sensor's message arrives a latency after its stamp.
    pub at: Duration,
    /// The message.
    pub message: Message,
}

/// A sensor's message, the truth, or an incident.
#[derive(Debug, Clone, PartialEq)]
pub enum Message {
    /// A sweep of the laser.
    Scan(Scan),
    /// Wheel odometry.
    Odometry(Odometry),
    /// A reading of the gyroscope.
    Gyro(Gyro),
    /// The car's true state, at 100 Hz.
    Truth(Truth),
    /// A lap is over.
    Lap(Lap),
    /// The car hit a wall and stands.
    Crash(Contact),
    /// The car touched a wall and goes on. Sent once per contact.
    Scrape(Contact),
    /// The car and another one touched. Sent to both, once per contact.
    Collision(Contact),
    /// The car turned more than 90 degrees away from the line.
    Spin,
    /// The recovery crew put the car here, at rest.
    Placed(Pose),
}

/// The true state of a car.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Truth {
    /// Time since the start of the race.
    pub stamp: Duration,
    /// `map_from_base_link`.
    pub pose: Pose,
    /// Velocity of `base_link` in its own frame: forwards \[m/s\], to the left \[m/s\], yaw rate \[rad/s\].
    pub twist: [f64; 3],
    /// Speed of the wheels' circumference \[m/s\].
    pub wheel_speed: f64,
    /// Position relative to the raceline.
    pub track: TrackPosition,
    /// Laps finished.
    pub laps: u32,
}

/// A finished lap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lap {
    /// Counts from 1.
    pub number: u32,
    /// From one crossing of the start line to the next.
    pub time: Duration,
}

/// Contact with a wall or another car.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Contact {
    /// Where the car was: `map_from_base_link`.
    pub pose: Pose,
    /// Speed into what was touched \[m/s\].
    pub impact: f64,
}
