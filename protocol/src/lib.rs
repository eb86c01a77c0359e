//! What crosses the network between the cars and the pit wall.
//!
//! ```text
//! car  --- pose, cloud, scan, health, load, params, shadow, event, recorded/* --->  pit wall      (telemetry)
//! car  <-- map?, info?, clock?, missing? --------------------------------  pit wall      (questions)
//! car  <-- cmd/params, cmd/pose, cmd/relocalize, cmd/rates, cmd/auto ----  pit wall      (commands)
//!      --- answer: done at update N | refused | stale revision ---------->
//! car  <-- link (how late its poses arrive) -----------------------------  pit wall
//! ```
//!
//! Each message travels under the key `synpf/v1/<car>/<topic>` ([`Key`]) as a fixed [`Header`] followed by its
//! payload ([`encode`], [`decode`]). This crate holds no socket, no file and no clock.
//!
//! # Compatibility
//! - A change of a message's layout is a new version of it: the old struct stays, frozen, and is converted.
//! - Enum variants are appended, never reordered or removed: their order is on the wire.
//! - An unknown version, topic or variant is an error that says so; the receiver counts it and carries on.
//! - The golden bytes in `tests/golden.rs` hold all of this in place.
//!
//! # Numbers
//! No float on the wire is NaN or infinite: both [`encode`] and [`decode`] refuse one, naming its field. What
//! may be unknown is an `Option`.
//!
//! ```
//! use protocol::{CarName, Key, Pose2, Stamps, Topic, Truth, Twist2, decode, encode};
//!
//! let key = Key::new(CarName::new("car-1")?, Topic::RecordedTruth);
//! assert_eq!(key.to_string(), "synpf/v1/car-1/recorded/truth");
//!
//! let truth = Truth { pose: Pose2 { x: 1.0, y: 2.0, heading: 0.5 }, twist: Twist2::default() };
//! let bytes = encode(&truth, Stamps { run_id: 1, sequence: 1, sensor: 0, published: 0 })?;
//! let (header, back) = decode::<Truth>(&bytes)?;
//! assert_eq!((header.sequence, back), (1, truth));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
mod codec;
mod finite;
mod geometry;
mod header;
mod key;
mod message;
mod telemetry;
mod to_car;
mod to_wall;

pub use codec::{CodecError, Payload, decode, encode};
pub use geometry::{Covariance, Pose2, Twist2};
pub use header::{Header, HeaderError, Stamps};
pub use key::{CarName, Key, KeyError, Topic};
pub use message::{Invalid, Message, Schema};
pub use telemetry::Telemetry;
pub use to_car::{
    Action, Answer, Candidate, Command, CommandId, IdError, Kept, LinkReport, MissingReply, MissingRequest,
    Outcome, ParamsAction, Rates, RatesAction, RelocalizeAction, Reply, Resent, StoredSet, Wanted,
};
pub use to_wall::{
    CarInfo, Cause, CauseKind, Cell, ClockReply, ClockRequest, Cloud, CloudParticle, Comparison, Drops,
    EndPoint, EndPointKind, Event, EventKind, Fitness, Health, Latency, Load, MapRaceline, MapReply, Metrics,
    ParameterSet, Params, PendingRevert, Pose, PoseKind, Proposal, RecordedOdometry, RecordedScan, ScanView,
    SetRef, Severity, Shadow, State, TrackPoint, Truth, Value, ValueChange,
};
