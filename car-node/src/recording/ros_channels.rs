//! Sensor data as ROS 2 messages, with which `car-node evaluate --bag` and other tools read a recording.

use protocol::Pose2;
use synpf::{Odometry, Scan, Stamp, Twist, YawRate};

use crate::ros2::messages::{
    self, CdrError, Header, Imu, LaserScan, RosOdometry, TfMessage, TransformStamped, Vector3,
};
use crate::sensors::TrueMotion;
use crate::wire;

const MAP: &str = "map";
const ODOM: &str = "odom";
const BASE_LINK: &str = "base_link";
const LASER: &str = "laser";

/// A message to be written as a ROS 2 message. Stamps are wall time \[unix\].
#[derive(Debug, Clone, PartialEq)]
pub enum RosMessage {
    /// A scan.
    Scan(Scan),
    /// Wheel odometry.
    Odometry(Odometry),
    /// The yaw rate of an IMU.
    YawRate(YawRate),
    /// The truth.
    Truth(TrueMotion),
    /// The laser's pose `base_link_from_laser`.
    Mount(Stamp, Pose2),
}

impl RosMessage {
    /// Its topic and the name of its type.
    pub(super) fn channel(&self) -> (&'static str, &'static str) {
        match self {
            Self::Scan(_) => ("/scan", "sensor_msgs/msg/LaserScan"),
            Self::Odometry(_) => ("/odom", "nav_msgs/msg/Odometry"),
            Self::YawRate(_) => ("/imu", "sensor_msgs/msg/Imu"),
            Self::Truth(_) => ("/ground_truth/odom", "nav_msgs/msg/Odometry"),
            Self::Mount(..) => ("/tf_static", "tf2_msgs/msg/TFMessage"),
        }
    }

    /// Its size in memory, about \[bytes\].
    pub(super) fn size(&self) -> usize {
        match self {
            Self::Scan(scan) => 4 * scan.ranges.len() + 100,
            _ => 200,
        }
    }

    /// The message in CDR.
    pub(super) fn to_cdr(&self) -> Result<Vec<u8>, CdrError> {
        match self {
            Self::Scan(scan) => messages::encode(&laser_scan(scan)),
            Self::Odometry(odometry) => messages::encode(&RosOdometry {
                header: header(odometry.stamp, ODOM),
                child_frame_id: BASE_LINK.into(),
                pose: odometry.pose.into(),
                linear: linear(odometry.twist),
                angular: about_z(odometry.twist.angular),
                ..RosOdometry::default()
            }),
            Self::YawRate(yaw_rate) => {
                let mut imu = Imu {
                    header: header(yaw_rate.stamp, BASE_LINK),
                    angular_velocity: about_z(yaw_rate.rate),
                    ..Imu::default()
                };
                // By the definition of the message: this is not measured.
                imu.orientation_covariance[0] = -1.0;
                imu.linear_acceleration_covariance[0] = -1.0;
                messages::encode(&imu)
            }
            Self::Truth(truth) => messages::encode(&RosOdometry {
                header: header(truth.stamp, MAP),
                child_frame_id: BASE_LINK.into(),
                pose: truth.pose.into(),
                linear: linear(truth.twist),
                angular: about_z(truth.twist.angular),
                ..RosOdometry::default()
            }),
            Self::Mount(stamp, base_link_from_laser) => messages::encode(&TfMessage {
                transforms: vec![TransformStamped {
                    header: header(*stamp, BASE_LINK),
                    child_frame_id: LASER.into(),
                    transform: wire::pose(*base_link_from_laser).into(),
                }],
            }),
        }
    }
}

fn header(stamp: Stamp, frame: &str) -> Header {
    Header {
        stamp: stamp.into(),
        frame_id: frame.into(),
    }
}

fn linear(twist: Twist) -> Vector3 {
    Vector3 {
        x: twist.linear_x,
        y: twist.linear_y,
        z: 0.0,
    }
}

fn about_z(rate: f64) -> Vector3 {
    Vector3 {
        z: rate,
        ..Vector3::default()
    }
}

fn laser_scan(scan: &Scan) -> LaserScan {
    let last = scan.ranges.len().saturating_sub(1) as f64;
    LaserScan {
        header: header(scan.stamp, LASER),
        angle_min: scan.angle_min as f32,
        angle_max: scan
            .angle_max
            .unwrap_or(scan.angle_min + last * scan.angle_increment) as f32,
        angle_increment: scan.angle_increment as f32,
        time_increment: scan.time_increment as f32,
        scan_time: scan.scan_time.unwrap_or(0.0) as f32,
        range_min: scan.range_min as f32,
        range_max: scan.range_max as f32,
        ranges: scan.ranges.clone(),
        intensities: Vec::new(),
    }
}

/// The definition of a message type with those of its parts, as an MCAP file needs it.
pub(super) fn definition(of: &str) -> String {
    let mut text = fields(of).to_owned();
    for part in parts(of) {
        text.extend([
            &"=".repeat(80),
            "\nMSG: ",
            &part.replace("/msg/", "/"),
            "\n",
            fields(part),
        ]);
    }
    text
}

fn parts(of: &str) -> &'static [&'static str] {
    match of {
        "sensor_msgs/msg/LaserScan" => &["std_msgs/msg/Header", "builtin_interfaces/msg/Time"],
        "nav_msgs/msg/Odometry" => &[
            "std_msgs/msg/Header",
            "builtin_interfaces/msg/Time",
            "geometry_msgs/msg/PoseWithCovariance",
            "geometry_msgs/msg/Pose",
            "geometry_msgs/msg/Point",
            "geometry_msgs/msg/Quaternion",
            "geometry_msgs/msg/TwistWithCovariance",
            "geometry_msgs/msg/Twist",
            "geometry_msgs/msg/Vector3",
        ],
        "sensor_msgs/msg/Imu" => &[
            "std_msgs/msg/Header",
            "builtin_interfaces/msg/Time",
            "geometry_msgs/msg/Quaternion",
            "geometry_msgs/msg/Vector3",
        ],
        "tf2_msgs/msg/TFMessage" => &[
            "geometry_msgs/msg/TransformStamped",
            "std_msgs/msg/Header",
            "builtin_interfaces/msg/Time",
            "geometry_msgs/msg/Transform",
            "geometry_msgs/msg/Vector3",
            "geometry_msgs/msg/Quaternion",
        ],
        _ => &[],
    }
}

fn fields(of: &str) -> &'static str {
    match of {
        "builtin_interfaces/msg/Time" => "int32 sec\nuint32 nanosec\n",
        "std_msgs/msg/Header" => "builtin_interfaces/Time stamp\nstring frame_id\n",
        "geometry_msgs/msg/Point" | "geometry_msgs/msg/Vector3" => "float64 x\nfloat64 y\nfloat64 z\n",
        "geometry_msgs/msg/Quaternion" => "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
        "geometry_msgs/msg/Pose" => "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
        "geometry_msgs/msg/PoseWithCovariance" => "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
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
            "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\nfloat32 time_increment\n\
             float32 scan_time\nfloat32 range_min\nfloat32 range_max\nfloat32[] ranges\nfloat32[] intensities\n"
        }
        "sensor_msgs/msg/Imu" => {
            "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n\
             geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n\
             geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n"
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
        for of in [
            "sensor_msgs/msg/LaserScan",
            "nav_msgs/msg/Odometry",
            "sensor_msgs/msg/Imu",
            "tf2_msgs/msg/TFMessage",
        ] {
            assert!(!fields(of).is_empty(), "{of}");
            let text = definition(of);
            for line in text.lines().filter(|line| !line.starts_with(['=', 'M'])) {
                let kind = line.split([' ', '[']).next().unwrap_or_default();
                assert!(
                    !kind.contains('/') || text.contains(&format!("MSG: {kind}\n")),
                    "{of}: {kind}"
                );
            }
            for part in parts(of) {
                assert!(!fields(part).is_empty(), "{of}: {part}");
            }
        }
    }

    #[test]
    fn a_scan_is_read_back_as_it_was() {
        let scan = Scan {
            stamp: Stamp(1_700_000_000_123_456_789),
            angle_min: -2.0,
            angle_increment: 0.25,
            time_increment: 0.0,
            scan_time: Some(0.025),
            angle_max: Some(-1.5),
            range_min: 0.0625,
            range_max: 30.0,
            ranges: vec![1.25, f32::INFINITY, 3.0],
        };
        let bytes = RosMessage::Scan(scan.clone()).to_cdr().expect("encodes");
        let back: LaserScan = messages::decode(&bytes).expect("decodes");
        let back = back.to_scan(false);
        assert_eq!(back.ranges, scan.ranges);
        assert_eq!(
            (back.stamp, back.angle_max, back.angle_increment),
            (scan.stamp, scan.angle_max, scan.angle_increment)
        );
    }
}
