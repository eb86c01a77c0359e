//! The network: opens the zenoh session and declares publishers on it.
//!
//! The car connects to the pit wall as a peer, and accepts no connections. It never blocks: what a slow link cannot take is
//! dropped. The pit wall requests missing messages of streams that must be complete (`replay_buffer.rs`). zenoh-ext's recovery
//! is not used: it replies from zenoh's receiving thread, blocking and without a limit of size, which stops a slow link.

use std::time::Duration;

use keys::{Protection, Side};
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
    /// The keys cannot be used, or do not fit an endpoint. The message holds no secret.
    #[error("{0}")]
    Keys(String),
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
const LOCAL_ADDRESS: &str = "127.0.0.1:7447";

/// Longest message from the network \[bytes\], the same as at the pit wall, which drops longer ones.
const LONGEST_MESSAGE: usize = 17 * 1024 * 1024;

/// Send buffer of the operating system [bytes]: enough for 10 Mbit/s at a round trip of 10 ms.
const SEND_BUFFER: usize = 16 * 1024;
/// Size of a batch on the link [bytes]: a pose waits for at most one batch of a scan.
const BATCH: usize = 4 * 1024;

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

/// The first endpoint that is not on this machine.
pub fn remote_endpoint(connect: &[String]) -> Option<&str> {
    let remote = |endpoint: &&String| {
        let Ok(endpoint) = endpoint.parse::<EndPoint>() else {
            return true;
        };
        let address = endpoint.address();
        let host = address.as_str().rsplit_once(':').map_or("", |(host, _)| host);
        let host = host.trim_matches(['[', ']']);
        let local = host == "localhost"
            || host
                .parse::<std::net::IpAddr>()
                .is_ok_and(|host| host.is_loopback());
        !local
    };
    connect.iter().find(remote).map(String::as_str)
}

/// Opens the session of `car`, which connects to the endpoints `connect`. Without one it looks for a pit wall on this machine.
/// With `search` it also looks by multicast.
pub fn open(
    car: &CarName,
    connect: &[String],
    protection: &Protection,
    search: bool,
) -> Result<Session, NetworkError> {
    for endpoint in connect {
        protection.check_endpoint(endpoint).map_err(NetworkError::Keys)?;
    }
    let protected = protection
        .settings(&Side::Car(car.clone()))
        .map_err(|error| NetworkError::Keys(error.to_string()))?;
    let scout = (search && connect.is_empty()).to_string();
    let endpoints = if connect.is_empty() {
        serde_json::json!([format!("{}/{LOCAL_ADDRESS}", protection.scheme())]).to_string()
    } else {
        serde_json::json!(connect).to_string()
    };
    let settings = [
        ("mode", r#""peer""#.to_owned()),
        ("connect/endpoints", endpoints),
        ("connect/exit_on_failure", "false".to_owned()),
        ("connect/timeout_ms", "-1".to_owned()),
        ("connect/retry", sockets::RETRY.to_owned()),
        // Only cars open connections: two peers that connect to each other can stay half connected.
        ("listen/endpoints", "[]".to_owned()),
        ("scouting/multicast/enabled", scout),
        ("scouting/gossip/enabled", "false".to_owned()),
        // On a slow link messages should wait in zenoh's queues, where a pose overtakes a scan, and not in the buffers of the
        // operating system. Those hold megabytes: a minute of a slow link. `sockets` limits what they take further.
        ("transport/link/tcp/so_sndbuf", SEND_BUFFER.to_string()),
        ("transport/link/rx/max_message_size", LONGEST_MESSAGE.to_string()),
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
    for (key, value) in settings.into_iter().chain(sockets::zenoh_settings()) {
        config
            .insert_json5(key, &value)
            .map_err(|error| NetworkError::Config {
                key,
                value,
                reason: error.to_string(),
            })?;
    }
    for (key, value) in &protected.entries {
        // The value holds secrets: it is not part of the error.
        config
            .insert_json5(key, value)
            .map_err(|_| NetworkError::Keys(format!("zenoh refuses its setting {key}")))?;
    }
    if matches!(protection, Protection::Keys(_)) {
        config
            .insert_json5("transport/link/tls/so_sndbuf", &SEND_BUFFER.to_string())
            .map_err(|_| NetworkError::Keys("zenoh refuses the size of its send buffer".into()))?;
    }
    sockets::watch();
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
