//! The messages between the cars and the pit wall: their types, their keys and their bytes.
//!
//! The crate encodes, decodes and validates messages. It never opens a socket or a file and never reads a clock, and
//! it depends on neither zenoh nor tokio.
//!
//! ```text
//! car  --- pose, cloud, scan, health, load, params, shadow, event, recorded/* -->  pit wall   (telemetry)
//! car  <-- map?, info?, clock?, missing?, files? ------------------------------------  pit wall   (queries)
//! car  <-- cmd/params, cmd/pose, cmd/relocalize, cmd/rates, cmd/auto, cmd/record  pit wall   (commands)
//!      --- answer: done at update N | refused | stale revision ----------------->
//! car  <-- link (how late its poses arrive) -------------------------------------  pit wall   (link report)
//! ```
//!
//! Each message travels under the key `synpf/v1/<car>/<topic>` ([`Key`]). It is a fixed [`Header`] followed by a
//! payload ([`encode`], [`decode`]).
//!
//! # Compatibility
//! - A change of a message's layout is a new version of the message. The old struct stays unchanged, and what it
//!   holds is converted.
//! - Enum variants are appended, never reordered or removed: their order is on the wire.
//! - An unknown version, topic or variant is an error. The receiver counts it and goes on.
//! - Golden bytes in `tests/wire/golden.rs` fail when the layout of a message changes.
//!
//! # Numbers
//! No float on the wire is NaN or infinite. [`encode`] and [`decode`] refuse one and name its field. A value that may
//! be unknown is an `Option`.
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
mod plain_text;
mod telemetry;
mod to_car;
mod to_wall;

pub mod ros;

pub use codec::{CodecError, Payload, decode, encode};
pub use geometry::{Covariance, Pose2, Twist2};
pub use header::{Header, HeaderError, Stamps};
pub use key::{CarName, Key, KeyError, Topic};
pub use message::{Invalid, Message, Schema};
pub use plain_text::plain_text;
pub use telemetry::Telemetry;
pub use to_car::{
    Action, Answer, Candidate, Command, CommandId, FileInfo, FileName, FileNameError, FilesReply,
    FilesRequest, IdError, Kept, LinkReport, MissingReply, MissingRequest, Outcome, ParamsAction, Rates,
    RatesAction, RecordAction, RelocalizeAction, Reply, Resent, StoredSet, UtcTime, Wanted,
};
pub use to_wall::{
    CarInfo, Cause, CauseKind, Cell, ClockReply, ClockRequest, Cloud, CloudParticle, Comparison, Drops,
    EndPoint, EndPointKind, Event, EventKind, Fitness, Health, Latency, Load, MapRaceline, MapReply, Metrics,
    ParameterSet, Params, PendingRevert, Pose, PoseKind, Proposal, RecordedOdometry, RecordedScan,
    RecorderState, ScanView, SetRef, Severity, Shadow, State, TrackPoint, Truth, Value, ValueChange,
};
