//! The state that the threads of a car share. Every lock is held for microseconds.

use std::sync::{Arc, Mutex, PoisonError};

use maps::Pose;
use protocol::{CommandId, EventKind, Rates};
use synpf::Stamp;

use crate::health::Proposal;
use crate::recording::Recorder;
use crate::sensors::{PoseEstimate, SharedPose};
use crate::telemetry::counters::Counters;
use crate::telemetry::queue::{EventPayload, Record, TelemetryQueue};
use crate::telemetry::throttle::Throttle;

/// The state that the filter, the command server, the publisher and the load meter share.
#[derive(Debug)]
pub struct SharedState {
    /// Messages for the publisher.
    pub telemetry: TelemetryQueue,
    /// Counters for the load meter.
    pub counters: Arc<Counters>,
    /// How often each topic is sent, as requested by the operator.
    pub rates: Mutex<Rates>,
    /// The set that the car proposes, and whether it may switch by itself.
    pub advice: Mutex<Advice>,
    /// The latest pose estimate; a simulated driver steers by it.
    pub pose: SharedPose,
    /// Lowers the rates while the link is slow.
    pub throttle: Mutex<Throttle>,
    /// Pose of the laser on `base_link`, once it was found out later than at the start.
    pub laser: Mutex<Option<Pose>>,
    /// Name of the shadow set. The command handler starts it; the shadow's thread may drop it.
    pub shadow: Mutex<Option<String>>,
    /// Records on the car; None on a car without a folder for it.
    pub recorder: Option<Arc<Recorder>>,
}

impl Default for SharedState {
    fn default() -> Self {
        Self {
            telemetry: TelemetryQueue::default(),
            counters: Arc::default(),
            rates: Mutex::new(DEFAULT_RATES),
            advice: Mutex::default(),
            pose: SharedPose::default(),
            throttle: Mutex::default(),
            laser: Mutex::default(),
            shadow: Mutex::default(),
            recorder: None,
        }
    }
}

/// The rates of a new car: every pose, the rest at 10 Hz.
pub const DEFAULT_RATES: Rates = Rates {
    pose: Rates::MAX,
    cloud: 10.0,
    scan: 10.0,
    health: 10.0,
    recorded: true,
};

/// The filter writes the proposal; the command handler decides.
#[derive(Debug, Clone, Default)]
pub struct Advice {
    /// The set that the car proposes.
    pub proposal: Option<Proposal>,
    /// True when the command handler may follow the proposal by itself.
    pub auto: bool,
}

impl SharedState {
    /// Sets the name of the shadow set; returns the previous one.
    pub fn set_shadow(&self, name: Option<String>) -> Option<String> {
        let mut shadow = self.shadow.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut *shadow, name)
    }

    /// True while the car records on its own disk.
    pub fn recording(&self) -> bool {
        self.recorder
            .as_ref()
            .is_some_and(|recorder| recorder.recording())
    }

    /// The laser's pose on `base_link`; None while it is as at the start.
    pub fn laser(&self) -> Option<Pose> {
        *self.laser.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the laser's pose on `base_link`.
    pub fn set_laser(&self, base_link_from_laser: Pose) {
        *self.laser.lock().unwrap_or_else(PoisonError::into_inner) = Some(base_link_from_laser);
    }

    /// The latest pose estimate; None before the first.
    pub fn latest_pose(&self) -> Option<PoseEstimate> {
        *self.pose.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Queues an event.
    pub fn event(
        &self,
        stamp: Stamp,
        update: u64,
        kind: EventKind,
        who: Option<&str>,
        command: Option<CommandId>,
    ) {
        self.telemetry.record(Record::Event(EventPayload {
            stamp,
            update,
            who: who.map(str::to_owned),
            command,
            kind,
        }));
    }
}
