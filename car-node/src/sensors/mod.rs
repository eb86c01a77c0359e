//! Sources of sensor data: recorded, simulated or live. One thread sends each message to the filter when it is due.

pub mod bag;
mod bag_player;
pub mod clock;
pub(crate) mod external_pose;
pub mod frames;
mod ros2;
mod simulated;
mod sweep_stamps;

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, SendTimeoutError, Sender};
use maps::Pose;
use synpf::{Stamp, Twist};

pub use bag_player::BagPlayer;
pub use ros2::{Ros2, Ros2Error, Ros2Options};
pub(crate) use simulated::sensor_event;
pub use simulated::{Incident, Race, Script, ScriptedIncident, SimulatedCar};

use self::bag::SensorEvent;
use self::clock::SensorClock;
use self::frames::Mount;

/// What a source delivers.
#[derive(Debug, Clone, PartialEq)]
pub enum Feed {
    /// A message for the filter.
    Sensor(SensorEvent),
    /// Ground truth, for the recorder.
    Truth(TrueMotion),
    /// A message for the log, such as a crash.
    Log(String),
    /// An initial pose from outside the filter.
    InitialPose {
        /// `map_from_base_link`.
        pose: Pose,
        /// Where it comes from: a ROS topic, or the recovery crew of a simulated race.
        by: String,
    },
    /// The sensors' clock was set, or runs otherwise than it did. Stamps of sensor data go on as before.
    Clock {
        /// By how much [`SensorClock`] was moved \[s\].
        moved: f64,
        /// By how much the sensors' clock was set, back if negative \[s\].
        step: Option<f64>,
        /// The same for people, if it is worth a message.
        text: Option<String>,
    },
    /// How the laser is mounted, found out late. It holds for the scans after it.
    Mount {
        /// The mount.
        mount: Mount,
        /// The laser was taken to be the other way up: a pose that was found so is worth nothing.
        turned: bool,
        /// The same for people.
        text: String,
    },
    /// A request to search the whole map.
    GlobalSearch {
        /// Where it comes from: a ROS topic.
        by: String,
    },
}

/// The car's true motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrueMotion {
    /// The time at which it is true.
    pub stamp: Stamp,
    /// `map_from_base_link`.
    pub pose: Pose,
    /// Velocity.
    pub twist: Twist,
}

/// The pose that the localizer estimates. A simulated driver steers by it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseEstimate {
    /// When it is true, on the sensors' clock.
    pub stamp: Stamp,
    /// `map_from_base_link`.
    pub pose: Pose,
    /// Velocity.
    pub twist: Twist,
}

/// What a source has next.
#[derive(Debug, Clone, PartialEq)]
pub enum Next {
    /// A message, and when it arrives.
    Due(Stamp, Feed),
    /// Nothing has come for a while; more may come.
    Quiet,
    /// Nothing more will come.
    End,
}

/// Delivers a car's sensor data in the order in which it arrives.
pub trait Source: Send {
    /// A description for people.
    fn description(&self) -> String;
    /// How the laser is mounted.
    fn mount(&self) -> Mount;
    /// The sensors' clock. It starts now and runs `rate` times as fast as this machine's.
    fn clock(&mut self, rate: f64) -> SensorClock;
    /// The car's first pose, if the source knows it.
    fn start(&self) -> Option<Pose>;
    /// The topic of another localizer's poses, if it is one of those delivered.
    fn pose_topic(&self) -> Option<&str> {
        None
    }
    /// Waits for the next message, a tenth of a second at most. `estimate` is the filter's latest.
    fn next(&mut self, estimate: Option<PoseEstimate>) -> Next;
}

/// The latest pose estimate: the filter writes it, the source reads it.
pub type SharedPose = Arc<Mutex<Option<PoseEstimate>>>;

/// Messages that wait for the filter: a quarter of a second of all sensors.
pub const QUEUE: usize = 64;

/// How long a message waits for room in the queue.
pub const WAITS: Duration = Duration::from_millis(100);

/// Starts the thread that plays `source` into `filter` by `clock`.
///
/// It ends with the source, when the filter is gone, or when `stop` is dropped. A message that finds the queue full waits for
/// [`WAITS`] at most. Then it is dropped, and `on_overrun` is called: a late filter needs new data more than old data.
pub fn play(
    mut source: Box<dyn Source>,
    clock: SensorClock,
    filter: Sender<Feed>,
    estimate: SharedPose,
    on_overrun: impl Fn() + Send + 'static,
    stop: Receiver<()>,
) -> std::io::Result<JoinHandle<()>> {
    thread::Builder::new().name("source".into()).spawn(move || {
        loop {
            let latest = *estimate.lock().unwrap_or_else(PoisonError::into_inner);
            let (wait, feed) = match source.next(latest) {
                Next::Due(due, feed) => (clock.until(due), Some(feed)),
                Next::Quiet => (Duration::ZERO, None),
                Next::End => return,
            };
            if stop.recv_timeout(wait) != Err(RecvTimeoutError::Timeout) {
                return;
            }
            let Some(feed) = feed else { continue };
            match filter.send_timeout(feed, WAITS) {
                Ok(()) => {}
                Err(SendTimeoutError::Timeout(_)) => on_overrun(),
                Err(SendTimeoutError::Disconnected(_)) => return,
            }
        }
    })
}
