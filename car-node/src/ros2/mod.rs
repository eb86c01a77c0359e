//! ROS 2: its messages, and publishers that a car's own nodes hear.

pub mod messages;
pub mod pose_publisher;
