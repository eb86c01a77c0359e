//! The ROS types that this node reads and publishes: their names and hashes, as the keys of `rmw_zenoh` have them.

/// A message type, or a service type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RosType {
    /// The name: `nav_msgs::msg::dds_::Odometry_`.
    pub dds: &'static str,
    /// Its hash, the same in Iron, Jazzy and Kilted (REP 2016).
    pub hash: &'static str,
}

/// What stands in for every hash in Humble.
pub const NO_HASH: &str = "TypeHashNotSupported";

impl RosType {
    /// The name as ROS spells it: `nav_msgs/msg/Odometry`.
    pub fn name(self) -> String {
        self.dds
            .trim_end_matches('_')
            .replace("::dds_::", "/")
            .replace("::", "/")
    }
}

macro_rules! types {
    ($($(#[$doc:meta])* $name:ident = $package:literal $kind:literal $type:literal $hash:literal;)*) => {
        $($(#[$doc])* pub const $name: RosType = RosType {
            dds: concat!($package, "::", $kind, "::dds_::", $type, "_"),
            hash: concat!("RIHS01_", $hash),
        };)*
        /// All of them.
        pub const ALL: &[RosType] = &[$($name),*];
    };
}

types! {
    /// `sensor_msgs/msg/LaserScan`.
    LASER_SCAN = "sensor_msgs" "msg" "LaserScan" "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828";
    /// `sensor_msgs/msg/Imu`.
    IMU = "sensor_msgs" "msg" "Imu" "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b";
    /// `nav_msgs/msg/Odometry`.
    ODOMETRY = "nav_msgs" "msg" "Odometry" "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0";
    /// `nav_msgs/msg/OccupancyGrid`.
    OCCUPANCY_GRID = "nav_msgs" "msg" "OccupancyGrid" "8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7";
    /// `geometry_msgs/msg/PoseStamped`.
    POSE_STAMPED = "geometry_msgs" "msg" "PoseStamped" "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8";
    /// `geometry_msgs/msg/PoseWithCovarianceStamped`.
    POSE_WITH_COVARIANCE_STAMPED = "geometry_msgs" "msg" "PoseWithCovarianceStamped"
        "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e";
    /// `geometry_msgs/msg/PoseArray`.
    POSE_ARRAY = "geometry_msgs" "msg" "PoseArray" "af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0";
    /// `geometry_msgs/msg/PointStamped`.
    POINT_STAMPED = "geometry_msgs" "msg" "PointStamped" "4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897";
    /// `tf2_msgs/msg/TFMessage`.
    TF_MESSAGE = "tf2_msgs" "msg" "TFMessage" "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087";
    /// `diagnostic_msgs/msg/DiagnosticArray`.
    DIAGNOSTIC_ARRAY = "diagnostic_msgs" "msg" "DiagnosticArray"
        "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e";
    /// `rcl_interfaces/msg/ParameterEvent`.
    PARAMETER_EVENT = "rcl_interfaces" "msg" "ParameterEvent"
        "043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204";
    /// `rcl_interfaces/srv/ListParameters`.
    LIST_PARAMETERS = "rcl_interfaces" "srv" "ListParameters"
        "3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d";
    /// `rcl_interfaces/srv/GetParameters`.
    GET_PARAMETERS = "rcl_interfaces" "srv" "GetParameters"
        "bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc";
    /// `rcl_interfaces/srv/GetParameterTypes`.
    GET_PARAMETER_TYPES = "rcl_interfaces" "srv" "GetParameterTypes"
        "da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca";
    /// `rcl_interfaces/srv/DescribeParameters`.
    DESCRIBE_PARAMETERS = "rcl_interfaces" "srv" "DescribeParameters"
        "845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff";
    /// `rcl_interfaces/srv/SetParameters`.
    SET_PARAMETERS = "rcl_interfaces" "srv" "SetParameters"
        "56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0";
    /// `rcl_interfaces/srv/SetParametersAtomically`.
    SET_PARAMETERS_ATOMICALLY = "rcl_interfaces" "srv" "SetParametersAtomically"
        "0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd";
    /// `std_srvs/srv/Empty`.
    EMPTY = "std_srvs" "srv" "Empty" "5888399dedec5ccc85ea6451949fd2c9f97bfdf963f9a588821639fcd31b5d19";
    /// `rcl_interfaces/msg/Log`.
    LOG = "rcl_interfaces" "msg" "Log" "e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac";
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_has_the_name_that_ros_gives_it() {
        assert_eq!(ODOMETRY.name(), "nav_msgs/msg/Odometry");
        assert_eq!(ODOMETRY.dds, "nav_msgs::msg::dds_::Odometry_");
        assert!(ALL.iter().all(|each| each.hash.len() == 7 + 64));
    }
}
