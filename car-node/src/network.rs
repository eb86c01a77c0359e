//! The network: opens the zenoh session and declares publishers on it.
//!
//! The car dials the pit wall as a peer and listens to nobody. It never blocks: what a slow link cannot take is
//! dropped, and of the streams that must be whole the pit wall asks for what it lacks (`archive.rs`). zenoh-ext's recovery
//! is not used: it answers from zenoh's receiving thread with blocking replies of any length, which stops a slow link.

use std::time::Duration;

use protocol::{CarName, Key, Topic};
use zenoh::config::EndPoint;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Config, Session, Wait};

/// Why there is no link.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    /// A setting that zenoh refuses, such as a malformed endpoint.
    #[error("zenoh refuses {key} = {value}: {reason}")]
    Config {
        /// The setting.
        key: &'static str,
        /// Its value.
        value: String,
        /// Why.
        reason: String,
    },
    /// The session does not open.
    #[error("the zenoh session does not open: {0}")]
    Open(String),
    /// A publisher or a queryable cannot be declared.
    #[error("{key}: {reason}")]
    Declare {
        /// Its key.
        key: String,
        /// Why.
        reason: String,
    },
}

/// Where a pit wall on this machine listens.
const LOCAL_WALL: &str = "tcp/127.0.0.1:7447";

/// What the system may hold of what is sent [bytes]: enough for 10 Mbit/s at 10 ms there and back.
const SEND_BUFFER: usize = 16 * 1024;
/// What is written to the link in one piece [bytes]: a pose waits for no more than that of a scan.
const BATCH: usize = 8 * 1024;

/// An endpoint as it is given on a command line, or what it should be.
pub fn endpoint(text: &str) -> Result<String, String> {
    let endpoint = text.parse::<EndPoint>().ok().filter(|endpoint| {
        let port = endpoint
            .address()
            .as_str()
            .rsplit_once(':')
            .map(|(_, port)| port.parse::<u16>());
        ["tcp", "tls"].contains(&endpoint.protocol().as_str()) && matches!(port, Some(Ok(_)))
    });
    match endpoint {
        Some(_) => Ok(text.into()),
        None => Err("should be tcp/HOST:PORT (or tls), as in tcp/192.168.1.10:7447".into()),
    }
}

/// Opens a session that dials `connect`; without one it looks for a pit wall on this machine and by multicast.
pub fn open(connect: &[String]) -> Result<Session, NetworkError> {
    let scout = connect.is_empty().to_string();
    let endpoints = if connect.is_empty() {
        serde_json::json!([LOCAL_WALL]).to_string()
    } else {
        serde_json::json!(connect).to_string()
    };
    let settings = [
        ("mode", r#""peer""#.to_owned()),
        ("connect/endpoints", endpoints),
        ("connect/exit_on_failure", "false".to_owned()),
        ("connect/timeout_ms", "-1".to_owned()),
        (
            "connect/retry",
            r#"{"period_init_ms":200,"period_max_ms":1000,"period_increase_factor":2}"#.to_owned(),
        ),
        // Only cars dial: two that dial each other can end up half connected for good.
        ("listen/endpoints", "[]".to_owned()),
        ("scouting/multicast/enabled", scout),
        ("scouting/gossip/enabled", "false".to_owned()),
        // A cut link is noticed within four seconds. Not sooner: on a radio that loses packets TCP is silent for two now and
        // then, and to dial again takes longer than to wait.
        ("transport/link/tx/lease", "4000".to_owned()),
        // On a slow link what waits should wait here, where a pose overtakes a scan, and not in the system's buffers, where
        // it does not: those would take megabytes, which is a minute of it.
        ("transport/link/tcp/so_sndbuf", SEND_BUFFER.to_string()),
        ("transport/link/tx/batch_size", BATCH.to_string()),
        ("transport/link/tx/queue/size/data", "4".to_owned()),
        ("transport/link/tx/queue/size/data_low", "16".to_owned()),
        // A map takes many pieces, each of which waits for the one before; it goes when there is nothing else to send.
        (
            "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments",
            "3000000".to_owned(),
        ),
    ];
    let mut config = Config::default();
    for (key, value) in settings {
        config
            .insert_json5(key, &value)
            .map_err(|error| NetworkError::Config {
                key,
                value,
                reason: error.to_string(),
            })?;
    }
    zenoh::open(config)
        .wait()
        .map_err(|error| NetworkError::Open(error.to_string()))
}

/// Closes a session, but waits no longer than `patience`: on a dead link it would take 12 s.
pub fn close(session: &Session, patience: Duration) {
    let session = session.clone();
    let (done, closed) = crossbeam_channel::bounded(1);
    let spawned = std::thread::Builder::new().name("close".into()).spawn(move || {
        if let Err(error) = session.close().wait() {
            tracing::debug!(%error, "closing the session");
        }
        done.send(()).ok();
    });
    if spawned.is_ok() && closed.recv_timeout(patience).is_err() {
        tracing::debug!("the session did not close in time");
    }
}

/// Says that the car is there, for as long as the token is kept.
pub fn declare_alive(session: &Session, car: &CarName) -> Result<LivelinessToken, NetworkError> {
    let key = Key::new(car.clone(), Topic::Alive).to_string();
    session
        .liveliness()
        .declare_token(&key)
        .wait()
        .map_err(|error| NetworkError::Declare {
            key,
            reason: error.to_string(),
        })
}

/// A way out for one topic: what the link cannot take is dropped, never waited for.
pub fn declare_publisher(
    session: &Session,
    car: &CarName,
    topic: Topic,
) -> Result<Publisher<'static>, NetworkError> {
    let key = Key::new(car.clone(), topic).to_string();
    let priority = match topic {
        Topic::Pose | Topic::Event => Priority::RealTime,
        Topic::Health => Priority::InteractiveHigh,
        Topic::Cloud | Topic::Scan => Priority::DataLow,
        topic if topic.recorded() => Priority::DataLow,
        _ => Priority::Data,
    };
    session
        .declare_publisher(key.clone())
        .congestion_control(CongestionControl::Drop)
        .priority(priority)
        .wait()
        .map_err(|error| NetworkError::Declare {
            key,
            reason: error.to_string(),
        })
}
