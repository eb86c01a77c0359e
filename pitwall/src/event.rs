//! What reaches the pit wall: the one stream of events that the fleet, the recorder and a replay share.

use std::sync::Arc;

use protocol::{CarInfo, CarName, Header, MapReply, Telemetry, Topic};

/// Receives every event. It runs in the decoder's thread or in one of zenoh's, so it must not wait.
pub type EventSink = Arc<dyn Fn(FleetEvent) + Send + Sync>;

/// Something that reached the pit wall.
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
    /// Bytes that are no message, or a message of an unknown version.
    Unreadable {
        /// The topic that they came on.
        topic: Topic,
        /// Their header, if they begin with one.
        header: Option<Header>,
        /// Why they cannot be decoded.
        error: String,
    },
    /// The car's map was fetched.
    Map {
        /// The map.
        map: Arc<MapReply>,
        /// The bytes as received.
        bytes: Arc<[u8]>,
    },
    /// What runs on the car was fetched.
    Info(CarInfo),
    /// Somebody at the pit wall marked this moment.
    Marker {
        /// Who.
        who: Arc<str>,
        /// The text that they typed.
        text: Arc<str>,
    },
    /// The car's clock was compared with the laptop's.
    Clock {
        /// Car's clock minus laptop's clock \[ns\].
        offset: i64,
        /// Round-trip time; the offset is exact to within half of it \[ns\].
        round_trip: i64,
    },
    /// The car has reported where its streams end, because a recording is about to end there.
    StreamEnds {
        /// The car's run.
        run_id: u64,
        /// When the car reported it, by its own clock \[unix ns\].
        published: i64,
        /// The streams of which messages are still to come.
        outstanding: Vec<SentRange>,
    },
}

/// Sequence numbers of a stream that were sent and have not been forwarded yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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
    /// In the order of sending and with gaps filled, so possibly late.
    InOrder,
}
