//! The network: opens the zenoh session and declares publishers on it.
//!
//! The car connects to the pit wall as a peer, and accepts no connections. It never blocks: what a slow link cannot take is
//! dropped. The pit wall requests missing messages of streams that must be complete (`replay_buffer.rs`). zenoh-ext's recovery
//! is not used: it replies from zenoh's receiving thread, blocking and without a limit of size, which stops a slow link.

use std::time::Duration;

use protocol::{CarName, Key, Topic};
use zenoh::config::EndPoint;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Config, Session, Wait};

/// Why the network does not work.
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

/// Send buffer of the operating system [bytes]: enough for 10 Mbit/s at a round trip of 10 ms.
const SEND_BUFFER: usize = 16 * 1024;
/// Size of a batch on the link [bytes]: a pose waits for at most one batch of a scan.
const BATCH: usize = 8 * 1024;

/// Parses an endpoint of the command line. The error describes the format.
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

/// Opens a session that connects to the endpoints `connect`. Without one it looks for a pit wall on this machine and by
/// multicast.
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
        // Only cars open connections: two peers that connect to each other can stay half connected.
        ("listen/endpoints", "[]".to_owned()),
        ("scouting/multicast/enabled", scout),
        ("scouting/gossip/enabled", "false".to_owned()),
        // A cut link is noticed within four seconds. Not sooner: on a radio that loses packets TCP is sometimes silent for two,
        // and connecting again takes longer than waiting.
        ("transport/link/tx/lease", "4000".to_owned()),
        // On a slow link messages should wait in zenoh's queues, where a pose overtakes a scan, and not in the buffers of the
        // operating system. Those hold megabytes: a minute of a slow link.
        ("transport/link/tcp/so_sndbuf", SEND_BUFFER.to_string()),
        ("transport/link/tx/batch_size", BATCH.to_string()),
        ("transport/link/tx/queue/size/data", "4".to_owned()),
        ("transport/link/tx/queue/size/data_low", "16".to_owned()),
        // A map is sent in many fragments, each of which waits for the one before. It has the lowest priority.
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

/// Closes a session, and waits at most `patience`: on a dead link closing takes 12 s.
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

/// Declares the car and its run as alive, until the tokens are dropped.
pub fn declare_alive(
    session: &Session,
    car: &CarName,
    run_id: u64,
) -> Result<[LivelinessToken; 2], NetworkError> {
    let declare = |key: String| {
        session
            .liveliness()
            .declare_token(&key)
            .wait()
            .map_err(|error| NetworkError::Declare {
                key,
                reason: error.to_string(),
            })
    };
    Ok([
        // The run first: whoever sees the car then knows its run.
        declare(Key::run_token(car, run_id))?,
        declare(Key::new(car.clone(), Topic::Alive).to_string())?,
    ])
}

/// Declares the publisher of a topic. It drops what the link cannot take, and never blocks.
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
