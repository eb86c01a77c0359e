//! Bags of ROS 2 and ROS 1 in every form that recorders leave behind: which topics are in them, and the sensor data in the
//! order it was logged.
//!
//! | file | what it is | maybe compressed by zstd |
//! |---|---|---|
//! | `mcap_reader.rs` | ROS 2, MCAP, with or without an index | the file, chunks, messages |
//! | `sqlite.rs` | ROS 2, SQLite (`.db3`) | the file, messages |
//! | `ros1.rs`, `ros1_message.rs` | ROS 1, format 2.0 | (chunks by bz2 or lz4) |
//!
//! `folder.rs` finds the files of a rosbag2 folder, `reader.rs` opens a file by its first bytes, and `choice.rs` chooses the
//! topics of one car.

mod choice;
mod folder;
mod mcap_reader;
mod reader;
mod ros1;
mod ros1_message;
mod sqlite;

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use maps::Pose;
use serde::de::DeserializeOwned;
use synpf::{ExternalPose, Odometry, PoseOf, Scan, Stamp, YawRate};

use self::reader::{Encoding, Fault, Sink, plain_message};
use crate::ros2::messages::{
    self, Imu, LaserScan, PoseStamped, PoseWithCovarianceStamped, RosOdometry, TfMessage,
};
use crate::ros2::topics;
use crate::sensors::frames::Mount;

/// One message for the localizer.
#[derive(Debug, Clone, PartialEq)]
pub enum SensorEvent {
    /// A laser scan.
    Scan(Scan),
    /// Wheel odometry.
    Odometry(Odometry),
    /// A gyroscope's yaw rate.
    YawRate(YawRate),
    /// A pose from another localizer.
    Pose(ExternalPose),
}

impl SensorEvent {
    /// The message's own stamp.
    pub fn stamp(&self) -> Stamp {
        match self {
            Self::Scan(scan) => scan.stamp,
            Self::Odometry(odometry) => odometry.stamp,
            Self::YawRate(yaw_rate) => yaw_rate.stamp,
            Self::Pose(pose) => pose.stamp,
        }
    }

    /// The message's own stamp, mutable.
    pub fn stamp_mut(&mut self) -> &mut Stamp {
        match self {
            Self::Scan(scan) => &mut scan.stamp,
            Self::Odometry(odometry) => &mut odometry.stamp,
            Self::YawRate(yaw_rate) => &mut yaw_rate.stamp,
            Self::Pose(pose) => &mut pose.stamp,
        }
    }
}

/// A message with the time at which it arrived.
#[derive(Debug, Clone, PartialEq)]
pub struct Arrival {
    /// When it was logged: later than its own stamp by the sensor's latency.
    pub log_time: Stamp,
    /// The message.
    pub event: SensorEvent,
}

/// Which topics to take; None takes the usual names, or else the first of the type.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Topics {
    /// `sensor_msgs/LaserScan`.
    pub scan: Option<String>,
    /// `nav_msgs/Odometry`.
    pub odometry: Option<String>,
    /// `nav_msgs/Odometry` or `geometry_msgs/PoseStamped`.
    pub truth: Option<String>,
    /// `sensor_msgs/Imu`.
    pub imu: Option<String>,
    /// Poses of another localizer: `nav_msgs/Odometry`, `geometry_msgs/PoseStamped`, `geometry_msgs/PoseWithCovarianceStamped`
    /// or `tf2_msgs/TFMessage`. None takes none.
    pub pose: Option<String>,
    /// What these are poses of; None goes by the messages.
    pub pose_of: Option<PoseOf>,
}

/// The usual names, preferred first.
pub(crate) const SCAN_NAMES: [&str; 1] = ["/scan"];
pub(crate) const ODOMETRY_NAMES: [&str; 4] = [
    "/early_fusion/odom",
    "/state_estimation/odom",
    "/vesc/odom",
    "/odom",
];
pub(crate) const TRUTH_NAMES: [&str; 1] = ["/ground_truth/odom"];
/// Where localizers publish their poses as `nav_msgs/Odometry`, ours among them.
const LOCALIZER_OUTPUTS: [&str; 4] = topics::POSES;
pub(crate) const IMU_NAMES: [&str; 2] = ["/sensors/imu/raw", "/imu"];

/// False for a topic of type `nav_msgs/Odometry` that is known to be no wheel odometry: ground truth, and the output of a
/// localizer, in any namespace. Such a topic is taken only if it is asked for by name.
pub(crate) fn is_wheel_odometry(topic: &str) -> bool {
    !TRUTH_NAMES.contains(&topic) && !LOCALIZER_OUTPUTS.iter().any(|output| topic.ends_with(output))
}

/// Why a bag cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum BagError {
    /// The file does not open.
    #[error("{path}: {source}")]
    Open {
        /// The bag.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The file is no bag, is damaged, or has a message that does not decode.
    #[error("{path}: {fault}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What is wrong with it, and where.
        fault: String,
    },
    /// The folder has no bag, or more than one.
    #[error("{path}: {fault}")]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What is wrong with it.
        fault: String,
    },
    /// A topic that is needed, or asked for, is missing.
    #[error("{path}: no topic {wanted}; there is {present}")]
    NoTopic {
        /// The bag.
        path: PathBuf,
        /// What was looked for.
        wanted: String,
        /// What is in the bag.
        present: String,
    },
    /// A topic that is needed is there and empty.
    #[error("{path}: {topic} has no messages")]
    NoMessages {
        /// The bag.
        path: PathBuf,
        /// The topic.
        topic: String,
    },
    /// A topic that is asked for cannot be used.
    #[error("{path}: {topic}: {fault}")]
    Topic {
        /// The bag.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// Why.
        fault: String,
    },
    /// The laser's pose is unknown.
    #[error(
        "{path}: /tf_static does not connect {base_link} with {laser}; give the laser's pose with --laser x,y,heading"
    )]
    NoMount {
        /// The bag.
        path: PathBuf,
        /// The frame that odometry moves.
        base_link: String,
        /// The frame of the scans.
        laser: String,
    },
}

impl BagError {
    fn new(path: &Path, fault: Fault) -> Self {
        match fault {
            Fault::Io(source) => Self::Open {
                path: path.into(),
                source,
            },
            fault => Self::Unreadable {
                path: path.into(),
                fault: fault.to_string(),
            },
        }
    }
}

/// A topic's messages, decoded.
#[derive(Debug)]
enum Messages {
    Scan(Vec<(Stamp, LaserScan)>),
    Odometry(Vec<(Stamp, RosOdometry)>),
    Imu(Vec<(Stamp, Imu)>),
    Pose(Vec<(Stamp, PoseStamped)>),
    PoseWithCovariance(Vec<(Stamp, PoseWithCovarianceStamped)>),
    Tf(Vec<(Stamp, TfMessage)>),
}

impl Messages {
    /// An empty list for the messages of a type; None for other types. ROS 2 puts `msg` in the name, ROS 1 does not.
    fn of_type(name: &str) -> Option<Self> {
        Some(match name.replace("/msg/", "/").as_str() {
            "sensor_msgs/LaserScan" => Self::Scan(Vec::new()),
            "nav_msgs/Odometry" => Self::Odometry(Vec::new()),
            "sensor_msgs/Imu" => Self::Imu(Vec::new()),
            "geometry_msgs/PoseStamped" => Self::Pose(Vec::new()),
            "geometry_msgs/PoseWithCovarianceStamped" => Self::PoseWithCovariance(Vec::new()),
            "tf2_msgs/TFMessage" | "tf/tfMessage" => Self::Tf(Vec::new()),
            _ => return None,
        })
    }

    fn push(&mut self, log_time: Stamp, encoding: Encoding, payload: &[u8]) -> Result<(), String> {
        match self {
            Self::Scan(list) => {
                let mut scan: LaserScan = decode(encoding, payload)?;
                // Half of the memory, and nobody reads them.
                scan.intensities = Vec::new();
                list.push((log_time, scan));
            }
            Self::Odometry(list) => list.push((log_time, decode(encoding, payload)?)),
            Self::Imu(list) => list.push((log_time, decode(encoding, payload)?)),
            Self::Pose(list) => list.push((log_time, decode(encoding, payload)?)),
            Self::PoseWithCovariance(list) => list.push((log_time, decode(encoding, payload)?)),
            Self::Tf(list) => list.push((log_time, decode(encoding, payload)?)),
        }
        Ok(())
    }

    fn len(&self) -> usize {
        match self {
            Self::Scan(list) => list.len(),
            Self::Odometry(list) => list.len(),
            Self::Imu(list) => list.len(),
            Self::Pose(list) => list.len(),
            Self::PoseWithCovariance(list) => list.len(),
            Self::Tf(list) => list.len(),
        }
    }
}

/// Decodes a message, which may be compressed by itself.
fn decode<T: DeserializeOwned>(encoding: Encoding, payload: &[u8]) -> Result<T, String> {
    match encoding {
        Encoding::Cdr => {
            let plain = plain_message(payload).map_err(|error| format!("zstd: {error}"))?;
            messages::decode(plain.as_deref().unwrap_or(payload)).map_err(|error| error.to_string())
        }
        Encoding::Ros1 => ros1_message::decode(payload).map_err(|error| error.to_string()),
    }
}

/// The messages of a bag that a localizer needs, in memory (about 10 MB a minute at 40 scans a second).
#[derive(Debug)]
pub struct Bag {
    path: PathBuf,
    topics: BTreeMap<String, Messages>,
    notes: Vec<String>,
}

/// Most that is kept of the messages of one bag \[bytes\]: seven hours of a car.
const MOST_KEPT: u64 = 4 << 30;

/// Collects the topics that a localizer needs.
#[derive(Default)]
struct Collector {
    topics: BTreeMap<String, (Encoding, Messages)>,
    taken: u64,
    bytes: u64,
}

impl Sink for Collector {
    fn topic(&mut self, name: &str, message_type: &str, encoding: Encoding) -> bool {
        if !self.topics.contains_key(name) {
            let Some(messages) = Messages::of_type(message_type) else {
                return false;
            };
            self.topics.insert(name.into(), (encoding, messages));
        }
        true
    }

    fn message(&mut self, topic: &str, log_time: Stamp, payload: &[u8]) -> Result<(), Fault> {
        let Some((encoding, messages)) = self.topics.get_mut(topic) else {
            return Ok(());
        };
        self.taken += 1;
        self.bytes += payload.len() as u64;
        if self.bytes > MOST_KEPT {
            return Err(Fault::TooLarge(MOST_KEPT));
        }
        messages
            .push(log_time, *encoding, payload)
            .map_err(|fault| Fault::Message {
                topic: topic.into(),
                number: messages.len() + 1,
                fault,
            })
    }

    fn taken(&self) -> u64 {
        self.taken
    }
}

/// Poses by the time at which they were true.
pub type StampedPoses = Vec<(Stamp, Pose)>;

/// The sensor data of a bag.
#[derive(Debug, Clone)]
pub struct SensorLog {
    /// Every message, in the order it arrived.
    pub arrivals: Vec<Arrival>,
    /// How the laser is mounted; None without `/tf_static`.
    pub mount: Option<Mount>,
    /// True poses, `map_from_base_link`, by stamp; empty when the bag has none.
    pub truth: StampedPoses,
    /// The topics taken.
    pub topics: Topics,
    /// What the user should know of how it was read, one sentence each.
    pub notes: Vec<String>,
}

impl SensorLog {
    /// The stamps of the first and of the last scan; None without one.
    pub fn span(&self) -> Option<[Stamp; 2]> {
        let mut scans = self.arrivals.iter().filter_map(|arrival| match &arrival.event {
            SensorEvent::Scan(scan) => Some(scan.stamp),
            _ => None,
        });
        let first = scans.next()?;
        Some([first, scans.next_back().unwrap_or(first)])
    }

    /// Keeps the part that starts `from` after the first scan and lasts `lasting` \[s\], with the odometry just before its first
    /// scan. A log without a scan stays as it is.
    pub fn keep(&mut self, from: f64, lasting: f64) {
        /// Odometry this long before the part is kept \[s\].
        const LEAD: f64 = 0.2;
        let Some([first, _]) = self.span() else {
            return;
        };
        let begin = first.plus(from);
        let within = |stamp: Stamp, lead: f64| (-lead..lasting).contains(&stamp.since(begin));
        self.arrivals.retain(|arrival| {
            let lead = if matches!(arrival.event, SensorEvent::Scan(_)) {
                0.0
            } else {
                LEAD
            };
            within(arrival.event.stamp(), lead)
        });
        self.truth.retain(|(stamp, _)| within(*stamp, LEAD));
    }
}

impl Bag {
    /// Reads a bag: a file, or a folder as rosbag2 leaves it. Topics that no localizer needs are skipped. A file that is cut
    /// off is read as far as it goes.
    pub fn read(path: &Path) -> Result<Self, BagError> {
        let folder::Contents { files, topics, note } = folder::files(path)?;
        let mut notes: Vec<String> = note.into_iter().collect();
        let mut collector = Collector::default();
        for (name, message_type, encoding) in &topics {
            collector.topic(name, message_type, *encoding);
        }
        for file in &files {
            let before = collector.taken();
            match reader::read_file(file, &mut collector) {
                Ok(()) => {}
                // What came before it is whole.
                Err(fault @ Fault::CutOff { .. }) if collector.taken() > before => {
                    notes.push(format!("{}: {fault}; read as far as it goes", file.display()));
                }
                Err(fault) => return Err(BagError::new(file, fault)),
            }
        }
        Ok(Self {
            path: path.into(),
            topics: collector
                .topics
                .into_iter()
                .map(|(name, (_, messages))| (name, messages))
                .collect(),
            notes,
        })
    }

    /// The file or folder it was read from.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_damaged_bag_is_an_error_that_names_the_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("drive.mcap");
        let mut writer = mcap::Writer::new(io::Cursor::new(Vec::new())).expect("begun");
        let channel = writer
            .add_channel(0, "/chatter", "cdr", &BTreeMap::new())
            .expect("added");
        let header = mcap::records::MessageHeader {
            channel_id: channel,
            sequence: 1,
            log_time: 1,
            publish_time: 1,
        };
        writer.write_to_known_channel(&header, b"hello").expect("written");
        writer.finish().expect("ended");
        let bytes = writer.into_inner().into_inner();
        std::fs::write(&path, &bytes).expect("written");
        assert!(Bag::read(&path).is_ok());

        let chunk = bytes
            .windows(4)
            .position(|part| part == b"zstd")
            .expect("a chunk");
        // The highest byte of the chunk's compressed size, and a byte of its content.
        for at in [chunk + 4 + 7, chunk + 4 + 8 + 8] {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0xff;
            std::fs::write(&path, &damaged).expect("written");
            let text = Bag::read(&path).expect_err("damaged").to_string();
            assert!(
                text.contains("drive.mcap: not a readable MCAP file after 0 messages"),
                "{text}"
            );
        }
        std::fs::write(&path, &bytes[..chunk + 20]).expect("written");
        let text = Bag::read(&path).expect_err("cut off").to_string();
        assert!(
            text.contains("drive.mcap") && text.contains("mcap recover"),
            "{text}"
        );
    }
}
