//! Where sensor data comes from: one thread that hands each message to the filter when it is due.

mod bag_player;
mod ros2;
mod simulated;

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, TrySendError};
use maps::Pose;
use synpf::{Stamp, Twist};

pub use bag_player::BagPlayer;
pub use ros2::{Ros2, Ros2Error, Ros2Options};
pub use simulated::{Incident, Race, Script, ScriptedIncident, SimulatedCar};

use crate::bag::SensorEvent;
use crate::clock::SensorClock;
use crate::counters::Counters;
use crate::frames::Mount;
use crate::outbox::TrueMotion;

/// What a source delivers.
#[derive(Debug, Clone, PartialEq)]
pub enum Feed {
    /// A message for the filter.
    Sensor(SensorEvent),
    /// The truth, for whoever records.
    Truth(TrueMotion),
    /// A word about what has happened, such as a crash.
    Word(String),
    /// Somebody has put the car here, and says so.
    Placed(Pose),
}

/// What the car believes, for a simulated driver that steers by it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Belief {
    /// When it is true, on the sensors' clock.
    pub stamp: Stamp,
    /// `map_from_base_link`.
    pub pose: Pose,
    /// Velocity.
    pub twist: Twist,
}

/// What a source has to give.
#[derive(Debug, Clone, PartialEq)]
pub enum Next {
    /// A message, and when it arrives.
    Due(Stamp, Feed),
    /// Nothing has come for a while; more may.
    Quiet,
    /// Nothing more will come.
    End,
}

/// Delivers a car's sensor data in the order in which it arrives.
pub trait Source: Send {
    /// What it is, in words.
    fn description(&self) -> String;
    /// Where the laser is.
    fn mount(&self) -> Mount;
    /// The sensors' clock, which starts now and runs `rate` times as fast as ours.
    fn clock(&mut self, rate: f64) -> SensorClock;
    /// Where the car begins, if the source knows.
    fn start(&self) -> Option<Pose>;
    /// What comes next; waits for it no longer than a tenth of a second. `belief` is what the filter last said.
    fn next(&mut self, belief: Option<Belief>) -> Next;
}

/// A place for the latest belief: the filter writes it, the source reads it.
pub type SharedBelief = Arc<Mutex<Option<Belief>>>;

/// Messages that wait for the filter: a quarter of a second of all sensors.
pub const QUEUE: usize = 64;

/// Starts the thread that plays `source` into `filter` by `clock`. It ends with the source, when the filter is
/// gone, or when `stop` is dropped. A message that finds the queue full is dropped and counted: a filter that is
/// late is served best with what is new.
pub fn play(
    mut source: Box<dyn Source>,
    clock: SensorClock,
    filter: Sender<Feed>,
    belief: SharedBelief,
    counters: Arc<Counters>,
    stop: Receiver<()>,
) -> std::io::Result<JoinHandle<()>> {
    thread::Builder::new().name("source".into()).spawn(move || {
        loop {
            let latest = *belief.lock().unwrap_or_else(PoisonError::into_inner);
            let (wait, feed) = match source.next(latest) {
                Next::Due(due, feed) => (clock.until(due), Some(feed)),
                Next::Quiet => (Duration::ZERO, None),
                Next::End => return,
            };
            if stop.recv_timeout(wait) != Err(RecvTimeoutError::Timeout) {
                return;
            }
            let Some(feed) = feed else { continue };
            match filter.try_send(feed) {
                Ok(()) => {}
                Err(TrySendError::Full(_)) => counters.overrun(),
                Err(TrySendError::Disconnected(_)) => return,
            }
        }
    })
}
