//! ROS 2: its messages, and a publisher for the car's own nodes.

pub mod messages;
pub mod pose_publisher;
pub mod topics;
