//! The events that reach the pit wall. The fleet, the recorder and a replay share them.

use std::fmt;
use std::sync::Arc;

use protocol::{CarInfo, CarName, Header, MapReply, Telemetry, Topic};
use serde::{Deserialize, Serialize};

/// Receives every event. It runs in the decoder's thread or in one of zenoh's, so it must not wait.
pub type EventSink = Arc<dyn Fn(FleetEvent) + Send + Sync>;

/// An event of one car.
#[derive(Debug, Clone)]
pub struct FleetEvent {
    /// When it arrived, by the laptop's clock \[unix ns\].
    pub at: i64,
    /// The car that it concerns.
    pub car: CarName,
    /// The content.
    pub payload: EventPayload,
}

/// The content of a [`FleetEvent`].
#[derive(Debug, Clone)]
pub enum EventPayload {
    /// The car's node or its link has come up.
    Appeared,
    /// The car's node or its link has ended.
    Vanished,
    /// A message.
    Message {
        /// The topic that it came on.
        topic: Topic,
        /// How it was delivered.
        delivery: Delivery,
        /// Its header.
        header: Header,
        /// Its content.
        telemetry: Box<Telemetry>,
        /// The bytes as received.
        bytes: Arc<[u8]>,
    },
    /// A message that cannot be decoded, because it is damaged or of an unknown version.
    Unreadable {
        /// The topic that it came on.
        topic: Topic,
        /// The header, if it can be decoded.
        header: Option<Header>,
        /// Why it cannot be decoded.
        error: String,
    },
    /// Messages that were dropped because their run or their number is not plausible. They are not in the counts of a stream.
    Rejected {
        /// Their topic.
        topic: Topic,
        /// Run id of the last of them.
        run_id: u64,
        /// Sequence number of the last of them.
        sequence: u64,
        /// How many.
        count: u64,
        /// Why.
        reason: Rejection,
    },
    /// The car's map was fetched.
    Map {
        /// The map.
        map: Arc<MapReply>,
        /// The bytes as received.
        bytes: Arc<[u8]>,
    },
    /// The software versions on the car were fetched.
    Info(CarInfo),
    /// An operator marked this moment.
    Marker {
        /// The operator.
        who: Arc<str>,
        /// The text.
        text: Arc<str>,
    },
    /// The car's clock was compared with the laptop's.
    Clock {
        /// The car's run; None where it is not known.
        run_id: Option<u64>,
        /// Car's clock minus laptop's clock \[ns\].
        offset: i64,
        /// Round-trip time; the offset is exact to within half of it \[ns\].
        round_trip: i64,
    },
    /// It is known how far the streams of a run go.
    StreamEnds {
        /// The car's run.
        run_id: u64,
        /// The end, by the car's own clock \[unix ns\].
        published: i64,
        /// How it is known.
        end: RunEnd,
        /// The messages that have not arrived yet.
        outstanding: Vec<SentRange>,
    },
}

/// Why messages are dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rejection {
    /// Two cars of this name send at once.
    TwoSenders,
    /// They are of another run than the one that is followed.
    OtherRun,
    /// Their number is far from the others of the stream.
    Leap,
}

impl fmt::Display for Rejection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::TwoSenders => "two cars of this name send at once; only the first is shown and recorded",
            Self::OtherRun => "another run of the car than the one that is followed",
            Self::Leap => "a sequence number that is far from the others",
        })
    }
}

/// How the end of a run's streams is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RunEnd {
    /// The car has answered a final sync, as a recording ended.
    #[default]
    Answered,
    /// The car has completed its own recording.
    Recorded,
    /// The car's own recording was cut off. What it had not brought to its disk is lost, and nobody has it.
    CutOff,
    /// The car has answered a final sync as it stopped. The run has no further messages.
    Stopped,
}

/// Sequence numbers of a stream that were sent and have not been released yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SentRange {
    /// The stream's topic.
    pub topic: Topic,
    /// The first number.
    pub from: u64,
    /// The last number.
    pub to: u64,
}

/// How a message was delivered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// As soon as it arrived; messages before it may be missing.
    Live,
    /// In the order of sending, with gaps filled, and therefore possibly late.
    InOrder,
}
