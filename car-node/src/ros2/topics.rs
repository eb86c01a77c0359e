//! Names of the topics that this node publishes to the car's own nodes. They are in the namespace of the car, apart from those
//! that all nodes of a machine share.

/// The topic on which the reference publishes its pose, and which controllers subscribe to (`nav_msgs/msg/Odometry`).
pub const POSE_ODOMETRY: &str = "/pf/pose/odom";
/// The reference's pose for pure-pursuit controllers (`geometry_msgs/msg/PoseStamped`).
pub const INFERRED_POSE: &str = "/pf/viz/inferred_pose";
/// Cartographer's pose (`geometry_msgs/msg/PoseStamped`).
pub const TRACKED_POSE: &str = "/tracked_pose";
/// The pose with its covariance (`geometry_msgs/msg/PoseWithCovarianceStamped`).
pub const POSE_WITH_COVARIANCE: &str = "/tracked_pose/with_covariance";
/// The reference's particles (`geometry_msgs/msg/PoseArray`).
pub const PARTICLES: &str = "/pf/viz/particles";
/// Transforms (`tf2_msgs/msg/TFMessage`).
pub const TRANSFORMS: &str = "/tf";
/// The map (`nav_msgs/msg/OccupancyGrid`).
pub const MAP: &str = "/map";
/// Judgements of all nodes (`diagnostic_msgs/msg/DiagnosticArray`); in no namespace.
pub const DIAGNOSTICS: &str = "/diagnostics";
/// Log messages of all nodes (`rcl_interfaces/msg/Log`); in no namespace.
pub const LOG: &str = "/rosout";

/// The topics that carry this node's own poses. They are never inputs.
pub const POSES: [&str; 4] = [POSE_ODOMETRY, INFERRED_POSE, TRACKED_POSE, POSE_WITH_COVARIANCE];
