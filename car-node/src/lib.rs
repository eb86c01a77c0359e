//! The on-car node: SynPF on recorded, simulated or live sensors, published over zenoh.
//!
//! ```text
//! sensors -> localization -> health -> telemetry ==zenoh==> pit wall
//!               ^                                              |
//!             control <================ commands ==============+
//! ```
//!
//! The library holds the parts, the binary the commands. The filter's thread never waits for the network, a disk or a clock.
//! [`evaluate`] runs a localizer over a recorded log, [`stress`] over a log that is damaged in many ways, and [`race`] drives
//! simulated cars; none needs a network.
//!
//! A lap of the bundled track `club`, driven on the localizer's own estimates:
//!
//! ```
//! use std::sync::Arc;
//!
//! use car_node::localization::LocalizerParameters;
//! use car_node::race::{PoseSource, Quality, RaceSetup, race};
//! use simulator::Track;
//! use synpf::TrackMap;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let track = Arc::new(Track::find("club", None)?);
//! let map = Arc::new(TrackMap::new(track.grid.clone())?);
//! let setup = RaceSetup {
//!     laps: 1,
//!     cars: 1,
//!     quality: Quality::Hq,
//!     pose_source: PoseSource::Localizer(LocalizerParameters::named("hq").ok_or("a built-in set")?),
//!     speed_scale: 1.0,
//!     seed: 0,
//!     defects: Vec::new(),
//! };
//! let cars = race(&track, &map, &setup)?;
//! assert!(cars[0].finished && cars[0].crashes == 0);
//! println!("lap time {:.2} s", cars[0].laps[0].time_s);
//! # Ok(())
//! # }
//! ```
pub mod control;
pub mod evaluate;
pub mod health;
pub mod import;
pub mod localization;
pub mod network;
pub mod node;
pub mod race;
pub mod recording;
pub mod ros2;
pub mod sensors;
pub mod statistics;
pub mod stress;
pub mod telemetry;
pub mod wire;
