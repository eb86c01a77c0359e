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
use protocol::{Covariance, Header, Pose2, RecordedScan, Telemetry, Twist2};

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

const SCAN: (&str, &str) = ("/scan", "sensor_msgs/msg/LaserScan");
const ODOMETRY: (&str, &str) = ("/odom", "nav_msgs/msg/Odometry");
const POSE: (&str, &str) = ("/pose", "geometry_msgs/msg/PoseWithCovarianceStamped");
const TRUTH: (&str, &str) = ("/ground_truth/odom", "nav_msgs/msg/Odometry");
const TF: (&str, &str) = ("/tf", "tf2_msgs/msg/TFMessage");
const TF_STATIC: (&str, &str) = ("/tf_static", "tf2_msgs/msg/TFMessage");

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
                let message = odometry_message(header.sensor, "odom", odometry.pose, odometry.twist);
                self.write(ODOMETRY, at, &message)?;
            }
            Telemetry::Truth(truth) => {
                let message = odometry_message(header.sensor, "map", truth.pose, truth.twist);
                self.write(TRUTH, at, &message)?;
            }
            Telemetry::Pose(pose) => {
                let message = pose_message(header.sensor, pose.pose, &pose.covariance);
                self.write(POSE, at, &message)?;
                let message = transform(header.sensor, "map", "base_link", pose.pose);
                self.write(TF, at, &message)?;
            }
            _ => return Ok(()),
        }
        if let Some(mount) = self.mount.take() {
            let message = transform(header.sensor, "base_link", "laser", mount);
            self.write(TF_STATIC, at, &message)?;
        }
        Ok(())
    }

    fn write(
        &mut self,
        (topic, kind): (&'static str, &'static str),
        at: i64,
        cdr: &Cdr,
    ) -> Result<(), McapError> {
        let channel_id = if let Some((id, ..)) = self.channels.get(topic) {
            *id
        } else {
            let schema = self
                .writer
                .add_schema(kind, "ros2msg", definition(kind).as_bytes())?;
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
        self.writer.write_to_known_channel(&header, &cdr.0)
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

/// A message in CDR, little-endian. Numbers are aligned to their size, counted from behind the first four bytes.
struct Cdr(Vec<u8>);

impl Cdr {
    const HEAD: usize = 4;

    /// A message that begins with a `std_msgs/Header`.
    fn with_header(stamp: i64, frame: &str) -> Self {
        let mut cdr = Self::new();
        cdr.header(stamp, frame);
        cdr
    }

    fn new() -> Self {
        Self(vec![0, 1, 0, 0])
    }

    fn align(&mut self, size: usize) {
        while !(self.0.len() - Self::HEAD).is_multiple_of(size) {
            self.0.push(0);
        }
    }

    fn u32(&mut self, value: u32) {
        self.align(4);
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    fn f32(&mut self, value: f32) {
        self.align(4);
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    fn f64s(&mut self, values: &[f64]) {
        self.align(8);
        for value in values {
            self.0.extend_from_slice(&value.to_le_bytes());
        }
    }

    fn text(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.0.extend_from_slice(text.as_bytes());
        self.0.push(0);
    }

    fn header(&mut self, stamp: i64, frame: &str) {
        self.u32(stamp.div_euclid(1_000_000_000) as u32);
        self.u32(stamp.rem_euclid(1_000_000_000) as u32);
        self.text(frame);
    }

    /// Position and orientation.
    fn pose(&mut self, pose: Pose2) {
        let (sin, cos) = (pose.heading / 2.0).sin_cos();
        self.f64s(&[pose.x, pose.y, 0.0, 0.0, 0.0, sin, cos]);
    }
}

fn laser_scan(stamp: i64, scan: &RecordedScan) -> Cdr {
    let mut cdr = Cdr::with_header(stamp, "laser");
    let last = scan.ranges.len().saturating_sub(1) as f64;
    let (from, to) = (scan.angle_min, scan.angle_min + last * scan.angle_increment);
    let duration = scan.time_increment * (last + 1.0);
    for value in [
        from,
        to,
        scan.angle_increment,
        scan.time_increment,
        duration,
        scan.range_min,
        scan.range_max,
    ] {
        cdr.f32(value as f32);
    }
    cdr.u32(scan.ranges.len() as u32);
    for range in &scan.ranges {
        cdr.f32(RecordedScan::metres(*range));
    }
    // No intensities.
    cdr.u32(0);
    cdr
}

fn odometry_message(stamp: i64, frame: &str, pose: Pose2, twist: Twist2) -> Cdr {
    let mut cdr = Cdr::with_header(stamp, frame);
    cdr.text("base_link");
    cdr.pose(pose);
    cdr.f64s(&[0.0; 36]);
    cdr.f64s(&[twist.linear_x, twist.linear_y, 0.0, 0.0, 0.0, twist.angular]);
    cdr.f64s(&[0.0; 36]);
    cdr
}

fn pose_message(stamp: i64, pose: Pose2, covariance: &Covariance) -> Cdr {
    let mut cdr = Cdr::with_header(stamp, "map");
    cdr.pose(pose);
    // x, y, z and the rotations about x, y, z.
    let mut matrix = [0.0; 36];
    let Covariance {
        xx,
        xy,
        xh,
        yy,
        yh,
        hh,
    } = covariance;
    for (row, column, value) in [
        (0, 0, xx),
        (0, 1, xy),
        (1, 0, xy),
        (0, 5, xh),
        (5, 0, xh),
        (1, 1, yy),
        (1, 5, yh),
        (5, 1, yh),
        (5, 5, hh),
    ] {
        matrix[6 * row + column] = f64::from(*value);
    }
    cdr.f64s(&matrix);
    cdr
}

fn transform(stamp: i64, frame: &str, child: &str, pose: Pose2) -> Cdr {
    let mut cdr = Cdr::new();
    cdr.u32(1);
    cdr.header(stamp, frame);
    cdr.text(child);
    cdr.pose(pose);
    cdr
}

/// The definition of a message type, followed by those of its parts.
fn definition(kind: &str) -> String {
    let mut text = fields(kind).to_owned();
    let mut parts: Vec<String> = Vec::new();
    let mut next = 0;
    let mut of = kind.to_owned();
    loop {
        for line in fields(&of).lines() {
            let part = line.split([' ', '[']).next().unwrap_or_default();
            if part.contains('/') && !parts.iter().any(|known| known == part) {
                parts.push(part.to_owned());
            }
        }
        let Some(part) = parts.get(next) else {
            return text;
        };
        of = part.replace('/', "/msg/");
        text.extend([&"=".repeat(80), "\nMSG: ", part.as_str(), "\n", fields(&of)]);
        next += 1;
    }
}

/// The fields of a message type.
fn fields(kind: &str) -> &'static str {
    match kind {
        "builtin_interfaces/msg/Time" => "int32 sec\nuint32 nanosec\n",
        "std_msgs/msg/Header" => "builtin_interfaces/Time stamp\nstring frame_id\n",
        "geometry_msgs/msg/Point" | "geometry_msgs/msg/Vector3" => "float64 x\nfloat64 y\nfloat64 z\n",
        "geometry_msgs/msg/Quaternion" => "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
        "geometry_msgs/msg/Pose" => "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
        "geometry_msgs/msg/PoseWithCovariance" => "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
        "geometry_msgs/msg/PoseWithCovarianceStamped" => {
            "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n"
        }
        "geometry_msgs/msg/Twist" => "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
        "geometry_msgs/msg/TwistWithCovariance" => "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
        "geometry_msgs/msg/Transform" => {
            "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
        }
        "geometry_msgs/msg/TransformStamped" => {
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
        }
        "tf2_msgs/msg/TFMessage" => "geometry_msgs/TransformStamped[] transforms\n",
        "sensor_msgs/msg/LaserScan" => {
            "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\n\
             float32 time_increment\nfloat32 scan_time\nfloat32 range_min\nfloat32 range_max\nfloat32[] ranges\n\
             float32[] intensities\n"
        }
        "nav_msgs/msg/Odometry" => {
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n\
             geometry_msgs/TwistWithCovariance twist\n"
        }
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_part_of_a_definition_is_defined() {
        for (_, kind) in [SCAN, ODOMETRY, POSE, TF] {
            let text = definition(kind);
            assert!(!fields(kind).is_empty(), "{kind}");
            for part in text.lines().filter_map(|line| line.strip_prefix("MSG: ")) {
                assert!(!fields(&part.replace('/', "/msg/")).is_empty(), "{kind}: {part}");
            }
        }
        assert_eq!(definition(POSE.1).matches("MSG: ").count(), 6);
    }

    #[test]
    fn numbers_are_aligned_behind_the_head() {
        let message = transform(1_500_000_000, "map", "base_link", Pose2::default());
        let expected = [
            &[0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0][..],
            &500_000_000_u32.to_le_bytes(),
            &[4, 0, 0, 0, b'm', b'a', b'p', 0, 10, 0, 0, 0],
            b"base_link\0",
            &[0, 0],
        ]
        .concat();
        assert_eq!(message.0[..expected.len()], expected);
        assert_eq!(message.0.len(), expected.len() + 4 + 7 * 8);
    }
}
