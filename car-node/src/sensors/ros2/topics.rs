//! The topics that a car's sensors come on: types, usual names, how zenoh keys name them, and how their messages are read.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Instant;

use crossbeam_channel::Sender;
use serde::de::DeserializeOwned;
use zenoh::handlers::Callback;
use zenoh::sample::Sample;

use crate::ros2::messages::{
    self, CdrError, Imu, LaserScan, PointStamped, PoseWithCovarianceStamped, RosOdometry, TfMessage,
};
use crate::ros2::types::{self, RosType};
use crate::sensors::bag::{IMU_NAMES, ODOMETRY_NAMES, SCAN_NAMES, Topics};
use crate::sensors::external_pose::PoseMessage;

/// The kinds of messages that the node subscribes to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Scan,
    Odometry,
    Imu,
    Transforms,
    InitialPose,
    ClickedPoint,
}

impl Kind {
    /// The kinds from which the car's topics are discovered. The other two have one name each.
    pub(super) const DISCOVERED: [Self; 4] = [Self::Scan, Self::Odometry, Self::Imu, Self::Transforms];

    /// The message type.
    pub(super) fn ros_type(self) -> RosType {
        match self {
            Self::Scan => types::LASER_SCAN,
            Self::Odometry => types::ODOMETRY,
            Self::Imu => types::IMU,
            Self::Transforms => types::TF_MESSAGE,
            Self::InitialPose => types::POSE_WITH_COVARIANCE_STAMPED,
            Self::ClickedPoint => types::POINT_STAMPED,
        }
    }

    /// The kind that is discovered by a type, as keys spell it.
    pub(super) fn of_type(dds: &str) -> Option<Self> {
        Self::DISCOVERED
            .into_iter()
            .find(|kind| kind.ros_type().dds == dds)
    }

    /// The usual names in a car's namespace, the preferred one first.
    pub(super) fn usual_names(self) -> &'static [&'static str] {
        match self {
            Self::Scan => &SCAN_NAMES,
            Self::Odometry => &ODOMETRY_NAMES,
            Self::Imu => &IMU_NAMES,
            Self::Transforms => &["/tf_static", "/tf"],
            Self::InitialPose => &["/initialpose"],
            Self::ClickedPoint => &["/clicked_point"],
        }
    }

    /// The topic that was asked for.
    pub(super) fn asked(self, asked: &Topics) -> Option<&str> {
        match self {
            Self::Scan => asked.scan.as_deref(),
            Self::Odometry => asked.odometry.as_deref(),
            Self::Imu => asked.imu.as_deref(),
            Self::Transforms | Self::InitialPose | Self::ClickedPoint => None,
        }
    }

    pub(super) fn decode(self, payload: &[u8]) -> Result<Content, CdrError> {
        fn of<T: DeserializeOwned>(payload: &[u8]) -> Result<Box<T>, CdrError> {
            messages::decode(payload).map(Box::new)
        }
        Ok(match self {
            Self::Scan => Content::Scan(of(payload)?),
            Self::Odometry => Content::Odometry(of(payload)?),
            Self::Imu => Content::Imu(of(payload)?),
            Self::Transforms => Content::Transforms(of(payload)?),
            Self::InitialPose => Content::InitialPose(of(payload)?),
            Self::ClickedPoint => {
                of::<PointStamped>(payload)?;
                Content::ClickedPoint
            }
        })
    }
}

/// A decoded message.
#[derive(Debug)]
pub(super) enum Content {
    Scan(Box<LaserScan>),
    Odometry(Box<RosOdometry>),
    Imu(Box<Imu>),
    Transforms(Box<TfMessage>),
    InitialPose(Box<PoseWithCovarianceStamped>),
    /// Of another localizer.
    Pose(PoseMessage),
    /// Where the point is does not matter.
    ClickedPoint,
}

/// A message with its topic.
#[derive(Debug)]
pub(super) struct TopicMessage {
    /// The ROS name, with its leading slash.
    pub(super) topic: String,
    /// The hash of the type, which the keys of `rmw_zenoh` contain.
    pub(super) hash: Option<String>,
    /// When it came in.
    pub(super) arrival: Instant,
    pub(super) content: Result<Content, CdrError>,
}

/// What the listeners in zenoh's threads share with the source.
#[derive(Debug, Clone)]
pub(super) struct Intake {
    sender: Sender<TopicMessage>,
    /// The topics to read; None while all are.
    wanted: Arc<RwLock<Option<BTreeSet<String>>>>,
    /// Messages that found the queue full.
    dropped: Arc<AtomicU64>,
}

impl Intake {
    pub(super) fn new(sender: Sender<TopicMessage>) -> Self {
        Self {
            sender,
            wanted: Arc::default(),
            dropped: Arc::default(),
        }
    }

    /// Reads only these topics from now on.
    pub(super) fn read_only(&self, topics: BTreeSet<String>) {
        *self.wanted.write().unwrap_or_else(PoisonError::into_inner) = Some(topics);
    }

    fn wants(&self, topic: &str) -> bool {
        let wanted = self.wanted.read().unwrap_or_else(PoisonError::into_inner);
        wanted.as_ref().is_none_or(|topics| topics.contains(topic))
    }

    /// How many messages have found the queue full.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// The same for the poses of another localizer on `topic`, of whatever type.
pub(super) fn pose_listener(topic: &str, intake: &Intake) -> Callback<Sample> {
    let (intake, topic) = (intake.clone(), topic.to_owned());
    Callback::from(move |sample: Sample| {
        let message = TopicMessage {
            content: PoseMessage::decode(&sample.payload().to_bytes()).map(Content::Pose),
            topic: topic.clone(),
            hash: None,
            arrival: Instant::now(),
        };
        if intake.sender.try_send(message).is_err() {
            intake.dropped.fetch_add(1, Ordering::Relaxed);
        }
    })
}

/// Decodes messages in zenoh's thread and queues them. A message that finds the queue full is dropped and counted.
pub(super) fn listener(kind: Kind, domain: u32, intake: &Intake) -> Callback<Sample> {
    let intake = intake.clone();
    Callback::from(move |sample: Sample| {
        let arrival = Instant::now();
        let key = sample.key_expr().as_str();
        // Telemetry for the pit wall may be on the same router, and has topics of such names.
        if key.starts_with("synpf/") {
            return;
        }
        let (topic, hash) = topic(key, kind, domain);
        let named = |name: &&str| topic.ends_with(*name);
        if !intake.wants(&topic) || (kind == Kind::Transforms && !kind.usual_names().iter().any(named)) {
            return;
        }
        let message = TopicMessage {
            content: kind.decode(&sample.payload().to_bytes()),
            topic,
            hash,
            arrival,
        };
        if intake.sender.try_send(message).is_err() {
            intake.dropped.fetch_add(1, Ordering::Relaxed);
        }
    })
}

/// The ROS name of a key, and the hash of the type where the key has one.
pub(super) fn topic(key: &str, kind: Kind, domain: u32) -> (String, Option<String>) {
    let rmw = || {
        let (rest, hash) = key.strip_prefix(&format!("{domain}/"))?.rsplit_once('/')?;
        Some((rest.strip_suffix(kind.ros_type().dds)?.strip_suffix('/')?, hash))
    };
    match rmw() {
        Some((name, hash)) => (format!("/{name}"), Some(hash.to_owned())),
        None => (format!("/{key}"), None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_of_rmw_zenoh_and_of_a_bridge_name_the_same_topic() {
        let rmw = "0/car/scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_64c1";
        let named = |name: &str, hash: Option<&str>| (name.to_owned(), hash.map(str::to_owned));
        assert_eq!(topic(rmw, Kind::Scan, 0), named("/car/scan", Some("RIHS01_64c1")));
        assert_eq!(topic("car/scan", Kind::Scan, 0), named("/car/scan", None));
        let humble = "7/odom/nav_msgs::msg::dds_::Odometry_/TypeHashNotSupported";
        assert_eq!(
            topic(humble, Kind::Odometry, 7),
            named("/odom", Some("TypeHashNotSupported"))
        );
    }
}
