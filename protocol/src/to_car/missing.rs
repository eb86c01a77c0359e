//! Requests for messages that were lost.
//!
//! ```text
//! pit wall --- missing numbers of each stream, most bytes of the reply ------------------> car
//!          <-- the messages, oldest first; the first and last number kept of each stream ---
//! ```
//!
//! A reply is one message of bounded length, so the pit wall decides the pace and a reply fits between two poses. Messages
//! before [`Kept::first`] are no longer kept and cannot be had.

use serde::{Deserialize, Serialize};

use crate::{Invalid, Message, Schema, Topic};

/// Requests messages by number.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MissingRequest {
    /// The run of the car that the numbers belong to. A car in another run sends no messages; the header of its
    /// reply carries its own run id.
    pub run_id: u64,
    /// The missing numbers, the most urgent stream first, at most [`MissingRequest::MAX_STREAMS`].
    pub streams: Vec<Wanted>,
    /// Total length of the messages in the reply \[bytes\]. One message is sent even if it is longer.
    pub budget: u32,
}

impl MissingRequest {
    /// Most streams in one request.
    pub const MAX_STREAMS: usize = 16;
    /// Largest budget that a car accepts \[bytes\].
    pub const MAX_BUDGET: u32 = 64 * 1024;
}

/// The missing numbers of one stream.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Wanted {
    /// The stream.
    pub topic: Topic,
    /// Sequence numbers as `[from, to]`, ascending, at most [`Wanted::MAX_RANGES`].
    pub ranges: Vec<[u64; 2]>,
}

impl Wanted {
    /// Most ranges of one stream.
    pub const MAX_RANGES: usize = 64;
}

/// The messages requested, as far as the car still has them.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MissingReply {
    /// Every stream that the car keeps.
    pub streams: Vec<Kept>,
    /// The messages as they were sent, with their headers.
    pub messages: Vec<Resent>,
}

/// The range of messages that a car keeps of one stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Kept {
    /// The stream.
    pub topic: Topic,
    /// Number of the oldest message that it still has.
    pub first: u64,
    /// Number of the last message that it has sent.
    pub last: u64,
}

/// A message that is sent again.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Resent {
    /// Its stream.
    pub topic: Topic,
    /// The message.
    pub bytes: Vec<u8>,
}

impl Message for MissingRequest {
    const SCHEMA: Schema = Schema::MissingRequest;

    fn validate(&self) -> Result<(), Invalid> {
        Invalid::unless_at_most("streams", self.streams.len(), Self::MAX_STREAMS)?;
        for Wanted { topic, ranges } in &self.streams {
            Invalid::unless_at_most("ranges", ranges.len(), Wanted::MAX_RANGES)?;
            if let Some([from, to]) = ranges.iter().find(|[from, to]| from > to) {
                return Err(Invalid::new(
                    "ranges",
                    format!("{topic}: {from} to {to} is no range"),
                ));
            }
        }
        Ok(())
    }
}

impl Message for MissingReply {
    const SCHEMA: Schema = Schema::MissingReply;
    /// The largest budget plus the largest message.
    const MAX_LEN: usize = 256 * 1024;

    fn validate(&self) -> Result<(), Invalid> {
        let most = crate::Header::MAX_SEQUENCE;
        let beyond = |kept: &&Kept| kept.first > most || kept.last > most;
        match self.streams.iter().find(beyond) {
            None => Ok(()),
            Some(Kept { topic, first, last }) => Err(Invalid::new(
                "streams",
                format!("{topic}: {first} to {last} exceeds {most}"),
            )),
        }
    }
}
