//! Asking a car again for what did not come.
//!
//! ```text
//! pit wall --- of these streams I lack these numbers; answer with at most so many bytes ---> car
//!          <-- the messages, oldest first; what is still kept of each stream, and its last number ---
//! ```
//!
//! One answer is one message of bounded length: what is missing comes in pieces as large as the link can take between
//! two poses, and the asker sets the pace. Ranges that the car no longer keeps are those before [`Kept::first`].

use serde::{Deserialize, Serialize};

use crate::{Invalid, Message, Schema, Topic};

/// Asks for messages by number.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MissingRequest {
    /// The run of the car that the numbers belong to. A car in another run sends no messages; the header of its
    /// answer carries its own run id.
    pub run_id: u64,
    /// What is missing, the most urgent stream first, at most [`MissingRequest::MAX_STREAMS`].
    pub streams: Vec<Wanted>,
    /// How long the messages in the answer may be together [bytes]. One comes in any case.
    pub budget: u32,
}

impl MissingRequest {
    /// Most streams in one request.
    pub const MAX_STREAMS: usize = 16;
    /// Largest budget that a car goes along with [bytes].
    pub const MAX_BUDGET: u32 = 64 * 1024;
}

/// What is missing of one stream.
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

/// What a car still has of it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MissingReply {
    /// Every stream that the car keeps.
    pub streams: Vec<Kept>,
    /// Messages as they were sent, header and all.
    pub messages: Vec<Resent>,
}

/// What a car keeps of one stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Kept {
    /// The stream.
    pub topic: Topic,
    /// Number of the oldest message that it still has.
    pub first: u64,
    /// Number of the last message that it made.
    pub last: u64,
}

/// A message once more.
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
    /// The largest budget, and the largest message beyond it.
    const MAX_LEN: usize = 256 * 1024;
}
