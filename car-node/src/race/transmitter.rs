//! What a car of a race would send to a pit wall, so that a race can be recorded as a session is.

use std::sync::Arc;

use maps::Pose;
use protocol::{EventKind, State};
use simulator::Track;
use synpf::{Odometry, Scan, Stamp, TrackMap, Twist, Update, WeightedPose};

use crate::health::Verdict;
use crate::localization::lap_counter::LapCounter;
use crate::localization::{Pace, views};
use crate::sensors::TrueMotion;
use crate::telemetry::queue::{HealthReport, PoseReport};
use crate::telemetry::shared_state::DEFAULT_RATES;
use crate::wire;

/// A message of a car. Times in it are those of the race.
#[derive(Debug, Clone, PartialEq)]
pub struct Transmission {
    /// The car, from 0.
    pub car: usize,
    /// Time of the race when it was sent.
    pub sent: Stamp,
    /// The time that it describes.
    pub stamp: Stamp,
    /// What it says.
    pub content: Content,
}

/// The content of a [`Transmission`].
#[derive(Debug, Clone, PartialEq)]
pub enum Content {
    /// A pose after a scan. True where it is also due at the rate for display.
    Pose(Box<protocol::Pose>, bool),
    /// The health after a scan. True where it is also due at the rate for display.
    Health(Box<protocol::Health>, bool),
    /// The particles.
    Cloud(protocol::Cloud),
    /// The end points of a scan.
    ScanView(protocol::ScanView),
    /// A whole scan.
    Scan(protocol::RecordedScan),
    /// Odometry.
    Odometry(protocol::RecordedOdometry),
    /// The truth.
    Truth(protocol::Truth),
    /// An event.
    Event(EventKind),
}

/// Makes the messages of one car.
pub(super) struct Transmitter {
    track: Arc<Track>,
    map: Arc<TrackMap>,
    base_link_from_laser: Pose,
    set: String,
    laps: LapCounter,
    state: State,
    paces: [Pace; 4],
    ready: Vec<(Stamp, Content)>,
}

impl Transmitter {
    pub(super) fn new(
        track: Arc<Track>,
        map: Arc<TrackMap>,
        base_link_from_laser: Pose,
        set: String,
    ) -> Self {
        Self {
            track,
            map,
            base_link_from_laser,
            set,
            laps: LapCounter::default(),
            state: State::Init,
            paces: Default::default(),
            ready: Vec::new(),
        }
    }

    /// The messages since the last call, with the times that they describe.
    pub(super) fn take(&mut self) -> Vec<(Stamp, Content)> {
        std::mem::take(&mut self.ready)
    }

    pub(super) fn on_odometry(&mut self, odometry: &Odometry) {
        self.ready
            .push((odometry.stamp, Content::Odometry(wire::odometry(odometry))));
    }

    pub(super) fn on_truth(&mut self, truth: &simulator::Truth, stamp: Stamp) {
        let [linear_x, linear_y, angular] = truth.twist;
        let motion = TrueMotion {
            stamp,
            pose: truth.pose,
            twist: Twist {
                linear_x,
                linear_y,
                angular,
            },
        };
        self.ready.push((stamp, Content::Truth(wire::truth(&motion))));
    }

    /// The recovery crew has put the car here.
    pub(super) fn on_placed(&mut self, pose: Pose, now: Stamp) {
        self.laps.on_new_pose();
        let kind = EventKind::PoseInitialized {
            before: None,
            pose: wire::pose2(pose),
        };
        self.ready.push((now, Content::Event(kind)));
    }

    /// A scan has led to an update, and that to a verdict.
    pub(super) fn on_update(
        &mut self,
        update: &Update,
        scan: &Scan,
        particles: impl FnOnce(usize) -> Vec<WeightedPose>,
        verdict: &Verdict,
        now: Stamp,
    ) {
        let line = &self.track.raceline;
        let at = line.project([update.pose.x, update.pose.y]);
        if let Some(crossing) = self.laps.on_position(update.stamp, at, line) {
            let kind = EventKind::Lap {
                lap: crossing.ended,
                time: crossing.time,
                set: self.set.clone(),
            };
            self.ready.push((now, Content::Event(kind)));
        }
        let [pose_pace, health_pace, cloud_pace, scan_pace] = &mut self.paces;
        let pose = wire::pose_message(&PoseReport {
            stamp: update.stamp,
            pose: update.pose,
            twist: update.twist,
            covariance: update.covariance,
            track: Some([at.s, at.d]),
            lap: self.laps.laps(),
            update: update.number,
            predicted: false,
        });
        let shown = pose_pace.due(update.stamp, DEFAULT_RATES.pose);
        self.ready
            .push((update.stamp, Content::Pose(Box::new(pose), shown)));
        if verdict.state != self.state {
            let kind = EventKind::StateChanged {
                from: self.state,
                to: verdict.state,
                causes: verdict.causes.clone(),
            };
            self.ready.push((now, Content::Event(kind)));
        }
        let shown = health_pace.due(now, DEFAULT_RATES.health) || verdict.state != self.state;
        self.state = verdict.state;
        let report = HealthReport {
            stamp: now,
            verdict: verdict.clone(),
            proposal: None,
            auto: false,
        };
        let health = wire::health(&report, |stamp| stamp);
        self.ready.push((now, Content::Health(Box::new(health), shown)));
        if cloud_pace.due(update.stamp, DEFAULT_RATES.cloud) {
            let sample = views::cloud(update, particles(protocol::Cloud::MAX_PARTICLES));
            self.ready
                .push((update.stamp, Content::Cloud(wire::cloud(&sample))));
        }
        if scan_pace.due(update.stamp, DEFAULT_RATES.scan) {
            let points = views::scan_points(update, scan, &self.map, self.base_link_from_laser);
            self.ready
                .push((update.stamp, Content::ScanView(wire::scan_view(&points))));
        }
        self.ready.push((scan.stamp, Content::Scan(wire::scan(scan))));
    }
}
