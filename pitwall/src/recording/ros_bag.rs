//! Writes one car of a recording as a ROS 2 bag: `ros2 bag play`, `car-node evaluate --bag` and ROS tools read it.
//!
//! | topic | type | from |
//! |---|---|---|
//! | `/scan` | `sensor_msgs/msg/LaserScan` | the full-rate scans |
//! | `/odom` | `nav_msgs/msg/Odometry` | wheel odometry |
//! | `/pose` | `geometry_msgs/msg/PoseWithCovarianceStamped` | the estimate, in `map` |
//! | `/ground_truth/odom` | `nav_msgs/msg/Odometry` | the truth, in `map` |
//! | `/tf` | `tf2_msgs/msg/TFMessage` | the estimate, `map` to `base_link` |
//! | `/tf_static` | `tf2_msgs/msg/TFMessage` | the laser on the car |
//!
//! Stamps are those of the sensors, times of the bag those of publishing, both by the car's clock.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions, Writer};
use protocol::ros::{self, BASE_LINK, LASER, LaserScan, MAP, ODOM};
use protocol::{Header, Pose2, RecordedScan, Telemetry};

/// A bag being written: a folder with one MCAP file and `metadata.yaml`.
pub struct RosBag {
    writer: Writer<BufWriter<File>>,
    file: String,
    /// Each topic with its channel and the number of its messages.
    channels: BTreeMap<&'static str, (u16, &'static str, u64)>,
    /// The first and the last time \[unix ns\].
    span: Option<(i64, i64)>,
    mount: Option<Pose2>,
}

const SCAN: (&str, &str) = ("/scan", ros::LASER_SCAN);
const ODOMETRY: (&str, &str) = ("/odom", ros::ODOMETRY);
const POSE: (&str, &str) = ("/pose", ros::POSE_WITH_COVARIANCE);
const TRUTH: (&str, &str) = ("/ground_truth/odom", ros::ODOMETRY);
const TF: (&str, &str) = ("/tf", ros::TRANSFORMS);
const TF_STATIC: (&str, &str) = ("/tf_static", ros::TRANSFORMS);

impl RosBag {
    /// Creates the bag in an empty folder.
    pub fn create(folder: &Path, name: &str) -> Result<Self, McapError> {
        let file = format!("{name}_0.mcap");
        let out = BufWriter::new(File::create_new(folder.join(&file))?);
        Ok(Self {
            writer: WriteOptions::new().profile("ros2").create(out)?,
            file,
            channels: BTreeMap::new(),
            span: None,
            mount: None,
        })
    }

    /// Sets the pose of the laser on the car, `base_link_from_laser`.
    pub fn set_mount(&mut self, mount: Pose2) {
        self.mount = Some(mount);
    }

    /// Writes a message, if ROS has a type for it.
    pub fn add(&mut self, header: &Header, telemetry: &Telemetry) -> Result<(), McapError> {
        let at = header.published;
        match telemetry {
            Telemetry::RecordedScan(scan) => self.write(SCAN, at, &laser_scan(header.sensor, scan))?,
            Telemetry::Odometry(odometry) => {
                let message = ros::odometry(header.sensor, ODOM, odometry.pose, odometry.twist);
                self.write(ODOMETRY, at, &message)?;
            }
            Telemetry::Truth(truth) => {
                let message = ros::odometry(header.sensor, MAP, truth.pose, truth.twist);
                self.write(TRUTH, at, &message)?;
            }
            Telemetry::Pose(pose) => {
                let message = ros::pose_with_covariance(header.sensor, pose.pose, &pose.covariance);
                self.write(POSE, at, &message)?;
                let message = ros::transform(header.sensor, MAP, BASE_LINK, pose.pose);
                self.write(TF, at, &message)?;
            }
            _ => return Ok(()),
        }
        if let Some(mount) = self.mount.take() {
            let message = ros::transform(header.sensor, BASE_LINK, LASER, mount);
            self.write(TF_STATIC, at, &message)?;
        }
        Ok(())
    }

    fn write(
        &mut self,
        (topic, kind): (&'static str, &'static str),
        at: i64,
        cdr: &[u8],
    ) -> Result<(), McapError> {
        let channel_id = if let Some((id, ..)) = self.channels.get(topic) {
            *id
        } else {
            let schema = self
                .writer
                .add_schema(kind, "ros2msg", ros::definition(kind).as_bytes())?;
            let id = self.writer.add_channel(schema, topic, "cdr", &metadata(topic))?;
            self.channels.insert(topic, (id, kind, 0));
            id
        };
        if let Some((_, _, count)) = self.channels.get_mut(topic) {
            *count += 1;
        }
        self.span = Some(
            self.span
                .map_or((at, at), |(from, to)| (from.min(at), to.max(at))),
        );
        let header = MessageHeader {
            channel_id,
            sequence: 0,
            log_time: at.max(0) as u64,
            publish_time: at.max(0) as u64,
        };
        self.writer.write_to_known_channel(&header, cdr)
    }

    /// Completes the bag. Returns the number of messages.
    pub fn finish(mut self, folder: &Path) -> Result<u64, McapError> {
        self.writer.finish()?;
        let (from, to) = self.span.unwrap_or_default();
        let count: u64 = self.channels.values().map(|(.., count)| count).sum();
        let mut text = format!(
            "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  duration:\n    nanoseconds: {}\n  \
             starting_time:\n    nanoseconds_since_epoch: {from}\n  message_count: {count}\n  topics_with_message_count:\n",
            to - from
        );
        for (topic, (_, kind, count)) in &self.channels {
            // A static transform is for those who come later, too.
            let quality = if *topic == TF_STATIC.0 { LATCHED } else { "" };
            text.extend([format!(
                "    - topic_metadata:\n        name: {topic}\n        type: {kind}\n        serialization_format: cdr\n        \
                 offered_qos_profiles: \"{quality}\"\n      message_count: {count}\n"
            )]);
        }
        text.extend([format!(
            "  compression_format: \"\"\n  compression_mode: \"\"\n  relative_file_paths:\n    - {}\n",
            self.file
        )]);
        std::fs::write(folder.join("metadata.yaml"), text)?;
        Ok(count)
    }
}

/// The quality of service in a channel's metadata; it must be that of `metadata.yaml`.
fn metadata(topic: &str) -> BTreeMap<String, String> {
    let quality = (topic == TF_STATIC.0).then(|| LATCHED.replace("\\n", "\n"));
    quality
        .map(|quality| ("offered_qos_profiles".to_owned(), quality))
        .into_iter()
        .collect()
}

/// Kept for later subscribers, and reliable.
const LATCHED: &str = "- history: 1\\n  depth: 1\\n  reliability: 1\\n  durability: 1\\n  deadline:\\n    sec: 9223372036\\n    \
                       nsec: 854775807\\n  lifespan:\\n    sec: 9223372036\\n    nsec: 854775807\\n  liveliness: 1\\n  \
                       liveliness_lease_duration:\\n    sec: 9223372036\\n    nsec: 854775807\\n  \
                       avoid_ros_namespace_conventions: false";

fn laser_scan(stamp: i64, scan: &RecordedScan) -> Vec<u8> {
    let last = scan.ranges.len().saturating_sub(1) as f64;
    let ranges: Vec<_> = scan
        .ranges
        .iter()
        .map(|range| RecordedScan::metres(*range))
        .collect();
    ros::laser_scan(&LaserScan {
        stamp,
        angle_min: scan.angle_min,
        angle_max: scan.angle_min + last * scan.angle_increment,
        angle_increment: scan.angle_increment,
        time_increment: scan.time_increment,
        scan_time: scan.time_increment * (last + 1.0),
        range_min: scan.range_min,
        range_max: scan.range_max,
        ranges: &ranges,
    })
}
