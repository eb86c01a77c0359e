//! The topics that a car's sensors come on: types, usual names, and how zenoh keys name them.

use crossbeam_channel::Sender;
use serde::de::DeserializeOwned;
use zenoh::handlers::Callback;
use zenoh::sample::Sample;

use crate::ros2::messages::{
    self, CdrError, Imu, LaserScan, PointStamped, PoseWithCovarianceStamped, RosOdometry, TfMessage,
};
use crate::sensors::bag::{IMU_NAMES, ODOMETRY_NAMES, SCAN_NAMES, Topics};

/// The kinds of messages that the node subscribes to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Scan,
    Odometry,
    Imu,
    StaticTransform,
    InitialPose,
    ClickedPoint,
}

impl Kind {
    /// The kinds from which the car's topics are discovered. The other two have one name each.
    pub(super) const DISCOVERED: [Self; 4] = [Self::Scan, Self::Odometry, Self::Imu, Self::StaticTransform];

    /// The type as the keys of `rmw_zenoh` spell it.
    pub(super) fn dds_type(self) -> &'static str {
        match self {
            Self::Scan => "sensor_msgs::msg::dds_::LaserScan_",
            Self::Odometry => "nav_msgs::msg::dds_::Odometry_",
            Self::Imu => "sensor_msgs::msg::dds_::Imu_",
            Self::StaticTransform => "tf2_msgs::msg::dds_::TFMessage_",
            Self::InitialPose => "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_",
            Self::ClickedPoint => "geometry_msgs::msg::dds_::PointStamped_",
        }
    }

    /// The type as ROS spells it.
    pub(super) fn ros_type(self) -> String {
        self.dds_type()
            .trim_end_matches('_')
            .replace("::msg::dds_::", "/msg/")
    }

    /// The topic that was asked for, or else the usual names, the preferred one first.
    pub(super) fn names(self, asked: &Topics) -> Vec<&str> {
        let (asked, usual): (_, &[&str]) = match self {
            Self::Scan => (&asked.scan, &SCAN_NAMES),
            Self::Odometry => (&asked.odometry, &ODOMETRY_NAMES),
            Self::Imu => (&asked.imu, &IMU_NAMES),
            Self::StaticTransform => (&None, &["/tf_static"]),
            Self::InitialPose => (&None, &["/initialpose"]),
            Self::ClickedPoint => (&None, &["/clicked_point"]),
        };
        asked
            .as_deref()
            .map_or_else(|| usual.to_vec(), |asked| vec![asked])
    }

    pub(super) fn decode(self, payload: &[u8]) -> Result<Content, CdrError> {
        fn of<T: DeserializeOwned>(payload: &[u8]) -> Result<Box<T>, CdrError> {
            messages::decode(payload).map(Box::new)
        }
        Ok(match self {
            Self::Scan => Content::Scan(of(payload)?),
            Self::Odometry => Content::Odometry(of(payload)?),
            Self::Imu => Content::Imu(of(payload)?),
            Self::StaticTransform => Content::StaticTransform(of(payload)?),
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
    StaticTransform(Box<TfMessage>),
    InitialPose(Box<PoseWithCovarianceStamped>),
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
    pub(super) content: Result<Content, CdrError>,
}

/// Decodes messages in zenoh's thread and queues them. A message that finds the queue full is dropped.
pub(super) fn listener(kind: Kind, domain: u32, sender: &Sender<TopicMessage>) -> Callback<Sample> {
    let sender = sender.clone();
    Callback::from(move |sample: Sample| {
        let (topic, hash) = topic(sample.key_expr().as_str(), kind, domain);
        // Moving transforms have the same type.
        if kind == Kind::StaticTransform && !topic.ends_with("tf_static") {
            return;
        }
        let content = kind.decode(&sample.payload().to_bytes());
        if sender.try_send(TopicMessage { topic, hash, content }).is_err() {
            tracing::debug!("the queue is full: a message from ROS is dropped");
        }
    })
}

/// The ROS name of a key, and the hash of the type where the key has one.
pub(super) fn topic(key: &str, kind: Kind, domain: u32) -> (String, Option<String>) {
    let rmw = || {
        let (rest, hash) = key.strip_prefix(&format!("{domain}/"))?.rsplit_once('/')?;
        Some((rest.strip_suffix(kind.dds_type())?.strip_suffix('/')?, hash))
    };
    match rmw() {
        Some((name, hash)) => (format!("/{name}"), Some(hash.to_owned())),
        None => (format!("/{key}"), None),
    }
}

/// The topic `name` in the namespace of the scan: `/initialpose` for `/scan`, `/car2/initialpose` for `/car2/scan`.
pub(super) fn in_namespace_of(scan: &str, name: &str) -> String {
    let namespace = scan.rsplit_once('/').map_or("", |(namespace, _)| namespace);
    format!("{namespace}{name}")
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

    #[test]
    fn a_topic_is_in_the_namespace_of_the_scan() {
        assert_eq!(in_namespace_of("/scan", "/initialpose"), "/initialpose");
        assert_eq!(in_namespace_of("/car2/scan", "/initialpose"), "/car2/initialpose");
        assert_eq!(
            in_namespace_of("/team/car2/scan", "/initialpose"),
            "/team/car2/initialpose"
        );
    }
}
