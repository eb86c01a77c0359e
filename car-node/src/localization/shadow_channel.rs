//! Passes sensor data and updates from the filter to the shadow set. It never blocks the filter.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use crossbeam_channel::{Receiver, Sender, bounded};
use maps::Pose;
use protocol::SetRef;
use synpf::{ExternalPose, Odometry, Scan, Update, YawRate};

/// What the filter sends to the shadow.
#[derive(Debug)]
pub enum ShadowInput {
    /// Odometry that the filter has accepted.
    Odometry(Odometry),
    /// A yaw rate that the filter has received.
    YawRate(YawRate),
    /// A pose of another localizer.
    Pose(ExternalPose),
    /// A scan that led to an update.
    Scan(Box<ShadowScan>),
    /// The filter was given a new pose; the shadow starts again from it.
    PoseReset,
    /// The laser is mounted elsewhere than was assumed: its pose on `base_link`.
    Laser(Pose),
}

/// A scan, with the update that it led to under the set in force.
#[derive(Debug)]
pub struct ShadowScan {
    /// The scan.
    pub scan: Scan,
    /// The update.
    pub update: Update,
    /// Time of the update \[s\].
    pub taken: f64,
    /// Messages that waited for the filter meanwhile.
    pub queued: usize,
    /// The set in force.
    pub set: SetRef,
}

/// Inputs that wait for the shadow: half a second of a car's sensors.
const QUEUE: usize = 64;

/// The filter's end.
#[derive(Debug, Clone)]
pub struct ShadowSender {
    inputs: Sender<ShadowInput>,
    wanted: Arc<AtomicBool>,
    skipped: Arc<AtomicU64>,
}

impl ShadowSender {
    /// True while a shadow runs; without one, nothing needs to be copied.
    pub fn wanted(&self) -> bool {
        self.wanted.load(Ordering::Relaxed)
    }

    /// Sends an input. A full queue drops it; dropped scans are counted.
    pub fn send(&self, input: ShadowInput) {
        let scan = matches!(input, ShadowInput::Scan(_));
        if self.inputs.try_send(input).is_err() && scan {
            self.skipped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// The shadow's end.
#[derive(Debug)]
pub struct ShadowReceiver {
    inputs: Receiver<ShadowInput>,
    wanted: Arc<AtomicBool>,
    skipped: Arc<AtomicU64>,
}

impl ShadowReceiver {
    /// The queue of inputs.
    pub(super) fn inputs(&self) -> &Receiver<ShadowInput> {
        &self.inputs
    }

    /// Scans that a full queue has dropped since the start.
    pub(super) fn skipped(&self) -> u64 {
        self.skipped.load(Ordering::Relaxed)
    }

    /// Starts or stops the flow of inputs.
    pub(super) fn set_wanted(&self, wanted: bool) {
        self.wanted.store(wanted, Ordering::Relaxed);
    }
}

/// A channel from the filter to the shadow.
pub fn shadow_channel() -> (ShadowSender, ShadowReceiver) {
    let (sender, inputs) = bounded(QUEUE);
    let (wanted, skipped) = (Arc::default(), Arc::default());
    let sender = ShadowSender {
        inputs: sender,
        wanted: Arc::clone(&wanted),
        skipped: Arc::clone(&skipped),
    };
    let receiver = ShadowReceiver {
        inputs,
        wanted,
        skipped,
    };
    (sender, receiver)
}
