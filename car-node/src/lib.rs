//! The on-car node: SynPF on recorded, simulated or live sensors, published over zenoh.
//!
//! The library holds the parts, the binary the commands. See [`evaluate`] for a filter over a recorded log.
pub mod bag;
pub mod evaluate;
pub mod frames;
pub mod ros;
pub mod sets;
