//! The pit wall: shows on one laptop how well every car is localized, and why.
//!
//! ```text
//! cars ==zenoh==> network -> FleetEvent -> Fleet (pure state) -> page, terminal, JSON
//!                                '-------> recording (one MCAP file with all cars)
//! ```
//!
//! [`Fleet`] has no clock and no I/O: a replay is the same [`Fleet::apply`] over the same events. Only [`Connection`] uses
//! the network. The pit wall never localizes a car, and it does not depend on the node that does.
//!
//! # Example
//!
//! A car appears and then sends nothing for two seconds:
//!
//! ```
//! use pitwall::{EventPayload, Fleet, FleetEvent};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! const SECOND: i64 = 1_000_000_000;
//! let mut fleet = Fleet::default();
//! fleet.apply(&FleetEvent {
//!     at: SECOND,
//!     car: "car-1".parse()?,
//!     payload: EventPayload::Appeared,
//! });
//! assert_eq!(fleet.view(SECOND)[0].state, "INIT");
//!
//! fleet.tick(3 * SECOND);
//! assert_eq!(fleet.view(3 * SECOND)[0].state, "BLIND");
//! assert_eq!(fleet.log().alarms(), 1);
//! # Ok(())
//! # }
//! ```

// The commands name the library as any other program would.
extern crate self as pitwall;

mod analysis;
mod cli;
mod clock;
mod commands;
mod event;
mod event_bus;
mod fleet;
mod fleet_service;
mod network;
mod number_ranges;
mod output;
mod program;
mod qr_code;
mod recording;
mod replay;
mod report;
#[cfg(feature = "rerun")]
mod rerun;
mod server;
mod terminal;
mod web;

#[cfg(feature = "rerun")]
pub use crate::rerun::{RerunError, RerunOutlet, RerunView};
pub use analysis::{
    Channel, Disagreement, Invalid, LapBook, LapKind, LapTrace, MapCheck, MapFinding, PoseSample, Sectors,
    TrackLine, ideal_lap,
};
pub use clock::unix_now;
pub use event::{Delivery, EventPayload, EventSink, FleetEvent, Rejection, RunEnd, SentRange};
pub use event_bus::{EventBus, FleetGuard};
pub use fleet::{
    Car, CarView, Fleet, GapSummary, HealthSample, Lap, LapGrip, Limits, Log, LogEntry, PoseView,
    ProfileCell, SECTORS, SequenceStatus, SequenceTracker, SetView, StreamStatistics, StreamView,
};
pub use fleet_service::{FleetService, StartRecordingError};
pub use network::{
    CarFiles, Client, Connection, ConnectionError, LOCAL_PITWALL, REPLY_TIMEOUT, RecorderNews, RecorderView,
    Role, Router, Verdict, new_command_id, open_router,
};
pub use program::program;
pub use recording::{
    CarCheck, Check, Damage, FetchError, FetchOptions, FetchProgress, Fetched, FileSource, GapCheck, InOrder,
    Merged, MergedInput, Recorder, RecorderOptions, RecorderStatus, Recording, RecordingError,
    RecordingProgress, RecordingSummary, Recovered, RosBag, RunCheck, Session, SessionIndex,
    SessionIndexError, StreamCheck, StreamSummary, Unreadable, UnreadableCount, check, fetch, merge,
    missing_content, read_events, read_in_order, recover, session_name,
};
pub use replay::{Replay, ReplayView};
pub use report::{Alarm, CarReport, MeanSigma, Report, TableRow, TrueError};
pub use server::{PitWallError, PitWallOptions, PitWallServer};
pub use web::{Page, PageOptions, disk_free};
