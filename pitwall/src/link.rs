//! The network at the pit wall: the only file, with `ask.rs`, that names zenoh.
//!
//! The pit wall opens a router in its own process and the cars dial it, so that no daemon is needed. A second
//! program on the same laptop joins the first one's router as a client. zenoh's threads only note when a message
//! arrived: one that is slow to take in is one that loses messages. A thread of our own decodes each once and hands
//! it on as a [`FleetEvent`].

use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crossbeam_channel::{Receiver, Sender};
use protocol::{CarName, Key, Telemetry, Topic};
use zenoh::handlers::Callback;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Config, Session};
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt, HistoryConfig, RecoveryConfig};

use crate::event::{FleetEvent, Happening, Lane};

/// Where a pit wall listens for cars unless told otherwise.
pub const DEFAULT_LISTEN: &str = "tcp/0.0.0.0:7447";
/// Where a pit wall on the same laptop is found.
pub const LOCAL_WALL: &str = "tcp/127.0.0.1:7447";

/// How to get at the cars.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Role {
    /// Open a router that the cars dial.
    Router {
        /// Endpoints to listen on, such as `tcp/0.0.0.0:7447`.
        listen: Vec<String>,
        /// Answer cars on the local network that look for a pit wall by multicast.
        discoverable: bool,
    },
    /// Join a router that is there already.
    Client {
        /// Endpoints to try.
        connect: Vec<String>,
    },
}

impl Role {
    /// What the options mean: join what `--connect` names, else open what `--listen` names, else join the pit wall
    /// that runs on this laptop, and where none does, open one.
    pub fn choose(listen: &[String], connect: &[String]) -> Self {
        if !connect.is_empty() {
            Self::Client {
                connect: connect.to_vec(),
            }
        } else if !listen.is_empty() {
            Self::Router {
                listen: listen.to_vec(),
                discoverable: false,
            }
        } else if answers(LOCAL_WALL) {
            Self::Client {
                connect: vec![LOCAL_WALL.to_owned()],
            }
        } else {
            Self::Router {
                listen: vec![DEFAULT_LISTEN.to_owned()],
                discoverable: true,
            }
        }
    }

    fn discoverable(&self) -> bool {
        matches!(
            self,
            Self::Router {
                discoverable: true,
                ..
            }
        )
    }

    fn config(&self) -> Result<Config, LinkError> {
        let list = |endpoints: &[String]| serde_json::json!(endpoints).to_string();
        let mut entries = vec![
            ("scouting/multicast/enabled", self.discoverable().to_string()),
            ("scouting/gossip/enabled", "false".to_owned()),
            ("transport/link/tx/lease", "4000".to_owned()),
        ];
        match self {
            Self::Router { listen, .. } => {
                entries.push(("mode", r#""router""#.to_owned()));
                entries.push(("listen/endpoints", list(listen)));
            }
            Self::Client { connect } => {
                entries.push(("mode", r#""client""#.to_owned()));
                entries.push(("connect/endpoints", list(connect)));
                entries.push(("connect/timeout_ms", "3000".to_owned()));
                let retry = r#"{"period_init_ms":200,"period_max_ms":1000,"period_increase_factor":2}"#;
                entries.push(("connect/retry", retry.to_owned()));
            }
        }
        let mut config = Config::default();
        for (key, value) in entries {
            config.insert_json5(key, &value).map_err(|e| LinkError::Config {
                key,
                value,
                reason: e.to_string(),
            })?;
        }
        Ok(config)
    }
}

impl std::fmt::Display for Role {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Router { listen, .. } => write!(f, "listening for cars on {}", listen.join(", ")),
            Self::Client { connect } => write!(f, "joined the pit wall at {}", connect.join(", ")),
        }
    }
}

/// True when something accepts connections at a `tcp/` endpoint.
fn answers(endpoint: &str) -> bool {
    let address: Option<SocketAddr> = endpoint
        .strip_prefix("tcp/")
        .and_then(|address| address.to_socket_addrs().ok()?.next());
    address.is_some_and(|address| TcpStream::connect_timeout(&address, Duration::from_millis(200)).is_ok())
}

/// The present time [unix ns].
pub fn unix_now() -> i64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |since| since.as_nanos() as i64)
}

/// A connection to the cars.
pub struct Link {
    pub(crate) session: Session,
    sink: Sink,
    arrivals: Sender<Arrival>,
    _live: Vec<Box<dyn Send + Sync>>,
    recorded: Mutex<Vec<AdvancedSubscriber<()>>>,
}

/// Takes events in, in the link's own thread: what comes meanwhile queues.
pub type Sink = Arc<dyn Fn(FleetEvent) + Send + Sync>;

impl Link {
    /// Opens the link and subscribes to everything but the full-rate streams ([`Link::subscribe_recorded`]). Needs
    /// a multi-thread tokio runtime. `sink` gets every event.
    pub async fn open(role: &Role, sink: Sink) -> Result<Self, LinkError> {
        let session = zenoh::open(role.config()?).await.map_err(|e| LinkError::Open {
            role: role.clone(),
            reason: e.to_string(),
        })?;
        let (arrivals, queue) = crossbeam_channel::bounded(QUEUE);
        let out = sink.clone();
        std::thread::Builder::new()
            .name("decode".to_owned())
            .spawn(move || hand_on_all(&queue, &out))
            .map_err(LinkError::Thread)?;
        let mut live: Vec<Box<dyn Send + Sync>> = Vec::new();
        for topic in Topic::all() {
            match topic {
                Topic::Alive => live.push(Box::new(alive(&session, &sink).await?)),
                // Newest wins: whatever comes, as it comes.
                Topic::Pose | Topic::Cloud | Topic::Scan | Topic::Load | Topic::Params | Topic::Shadow => {
                    live.push(Box::new(plain(&session, topic, &arrivals).await?));
                }
                // The display follows the plain subscriber: the other one holds back what comes after a gap until
                // the gap is filled.
                Topic::Health => {
                    live.push(Box::new(plain(&session, topic, &arrivals).await?));
                    live.push(Box::new(complete(&session, topic, &arrivals).await?));
                }
                Topic::Event => live.push(Box::new(complete(&session, topic, &arrivals).await?)),
                _ => {}
            }
        }
        Ok(Self {
            session,
            sink,
            arrivals,
            _live: live,
            recorded: Mutex::default(),
        })
    }

    /// Hands on something that was asked for.
    pub(crate) fn hand_on(&self, car: &CarName, happening: Happening) {
        (self.sink)(FleetEvent {
            at: unix_now(),
            car: car.clone(),
            happening,
        });
    }

    /// Subscribes to the full-rate streams, or ends that.
    pub async fn subscribe_recorded(&self, on: bool) -> Result<(), LinkError> {
        let mut subscribers = Vec::new();
        if on {
            for topic in Topic::all().filter(|topic| topic.recorded()) {
                subscribers.push(complete(&self.session, topic, &self.arrivals).await?);
            }
        }
        let before = std::mem::replace(
            &mut *self.recorded.lock().unwrap_or_else(PoisonError::into_inner),
            subscribers,
        );
        drop(before);
        Ok(())
    }

    /// Closes the session; gives up after two seconds, because a session whose network has died takes longer.
    pub async fn close(&self) {
        let closing = async { self.session.close().await };
        if tokio::time::timeout(Duration::from_secs(2), closing)
            .await
            .is_err()
        {
            tracing::warn!("the network did not answer the good-bye");
        }
    }
}

async fn alive(session: &Session, sink: &Sink) -> Result<impl Send + Sync + use<>, LinkError> {
    let sink = sink.clone();
    let key = Topic::Alive.of_all_cars();
    session
        .liveliness()
        .declare_subscriber(&key)
        .history(true)
        .callback(move |sample| {
            let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
                return;
            };
            let happening = match sample.kind() {
                SampleKind::Put => Happening::Appeared,
                SampleKind::Delete => Happening::Vanished,
            };
            sink(FleetEvent {
                at: unix_now(),
                car: key.car,
                happening,
            });
        })
        .await
        .map_err(|e| LinkError::subscribe(&key, &e))
}

async fn plain(
    session: &Session,
    topic: Topic,
    arrivals: &Sender<Arrival>,
) -> Result<impl Send + Sync + use<>, LinkError> {
    let key = topic.of_all_cars();
    session
        .declare_subscriber(&key)
        .with(take_in(Lane::Live, arrivals))
        .await
        .map_err(|e| LinkError::subscribe(&key, &e))
}

async fn complete(
    session: &Session,
    topic: Topic,
    arrivals: &Sender<Arrival>,
) -> Result<AdvancedSubscriber<()>, LinkError> {
    let key = topic.of_all_cars();
    // What a car sent before it found us comes too: all its events, and of the rest the last second or two.
    let mut history = HistoryConfig::default().detect_late_publishers();
    if topic != Topic::Event {
        history = history.max_samples(HISTORY);
    }
    session
        .declare_subscriber(&key)
        .with(take_in(Lane::Complete, arrivals))
        .advanced()
        .history(history)
        .recovery(RecoveryConfig::default().heartbeat())
        .await
        .map_err(|e| LinkError::subscribe(&key, &e))
}

/// Messages of a stream that are asked for when its sender is found.
const HISTORY: usize = 100;
/// Messages that may wait to be decoded: some ten seconds of twenty cars.
const QUEUE: usize = 100_000;

/// A message, as it arrived.
struct Arrival {
    at: i64,
    lane: Lane,
    sample: Sample,
}

fn take_in(lane: Lane, arrivals: &Sender<Arrival>) -> Callback<Sample> {
    let arrivals = arrivals.clone();
    Callback::from(move |sample: Sample| {
        let at = unix_now();
        if arrivals.try_send(Arrival { at, lane, sample }).is_err() {
            tracing::warn!("messages come faster than they can be decoded; some are lost");
        }
    })
}

/// Decodes what arrives and hands it on, until the link is closed.
fn hand_on_all(arrivals: &Receiver<Arrival>, sink: &Sink) {
    for Arrival { at, lane, sample } in arrivals {
        if sample.kind() != SampleKind::Put {
            continue;
        }
        // A key that is not ours cannot be told from a stranger's: no car to count it against.
        let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
            tracing::debug!(key = %sample.key_expr(), "not a key of ours");
            continue;
        };
        let bytes: Arc<[u8]> = sample.payload().to_bytes().into();
        let happening = match Telemetry::decode(key.topic, &bytes) {
            Some(Ok((header, telemetry))) => Happening::Message {
                topic: key.topic,
                lane,
                header,
                telemetry: Box::new(telemetry),
                bytes,
            },
            Some(Err(error)) => Happening::Unreadable {
                topic: key.topic,
                error: error.to_string(),
            },
            None => continue,
        };
        sink(FleetEvent {
            at,
            car: key.car,
            happening,
        });
    }
}

/// How questions and commands travel: ahead of telemetry, and never blocking the sender.
pub(crate) const ASK_PRIORITY: Priority = Priority::InteractiveHigh;
/// See [`ASK_PRIORITY`].
pub(crate) const ASK_CONGESTION: CongestionControl = CongestionControl::Drop;

/// Why there is no link.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// A setting that zenoh refuses.
    #[error("network setting {key} = {value}: {reason}")]
    Config {
        /// The setting.
        key: &'static str,
        /// The value.
        value: String,
        /// What zenoh says.
        reason: String,
    },
    /// Nobody there to join, or the port is taken.
    #[error("{}: {reason}", cannot(.role))]
    Open {
        /// What was tried.
        role: Role,
        /// What zenoh says.
        reason: String,
    },
    /// The system gives no thread.
    #[error("no thread to decode messages: {0}")]
    Thread(std::io::Error),
    /// A subscription failed.
    #[error("cannot subscribe to {key}: {reason}")]
    Subscribe {
        /// The key expression.
        key: String,
        /// What zenoh says.
        reason: String,
    },
}

fn cannot(role: &Role) -> String {
    match role {
        Role::Router { listen, .. } => format!("cannot listen on {} (is the port taken?)", listen.join(", ")),
        Role::Client { connect } => format!("no pit wall answers at {}", connect.join(", ")),
    }
}

impl LinkError {
    fn subscribe(key: &str, error: &zenoh::Error) -> Self {
        Self::Subscribe {
            key: key.to_owned(),
            reason: error.to_string(),
        }
    }
}
