//! Laps and health over the track, and where the map is wrong.
//!
//! ```text
//! poses, health, load, events ──► LapBook ──► LapTrace: every channel over the track coordinate s
//! scan views                  ──► MapCheck ──► MapFinding: where scans and map disagree
//! ```
//!
//! A live pit wall, a replay and a report feed the same types with the same messages, so their figures are equal. Nothing
//! here has a clock or a network; only `session.rs` reads a file.

mod advice;
mod channel;
mod lap_book;
mod lap_check;
mod lap_trace;
mod map_check;
mod sectors;
mod session;
mod track_line;
mod view;

pub use channel::Channel;
pub(crate) use channel::Worse;
pub use lap_book::{LapBook, PoseSample};
pub(crate) use lap_check::{LapCheck, Step};
pub use lap_trace::{Invalid, LapKind, LapTrace};
pub use map_check::{Disagreement, MapCheck, MapFinding};
pub use sectors::{Sectors, ideal_lap};
pub(crate) use session::SessionLaps;
pub use track_line::TrackLine;
pub(crate) use view::{AnalysisView, CarLaps, LapData};

/// A line to test with: a ring.
#[cfg(test)]
pub(crate) fn test_line() -> TrackLine {
    TrackLine::of(&track_line::tests::ring(|_| false)).expect("a line")
}
