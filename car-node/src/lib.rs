//! The on-car node: SynPF on recorded, simulated or live sensors, published over zenoh.
//!
//! The library holds the parts, the binary the commands. See [`evaluate`] for a filter over a recorded log.
pub mod control;
pub mod evaluate;
pub mod health;
pub mod localization;
pub mod network;
pub mod node;
pub mod race;
pub mod ros2;
pub mod sensors;
pub mod statistics;
pub mod telemetry;
pub mod wire;
