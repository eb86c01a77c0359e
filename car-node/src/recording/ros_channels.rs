//! Sensor data as ROS 2 messages, with which `car-node evaluate --bag` and other tools read a recording.

use protocol::Pose2;
use protocol::ros::{self, BASE_LINK, LASER, LaserScan, MAP, ODOM};
use synpf::{Odometry, Scan, Stamp, YawRate};

use crate::sensors::TrueMotion;
use crate::wire;

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
            Self::Scan(_) => ("/scan", ros::LASER_SCAN),
            Self::Odometry(_) => ("/odom", ros::ODOMETRY),
            Self::YawRate(_) => ("/imu", ros::IMU),
            Self::Truth(_) => ("/ground_truth/odom", ros::ODOMETRY),
            Self::Mount(..) => ("/tf_static", ros::TRANSFORMS),
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
    pub(super) fn to_cdr(&self) -> Vec<u8> {
        match self {
            Self::Scan(scan) => laser_scan(scan),
            Self::Odometry(Odometry { stamp, pose, twist }) => {
                ros::odometry(stamp.0, ODOM, wire::pose2(*pose), wire::twist2(*twist))
            }
            Self::YawRate(yaw_rate) => ros::imu(yaw_rate.stamp.0, yaw_rate.rate),
            Self::Truth(TrueMotion { stamp, pose, twist }) => {
                ros::odometry(stamp.0, MAP, wire::pose2(*pose), wire::twist2(*twist))
            }
            Self::Mount(stamp, base_link_from_laser) => {
                ros::transform(stamp.0, BASE_LINK, LASER, *base_link_from_laser)
            }
        }
    }
}

fn laser_scan(scan: &Scan) -> Vec<u8> {
    let last = scan.ranges.len().saturating_sub(1) as f64;
    ros::laser_scan(&LaserScan {
        stamp: scan.stamp.0,
        angle_min: scan.angle_min,
        angle_max: scan
            .angle_max
            .unwrap_or(scan.angle_min + last * scan.angle_increment),
        angle_increment: scan.angle_increment,
        time_increment: scan.time_increment,
        scan_time: scan.scan_time.unwrap_or(0.0),
        range_min: scan.range_min,
        range_max: scan.range_max,
        ranges: &scan.ranges,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::messages::{self, Imu, RosOdometry, TfMessage};
    use maps::Pose;
    use synpf::Twist;

    // The messages are written by hand and read by a library for CDR.
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
        let bytes = RosMessage::Scan(scan.clone()).to_cdr();
        let back: messages::LaserScan = messages::decode_whole(&bytes).expect("decodes");
        let back = back.to_scan(false);
        assert_eq!(back.ranges, scan.ranges);
        assert_eq!(
            (back.stamp, back.angle_max, back.angle_increment),
            (scan.stamp, scan.angle_max, scan.angle_increment)
        );
    }

    #[test]
    fn the_other_messages_are_read_back_as_they_were() {
        let odometry = Odometry {
            stamp: Stamp(7_000_000_005),
            pose: Pose::new(1.0, 2.0, 0.5),
            twist: Twist {
                linear_x: 3.0,
                linear_y: 0.25,
                angular: -1.0,
            },
        };
        let bytes = RosMessage::Odometry(odometry).to_cdr();
        let back: RosOdometry = messages::decode_whole(&bytes).expect("decodes");
        assert_eq!(
            (back.header.frame_id.as_str(), back.child_frame_id.as_str()),
            ("odom", "base_link")
        );
        let back = back.to_odometry();
        assert_eq!((back.stamp, back.twist), (odometry.stamp, odometry.twist));
        assert!((back.pose.heading - 0.5).abs() < 1e-12);

        let rate = YawRate {
            stamp: Stamp(5),
            rate: 0.75,
        };
        let back: Imu = messages::decode_whole(&RosMessage::YawRate(rate).to_cdr()).expect("decodes");
        assert_eq!(back.to_yaw_rate(), rate);
        let unknown = [back.orientation_covariance, back.linear_acceleration_covariance];
        assert!(unknown.iter().all(|covariance| covariance[0] < 0.0));

        let mount = Pose2 {
            x: 0.25,
            ..Pose2::default()
        };
        let bytes = RosMessage::Mount(Stamp(5), mount).to_cdr();
        let back: TfMessage = messages::decode_whole(&bytes).expect("decodes");
        assert_eq!(back.transforms[0].child_frame_id, "laser");
        assert_eq!(back.transforms[0].transform.planar(), Pose::new(0.25, 0.0, 0.0));
    }
}
