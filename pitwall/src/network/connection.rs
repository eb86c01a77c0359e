//! The connection to the cars: a zenoh session and its subscriptions.
//!
//! The pit wall opens a router in its own process and the cars dial it, so that no daemon is needed. A second program
//! on the same laptop joins that router as a client. zenoh's threads only note when a message arrived and queue it,
//! because a slow callback loses messages. The decoder's thread does the rest.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crossbeam_channel::Sender;
use keys::Protection;
use protocol::{Key, Topic};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};

use super::acknowledgement;
use super::client::Client;
use super::decoder::{Decoder, DecoderInput, send_missing_queries};
use super::error::ConnectionError;
use super::flood_limit::{Flood, FloodLimit};
use super::gap_recovery::Outstanding;
use super::marker;
use super::recorders::{self, RecorderNews};
use super::role::Role;
use crate::clock::unix_now;
use crate::event::{Delivery, EventPayload, EventSink, FleetEvent};

/// Messages that may wait to be decoded: some ten seconds of twenty cars.
const QUEUE: usize = 100_000;

/// Characters of a foreign key that are shown.
const LONGEST_SHOWN_KEY: usize = 60;

/// A connection to the cars.
pub struct Connection {
    session: zenoh::Session,
    client: Client,
    inputs: Sender<DecoderInput>,
    _live: Vec<Box<dyn Send + Sync>>,
    recorded: Mutex<Vec<Subscriber<()>>>,
    missing_queries: JoinHandle<()>,
    floods: Arc<Mutex<FloodLimit>>,
    protection: Protection,
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.missing_queries.abort();
    }
}

impl Connection {
    /// Opens the connection and subscribes to every topic but the full-rate ones ([`Connection::subscribe_recorded`]).
    /// Needs a multi-thread tokio runtime. `sink` receives every event.
    pub async fn open(
        role: &Role,
        protection: &Protection,
        sink: EventSink,
    ) -> Result<Self, ConnectionError> {
        for endpoint in role.endpoints() {
            protection
                .check_endpoint(endpoint)
                .map_err(ConnectionError::Endpoint)?;
        }
        let (config, settings) = role.config(protection)?;
        let session = zenoh::open(config).await.map_err(|e| role.open_error(&e))?;
        drop(settings);
        let (inputs, queue) = crossbeam_channel::bounded(QUEUE);
        let (answers, answered) = crossbeam_channel::unbounded();
        let (queries, queued) = mpsc::unbounded_channel();
        let decoder = Decoder::new(sink.clone(), queries);
        std::thread::Builder::new()
            .name("decode".to_owned())
            .spawn(move || decoder.run(&queue, &answered))
            .map_err(ConnectionError::Thread)?;
        let missing_queries = tokio::spawn(send_missing_queries(session.clone(), queued, answers));
        let floods = Arc::default();
        let mut live: Vec<Box<dyn Send + Sync>> = Vec::new();
        for topic in Topic::all() {
            let delivery = match topic {
                Topic::Alive => {
                    live.push(Box::new(watch_runs(&session, &inputs).await?));
                    live.push(Box::new(watch_liveliness(&session, &sink, &inputs).await?));
                    continue;
                }
                // The newest message counts, so each is forwarded as it comes. Missing health messages follow late.
                Topic::Pose
                | Topic::Cloud
                | Topic::Scan
                | Topic::Health
                | Topic::Load
                | Topic::Params
                | Topic::Shadow => Delivery::Live,
                Topic::Event => Delivery::InOrder,
                _ => continue,
            };
            live.push(Box::new(
                subscribe(&session, topic, delivery, &inputs, &floods).await?,
            ));
        }
        live.push(Box::new(watch_markers(&session, &sink).await?));
        Ok(Self {
            client: Client::new(session.clone(), protection, sink)?,
            session,
            inputs,
            _live: live,
            recorded: Mutex::default(),
            missing_queries,
            floods,
            protection: protection.clone(),
        })
    }

    /// Sends queries and commands to the cars.
    pub fn client(&self) -> &Client {
        &self.client
    }

    /// Starts or ends the subscriptions to the full-rate topics. At the end, held-back messages have been forwarded when
    /// this returns.
    pub async fn subscribe_recorded(&self, on: bool) -> Result<(), ConnectionError> {
        let mut subscribers = Vec::new();
        if on {
            for topic in Topic::all().filter(|topic| topic.recorded()) {
                subscribers.push(
                    subscribe(
                        &self.session,
                        topic,
                        Delivery::InOrder,
                        &self.inputs,
                        &self.floods,
                    )
                    .await?,
                );
            }
        }
        let (done, forwarded) = oneshot::channel();
        // When the queue is full or closed there is nothing to wait for.
        self.inputs.try_send(DecoderInput::WantRecorded(on, done)).ok();
        forwarded.await.ok();
        let before = std::mem::replace(
            &mut *self.recorded.lock().unwrap_or_else(PoisonError::into_inner),
            subscribers,
        );
        drop(before);
        Ok(())
    }

    /// Cars that were muted because they flood, and that are heard again, since the last call.
    pub(crate) fn floods(&self) -> Vec<Flood> {
        self.floods
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .reports()
    }

    /// Notes hosts that are connected with revoked keys, for [`keys::refusals::take`].
    pub(crate) async fn note_revoked(&self) {
        note_revoked(&self.session, &self.protection).await;
    }

    /// Queries every car for the ends of its streams ([`EventPayload::StreamEnds`]) and for all that it has sent by then.
    /// Returns what is still outstanding.
    pub(crate) fn final_sync(&self) -> watch::Receiver<Outstanding> {
        let (progress, outstanding) = watch::channel(Outstanding::UNKNOWN);
        // When the queue is full or closed, `progress` is dropped, and the receiver sees that.
        self.inputs.try_send(DecoderInput::FinalSync(progress)).ok();
        outstanding
    }

    /// Tells the other pit walls that an operator has acknowledged all alarms so far.
    pub(crate) async fn tell_acknowledged(&self, operator: &str) {
        acknowledgement::tell(&self.session, operator).await;
    }

    /// Calls `on_acknowledged` with the operator whenever another pit wall acknowledges, for as long as the result lives.
    pub(crate) async fn watch_acknowledged(
        &self,
        on_acknowledged: impl Fn(&str) + Send + Sync + 'static,
    ) -> Result<Box<dyn Send + Sync>, ConnectionError> {
        Ok(Box::new(
            acknowledgement::watch(&self.session, on_acknowledged).await?,
        ))
    }

    /// Tells the other pit walls what the recorder here does. Returns the same with the name of this program.
    pub(crate) async fn tell_recorder(&self, news: RecorderNews) -> RecorderNews {
        recorders::tell(&self.session, news).await
    }

    /// Calls `on_news` with what the recorders of other pit walls do, for as long as the result lives.
    pub(crate) async fn watch_recorders(
        &self,
        on_news: impl Fn(RecorderNews) + Send + Sync + 'static,
    ) -> Result<Box<dyn Send + Sync>, ConnectionError> {
        recorders::watch(&self.session, on_news).await
    }

    /// Closes the zenoh session. Gives up after two seconds, because closing takes longer when the network is down.
    pub async fn close(&self) {
        let closing = async { self.session.close().await };
        if tokio::time::timeout(Duration::from_secs(2), closing)
            .await
            .is_err()
        {
            tracing::warn!("the network did not confirm that the connection is closed");
        }
    }
}

/// Notes a key under which no car can send, such as one with markup in its name.
fn note_foreign_key(key: &str) {
    let shown: String = protocol::plain_text(key)
        .chars()
        .take(LONGEST_SHOWN_KEY)
        .collect();
    keys::refusals::add(
        "foreign key",
        format!("what a stranger sent under {shown:?} was ignored: that is no car's key"),
    );
}

/// Notes the owners of connected certificates that are not in force. zenoh lets them connect, and drops what they send.
async fn note_revoked(session: &zenoh::Session, protection: &Protection) {
    let Protection::Keys(bundle) = protection else {
        return;
    };
    for link in session.info().links().await {
        if let Some(name) = link.auth_identifier()
            && let Some(text) = bundle.revoked(name)
        {
            keys::refusals::add(name, text);
        }
    }
}

/// Receives the markers of all pit walls.
async fn watch_markers(
    session: &zenoh::Session,
    sink: &EventSink,
) -> Result<impl Send + Sync + use<>, ConnectionError> {
    let sink = sink.clone();
    session
        .declare_subscriber(marker::OF_ALL_CARS)
        .callback(move |sample: Sample| {
            let bytes = sample.payload().to_bytes();
            if let Some((car, payload)) = marker::decode(sample.key_expr().as_str(), &bytes) {
                let at = unix_now();
                sink(FleetEvent { at, car, payload });
            }
        })
        .await
        .map_err(|e| ConnectionError::subscribe(marker::OF_ALL_CARS, &e))
}

/// Watches the liveliness tokens of the cars' runs.
async fn watch_runs(
    session: &zenoh::Session,
    inputs: &Sender<DecoderInput>,
) -> Result<impl Send + Sync + use<>, ConnectionError> {
    let inputs = inputs.clone();
    let key = Key::run_tokens_of_all_cars();
    session
        .liveliness()
        .declare_subscriber(&key)
        .history(true)
        .callback(move |sample| {
            if let Some((car, run_id)) = Key::parse_run_token(sample.key_expr().as_str()) {
                let present = sample.kind() == SampleKind::Put;
                // When the queue is full, messages of the run reveal it anyway.
                inputs
                    .try_send(DecoderInput::RunToken { car, run_id, present })
                    .ok();
            }
        })
        .await
        .map_err(|e| ConnectionError::subscribe(&key, &e))
}

/// A router that only passes messages on.
pub struct Router(zenoh::Session, Protection);

/// Opens a router. Needs a multi-thread tokio runtime.
pub async fn open_router(role: &Role, protection: &Protection) -> Result<Router, ConnectionError> {
    let (config, settings) = role.config(protection)?;
    let session = zenoh::open(config).await.map_err(|e| role.open_error(&e))?;
    drop(settings);
    Ok(Router(session, protection.clone()))
}

impl Router {
    /// What was refused since the last call, as sentences.
    pub async fn refusals(&self) -> Vec<String> {
        note_revoked(&self.0, &self.1).await;
        keys::refusals::take()
    }

    /// Ends it. Gives up after two seconds.
    pub async fn close(self) {
        let closing = async { self.0.close().await };
        if tokio::time::timeout(Duration::from_secs(2), closing)
            .await
            .is_err()
        {
            tracing::warn!("the network did not confirm that the router is closed");
        }
    }
}

async fn watch_liveliness(
    session: &zenoh::Session,
    sink: &EventSink,
    inputs: &Sender<DecoderInput>,
) -> Result<impl Send + Sync + use<>, ConnectionError> {
    let sink = sink.clone();
    let inputs = inputs.clone();
    let key = Topic::Alive.of_all_cars();
    session
        .liveliness()
        .declare_subscriber(&key)
        .history(true)
        .callback(move |sample| {
            let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
                note_foreign_key(sample.key_expr().as_str());
                return;
            };
            let payload = match sample.kind() {
                SampleKind::Put => {
                    // When the queue is full, messages of the car reveal it anyway.
                    inputs.try_send(DecoderInput::Appeared(key.car.clone())).ok();
                    EventPayload::Appeared
                }
                SampleKind::Delete => EventPayload::Vanished,
            };
            sink(FleetEvent {
                at: unix_now(),
                car: key.car,
                payload,
            });
        })
        .await
        .map_err(|e| ConnectionError::subscribe(&key, &e))
}

async fn subscribe(
    session: &zenoh::Session,
    topic: Topic,
    delivery: Delivery,
    inputs: &Sender<DecoderInput>,
    floods: &Arc<Mutex<FloodLimit>>,
) -> Result<Subscriber<()>, ConnectionError> {
    let key = topic.of_all_cars();
    let inputs = inputs.clone();
    let floods = floods.clone();
    let lost = AtomicU64::new(0);
    session
        .declare_subscriber(&key)
        .callback(move |sample: Sample| {
            let at = unix_now();
            // A foreign key names no car to count it for.
            let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
                note_foreign_key(sample.key_expr().as_str());
                return;
            };
            let bytes = sample.payload().len();
            let admitted =
                floods
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner)
                    .admit(&key.car, bytes, Instant::now());
            if !admitted {
                return;
            }
            let input = DecoderInput::Sample {
                at,
                delivery,
                key,
                sample,
            };
            if inputs.try_send(input).is_err() {
                let count = lost.fetch_add(1, Ordering::Relaxed) + 1;
                if count.is_power_of_two() {
                    tracing::warn!(
                        count,
                        "messages arrive faster than they can be decoded; some are lost"
                    );
                }
            }
        })
        .await
        .map_err(|e| ConnectionError::subscribe(&key, &e))
}
