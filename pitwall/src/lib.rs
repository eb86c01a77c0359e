//! The pit wall: how well every car is localized and why, on one laptop.
//!
//! ```text
//! cars ==zenoh==> network -> FleetEvent -> Fleet (pure state) -> page, terminal, JSON
//!                                '-------> recording (one MCAP file per session)
//! ```
//!
//! [`Fleet`] has no clock and no I/O: a replay is the same [`Fleet::apply`] over the same events. [`Connection`] is the
//! only way to the network.

// The commands name the library as any other program would.
extern crate self as pitwall;

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
pub use clock::unix_now;
pub use event::{Delivery, EventPayload, EventSink, FleetEvent, SentRange};
pub use event_bus::{EventBus, FleetGuard};
pub use fleet::{
    Car, CarView, Fleet, GapSummary, HealthSample, Lap, LapGrip, Log, LogEntry, PoseView, ProfileCell,
    SECTORS, SequenceStatus, SequenceTracker, SetView, StreamStatistics, StreamView,
};
pub use fleet_service::{FleetService, StartRecordingError};
pub use network::{
    Client, Connection, ConnectionError, DEFAULT_LISTEN, LOCAL_PITWALL, REPLY_TIMEOUT, Role, Verdict,
    new_command_id,
};
pub use program::program;
pub use recording::{
    Damage, Recorder, RecorderStatus, Recording, RecordingError, RecordingProgress, RecordingSummary,
    Recovered, StreamSummary, Unreadable, UnreadableCount, read_events, recover,
};
pub use replay::{Replay, ReplayView};
pub use report::{CarReport, MeanSigma, Report, TableRow, TrueError};
pub use server::{PitWallError, PitWallOptions, PitWallServer};
pub use web::{Page, PageOptions};
