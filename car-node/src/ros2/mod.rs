//! ROS 2: its messages, this node in its graph, and what the node publishes to the car's own nodes.

pub mod graph;
mod map_server;
pub mod messages;
pub mod output;
pub mod output_publisher;
pub mod parameter_messages;
pub mod services;
pub mod topics;
pub mod types;
