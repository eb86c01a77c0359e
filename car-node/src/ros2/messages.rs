//! The ROS 2 messages that a localizer needs, decoded from CDR without a ROS installation.
//!
//! Layouts as in `sensor_msgs`, `nav_msgs`, `geometry_msgs` and `tf2_msgs` (the same from Foxy to Kilted).

use byteorder::{BigEndian, LittleEndian};
use maps::Pose;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use synpf::{Odometry, Scan, Stamp, Twist, YawRate};

/// Why a payload is not the message it should be.
#[derive(Debug, thiserror::Error)]
pub enum CdrError {
    /// Shorter than the encapsulation header.
    #[error("payload of {0} bytes is shorter than the CDR header")]
    TooShort(usize),
    /// An encapsulation other than plain CDR.
    #[error("encapsulation {0:02x}{1:02x} is not plain CDR")]
    Encapsulation(u8, u8),
    /// The body does not hold the message.
    #[error("body does not decode: {0}")]
    Body(String),
}

/// Decodes a CDR payload with its 4-byte encapsulation header.
pub fn decode<T: DeserializeOwned>(payload: &[u8]) -> Result<T, CdrError> {
    let Some((header, body)) = payload.split_at_checked(4) else {
        return Err(CdrError::TooShort(payload.len()));
    };
    let decoded = match header[..2] {
        [0, 0] => cdr_encoding::from_bytes::<T, BigEndian>(body),
        [0, 1] => cdr_encoding::from_bytes::<T, LittleEndian>(body),
        _ => return Err(CdrError::Encapsulation(header[0], header[1])),
    };
    decoded
        .map(|(message, _)| message)
        .map_err(|error| CdrError::Body(error.to_string()))
}

/// Decodes a message that must use the whole payload, but for its padding.
pub(crate) fn decode_whole<T: DeserializeOwned>(payload: &[u8]) -> Result<T, CdrError> {
    const PADDING: usize = 3;
    let Some((header, body)) = payload.split_at_checked(4) else {
        return Err(CdrError::TooShort(payload.len()));
    };
    let decoded = match header[..2] {
        [0, 0] => cdr_encoding::from_bytes::<T, BigEndian>(body),
        [0, 1] => cdr_encoding::from_bytes::<T, LittleEndian>(body),
        _ => return Err(CdrError::Encapsulation(header[0], header[1])),
    };
    let (message, used) = decoded.map_err(|error| CdrError::Body(error.to_string()))?;
    if used + PADDING < body.len() {
        return Err(CdrError::Body(format!("{} bytes are left", body.len() - used)));
    }
    Ok(message)
}

/// Encodes a message as little-endian CDR with its encapsulation header.
pub fn encode<T: Serialize>(message: &T) -> Result<Vec<u8>, CdrError> {
    let body = cdr_encoding::to_vec::<T, LittleEndian>(message)
        .map_err(|error| CdrError::Body(error.to_string()))?;
    Ok([&[0, 1, 0, 0], body.as_slice()].concat())
}

/// `builtin_interfaces/Time`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Time {
    /// Seconds since the Unix epoch.
    pub sec: i32,
    /// Nanoseconds on top.
    pub nanosec: u32,
}

impl From<Time> for Stamp {
    fn from(time: Time) -> Self {
        Self(i64::from(time.sec) * 1_000_000_000 + i64::from(time.nanosec))
    }
}

impl From<Stamp> for Time {
    fn from(stamp: Stamp) -> Self {
        Self {
            sec: stamp.0.div_euclid(1_000_000_000) as i32,
            nanosec: stamp.0.rem_euclid(1_000_000_000) as u32,
        }
    }
}

/// `std_msgs/Header`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Header {
    /// The time that the content is from.
    pub stamp: Time,
    /// The frame it is in.
    pub frame_id: String,
}

/// `sensor_msgs/LaserScan`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct LaserScan {
    /// Time of the first beam, frame of the laser.
    pub header: Header,
    /// Direction of the first beam \[rad\].
    pub angle_min: f32,
    /// Direction of the last beam \[rad\].
    pub angle_max: f32,
    /// From one beam to the next \[rad\].
    pub angle_increment: f32,
    /// From one beam to the next \[s\].
    pub time_increment: f32,
    /// From one scan to the next \[s\].
    pub scan_time: f32,
    /// Least valid range \[m\].
    pub range_min: f32,
    /// Largest valid range \[m\].
    pub range_max: f32,
    /// One range per beam \[m\].
    pub ranges: Vec<f32>,
    /// One intensity per beam, or none (device units).
    pub intensities: Vec<f32>,
}

impl LaserScan {
    /// The scan as the localizer takes it. `upside_down` mirrors it, for a laser that is mounted upside down.
    pub fn to_scan(&self, upside_down: bool) -> Scan {
        let sign = if upside_down { -1.0 } else { 1.0 };
        Scan {
            stamp: self.header.stamp.into(),
            angle_min: sign * f64::from(self.angle_min),
            angle_increment: sign * f64::from(self.angle_increment),
            time_increment: f64::from(self.time_increment),
            scan_time: Some(f64::from(self.scan_time)),
            angle_max: Some(sign * f64::from(self.angle_max)),
            range_min: f64::from(self.range_min),
            range_max: f64::from(self.range_max),
            ranges: self.ranges.clone(),
        }
    }
}

/// `geometry_msgs/Vector3` and `geometry_msgs/Point`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Vector3 {
    /// Along x.
    pub x: f64,
    /// Along y.
    pub y: f64,
    /// Along z.
    pub z: f64,
}

/// `geometry_msgs/Quaternion`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Orientation {
    /// i.
    pub x: f64,
    /// j.
    pub y: f64,
    /// k.
    pub z: f64,
    /// Real part.
    pub w: f64,
}

impl Default for Orientation {
    fn default() -> Self {
        Self::from_yaw(0.0)
    }
}

impl Orientation {
    /// A turn about z \[rad\].
    pub fn from_yaw(yaw: f64) -> Self {
        let (z, w) = (yaw / 2.0).sin_cos();
        Self { x: 0.0, y: 0.0, z, w }
    }

    /// The turn about z \[rad\]; NaN for the quaternion of zeros that a publisher sends who never sets it.
    fn yaw(self) -> f64 {
        let Self { x, y, z, w } = self;
        if x * x + y * y + z * z + w * w < 1e-6 {
            return f64::NAN;
        }
        (2.0 * (w * z + x * y)).atan2(w * w + x * x - y * y - z * z)
    }
}

/// `geometry_msgs/Pose` and, with its translation as the position, `geometry_msgs/Transform`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct RosPose {
    /// Position \[m\].
    pub position: Vector3,
    /// Orientation.
    pub orientation: Orientation,
}

impl RosPose {
    /// The pose on the ground, without z, roll and pitch.
    pub fn planar(&self) -> Pose {
        Pose::new(self.position.x, self.position.y, self.orientation.yaw())
    }

    /// The pose in space. None when it is no valid transform, or larger than any track.
    pub fn spatial(&self) -> Option<Isometry3<f64>> {
        let Orientation { x, y, z, w } = self.orientation;
        let rotation = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-3)?;
        let Vector3 { x, y, z } = self.position;
        let transform = Isometry3::from_parts(Translation3::new(x, y, z), rotation);
        transform
            .to_homogeneous()
            .iter()
            .all(|v| v.is_finite() && v.abs() < 1e6)
            .then_some(transform)
    }
}

impl From<Pose> for RosPose {
    fn from(pose: Pose) -> Self {
        Self {
            position: Vector3 {
                x: pose.x,
                y: pose.y,
                z: 0.0,
            },
            orientation: Orientation::from_yaw(pose.heading),
        }
    }
}

/// A 6 x 6 covariance, row by row.
pub type Covariance = [[f64; 6]; 6];

/// `nav_msgs/Odometry`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RosOdometry {
    /// Time, and the frame of the pose.
    pub header: Header,
    /// The frame that moves; the twist is in it, too.
    pub child_frame_id: String,
    /// Pose of `child_frame_id` in `header.frame_id`.
    pub pose: RosPose,
    /// Covariance of the pose.
    pub pose_covariance: Covariance,
    /// Linear velocity [m/s].
    pub linear: Vector3,
    /// Angular velocity [rad/s].
    pub angular: Vector3,
    /// Covariance of the twist.
    pub twist_covariance: Covariance,
}

impl RosOdometry {
    /// The odometry as the localizer takes it.
    pub fn to_odometry(&self) -> Odometry {
        Odometry {
            stamp: self.header.stamp.into(),
            pose: self.pose.planar(),
            twist: Twist {
                linear_x: self.linear.x,
                linear_y: self.linear.y,
                angular: self.angular.z,
            },
        }
    }
}

/// `sensor_msgs/Imu`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Imu {
    /// Time, and the frame of the sensor.
    pub header: Header,
    /// Orientation, where the sensor has one.
    pub orientation: Orientation,
    /// Its covariance.
    pub orientation_covariance: [f64; 9],
    /// Angular velocity [rad/s].
    pub angular_velocity: Vector3,
    /// Its covariance.
    pub angular_velocity_covariance: [f64; 9],
    /// Acceleration [m/s^2].
    pub linear_acceleration: Vector3,
    /// Its covariance.
    pub linear_acceleration_covariance: [f64; 9],
}

impl Imu {
    /// The yaw rate, for a sensor mounted with z up.
    pub fn to_yaw_rate(&self) -> YawRate {
        self.yaw_rate_turned(&UnitQuaternion::identity())
    }

    /// The yaw rate, for a sensor that is turned so on the car.
    pub fn yaw_rate_turned(&self, base_link_from_imu: &UnitQuaternion<f64>) -> YawRate {
        let Vector3 { x, y, z } = self.angular_velocity;
        YawRate {
            stamp: self.header.stamp.into(),
            rate: (base_link_from_imu * nalgebra::Vector3::new(x, y, z)).z,
        }
    }
}

/// `geometry_msgs/PoseStamped`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PoseStamped {
    /// Time and frame.
    pub header: Header,
    /// The pose.
    pub pose: RosPose,
}

/// `geometry_msgs/PoseWithCovarianceStamped`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PoseWithCovarianceStamped {
    /// Time and frame.
    pub header: Header,
    /// The pose.
    pub pose: RosPose,
    /// Its covariance.
    pub covariance: Covariance,
}

/// `geometry_msgs/PointStamped`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PointStamped {
    /// Time and frame.
    pub header: Header,
    /// The point \[m\].
    pub point: Vector3,
}

/// `geometry_msgs/TransformStamped`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct TransformStamped {
    /// Time, and the parent frame.
    pub header: Header,
    /// The child frame.
    pub child_frame_id: String,
    /// Pose of `child_frame_id` in `header.frame_id`.
    pub transform: RosPose,
}

/// `tf2_msgs/TFMessage`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct TfMessage {
    /// Any number of transforms.
    pub transforms: Vec<TransformStamped>,
}

/// `geometry_msgs/PoseArray`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PoseArray {
    /// Time and frame.
    pub header: Header,
    /// Any number of poses.
    pub poses: Vec<RosPose>,
}

/// `nav_msgs/OccupancyGrid`, with its `MapMetaData` in line.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RosGrid {
    /// Time and frame.
    pub header: Header,
    /// When the map was loaded.
    pub load_time: Time,
    /// Edge of a cell \[m\].
    pub resolution: f32,
    /// Cells along x.
    pub width: u32,
    /// Cells along y.
    pub height: u32,
    /// Pose of the corner of the first cell.
    pub origin: RosPose,
    /// Row by row from the origin: -1 unknown, 0 free, 100 occupied.
    pub data: Vec<i8>,
}

/// `diagnostic_msgs/KeyValue`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct KeyValue {
    /// The name.
    pub key: String,
    /// The value.
    pub value: String,
}

/// `diagnostic_msgs/DiagnosticStatus`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct DiagnosticStatus {
    /// 0 OK, 1 WARN, 2 ERROR, 3 STALE.
    pub level: u8,
    /// What is judged.
    pub name: String,
    /// The judgement.
    pub message: String,
    /// The machine.
    pub hardware_id: String,
    /// Values behind it.
    pub values: Vec<KeyValue>,
}

/// `diagnostic_msgs/DiagnosticArray`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct DiagnosticArray {
    /// Time.
    pub header: Header,
    /// Any number of judgements.
    pub status: Vec<DiagnosticStatus>,
}

/// `rcl_interfaces/Log`, the messages of `/rosout`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Log {
    /// Time.
    pub stamp: Time,
    /// 20 INFO, 30 WARN, 40 ERROR.
    pub level: u8,
    /// The node.
    pub name: String,
    /// The text.
    pub msg: String,
    /// Source file.
    pub file: String,
    /// Function.
    pub function: String,
    /// Line.
    pub line: u32,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decodes_a_scan_laid_out_by_hand() {
        let mut bytes = vec![0, 1, 0, 0];
        bytes.extend(7_i32.to_le_bytes());
        bytes.extend(5_u32.to_le_bytes());
        bytes.extend(6_u32.to_le_bytes());
        bytes.extend(b"laser\0");
        bytes.extend([0, 0]); // floats are aligned to 4
        for value in [-1.0_f32, 1.0, 0.5, 0.001, 0.025, 0.02, 30.0] {
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend(2_u32.to_le_bytes());
        bytes.extend(1.5_f32.to_le_bytes());
        bytes.extend(f32::INFINITY.to_le_bytes());
        bytes.extend(0_u32.to_le_bytes());

        let message: LaserScan = decode(&bytes).expect("a whole message");
        assert_eq!(message.header.frame_id, "laser");
        let scan = message.to_scan(false);
        assert_eq!(scan.stamp, Stamp(7_000_000_005));
        assert_eq!(scan.ranges, [1.5, f32::INFINITY]);
        assert!((scan.angle_increment - 0.5).abs() < 1e-9);
        assert!((message.to_scan(true).angle_min - 1.0).abs() < 1e-9);

        for length in 0..bytes.len() {
            assert!(
                decode::<LaserScan>(&bytes[..length]).is_err(),
                "cut at {length} of {}",
                bytes.len()
            );
        }
    }

    #[test]
    fn encoding_is_undone_by_decoding() {
        let mut odometry = RosOdometry {
            child_frame_id: "base_link".into(),
            pose: Pose::new(1.0, 2.0, -3.0).into(),
            ..RosOdometry::default()
        };
        odometry.header.stamp = Stamp(-1).into();
        odometry.pose_covariance[5][5] = 0.4;
        odometry.angular.z = 0.25;
        let bytes = encode(&odometry).expect("encodes");
        assert_eq!(decode::<RosOdometry>(&bytes).expect("decodes"), odometry);
        let plain = odometry.to_odometry();
        assert_eq!(plain.stamp, Stamp(-1));
        assert!((plain.pose.heading + 3.0).abs() < 1e-12);
        // Header (8 + 4 + 1), padding to 4, name (4 + 10), padding to 8, 7 doubles, 36, 6, 36.
        assert_eq!(bytes.len(), 4 + 32 + 8 * (7 + 36 + 6 + 36));
    }

    #[test]
    fn an_orientation_never_set_is_no_heading() {
        let orientation = Orientation {
            x: 0.0,
            y: 0.0,
            z: 0.0,
            w: 0.0,
        };
        assert!(orientation.yaw().is_nan());
    }

    #[test]
    fn unknown_encapsulation_is_refused() {
        assert!(matches!(
            decode::<Time>(&[0, 3, 0, 0, 0, 0, 0, 0]),
            Err(CdrError::Encapsulation(0, 3))
        ));
    }

    /// Padding of each type by hand: a string before a number, a byte before a string, bytes before nothing.
    #[test]
    fn what_is_published_is_laid_out_as_ros_does() {
        let mut expected = vec![0, 1, 0, 0];
        expected.extend(7_i32.to_le_bytes());
        expected.extend(5_u32.to_le_bytes());
        expected.extend([4, 0, 0, 0]);
        expected.extend(b"map\0");
        expected.extend(7_i32.to_le_bytes());
        expected.extend(0_u32.to_le_bytes());
        expected.extend(0.05_f32.to_le_bytes());
        expected.extend(3_u32.to_le_bytes());
        expected.extend(1_u32.to_le_bytes());
        expected.extend([0; 4]); // doubles are aligned to 8
        for value in [1.0_f64, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0] {
            expected.extend(value.to_le_bytes());
        }
        expected.extend([3, 0, 0, 0, 255, 0, 100]);
        let header = Header {
            stamp: Time { sec: 7, nanosec: 5 },
            frame_id: "map".into(),
        };
        let grid = RosGrid {
            header: header.clone(),
            load_time: Time { sec: 7, nanosec: 0 },
            resolution: 0.05,
            width: 3,
            height: 1,
            origin: Pose::new(1.0, 2.0, 0.0).into(),
            data: vec![-1, 0, 100],
        };
        assert_eq!(encode(&grid).expect("encodes"), expected);
        assert_eq!(decode::<RosGrid>(&expected).expect("decodes"), grid);

        let mut expected = expected[..16].to_vec();
        expected.extend(b"map\0");
        expected.extend([1, 0, 0, 0, 2, 0, 0, 0]); // one status, its level, padding
        for text in ["a", "lost", ""] {
            expected.extend((text.len() as u32 + 1).to_le_bytes());
            expected.extend(text.as_bytes());
            expected.push(0);
            while expected.len() % 4 != 0 {
                expected.push(0);
            }
        }
        expected.extend([1, 0, 0, 0, 2, 0, 0, 0]);
        expected.extend(b"k\0\0\0");
        expected.extend([2, 0, 0, 0]);
        expected.extend(b"v\0");
        let status = DiagnosticStatus {
            level: 2,
            name: "a".into(),
            message: "lost".into(),
            values: vec![KeyValue {
                key: "k".into(),
                value: "v".into(),
            }],
            ..DiagnosticStatus::default()
        };
        let diagnostics = DiagnosticArray {
            header,
            status: vec![status],
        };
        assert_eq!(encode(&diagnostics).expect("encodes"), expected);
        assert_eq!(
            decode::<DiagnosticArray>(&expected).expect("decodes"),
            diagnostics
        );
    }

    #[test]
    fn lists_of_poses_and_log_messages_survive_a_round_trip() {
        let particles = PoseArray {
            poses: vec![Pose::new(1.0, 2.0, 0.5).into(), Pose::new(-3.0, 0.0, -2.0).into()],
            ..PoseArray::default()
        };
        let bytes = encode(&particles).expect("encodes");
        assert_eq!(decode::<PoseArray>(&bytes).expect("decodes"), particles);
        let log = Log {
            level: 30,
            name: "synpf".into(),
            msg: "initial pose refused".into(),
            line: 9,
            ..Log::default()
        };
        let bytes = encode(&log).expect("encodes");
        assert_eq!(decode::<Log>(&bytes).expect("decodes"), log);
    }
}
