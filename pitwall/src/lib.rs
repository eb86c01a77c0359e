//! The pit wall: how well every car is localized and why, on one laptop.
//!
//! ```text
//! cars ==zenoh==> link -> FleetEvent -> Fleet (pure state) -> page, terminal, JSON
//!                              '------> recorder (one MCAP file per session)
//! ```
//!
//! [`Fleet`] has no clock and no I/O: a replay is the same [`Fleet::apply`] over the same events. [`Link`] is the
//! only way to the network.

// The terminal's verbs name the library as anybody else would.
extern crate self as pitwall;

mod ask;
mod board;
mod car;
mod catch_up;
mod cli;
mod commands;
mod event;
mod fleet;
mod gaps;
mod history;
mod hub;
mod laps;
mod link;
mod log;
mod output;
mod program;
mod recording;
mod replay;
mod report;
#[cfg(feature = "rerun")]
mod rerun_view;
mod stream;
mod wall;
mod web;

pub use ask::{PATIENCE, Verdict, new_command_id};
pub use board::{Board, FleetGuard};
pub use car::{Car, CarView, PoseView, SetView};
pub use event::{FleetEvent, Happening, Lane, Sent};
pub use fleet::Fleet;
pub use gaps::{Arrival, GapSummary, Gaps};
pub use history::{Moment, Place};
pub use hub::{Hub, StartError};
pub use laps::{Lap, LapGrip, SECTORS};
pub use link::{DEFAULT_LISTEN, LOCAL_WALL, Link, LinkError, Role, Sink, unix_now};
pub use log::{Log, LogEntry};
pub use program::program;
pub use recording::{
    Progress, Recorder, Recording, RecordingError, Recovered, Status, StreamSummary, Summary, Unreadable,
    UnreadableCount, read_events, recover,
};
pub use replay::{Replay, ReplayView};
pub use report::{CarReport, MeanSigma, Report, TableRow, TrueError};
#[cfg(feature = "rerun")]
pub use rerun_view::{RerunError, RerunOutlet, RerunView};
pub use stream::{Stream, StreamView};
pub use wall::{PitWall, WallError, WallOptions};
pub use web::{Page, PageOptions};
