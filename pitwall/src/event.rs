//! What reaches the pit wall: the one stream that the fleet, the recorder and a replay share.

use std::sync::Arc;

use protocol::{CarInfo, CarName, Header, MapReply, Telemetry, Topic};

/// Something that reached the pit wall.
#[derive(Debug, Clone)]
pub struct FleetEvent {
    /// When, by the laptop's clock [unix ns].
    pub at: i64,
    /// The car it concerns.
    pub car: CarName,
    /// What.
    pub happening: Happening,
}

/// What can reach the pit wall.
#[derive(Debug, Clone)]
pub enum Happening {
    /// The car's node came up, or its link did.
    Appeared,
    /// The car's node ended, or its link did.
    Vanished,
    /// A message.
    Message {
        /// Where it came in.
        topic: Topic,
        /// How it came in.
        lane: Lane,
        /// Its header.
        header: Header,
        /// Its content.
        telemetry: Box<Telemetry>,
        /// The bytes as they came.
        bytes: Arc<[u8]>,
    },
    /// Bytes that are no message, or one of a version that is not known here.
    Unreadable {
        /// Where they came in.
        topic: Topic,
        /// The header that they begin with, if they do.
        header: Option<Header>,
        /// What is wrong with them.
        error: String,
    },
    /// The car's map was fetched.
    Map {
        /// The map.
        map: Arc<MapReply>,
        /// The bytes as they came.
        bytes: Arc<[u8]>,
    },
    /// What runs on the car was asked.
    Info(CarInfo),
    /// Somebody at the pit wall marked this moment.
    Marker {
        /// Who.
        who: Arc<str>,
        /// What they typed.
        text: Arc<str>,
    },
    /// The car's clock was compared with the laptop's.
    Clock {
        /// What must be added to the laptop's clock to get the car's [ns].
        offset: i64,
        /// Round-trip time; the offset is right to within half of it [ns].
        round_trip: i64,
    },
    /// The car has said how far its streams go, because a recording is about to end: here.
    HowFar {
        /// Its run id.
        run_id: u64,
        /// When it said so, by its own clock [unix ns].
        said: i64,
        /// The streams that must be whole of which something is still to come.
        streams: Vec<Sent>,
    },
}

/// Numbers of a stream that were sent and have not been handed on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    /// The stream.
    pub topic: Topic,
    /// The first of them.
    pub from: u64,
    /// The last.
    pub to: u64,
}

/// How a message came in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lane {
    /// As soon as it arrived; some may be missing.
    Live,
    /// In order and with gaps filled, so possibly late.
    Complete,
}
