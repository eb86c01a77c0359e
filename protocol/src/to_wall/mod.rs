//! Messages from a car: telemetry and replies to queries.

mod cloud;
mod event;
mod health;
mod info;
mod load;
mod map;
mod older_event;
mod params;
mod pose;
mod recorded;
mod scan_view;
mod shadow;

pub use cloud::{Cloud, CloudParticle};
pub use event::{Event, EventKind, SetRef, ValueChange};
pub use health::{Cause, CauseKind, Health, Metrics, Proposal, Severity, State};
pub use info::{CarInfo, ClockReply, ClockRequest};
pub use load::{Drops, Latency, Load, RecorderState};
pub use map::{Cell, MapRaceline, MapReply};
pub(crate) use params::set_name;
pub use params::{ParameterSet, Params, PendingRevert, Value};
pub use pose::{Pose, PoseKind, TrackPoint};
pub use recorded::{RecordedOdometry, RecordedScan, Truth};
pub use scan_view::{EndPoint, EndPointKind, ScanView};
pub use shadow::{Comparison, Fitness, Shadow};
