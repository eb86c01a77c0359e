//! Names of the topics that this node publishes to the car's own nodes.

/// The topic on which the reference publishes its pose, and which controllers subscribe to.
pub const POSE_ODOMETRY: &str = "/pf/pose/odom";
