//! ROS 2 bags (MCAP): which topics are in them, and the sensor data in the order it was logged.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};

use maps::Pose;
use mcap::McapError;
use synpf::{Odometry, Scan, Stamp, YawRate};

use crate::ros2::messages::{self, CdrError, Imu, LaserScan, PoseStamped, RosOdometry, TfMessage};
use crate::ros2::topics;
use crate::sensors::frames::{Frames, Mount};
use crate::sensors::mcap_reader::McapReader;

/// One message for the localizer.
#[derive(Debug, Clone, PartialEq)]
pub enum SensorEvent {
    /// A laser scan.
    Scan(Scan),
    /// Wheel odometry.
    Odometry(Odometry),
    /// A gyroscope's yaw rate.
    YawRate(YawRate),
}

impl SensorEvent {
    /// The message's own stamp.
    pub fn stamp(&self) -> Stamp {
        match self {
            Self::Scan(scan) => scan.stamp,
            Self::Odometry(odometry) => odometry.stamp,
            Self::YawRate(yaw_rate) => yaw_rate.stamp,
        }
    }

    /// The message's own stamp, mutable.
    pub fn stamp_mut(&mut self) -> &mut Stamp {
        match self {
            Self::Scan(scan) => &mut scan.stamp,
            Self::Odometry(odometry) => &mut odometry.stamp,
            Self::YawRate(yaw_rate) => &mut yaw_rate.stamp,
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
const LOCALIZER_OUTPUTS: [&str; 1] = [topics::POSE_ODOMETRY];
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
    /// The file is not MCAP, or is damaged.
    #[error("{path}: not a readable MCAP file after {messages} messages: {source}{}", advice(.source))]
    Mcap {
        /// The bag.
        path: PathBuf,
        /// Messages read before the fault.
        messages: u64,
        /// Why.
        source: McapError,
    },
    /// A message does not decode.
    #[error("{path}: {topic}: message {number}: {source}")]
    Message {
        /// The bag.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// Counted on the topic, from 1.
        number: usize,
        /// Why.
        source: CdrError,
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

/// Advice for a file that does not read.
fn advice(fault: &McapError) -> &'static str {
    match fault {
        McapError::BadMagic => " (`ros2 bag convert` makes one of a .db3 bag)",
        McapError::UnexpectedEof => " (`mcap recover` saves what is intact)",
        _ => "",
    }
}

/// A topic's messages, decoded.
#[derive(Debug)]
enum Messages {
    Scan(Vec<(Stamp, LaserScan)>),
    Odometry(Vec<(Stamp, RosOdometry)>),
    Imu(Vec<(Stamp, Imu)>),
    Pose(Vec<(Stamp, PoseStamped)>),
    Tf(Vec<(Stamp, TfMessage)>),
}

impl Messages {
    /// An empty list for the messages of a schema; None for other schemas. ROS 2 puts `msg` in the name, ROS 1 does not.
    fn of_schema(name: &str) -> Option<Self> {
        Some(match name.replace("/msg/", "/").as_str() {
            "sensor_msgs/LaserScan" => Self::Scan(Vec::new()),
            "nav_msgs/Odometry" => Self::Odometry(Vec::new()),
            "sensor_msgs/Imu" => Self::Imu(Vec::new()),
            "geometry_msgs/PoseStamped" => Self::Pose(Vec::new()),
            "tf2_msgs/TFMessage" => Self::Tf(Vec::new()),
            _ => return None,
        })
    }

    fn push(&mut self, log_time: Stamp, payload: &[u8]) -> Result<(), CdrError> {
        match self {
            Self::Scan(list) => list.push((log_time, messages::decode(payload)?)),
            Self::Odometry(list) => list.push((log_time, messages::decode(payload)?)),
            Self::Imu(list) => list.push((log_time, messages::decode(payload)?)),
            Self::Pose(list) => list.push((log_time, messages::decode(payload)?)),
            Self::Tf(list) => list.push((log_time, messages::decode(payload)?)),
        }
        Ok(())
    }

    fn len(&self) -> usize {
        match self {
            Self::Scan(list) => list.len(),
            Self::Odometry(list) => list.len(),
            Self::Imu(list) => list.len(),
            Self::Pose(list) => list.len(),
            Self::Tf(list) => list.len(),
        }
    }
}

/// The messages of a bag that a localizer needs, in memory (about 10 MB a minute at 40 scans a second).
#[derive(Debug)]
pub struct Bag {
    path: PathBuf,
    topics: BTreeMap<String, Messages>,
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
    /// Reads a bag. Topics that no localizer needs are skipped.
    pub fn read(path: &Path) -> Result<Self, BagError> {
        let open = || {
            if path.is_dir() {
                let advice = "is a folder: give the .mcap file in it";
                return Err(io::Error::new(io::ErrorKind::IsADirectory, advice));
            }
            File::open(path)
        };
        let file = open().map_err(|source| BagError::Open {
            path: path.into(),
            source,
        })?;
        let mut topics = BTreeMap::<String, Messages>::new();
        let reader = McapReader::new(BufReader::new(file));
        for (count, message) in reader.enumerate() {
            let message = message.map_err(|source| BagError::Mcap {
                path: path.into(),
                messages: count as u64,
                source,
            })?;
            let channel = &message.channel;
            if channel.message_encoding != "cdr" {
                continue;
            }
            if !topics.contains_key(&channel.topic) {
                let schema = channel.schema.as_ref().map_or("", |schema| schema.name.as_str());
                if let Some(messages) = Messages::of_schema(schema) {
                    topics.insert(channel.topic.clone(), messages);
                }
            }
            if let Some(messages) = topics.get_mut(&channel.topic) {
                let log_time = Stamp(i64::try_from(message.log_time).unwrap_or(i64::MAX));
                messages
                    .push(log_time, &message.data)
                    .map_err(|source| BagError::Message {
                        path: path.into(),
                        topic: channel.topic.clone(),
                        number: messages.len() + 1,
                        source,
                    })?;
            }
        }
        Ok(Self {
            path: path.into(),
            topics,
        })
    }

    /// The file it was read from.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The sensor data. `mount` overrides `/tf_static`.
    pub fn sensors(&self, wanted: &Topics, mount: Option<Mount>) -> Result<SensorLog, BagError> {
        let (scan_topic, scans) = self
            .find(
                "LaserScan",
                wanted.scan.as_deref(),
                &SCAN_NAMES,
                None,
                |m| match m {
                    Messages::Scan(list) => Some(list),
                    _ => None,
                },
            )?
            .ok_or_else(|| self.missing("of type sensor_msgs/LaserScan"))?;
        // Truth first, so that it is not taken for odometry.
        let truth = self.truth(wanted.truth.as_deref())?;
        let truth_topic = truth.as_ref().map(|(topic, _)| topic.as_str());
        let (odometry_topic, odometry) = self
            .find(
                "Odometry",
                wanted.odometry.as_deref(),
                &ODOMETRY_NAMES,
                truth_topic,
                |m| match m {
                    Messages::Odometry(list) => Some(list),
                    _ => None,
                },
            )?
            .ok_or_else(|| self.missing("of type nav_msgs/Odometry"))?;
        let imu = self.find("Imu", wanted.imu.as_deref(), &IMU_NAMES, None, |m| match m {
            Messages::Imu(list) => Some(list),
            _ => None,
        })?;

        let mount = match mount {
            Some(mount) => Some(mount),
            None => self.mount(odometry, scans)?,
        };
        let upside_down = mount.is_some_and(|mount| mount.upside_down);
        let mut arrivals = Vec::with_capacity(scans.len() + odometry.len());
        let arrival = |&log_time: &Stamp, event| Arrival { log_time, event };
        // Of messages with the same log time, odometry comes first: the prediction for a scan needs it.
        arrivals.extend(
            odometry
                .iter()
                .map(|(t, m)| arrival(t, SensorEvent::Odometry(m.to_odometry()))),
        );
        if let Some((_, imu)) = imu {
            arrivals.extend(
                imu.iter()
                    .map(|(t, m)| arrival(t, SensorEvent::YawRate(m.to_yaw_rate()))),
            );
        }
        arrivals.extend(
            scans
                .iter()
                .map(|(t, m)| arrival(t, SensorEvent::Scan(m.to_scan(upside_down)))),
        );
        arrivals.sort_by_key(|arrival| arrival.log_time);
        Ok(SensorLog {
            arrivals,
            mount,
            topics: Topics {
                scan: Some(scan_topic.to_owned()),
                odometry: Some(odometry_topic.to_owned()),
                truth: truth_topic.map(str::to_owned),
                imu: imu.map(|(topic, _)| topic.to_owned()),
            },
            truth: truth.map(|(_, poses)| poses).unwrap_or_default(),
        })
    }

    /// The topic `wanted`, or else the first of the usual names, or else the first of its kind in the bag that is
    /// not `taken` for something else.
    fn find<'a, T>(
        &'a self,
        kind: &str,
        wanted: Option<&str>,
        usual: &[&str],
        taken: Option<&str>,
        of_kind: impl Fn(&'a Messages) -> Option<&'a Vec<T>>,
    ) -> Result<Option<(&'a String, &'a Vec<T>)>, BagError> {
        let named = |name: &str| {
            let (topic, messages) = self.topics.get_key_value(name)?;
            Some((topic, of_kind(messages)?))
        };
        if let Some(name) = wanted {
            return named(name)
                .map(Some)
                .ok_or_else(|| self.missing(&format!("{name} of type {kind}")));
        }
        let free = |topic: &str| taken != Some(topic) && is_wheel_odometry(topic);
        let usual = usual.iter().filter(|name| free(name));
        Ok(usual.into_iter().find_map(|name| named(name)).or_else(|| {
            self.topics
                .iter()
                .filter(|(topic, _)| free(topic))
                .find_map(|(topic, messages)| Some((topic, of_kind(messages)?)))
        }))
    }

    fn truth(&self, wanted: Option<&str>) -> Result<Option<(String, StampedPoses)>, BagError> {
        let names: Vec<&str> = wanted.map_or(TRUTH_NAMES.to_vec(), |name| vec![name]);
        let found = names.iter().find_map(|name| {
            let (topic, messages) = self.topics.get_key_value(*name)?;
            let poses: StampedPoses = match messages {
                Messages::Odometry(list) => list
                    .iter()
                    .map(|(_, m)| (m.header.stamp.into(), m.pose.planar()))
                    .collect(),
                Messages::Pose(list) => list
                    .iter()
                    .map(|(_, m)| (m.header.stamp.into(), m.pose.planar()))
                    .collect(),
                _ => return None,
            };
            Some((topic.clone(), poses))
        });
        match (found, wanted) {
            (None, Some(name)) => Err(self.missing(&format!(
                "{name} of type nav_msgs/Odometry or geometry_msgs/PoseStamped"
            ))),
            (found, _) => Ok(found),
        }
    }

    /// The mount by `/tf_static`; None in a bag without it.
    fn mount(
        &self,
        odometry: &[(Stamp, RosOdometry)],
        scans: &[(Stamp, LaserScan)],
    ) -> Result<Option<Mount>, BagError> {
        let mut frames = Frames::default();
        for (topic, messages) in &self.topics {
            if let Messages::Tf(list) = messages
                && topic.ends_with("tf_static")
            {
                for transform in list.iter().flat_map(|(_, message)| &message.transforms) {
                    frames.insert(transform);
                }
            }
        }
        let (Some((_, odometry)), Some((_, scan))) = (odometry.first(), scans.first()) else {
            return Ok(None);
        };
        if frames.is_empty() {
            return Ok(None);
        }
        let (base_link, laser) = (&odometry.child_frame_id, &scan.header.frame_id);
        frames
            .mount(base_link, laser)
            .map(Some)
            .ok_or_else(|| BagError::NoMount {
                path: self.path.clone(),
                base_link: base_link.clone(),
                laser: laser.clone(),
            })
    }

    fn missing(&self, wanted: &str) -> BagError {
        let present = self.topics.keys().map(String::as_str).collect::<Vec<_>>();
        BagError::NoTopic {
            path: self.path.clone(),
            wanted: wanted.into(),
            present: if present.is_empty() {
                "none that a localizer can use".into()
            } else {
                present.join(", ")
            },
        }
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
            assert!(text.contains("drive.mcap: not a readable MCAP file"), "{text}");
        }
        std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("written");
        let text = Bag::read(&path).expect_err("cut off").to_string();
        assert!(text.contains("drive.mcap"), "{text}");
    }
}
