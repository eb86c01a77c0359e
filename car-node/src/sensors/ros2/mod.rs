//! Live sensors of a ROS 2 car, over zenoh and without ROS. The car's nodes use `rmw_zenoh`, or run behind a
//! zenoh-bridge-ros2dds.
//!
//! `rmw_zenoh` names a topic `<domain>/<topic>/<type>/<hash>` (its `design.md`); the bridge names it `<topic>`. The payload
//! is the same CDR. With `rmw_zenoh` the sensors are discovered by their types, as in a bag. Behind a bridge they are
//! discovered by the usual names, or by names that are given.
//!
//! An initial pose and a request for a global search come on one topic each, in the namespace of the scan. Other topics of
//! the same types, such as the poses of other localizers, are not subscribed to. Neither is what this node publishes.

mod discovery;
mod topics;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use maps::Pose;
use zenoh::sample::Locality;
use zenoh::{Config, Session, Wait};
use zenoh_ext::{AdvancedSubscriberBuilderExt, HistoryConfig};

use self::discovery::CarTopics;
use self::topics::{Content, Kind, TopicMessage, in_namespace_of, listener};
use super::{Feed, Next, PoseEstimate, Source};
use crate::ros2::messages::PoseWithCovarianceStamped;
use crate::ros2::pose_publisher::RosConnection;
use crate::sensors::bag::{SensorEvent, Topics};
use crate::sensors::clock::{SensorClock, wall_now};
use crate::sensors::frames::Mount;

/// Which ROS side to connect to, and which topics to take.
#[derive(Debug, Clone, PartialEq)]
pub struct Ros2Options {
    /// The ROS side's zenoh router or bridge.
    pub endpoint: String,
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// Topics to take; None takes what sends, the usual names first.
    pub topics: Topics,
    /// Topic of initial poses; None takes `/initialpose` in the namespace of the scan.
    pub initial_pose_topic: Option<String>,
    /// Topics that this node publishes on. They are never inputs.
    pub outputs: Vec<String>,
    /// How the laser is mounted; None takes it from `/tf_static`.
    pub mount: Option<Mount>,
}

impl Ros2Options {
    /// The default endpoint of `rmw_zenoh`'s router and of the bridge.
    pub const ENDPOINT: &'static str = "tcp/127.0.0.1:7447";

    /// Refuses a topic that is both an input and an output.
    fn check(&self) -> Result<(), Ros2Error> {
        let Topics {
            scan, odometry, imu, ..
        } = &self.topics;
        let inputs = [scan, odometry, imu, &self.initial_pose_topic];
        let same = |a: &str, b: &str| a.trim_matches('/') == b.trim_matches('/');
        match inputs
            .into_iter()
            .flatten()
            .find(|input| self.outputs.iter().any(|output| same(input, output)))
        {
            Some(topic) => Err(Ros2Error::OwnOutput(topic.clone())),
            None => Ok(()),
        }
    }
}

/// Why there are no live sensors.
#[derive(Debug, thiserror::Error)]
pub enum Ros2Error {
    /// zenoh refuses the endpoint or the domain.
    #[error("{0}")]
    Zenoh(String),
    /// A topic to take is one that this node publishes on.
    #[error("{0}: this node publishes on it, so it cannot take it as an input")]
    OwnOutput(String),
    /// The caller stopped waiting.
    #[error("stopped while waiting for ROS 2: {missing}")]
    Stopped {
        /// What was missing.
        missing: String,
    },
    /// `/tf_static` does not contain the laser's pose.
    #[error(
        "/tf_static does not connect {base_link} with {laser}; give the laser's pose with --laser x,y,heading"
    )]
    NoMount {
        /// The frame that odometry moves.
        base_link: String,
        /// The frame of the scans.
        laser: String,
    },
}

/// Messages that wait: some seconds of all sensors.
const QUEUE: usize = 1024;
/// Longest wait for the next message.
const PATIENCE: Duration = Duration::from_millis(100);

/// The live sensors of a car.
pub struct Ros2 {
    messages: Receiver<TopicMessage>,
    endpoint: String,
    scan: String,
    odometry: String,
    imu: Option<String>,
    initial_pose: String,
    mount: Mount,
    /// The mount is a guess, since `/tf_static` is missing.
    guessed: bool,
    /// Sensor time minus wall time \[s\].
    offset: f64,
    clock: SensorClock,
    /// Messages that do not decode, by topic.
    undecodable: BTreeMap<String, u64>,
    /// For publishing to the car's own nodes; None behind a bridge.
    ros: Option<RosConnection>,
    _subscribers: Vec<Box<dyn Send>>,
    _session: Session,
}

impl Ros2 {
    /// Finds the sensors. Blocks until there are a scan and odometry. Calls `waiting` every second with what is missing, and
    /// gives up when it returns false.
    pub fn find(options: &Ros2Options, mut waiting: impl FnMut(&str) -> bool) -> Result<Self, Ros2Error> {
        options.check()?;
        let session = open(&options.endpoint, &mut waiting)?;
        let (sender, messages) = bounded(QUEUE);
        let subscription = Subscription {
            session: &session,
            domain: options.domain,
            sender: &sender,
        };
        let mut subscribers = Vec::new();
        for kind in Kind::DISCOVERED {
            subscribers.extend(subscription.by_type(kind, &options.topics)?);
        }
        let found = CarTopics::discover(&messages, options, &mut waiting)?;
        let initial_pose = options
            .initial_pose_topic
            .clone()
            .unwrap_or_else(|| in_namespace_of(&found.scan.0, "/initialpose"));
        let clicked_point = in_namespace_of(&found.scan.0, "/clicked_point");
        subscribers.extend(subscription.by_name(Kind::InitialPose, &initial_pose)?);
        subscribers.extend(subscription.by_name(Kind::ClickedPoint, &clicked_point)?);
        let (mount, guessed) = found.mount(options.mount)?;
        Ok(Self {
            messages,
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
            initial_pose,
            undecodable: BTreeMap::new(),
            _subscribers: subscribers,
            _session: session,
        })
    }

    /// True when the laser's pose is a guess: the place where most cars have it.
    pub fn mount_is_a_guess(&self) -> bool {
        self.guessed
    }

    /// For publishing the pose to the car's own nodes; None behind a bridge.
    pub fn ros_connection(&self) -> Option<&RosConnection> {
        self.ros.as_ref()
    }

    /// What the filter gets of a message; None when its topic was not chosen.
    fn feed(&mut self, message: TopicMessage) -> Option<Feed> {
        let TopicMessage { topic, content, .. } = message;
        match content {
            Ok(Content::Scan(scan)) => (topic == self.scan)
                .then(|| Feed::Sensor(SensorEvent::Scan(scan.to_scan(self.mount.upside_down)))),
            Ok(Content::Odometry(odometry)) => {
                (topic == self.odometry).then(|| Feed::Sensor(SensorEvent::Odometry(odometry.to_odometry())))
            }
            Ok(Content::Imu(imu)) => (Some(&topic) == self.imu.as_ref())
                .then(|| Feed::Sensor(SensorEvent::YawRate(imu.to_yaw_rate()))),
            Ok(Content::InitialPose(pose)) => Some(initial_pose(&topic, &pose)),
            Ok(Content::ClickedPoint) => Some(Feed::GlobalSearch { by: topic }),
            // The mount is read once: a laser does not move while the car runs.
            Ok(Content::StaticTransform(_)) => None,
            Err(error) => {
                let count = self.undecodable.entry(topic.clone()).or_insert(0);
                *count += 1;
                count
                    .is_power_of_two()
                    .then(|| Feed::Log(format!("{topic}: {count} messages do not decode: {error}")))
            }
        }
    }
}

/// An initial pose, such as from `RViz`. One that is not in the frame `map` is refused.
fn initial_pose(topic: &str, message: &PoseWithCovarianceStamped) -> Feed {
    let frame = message.header.frame_id.trim_start_matches('/');
    let pose = message.pose.planar();
    if frame != "map" {
        Feed::Log(format!(
            "{topic}: initial pose refused: its frame is {frame:?} and not \"map\""
        ))
    } else if !pose.is_finite() {
        Feed::Log(format!("{topic}: initial pose refused: it is not finite"))
    } else {
        Feed::InitialPose {
            pose,
            by: topic.to_owned(),
        }
    }
}

impl Source for Ros2 {
    fn description(&self) -> String {
        let imu = self.imu.as_ref().map_or(String::new(), |imu| format!(", {imu}"));
        format!(
            "ROS 2 at {}: {}, {}{imu}; initial poses from {}",
            self.endpoint, self.scan, self.odometry, self.initial_pose
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
        match self.messages.recv_timeout(PATIENCE) {
            Ok(message) => match self.feed(message) {
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

/// Joins the ROS side's router as a client. Retries until the router answers.
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

/// Where subscribers are declared, and where their messages go.
struct Subscription<'a> {
    session: &'a Session,
    domain: u32,
    sender: &'a Sender<TopicMessage>,
}

/// A subscriber of any kind, which ends when it is dropped.
type AnySubscriber = Box<dyn Send>;

impl Subscription<'_> {
    /// Every topic of a type with `rmw_zenoh`; the names that are asked for, or the usual ones, behind a bridge.
    fn by_type(&self, kind: Kind, asked: &Topics) -> Result<Vec<AnySubscriber>, Ros2Error> {
        let rmw = format!("{}/**/{}/*", self.domain, kind.dds_type());
        let bridged = kind
            .names(asked)
            .into_iter()
            .map(|name| name.trim_matches('/').to_owned());
        std::iter::once(rmw)
            .chain(bridged)
            .map(|key| self.declare(kind, &key))
            .collect()
    }

    /// One topic, with `rmw_zenoh` and behind a bridge.
    fn by_name(&self, kind: Kind, topic: &str) -> Result<Vec<AnySubscriber>, Ros2Error> {
        let name = topic.trim_matches('/');
        let rmw = format!("{}/{name}/{}/*", self.domain, kind.dds_type());
        [rmw, name.to_owned()]
            .into_iter()
            .map(|key| self.declare(kind, &key))
            .collect()
    }

    fn declare(&self, kind: Kind, key: &str) -> Result<AnySubscriber, Ros2Error> {
        let failed = |error: zenoh::Error| Ros2Error::Zenoh(format!("cannot subscribe to {key}: {error}"));
        // What this node publishes on the same session is no input.
        let subscriber = self
            .session
            .declare_subscriber(key.to_owned())
            .with(listener(kind, self.domain, self.sender))
            .allowed_origin(Locality::Remote);
        // Static transforms are sent once, before this node subscribes. Their publishers keep them for late subscribers.
        Ok(if kind == Kind::StaticTransform {
            let subscriber = subscriber
                .advanced()
                .history(HistoryConfig::default().detect_late_publishers())
                .wait()
                .map_err(failed)?;
            Box::new(subscriber)
        } else {
            Box::new(subscriber.wait().map_err(failed)?)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::messages::{Header, RosPose};

    #[test]
    fn an_initial_pose_is_taken_in_the_frame_map_only() {
        let message = |frame: &str, x| PoseWithCovarianceStamped {
            header: Header {
                frame_id: frame.into(),
                ..Header::default()
            },
            pose: RosPose::from(Pose::new(x, 2.0, 1.0)),
            ..PoseWithCovarianceStamped::default()
        };
        assert!(
            matches!(initial_pose("/initialpose", &message("map", 1.0)), Feed::InitialPose { pose, .. } if pose.distance(Pose::new(1.0, 2.0, 1.0)) < 1e-9)
        );
        assert!(
            matches!(initial_pose("/initialpose", &message("odom", 1.0)), Feed::Log(text) if text.contains("odom"))
        );
        assert!(matches!(
            initial_pose("/initialpose", &message("map", f64::NAN)),
            Feed::Log(_)
        ));
    }
}
