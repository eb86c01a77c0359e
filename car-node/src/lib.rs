//! The on-car node: SynPF on recorded, simulated or live sensors, published over zenoh.
//!
//! The library holds the parts, the binary the commands. See [`evaluate`] for a filter over a recorded log.
pub mod archive;
pub mod bag;
pub mod clock;
pub mod counters;
pub mod desk;
pub mod evaluate;
pub mod filter;
pub mod frames;
pub mod health;
pub mod keeper;
pub mod laps;
pub mod library;
pub mod link;
pub mod load;
pub mod node;
pub mod outbox;
pub mod proposal;
pub mod publisher;
pub mod race;
pub mod ros;
pub mod ros_pose;
pub mod sets;
pub mod shadow;
pub mod source;
pub mod throttle;
pub mod wire;
