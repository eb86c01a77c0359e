//! Live sensors off ROS 2, over zenoh and without ROS: a car whose nodes talk through `rmw_zenoh`, or through a
//! zenoh-bridge-ros2dds beside them.
//!
//! `rmw_zenoh` names a topic `<domain>/<topic>/<type>/<hash>` (its `design.md`), the bridge `<topic>` alone; the payload is the
//! same CDR. Under `rmw_zenoh` topics are found by their types, as in a bag; behind a bridge by the usual names, or by those
//! that are given.

mod discovery;
mod topics;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use maps::Pose;
use zenoh::{Config, Session, Wait};
use zenoh_ext::{AdvancedSubscriberBuilderExt, HistoryConfig};

use self::discovery::Found;
use self::topics::{Content, Heard, Kind, listener};
use super::{Feed, Next, PoseEstimate, Source};
use crate::ros2::messages::PoseWithCovarianceStamped;
use crate::ros2::pose_publisher::RosConnection;
use crate::sensors::bag::{SensorEvent, Topics};
use crate::sensors::clock::{SensorClock, wall_now};
use crate::sensors::frames::Mount;

/// Where to listen, and for what.
#[derive(Debug, Clone, PartialEq)]
pub struct Ros2Options {
    /// The ROS side's zenoh router or bridge.
    pub endpoint: String,
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// Topics to take; None takes what is there, the usual names first.
    pub topics: Topics,
    /// Where the laser is; None takes it from `/tf_static`.
    pub mount: Option<Mount>,
}

impl Ros2Options {
    /// Where `rmw_zenoh`'s router and the bridge listen unless told otherwise.
    pub const ENDPOINT: &'static str = "tcp/127.0.0.1:7447";
}

/// Why there are no live sensors.
#[derive(Debug, thiserror::Error)]
pub enum Ros2Error {
    /// zenoh refuses the endpoint or the domain.
    #[error("{0}")]
    Zenoh(String),
    /// Whoever waited has given up.
    #[error("stopped while waiting for ROS 2: {missing}")]
    Stopped {
        /// What had not come.
        missing: String,
    },
    /// `/tf_static` does not say where the laser is.
    #[error(
        "/tf_static does not connect {base_link} with {laser}; say where the laser is with --laser x,y,heading"
    )]
    NoMount {
        /// The frame that odometry moves.
        base_link: String,
        /// The frame of the scans.
        laser: String,
    },
}

/// Messages that wait to be taken: some seconds of all sensors.
const QUEUE: usize = 1024;
/// Longest wait for the next message.
const PATIENCE: Duration = Duration::from_millis(100);

/// The live sensors of a car.
pub struct Ros2 {
    heard: Receiver<Heard>,
    endpoint: String,
    scan: String,
    odometry: String,
    imu: Option<String>,
    mount: Mount,
    /// The mount is a guess: nothing told it.
    guessed: bool,
    /// Sensor time less wall time [s].
    offset: f64,
    clock: SensorClock,
    /// Messages that could not be read, by topic.
    broken: BTreeMap<String, u64>,
    /// What it takes to publish for the car's own nodes; None behind a bridge.
    ros: Option<RosConnection>,
    _subscribers: Vec<Box<dyn Send>>,
    _session: Session,
}

impl Ros2 {
    /// Finds the sensors. Blocks until there are a scan and odometry; says every second to `waiting` what is still
    /// missing, and gives up when that returns false.
    pub fn find(options: &Ros2Options, mut waiting: impl FnMut(&str) -> bool) -> Result<Self, Ros2Error> {
        let session = open(&options.endpoint, &mut waiting)?;
        let (sender, heard) = bounded(QUEUE);
        let subscribers = subscribe(&session, options, &sender)?;
        let found = Found::wait(&heard, options, &mut waiting)?;
        let (mount, guessed) = found.mount(options.mount)?;
        Ok(Self {
            heard,
            endpoint: options.endpoint.clone(),
            mount,
            guessed,
            offset: found.offset,
            clock: live_clock(found.offset),
            scan: found.scan.0,
            ros: found.odometry_hash.map(|odometry_hash| RosConnection {
                session: session.clone(),
                domain: options.domain,
                odometry_hash,
                base_link: found.odometry.1,
            }),
            odometry: found.odometry.0,
            imu: found.imu,
            broken: BTreeMap::new(),
            _subscribers: subscribers,
            _session: session,
        })
    }

    /// True when nothing said where the laser is, so that it is taken to be where most cars have it.
    pub fn mount_is_a_guess(&self) -> bool {
        self.guessed
    }

    /// What it takes to publish the pose for the car's own nodes; None behind a bridge.
    pub fn ros_connection(&self) -> Option<&RosConnection> {
        self.ros.as_ref()
    }

    /// What the filter gets of a message; None when it is of a topic that was not chosen.
    fn feed(&mut self, heard: Heard) -> Option<Feed> {
        let Heard { topic, content, .. } = heard;
        match content {
            Ok(Content::Scan(scan)) => (topic == self.scan)
                .then(|| Feed::Sensor(SensorEvent::Scan(scan.to_scan(self.mount.upside_down)))),
            Ok(Content::Odometry(odometry)) => {
                (topic == self.odometry).then(|| Feed::Sensor(SensorEvent::Odometry(odometry.to_odometry())))
            }
            Ok(Content::Imu(imu)) => (Some(&topic) == self.imu.as_ref())
                .then(|| Feed::Sensor(SensorEvent::YawRate(imu.to_yaw_rate()))),
            Ok(Content::InitialPose(pose)) => Some(placed(&topic, &pose)),
            // A laser that is moved while the car runs is no laser to localize with.
            Ok(Content::StaticTransform(_)) => None,
            Err(error) => {
                let count = self.broken.entry(topic.clone()).or_insert(0);
                *count += 1;
                count
                    .is_power_of_two()
                    .then(|| Feed::Log(format!("{topic}: {count} messages cannot be read: {error}")))
            }
        }
    }
}

/// Somebody has clicked a pose in `RViz`.
fn placed(topic: &str, message: &PoseWithCovarianceStamped) -> Feed {
    let frame = message.header.frame_id.trim_start_matches('/');
    let pose = message.pose.planar();
    if frame != "map" {
        Feed::Log(format!("{topic}: a pose in frame {frame:?}, not in map: ignored"))
    } else if !pose.is_finite() {
        Feed::Log(format!("{topic}: a pose that is not finite: ignored"))
    } else {
        Feed::InitialPose(pose)
    }
}

impl Source for Ros2 {
    fn description(&self) -> String {
        let imu = self.imu.as_ref().map_or(String::new(), |imu| format!(", {imu}"));
        format!(
            "ROS 2 at {}: {}, {}{imu}",
            self.endpoint, self.scan, self.odometry
        )
    }

    fn mount(&self) -> Mount {
        self.mount
    }

    fn clock(&mut self, _: f64) -> SensorClock {
        self.clock = live_clock(self.offset);
        self.clock
    }

    fn start(&self) -> Option<Pose> {
        None
    }

    fn next(&mut self, _: Option<PoseEstimate>) -> Next {
        match self.heard.recv_timeout(PATIENCE) {
            Ok(heard) => match self.feed(heard) {
                Some(feed) => Next::Due(self.clock.now(), feed),
                None => Next::Quiet,
            },
            Err(RecvTimeoutError::Timeout) => Next::Quiet,
            Err(RecvTimeoutError::Disconnected) => Next::End,
        }
    }
}

fn live_clock(offset: f64) -> SensorClock {
    SensorClock::starting_at(wall_now().plus(offset), 1.0)
}

/// Joins the ROS side's router as a client, as soon as there is one.
fn open(endpoint: &str, waiting: &mut impl FnMut(&str) -> bool) -> Result<Session, Ros2Error> {
    let settings = [
        ("mode", r#""client""#.to_owned()),
        ("connect/endpoints", serde_json::json!([endpoint]).to_string()),
        ("connect/timeout_ms", "1000".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
    ];
    let mut config = Config::default();
    for (key, value) in settings {
        config
            .insert_json5(key, &value)
            .map_err(|error| Ros2Error::Zenoh(format!("zenoh refuses {key} = {value}: {error}")))?;
    }
    loop {
        let begun = Instant::now();
        match zenoh::open(config.clone()).wait() {
            Ok(session) => return Ok(session),
            Err(error) => {
                tracing::debug!(%error, "no router");
                let missing = format!("no zenoh router or bridge answers at {endpoint}");
                if !waiting(&missing) {
                    return Err(Ros2Error::Stopped { missing });
                }
                std::thread::sleep(Duration::from_secs(1).saturating_sub(begun.elapsed()));
            }
        }
    }
}

/// Subscribes to every kind, under `rmw_zenoh`'s keys by type and under a bridge's by name.
fn subscribe(
    session: &Session,
    options: &Ros2Options,
    sender: &Sender<Heard>,
) -> Result<Vec<Box<dyn Send>>, Ros2Error> {
    let mut subscribers: Vec<Box<dyn Send>> = Vec::new();
    for kind in Kind::ALL {
        let rmw = format!("{}/**/{}/*", options.domain, kind.dds_type());
        let bridged = kind
            .names(&options.topics)
            .into_iter()
            .map(|name| name.trim_matches('/').to_owned());
        for key in std::iter::once(rmw).chain(bridged) {
            let failed =
                |error: zenoh::Error| Ros2Error::Zenoh(format!("cannot subscribe to {key}: {error}"));
            let listener = listener(kind, options.domain, sender);
            // Static transforms are sent once, before we listen: their publishers keep them for those who ask.
            if kind == Kind::StaticTransform {
                let subscriber = session
                    .declare_subscriber(key.clone())
                    .with(listener)
                    .advanced()
                    .history(HistoryConfig::default().detect_late_publishers())
                    .wait()
                    .map_err(failed)?;
                subscribers.push(Box::new(subscriber));
            } else {
                let subscriber = session
                    .declare_subscriber(key.clone())
                    .with(listener)
                    .wait()
                    .map_err(failed)?;
                subscribers.push(Box::new(subscriber));
            }
        }
    }
    Ok(subscribers)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::messages::{Header, RosPose};

    #[test]
    fn a_pose_from_rviz_counts_in_the_map_alone() {
        let message = |frame: &str, x| PoseWithCovarianceStamped {
            header: Header {
                frame_id: frame.into(),
                ..Header::default()
            },
            pose: RosPose::from(Pose::new(x, 2.0, 1.0)),
            ..PoseWithCovarianceStamped::default()
        };
        assert!(
            matches!(placed("/initialpose", &message("map", 1.0)), Feed::InitialPose(pose) if pose.distance(Pose::new(1.0, 2.0, 1.0)) < 1e-9)
        );
        assert!(
            matches!(placed("/initialpose", &message("odom", 1.0)), Feed::Log(text) if text.contains("odom"))
        );
        assert!(matches!(
            placed("/initialpose", &message("map", f64::NAN)),
            Feed::Log(_)
        ));
    }
}
