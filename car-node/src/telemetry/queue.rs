//! The queue from the other threads to the publisher. Adding to it never blocks.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, bounded};
use maps::Pose;
use nalgebra::Matrix3;
use protocol::EventKind;
use synpf::{Odometry, Scan, Stamp, Twist, WeightedPose, YawRate};

use crate::health::{Proposal, Verdict};
use crate::sensors::TrueMotion;

/// A pose with what belongs to it. Stamps in this file are on the sensors' clock.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseReport {
    /// The time at which the pose is true.
    pub stamp: Stamp,
    /// `map_from_base_link`.
    pub pose: Pose,
    /// Velocity.
    pub twist: Twist,
    /// Covariance of x, y [m^2] and heading [rad^2].
    pub covariance: Matrix3<f64>,
    /// Arc length along the raceline and distance to its left [m, m].
    pub track: Option<[f64; 2]>,
    /// Laps begun.
    pub lap: u32,
    /// The update that it is from.
    pub update: u64,
    /// True when odometry has moved it since that update.
    pub predicted: bool,
}

/// The particle cloud, thinned out for sending.
#[derive(Debug, Clone, PartialEq)]
pub struct CloudSample {
    /// The time at which it is true.
    pub stamp: Stamp,
    /// The update that it is from.
    pub update: u64,
    /// The estimate.
    pub centre: Pose,
    /// Particles in use.
    pub count: usize,
    /// Effective sample size over `count`.
    pub ess_ratio: f64,
    /// Standard deviation along and across the track \[m\].
    pub spread: [f64; 2],
    /// Second mode over the first.
    pub second_mode: f64,
    /// The particles to send.
    pub particles: Vec<WeightedPose>,
}

/// A beam compared with the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BeamClass {
    /// It ends at a wall.
    OnWall,
    /// It ends off a wall.
    OffWall,
    /// It is much shorter than on the map.
    Short,
    /// It is much longer than on the map.
    Long,
}

/// End points of a scan at the estimate.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanPoints {
    /// Time of the first beam.
    pub stamp: Stamp,
    /// The update that it led to.
    pub update: u64,
    /// Where the laser is \[m\].
    pub centre: [f64; 2],
    /// End points in `map` \[m\].
    pub points: Vec<([f64; 2], BeamClass)>,
}

/// A health verdict with the recommended set.
#[derive(Debug, Clone, PartialEq)]
pub struct HealthReport {
    /// Time of the verdict.
    pub stamp: Stamp,
    /// The verdict.
    pub verdict: Verdict,
    /// The set that the car recommends.
    pub proposal: Option<Proposal>,
    /// True when the car switches sets by itself.
    pub auto: bool,
}

/// An event.
#[derive(Debug, Clone, PartialEq)]
pub struct EventPayload {
    /// Time of the event.
    pub stamp: Stamp,
    /// The last update before it.
    pub update: u64,
    /// Who caused it: an operator, or where a pose came from.
    pub who: Option<String>,
    /// The command that caused it.
    pub command: Option<protocol::CommandId>,
    /// What happened.
    pub kind: EventKind,
}

/// Messages that must be sent in order.
#[derive(Debug)]
pub enum Record {
    /// A pose, for the recorder.
    Pose(PoseReport),
    /// Health, for the pit wall and, at full rate, for the recorder.
    Health {
        /// The report.
        report: HealthReport,
        /// True to send it for display.
        live: bool,
        /// True to send it for the recorder.
        recorded: bool,
    },
    /// Odometry, for the recorder.
    Odometry(Odometry),
    /// A scan, for the recorder.
    Scan(Scan),
    /// A yaw rate, for the recorder on the car. It is not sent.
    YawRate(YawRate),
    /// The truth, for the recorder.
    Truth(TrueMotion),
    /// The set in force.
    Params(Box<protocol::Params>),
    /// The shadow set, compared with the set in force.
    Shadow(Box<protocol::Shadow>),
    /// Load of the last second.
    Load(Box<protocol::Load>),
    /// An event.
    Event(EventPayload),
}

/// Holds the newest value.
#[derive(Debug)]
pub struct Slot<T>(Mutex<Option<T>>);

impl<T> Default for Slot<T> {
    fn default() -> Self {
        Self(Mutex::new(None))
    }
}

impl<T> Slot<T> {
    fn put(&self, value: T) -> bool {
        let replaced = self
            .0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .replace(value);
        replaced.is_some()
    }

    /// Takes the value.
    pub fn take(&self) -> Option<T> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

/// Records in the queue: half a second of all streams at full rate.
const QUEUE: usize = 256;

/// The queue from the filter, the command server and the load meter to the publisher. Of poses, clouds and scans it keeps the
/// newest only.
#[derive(Debug)]
pub struct TelemetryQueue {
    pose: Slot<PoseReport>,
    cloud: Slot<CloudSample>,
    scan: Slot<ScanPoints>,
    queue: (Sender<Record>, Receiver<Record>),
    wake: (Sender<()>, Receiver<()>),
    dropped: AtomicU64,
}

impl Default for TelemetryQueue {
    fn default() -> Self {
        Self {
            pose: Slot::default(),
            cloud: Slot::default(),
            scan: Slot::default(),
            queue: bounded(QUEUE),
            wake: bounded(1),
            dropped: AtomicU64::new(0),
        }
    }
}

impl TelemetryQueue {
    /// Sets the newest pose.
    pub fn pose(&self, pose: PoseReport) {
        let replaced = self.pose.put(pose);
        self.count(replaced);
        self.wake();
    }

    /// Sets the newest cloud.
    pub fn cloud(&self, cloud: CloudSample) {
        let replaced = self.cloud.put(cloud);
        self.count(replaced);
        self.wake();
    }

    /// Sets the newest scan view.
    pub fn scan(&self, scan: ScanPoints) {
        let replaced = self.scan.put(scan);
        self.count(replaced);
        self.wake();
    }

    /// Adds a record. A full queue drops it and counts it.
    pub fn record(&self, record: Record) {
        self.count(self.queue.0.try_send(record).is_err());
        self.wake();
    }

    /// How much was dropped because the publisher was too slow.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// Waits until something was added, or for `at_most`.
    pub fn wait(&self, at_most: Duration) {
        // An error is a timeout: the caller checks the queue in any case.
        self.wake.1.recv_timeout(at_most).ok();
    }

    /// The newest pose, unless it was taken.
    pub fn take_pose(&self) -> Option<PoseReport> {
        self.pose.take()
    }

    /// The newest cloud, unless it was taken.
    pub fn take_cloud(&self) -> Option<CloudSample> {
        self.cloud.take()
    }

    /// The newest scan view, unless it was taken.
    pub fn take_scan(&self) -> Option<ScanPoints> {
        self.scan.take()
    }

    /// The next record.
    pub fn next_record(&self) -> Option<Record> {
        self.queue.1.try_recv().ok()
    }

    fn count(&self, lost: bool) {
        if lost {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn wake(&self) {
        // Full means that the publisher is being woken already.
        self.wake.0.try_send(()).ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(update: u64) -> PoseReport {
        PoseReport {
            stamp: Stamp(0),
            pose: Pose::IDENTITY,
            twist: Twist::default(),
            covariance: Matrix3::zeros(),
            track: None,
            lap: 0,
            update,
            predicted: false,
        }
    }

    #[test]
    fn the_newest_pose_wins_and_the_older_one_is_counted() {
        let telemetry = TelemetryQueue::default();
        telemetry.pose(pose(1));
        telemetry.pose(pose(2));
        assert_eq!(telemetry.take_pose().map(|pose| pose.update), Some(2));
        assert_eq!(telemetry.take_pose(), None);
        assert_eq!(telemetry.dropped(), 1);
    }

    #[test]
    fn a_slow_publisher_drops_records_and_blocks_nobody() {
        let telemetry = TelemetryQueue::default();
        for update in 0..QUEUE as u64 + 10 {
            telemetry.record(Record::Pose(pose(update)));
        }
        assert_eq!(telemetry.dropped(), 10);
        assert_eq!(std::iter::from_fn(|| telemetry.next_record()).count(), QUEUE);
    }
}
