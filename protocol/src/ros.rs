//! The ROS 2 messages that recordings of cars and bags of the pit wall hold: their definitions, and the messages in CDR.
//!
//! Layouts as in `sensor_msgs`, `nav_msgs`, `geometry_msgs` and `tf2_msgs` (the same from Foxy to Kilted).

use crate::{Covariance, Pose2, Twist2};

/// Type of [`laser_scan`].
pub const LASER_SCAN: &str = "sensor_msgs/msg/LaserScan";
/// Type of [`odometry`].
pub const ODOMETRY: &str = "nav_msgs/msg/Odometry";
/// Type of [`pose_with_covariance`].
pub const POSE_WITH_COVARIANCE: &str = "geometry_msgs/msg/PoseWithCovarianceStamped";
/// Type of [`imu`].
pub const IMU: &str = "sensor_msgs/msg/Imu";
/// Type of [`transform`].
pub const TRANSFORMS: &str = "tf2_msgs/msg/TFMessage";

/// Frame of the map.
pub const MAP: &str = "map";
/// Frame of odometry.
pub const ODOM: &str = "odom";
/// Frame of the car.
pub const BASE_LINK: &str = "base_link";
/// Frame of the laser.
pub const LASER: &str = "laser";

/// The content of a `sensor_msgs/LaserScan` without intensities, in the frame of the laser.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LaserScan<'a> {
    /// Time of the first beam \[unix ns\].
    pub stamp: i64,
    /// Direction of the first beam \[rad\].
    pub angle_min: f64,
    /// Direction of the last beam \[rad\].
    pub angle_max: f64,
    /// From one beam to the next \[rad\].
    pub angle_increment: f64,
    /// From one beam to the next \[s\].
    pub time_increment: f64,
    /// From one scan to the next \[s\].
    pub scan_time: f64,
    /// Least valid range \[m\].
    pub range_min: f64,
    /// Largest valid range \[m\].
    pub range_max: f64,
    /// One range per beam \[m\].
    pub ranges: &'a [f32],
}

/// A scan.
pub fn laser_scan(scan: &LaserScan<'_>) -> Vec<u8> {
    let mut cdr = Cdr::with_header(scan.stamp, LASER);
    cdr.0.reserve(4 * scan.ranges.len() + 64);
    for value in [
        scan.angle_min,
        scan.angle_max,
        scan.angle_increment,
        scan.time_increment,
        scan.scan_time,
        scan.range_min,
        scan.range_max,
    ] {
        cdr.f32(value as f32);
    }
    cdr.u32(scan.ranges.len() as u32);
    for range in scan.ranges {
        cdr.f32(*range);
    }
    // No intensities.
    cdr.u32(0);
    cdr.0
}

/// The pose of the car in `frame`, and its velocity. Covariances are zero: not known.
pub fn odometry(stamp: i64, frame: &str, pose: Pose2, twist: Twist2) -> Vec<u8> {
    let mut cdr = Cdr::with_header(stamp, frame);
    cdr.text(BASE_LINK);
    cdr.pose(pose);
    cdr.f64s(&[0.0; 36]);
    cdr.f64s(&[twist.linear_x, twist.linear_y, 0.0, 0.0, 0.0, twist.angular]);
    cdr.f64s(&[0.0; 36]);
    cdr.0
}

/// An estimated pose in the map.
pub fn pose_with_covariance(stamp: i64, pose: Pose2, covariance: &Covariance) -> Vec<u8> {
    let mut cdr = Cdr::with_header(stamp, MAP);
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
    cdr.0
}

/// The yaw rate of an IMU on the car \[rad/s\], and nothing else.
pub fn imu(stamp: i64, yaw_rate: f64) -> Vec<u8> {
    // By the definition of the message: this is not measured.
    let mut unknown = [0.0; 9];
    unknown[0] = -1.0;
    let mut cdr = Cdr::with_header(stamp, BASE_LINK);
    cdr.f64s(&[0.0, 0.0, 0.0, 1.0]);
    cdr.f64s(&unknown);
    cdr.f64s(&[0.0, 0.0, yaw_rate]);
    cdr.f64s(&[0.0; 9]);
    cdr.f64s(&[0.0; 3]);
    cdr.f64s(&unknown);
    cdr.0
}

/// The pose of the frame `child` in `frame`.
pub fn transform(stamp: i64, frame: &str, child: &str, pose: Pose2) -> Vec<u8> {
    let mut cdr = Cdr::new();
    cdr.u32(1);
    cdr.header(stamp, frame);
    cdr.text(child);
    cdr.pose(pose);
    cdr.0
}

/// The definition of a message type, followed by those of its parts, as an MCAP file has it. Empty for an unknown type.
pub fn definition(kind: &str) -> String {
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
        POSE_WITH_COVARIANCE => "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n",
        "geometry_msgs/msg/Twist" => "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
        "geometry_msgs/msg/TwistWithCovariance" => "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
        "geometry_msgs/msg/Transform" => {
            "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
        }
        "geometry_msgs/msg/TransformStamped" => {
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
        }
        TRANSFORMS => "geometry_msgs/TransformStamped[] transforms\n",
        LASER_SCAN => {
            "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\n\
             float32 time_increment\nfloat32 scan_time\nfloat32 range_min\nfloat32 range_max\nfloat32[] ranges\n\
             float32[] intensities\n"
        }
        IMU => {
            "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n\
             geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n\
             geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n"
        }
        ODOMETRY => {
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n\
             geometry_msgs/TwistWithCovariance twist\n"
        }
        _ => "",
    }
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_part_of_a_definition_is_defined() {
        for kind in [LASER_SCAN, ODOMETRY, POSE_WITH_COVARIANCE, IMU, TRANSFORMS] {
            let text = definition(kind);
            assert!(!fields(kind).is_empty(), "{kind}");
            for part in text.lines().filter_map(|line| line.strip_prefix("MSG: ")) {
                assert!(!fields(&part.replace('/', "/msg/")).is_empty(), "{kind}: {part}");
            }
        }
        assert_eq!(definition(POSE_WITH_COVARIANCE).matches("MSG: ").count(), 6);
        assert_eq!(definition("std_msgs/msg/Nothing"), "");
    }

    #[test]
    fn numbers_are_aligned_behind_the_head() {
        let message = transform(1_500_000_000, MAP, BASE_LINK, Pose2::default());
        let expected = [
            &[0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0][..],
            &500_000_000_u32.to_le_bytes(),
            &[4, 0, 0, 0, b'm', b'a', b'p', 0, 10, 0, 0, 0],
            b"base_link\0",
            &[0, 0],
        ]
        .concat();
        assert_eq!(message[..expected.len()], expected);
        assert_eq!(message.len(), expected.len() + 4 + 7 * 8);
    }
}
