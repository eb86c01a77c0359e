//! What is listened for, and how the ROS side names it.

use crossbeam_channel::Sender;
use serde::de::DeserializeOwned;
use zenoh::handlers::Callback;
use zenoh::sample::Sample;

use crate::ros2::messages::{
    self, CdrError, Imu, LaserScan, PoseWithCovarianceStamped, RosOdometry, TfMessage,
};
use crate::sensors::bag::{IMU_NAMES, ODOMETRY_NAMES, SCAN_NAMES, Topics};

/// The types that are listened for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Scan,
    Odometry,
    Imu,
    StaticTransform,
    InitialPose,
}

impl Kind {
    pub(super) const ALL: [Self; 5] = [
        Self::Scan,
        Self::Odometry,
        Self::Imu,
        Self::StaticTransform,
        Self::InitialPose,
    ];

    /// The type as `rmw_zenoh`'s keys spell it.
    pub(super) fn dds_type(self) -> &'static str {
        match self {
            Self::Scan => "sensor_msgs::msg::dds_::LaserScan_",
            Self::Odometry => "nav_msgs::msg::dds_::Odometry_",
            Self::Imu => "sensor_msgs::msg::dds_::Imu_",
            Self::StaticTransform => "tf2_msgs::msg::dds_::TFMessage_",
            Self::InitialPose => "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_",
        }
    }

    /// The type as ROS spells it.
    pub(super) fn ros_type(self) -> String {
        self.dds_type()
            .trim_end_matches('_')
            .replace("::msg::dds_::", "/msg/")
    }

    /// The topic that is wanted, or else the usual names, the preferred one first.
    pub(super) fn names(self, wanted: &Topics) -> Vec<&str> {
        let (wanted, usual): (_, &[&str]) = match self {
            Self::Scan => (&wanted.scan, &SCAN_NAMES),
            Self::Odometry => (&wanted.odometry, &ODOMETRY_NAMES),
            Self::Imu => (&wanted.imu, &IMU_NAMES),
            Self::StaticTransform => (&None, &["/tf_static"]),
            Self::InitialPose => (&None, &["/initialpose"]),
        };
        wanted
            .as_deref()
            .map_or_else(|| usual.to_vec(), |wanted| vec![wanted])
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
        })
    }
}

/// A message, decoded.
#[derive(Debug)]
pub(super) enum Content {
    Scan(Box<LaserScan>),
    Odometry(Box<RosOdometry>),
    Imu(Box<Imu>),
    StaticTransform(Box<TfMessage>),
    InitialPose(Box<PoseWithCovarianceStamped>),
}

/// What zenoh has brought.
#[derive(Debug)]
pub(super) struct Heard {
    /// The ROS name, with its leading slash.
    pub(super) topic: String,
    /// The type's hash, which `rmw_zenoh` has in its keys.
    pub(super) hash: Option<String>,
    pub(super) content: Result<Content, CdrError>,
}

/// Decodes in zenoh's thread and hands on; what finds the queue full is gone.
pub(super) fn listener(kind: Kind, domain: u32, sender: &Sender<Heard>) -> Callback<Sample> {
    let sender = sender.clone();
    Callback::from(move |sample: Sample| {
        let (topic, hash) = topic(sample.key_expr().as_str(), kind, domain);
        // Moving transforms are of the same type.
        if kind == Kind::StaticTransform && !topic.ends_with("tf_static") {
            return;
        }
        let content = kind.decode(&sample.payload().to_bytes());
        if sender.try_send(Heard { topic, hash, content }).is_err() {
            tracing::debug!("messages from ROS come faster than they are taken");
        }
    })
}

/// The ROS name of a key, and the hash of the type where there is one.
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
