//! The network at the pit wall: the only file, with `ask.rs`, that names zenoh.
//!
//! The pit wall opens a router in its own process and the cars dial it, so that no daemon is needed. A second
//! program on the same laptop joins the first one's router as a client. zenoh's threads only note when a message
//! arrived: one that is slow to take in is one that loses messages. A thread of our own decodes each once and hands
//! it on as a [`FleetEvent`]; it also knows what has not come (`catch_up.rs`), and has a task ask the cars for it.

use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crossbeam_channel::{Receiver, Sender, select};
use protocol::{CarName, Header, Key, MissingReply, Resent, Telemetry, Topic, decode, encode};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use zenoh::config::EndPoint;
use zenoh::pubsub::Subscriber;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Config, Session};

use crate::ask::{first_answer, stamps};
use crate::catch_up::{CatchUp, Outstanding, Place, Question};
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
                reason: reason(&e),
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

/// An endpoint as people type it, or what is wrong with it.
pub(crate) fn endpoint(text: &str) -> Result<String, String> {
    text.parse::<EndPoint>()
        .map(|endpoint| endpoint.to_string())
        .map_err(|_| "say PROTOCOL/ADDRESS:PORT, as in tcp/192.168.1.10:7447".to_owned())
}

/// What zenoh says, without the places in its source.
fn reason(error: &zenoh::Error) -> String {
    let text = error.to_string();
    let mut said = String::new();
    let mut rest = text.as_str();
    while let Some((before, place)) = rest.split_once(" at /")
        && let Some((_, after)) = place.split_once(".rs:")
    {
        said += before;
        let after = after.trim_start_matches(|c: char| c.is_ascii_digit());
        rest = after.strip_prefix('.').unwrap_or(after);
    }
    said + rest
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
    recorded: Mutex<Vec<Subscriber<()>>>,
    asking: JoinHandle<()>,
}

impl Drop for Link {
    fn drop(&mut self) {
        self.asking.abort();
    }
}

/// Takes events in, in the link's own thread: what comes meanwhile queues.
pub type Sink = Arc<dyn Fn(FleetEvent) + Send + Sync>;

impl Link {
    /// Opens the link and subscribes to everything but the full-rate streams ([`Link::subscribe_recorded`]). Needs
    /// a multi-thread tokio runtime. `sink` gets every event.
    pub async fn open(role: &Role, sink: Sink) -> Result<Self, LinkError> {
        let session = zenoh::open(role.config()?).await.map_err(|e| LinkError::Open {
            role: role.clone(),
            reason: reason(&e),
        })?;
        let (arrivals, queue) = crossbeam_channel::bounded(QUEUE);
        let (answers, answered) = crossbeam_channel::unbounded();
        let (questions, asked) = mpsc::unbounded_channel();
        let decoding = Decoding {
            catch_up: CatchUp::default(),
            sink: sink.clone(),
            questions,
            last_call: None,
        };
        std::thread::Builder::new()
            .name("decode".to_owned())
            .spawn(move || decoding.run(&queue, &answered))
            .map_err(LinkError::Thread)?;
        let asking = tokio::spawn(ask_all(session.clone(), asked, answers));
        let mut live: Vec<Box<dyn Send + Sync>> = Vec::new();
        for topic in Topic::all() {
            match topic {
                Topic::Alive => live.push(Box::new(alive(&session, &sink, &arrivals).await?)),
                // Newest wins: whatever comes, as it comes. Of health, what is missing follows.
                Topic::Pose
                | Topic::Cloud
                | Topic::Scan
                | Topic::Health
                | Topic::Load
                | Topic::Params
                | Topic::Shadow => live.push(Box::new(listen(&session, topic, Lane::Live, &arrivals).await?)),
                Topic::Event => live.push(Box::new(
                    listen(&session, topic, Lane::Complete, &arrivals).await?,
                )),
                _ => {}
            }
        }
        Ok(Self {
            session,
            sink,
            arrivals,
            _live: live,
            recorded: Mutex::default(),
            asking,
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

    /// Subscribes to the full-rate streams, or ends that; by then what was held back of them has been handed on.
    pub async fn subscribe_recorded(&self, on: bool) -> Result<(), LinkError> {
        let mut subscribers = Vec::new();
        if on {
            for topic in Topic::all().filter(|topic| topic.recorded()) {
                subscribers.push(listen(&self.session, topic, Lane::Complete, &self.arrivals).await?);
            }
        }
        let (done, handed_on) = oneshot::channel();
        // Full of messages, or closed: then there is nothing to wait for.
        self.arrivals.try_send(Arrival::WantRecorded(on, done)).ok();
        handed_on.await.ok();
        let before = std::mem::replace(
            &mut *self.recorded.lock().unwrap_or_else(PoisonError::into_inner),
            subscribers,
        );
        drop(before);
        Ok(())
    }

    /// Asks every car how far its streams go ([`Happening::HowFar`]), and for all that it has sent by then. Tells what is
    /// still to come.
    pub(crate) fn last_call(&self) -> watch::Receiver<Outstanding> {
        let (tell, outstanding) = watch::channel(Outstanding::MOST);
        // Full of messages, or closed: the other end is dropped, which says so.
        self.arrivals.try_send(Arrival::LastCall(tell)).ok();
        outstanding
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

async fn alive(
    session: &Session,
    sink: &Sink,
    arrivals: &Sender<Arrival>,
) -> Result<impl Send + Sync + use<>, LinkError> {
    let sink = sink.clone();
    let arrivals = arrivals.clone();
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
                SampleKind::Put => {
                    // Full of messages from it, it is known to be there anyway.
                    arrivals.try_send(Arrival::Appeared(key.car.clone())).ok();
                    Happening::Appeared
                }
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

async fn listen(
    session: &Session,
    topic: Topic,
    lane: Lane,
    arrivals: &Sender<Arrival>,
) -> Result<Subscriber<()>, LinkError> {
    let key = topic.of_all_cars();
    let arrivals = arrivals.clone();
    session
        .declare_subscriber(&key)
        .callback(move |sample: Sample| {
            let at = unix_now();
            if arrivals.try_send(Arrival::Sample { at, lane, sample }).is_err() {
                tracing::warn!("messages come faster than they can be decoded; some are lost");
            }
        })
        .await
        .map_err(|e| LinkError::subscribe(&key, &e))
}

/// Messages that may wait to be decoded: some ten seconds of twenty cars.
const QUEUE: usize = 100_000;
/// How often what is missing is looked at.
const TICK: Duration = Duration::from_millis(50);
/// How long a car may take to answer what is missing.
const MISSING_PATIENCE: Duration = Duration::from_secs(3);

/// What arrives, as it arrived.
#[expect(clippy::large_enum_variant, reason = "nearly all of them are samples")]
enum Arrival {
    Sample { at: i64, lane: Lane, sample: Sample },
    Appeared(CarName),
    WantRecorded(bool, oneshot::Sender<()>),
    LastCall(watch::Sender<Outstanding>),
}

/// What became of a question for what is missing.
struct Answered {
    at: i64,
    car: CarName,
    /// None when it did not answer.
    reply: Option<(Header, MissingReply)>,
}

/// A message of a known car and topic.
struct Received {
    at: i64,
    lane: Lane,
    key: Key,
    bytes: Arc<[u8]>,
}

/// Decodes what arrives, and knows what has not.
struct Decoding {
    catch_up: CatchUp<Received>,
    sink: Sink,
    questions: mpsc::UnboundedSender<Question>,
    /// Who waits for the end of a recording.
    last_call: Option<watch::Sender<Outstanding>>,
}

impl Decoding {
    /// Until the link is closed.
    fn run(mut self, arrivals: &Receiver<Arrival>, answers: &Receiver<Answered>) {
        let mut looked = Instant::now();
        loop {
            select! {
                recv(arrivals) -> arrival => match arrival {
                    Ok(arrival) => self.take_in(arrival),
                    Err(_) => return,
                },
                // Its end is the end of the arrivals, too.
                recv(answers) -> answer => if let Ok(answer) = answer {
                    self.take_answer(answer);
                    self.ask(unix_now());
                },
                default(TICK) => {}
            }
            if looked.elapsed() >= TICK {
                looked = Instant::now();
                let now = unix_now();
                for received in self.catch_up.overdue(now) {
                    self.hand_on(received);
                }
                self.ask(now);
                if let Some(tell) = &self.last_call {
                    tell.send_replace(self.catch_up.outstanding());
                }
            }
        }
    }

    fn ask(&mut self, now: i64) {
        for question in self.catch_up.due(now) {
            // Nobody asks any more when the link is being closed.
            self.questions.send(question).ok();
        }
    }

    fn take_in(&mut self, arrival: Arrival) {
        match arrival {
            Arrival::Appeared(car) => self.catch_up.appeared(&car),
            Arrival::WantRecorded(on, done) => {
                self.last_call = None;
                for received in self.catch_up.want_recorded(on) {
                    self.hand_on(received);
                }
                // Nobody need wait for it.
                done.send(()).ok();
            }
            Arrival::LastCall(tell) => {
                let now = unix_now();
                self.catch_up.last_call(now);
                self.last_call = Some(tell);
                self.ask(now);
            }
            Arrival::Sample { at, lane, sample } => {
                if sample.kind() != SampleKind::Put {
                    return;
                }
                // A key that is not ours cannot be told from a stranger's: no car to count it against.
                let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
                    tracing::debug!(key = %sample.key_expr(), "not a key of ours");
                    return;
                };
                let bytes = sample.payload().to_bytes().into();
                self.take_message(Received { at, lane, key, bytes });
            }
        }
    }

    fn take_message(&mut self, received: Received) {
        let header = Header::read(&received.bytes);
        let (Ok(header), true) = (header, received.key.topic.recovered()) else {
            return self.hand_on(received);
        };
        let place = Place {
            topic: received.key.topic,
            run_id: header.run_id,
            number: header.sequence,
        };
        let (car, at) = (received.key.car.clone(), received.at);
        for received in self.catch_up.arrive(&car, place, received, at) {
            self.hand_on(received);
        }
    }

    fn take_answer(&mut self, Answered { at, car, reply }: Answered) {
        let Some((header, MissingReply { streams, messages })) = reply else {
            return self.catch_up.unanswered(&car, at);
        };
        let more = !messages.is_empty();
        for Resent { topic, bytes } in messages {
            self.take_message(Received {
                at,
                lane: Lane::Complete,
                key: Key::new(car.clone(), topic),
                bytes: bytes.into(),
            });
        }
        let (released, how_far) = self.catch_up.answered(&car, header.run_id, &streams, more, at);
        if let Some(streams) = how_far {
            (self.sink)(FleetEvent {
                at,
                car,
                happening: Happening::HowFar {
                    run_id: header.run_id,
                    said: header.published,
                    streams,
                },
            });
        }
        for received in released {
            self.hand_on(received);
        }
    }

    /// Decodes a message and hands it on.
    fn hand_on(&self, received: Received) {
        let Received { at, lane, key, bytes } = received;
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
                header: Header::read(&bytes).ok(),
                error: error.to_string(),
            },
            None => return,
        };
        (self.sink)(FleetEvent {
            at,
            car: key.car,
            happening,
        });
    }
}

/// Puts questions for what is missing, until nobody has any more.
async fn ask_all(
    session: Session,
    mut questions: mpsc::UnboundedReceiver<Question>,
    answers: Sender<Answered>,
) {
    while let Some(question) = questions.recv().await {
        let (session, answers) = (session.clone(), answers.clone());
        tokio::spawn(async move {
            let car = question.car.clone();
            let reply = ask_for_missing(&session, question).await;
            let at = unix_now();
            // The thread that asked is gone when the link is closed.
            answers.send(Answered { at, car, reply }).ok();
        });
    }
}

/// Asks a car for what is missing. None without an answer in time.
async fn ask_for_missing(session: &Session, question: Question) -> Option<(Header, MissingReply)> {
    // Ahead of what can wait, behind what an operator waits for.
    let priority = if question.urgent {
        Priority::DataHigh
    } else {
        Priority::Data
    };
    let (car, topic) = (&question.car, Topic::Missing);
    let request = encode(&question.request, stamps()).ok()?;
    let bytes = first_answer(session, car, topic, request, MISSING_PATIENCE, priority).await?;
    decode::<MissingReply>(&bytes)
        .inspect_err(|error| tracing::debug!(%car, %error, "an answer that cannot be read"))
        .ok()
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
            reason: reason(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_in_source_are_left_out() {
        let error = |text: &'static str| -> zenoh::Error { text.into() };
        for (said, told) in [
            (
                "no listener: [in use at /a/b.rs:61.] at /c/d.rs:338.",
                "no listener: [in use]",
            ),
            ("Timeout! at /a/b.rs:7", "Timeout!"),
            ("looked at /etc", "looked at /etc"),
        ] {
            assert_eq!(reason(&error(said)), told);
        }
    }
}
