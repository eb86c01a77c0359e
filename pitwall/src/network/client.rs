//! Queries and commands to a car.

use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher, Hasher};
use std::sync::Arc;
use std::time::{Duration, Instant};

use keys::{Protection, Role, Signer};
use protocol::{
    Action, Answer, CarInfo, CarName, ClockReply, ClockRequest, CodecError, Command, CommandId, FilesReply,
    FilesRequest, Header, Key, LinkReport, MapReply, Message, Outcome, SetRef, Topic, decode, encode,
};
use tokio::sync::mpsc;
use zenoh::qos::Priority;

use super::error::ConnectionError;
use super::marker;
use super::query::{CONGESTION, OPERATOR_PRIORITY, first_reply, query, stamps};
use super::verdict::Verdict;
use crate::clock::unix_now;
use crate::event::{EventPayload, EventSink, FleetEvent};
use crate::recording::FileSource;

/// How long a car may take to reply: as long as a link may be silent before it counts as cut.
pub const REPLY_TIMEOUT: Duration = Duration::from_secs(4);
/// How long a map may take: it is large and is sent at background priority.
const MAP_TIMEOUT: Duration = Duration::from_secs(20);
/// A command without an answer is sent again after this time: the radio may have lost the command or its answer.
const RESEND_AFTER: Duration = Duration::from_millis(500);
/// A car not seen for this long after the first liveliness query counts as absent. One query is not enough: over a slow
/// link, or on a laptop that has just started, its reply may still be on the way.
const ABSENT_AFTER: Duration = Duration::from_millis(2500);

/// A new command id.
pub fn new_command_id() -> CommandId {
    // The keys of a RandomState come from the operating system's random numbers.
    let random = || u128::from(RandomState::new().build_hasher().finish());
    CommandId(random() << 64 | (random() ^ unix_now() as u128))
}

/// The recordings on one car. Requests have the lowest priority, and so have the replies.
pub struct CarFiles<'a> {
    client: &'a Client,
    car: CarName,
}

impl FileSource for CarFiles<'_> {
    async fn request(&self, request: FilesRequest, timeout: Duration) -> Option<FilesReply> {
        let Self { client, car } = self;
        let request = encode(&request, stamps()).ok()?;
        let priority = Priority::Background;
        let bytes = first_reply(&client.session, car, Topic::Files, request, timeout, priority).await?;
        decode::<FilesReply>(&bytes)
            .inspect_err(|error| tracing::debug!(%car, %error, "the reply cannot be decoded"))
            .map(|(_, reply)| reply)
            .ok()
    }
}

/// Sends queries and commands to the cars.
pub struct Client {
    session: zenoh::Session,
    sink: EventSink,
    signer: Option<Signer>,
    /// True for the keys of a viewer, to whose commands no car listens.
    viewer: bool,
}

impl Client {
    /// What the queries find out goes to `sink` as events.
    pub(super) fn new(
        session: zenoh::Session,
        protection: &Protection,
        sink: EventSink,
    ) -> Result<Self, ConnectionError> {
        Ok(Self {
            session,
            sink,
            signer: protection.signer().map_err(ConnectionError::Keys)?,
            viewer: matches!(protection, Protection::Keys(keys) if keys.role == Role::Viewer),
        })
    }

    /// Sends a new command to a car and waits for the answer.
    pub async fn command(
        &self,
        car: &CarName,
        operator: &str,
        expected_revision: Option<u64>,
        action: Action,
    ) -> Result<Verdict, CodecError> {
        let command = Command {
            id: new_command_id(),
            operator: operator.to_owned(),
            expected_revision,
            action,
        };
        self.send(car, &command, REPLY_TIMEOUT).await
    }

    /// Sends a command, and sends it again until it is answered or `timeout` is over. The command may have been sent
    /// before: the car executes it once, however many copies arrive.
    pub async fn send(
        &self,
        car: &CarName,
        command: &Command,
        timeout: Duration,
    ) -> Result<Verdict, CodecError> {
        let begun = Instant::now();
        let bytes = encode(command, stamps())?;
        if self.viewer {
            return Ok(not_allowed(
                command,
                "these keys are a viewer's: they may read, not command",
            ));
        }
        let signature = match &self.signer {
            Some(signer) => match self.sign(signer, car, command, &bytes, timeout).await {
                Ok(signature) => Some(signature),
                Err(Some(error)) => return Ok(not_allowed(command, &error)),
                Err(None) if self.alive(car).await => {
                    return Ok(Verdict::NoAnswer {
                        waited_s: begun.elapsed().as_secs_f64(),
                        gone: false,
                    });
                }
                Err(None) => return Ok(Verdict::NoSuchCar),
            },
            None => None,
        };
        // On a slow link, the answer to one copy may come after the next copy was sent.
        let (sender, mut replies) = mpsc::unbounded_channel();
        let (mut was_alive, mut alive) = (false, true);
        let mut presence = Box::pin(self.alive_after(Duration::ZERO, car));
        loop {
            let left = timeout.saturating_sub(begun.elapsed());
            query(
                &self.session,
                car,
                command.action.topic(),
                bytes.clone(),
                signature.clone(),
                left,
                OPERATOR_PRIORITY,
                &sender,
            )
            .await;
            let resend = tokio::time::sleep(RESEND_AFTER.min(left));
            tokio::pin!(resend);
            loop {
                tokio::select! {
                    biased;
                    Some(bytes) = replies.recv() => {
                        return Ok(Verdict::of(command, &bytes, begun.elapsed()));
                    }
                    seen = &mut presence => {
                        (was_alive, alive) = (was_alive || seen, seen);
                        presence = Box::pin(self.alive_after(RESEND_AFTER, car));
                    }
                    () = &mut resend => break,
                }
            }
            let waited = begun.elapsed();
            if waited >= timeout && was_alive {
                return Ok(Verdict::NoAnswer {
                    waited_s: waited.as_secs_f64(),
                    gone: !alive,
                });
            }
            if waited >= ABSENT_AFTER.min(timeout) && !was_alive {
                return Ok(Verdict::NoSuchCar);
            }
        }
    }

    /// Signs a command for the car's present run. The error is None when the car does not answer.
    async fn sign(
        &self,
        signer: &Signer,
        car: &CarName,
        command: &Command,
        bytes: &[u8],
        timeout: Duration,
    ) -> Result<Vec<u8>, Option<String>> {
        let begun = Instant::now();
        let patience = ABSENT_AFTER.min(timeout);
        // On a slow link, the reply to one copy may come after the next copy was sent.
        let (sender, mut replies) = mpsc::unbounded_channel();
        let run_id = loop {
            let Ok(request) = encode(&ClockRequest { sent: unix_now() }, stamps()) else {
                return Err(None);
            };
            let left = patience.saturating_sub(begun.elapsed());
            query(
                &self.session,
                car,
                Topic::Clock,
                request,
                None,
                left.max(RESEND_AFTER),
                OPERATOR_PRIORITY,
                &sender,
            )
            .await;
            let reply = tokio::time::timeout(RESEND_AFTER, replies.recv())
                .await
                .ok()
                .flatten();
            if let Some(Ok((header, _))) = reply.map(|bytes| decode::<ClockReply>(&bytes)) {
                break header.run_id;
            }
            if begun.elapsed() >= patience {
                return Err(None);
            }
        };
        let key = Key::new(car.clone(), command.action.topic()).to_string();
        signer.sign(&key, run_id, bytes).map_err(Some)
    }

    /// True when the car's node runs, checked after `delay`.
    async fn alive_after(&self, delay: Duration, car: &CarName) -> bool {
        tokio::time::sleep(delay).await;
        self.alive(car).await
    }

    /// True when the car's node runs.
    pub async fn alive(&self, car: &CarName) -> bool {
        let key = Key::new(car.clone(), Topic::Alive).to_string();
        let Ok(tokens) = self
            .session
            .liveliness()
            .get(&key)
            .timeout(Duration::from_secs(2))
            .await
        else {
            return false;
        };
        tokens
            .recv_async()
            .await
            .is_ok_and(|reply| reply.result().is_ok())
    }

    /// Fetches the car's map and emits it as an event. None when the car does not reply.
    pub async fn fetch_map(&self, car: &CarName) -> Option<()> {
        let bytes = first_reply(
            &self.session,
            car,
            Topic::Map,
            Vec::new(),
            MAP_TIMEOUT,
            Priority::Background,
        )
        .await?;
        match decode::<MapReply>(&bytes) {
            Ok((_, map)) => self.emit(
                car,
                EventPayload::Map {
                    map: Arc::new(map),
                    bytes: bytes.into(),
                },
            ),
            Err(error) => self.emit(
                car,
                EventPayload::Unreadable {
                    topic: Topic::Map,
                    header: Header::read(&bytes).ok(),
                    error: error.to_string(),
                },
            ),
        }
        Some(())
    }

    /// Queries what runs on the car and emits it as an event. None when the car does not reply. The car learns the version of this
    /// program, and says so when it is another one.
    pub async fn fetch_info(&self, car: &CarName) -> Option<CarInfo> {
        let version = env!("CARGO_PKG_VERSION").into();
        let (_, info) = self
            .query_message::<CarInfo>(car, Topic::Info, version, REPLY_TIMEOUT)
            .await?;
        self.emit(car, EventPayload::Info(info.clone()));
        Some(info)
    }

    /// Compares the car's clock with the laptop's and emits the result as an event. Returns the offset and the round-trip
    /// time \[ns\].
    pub async fn compare_clocks(&self, car: &CarName) -> Option<(i64, i64)> {
        let request = encode(&ClockRequest { sent: unix_now() }, stamps()).ok()?;
        let (header, reply) = self
            .query_message::<ClockReply>(car, Topic::Clock, request, Duration::from_secs(1))
            .await?;
        let (offset, round_trip) = reply.offset_and_round_trip(unix_now());
        // A car of the tests does not name its run.
        let run_id = Some(header.run_id).filter(|run_id| *run_id > 0);
        self.emit(
            car,
            EventPayload::Clock {
                run_id,
                offset,
                round_trip,
            },
        );
        Some((offset, round_trip))
    }

    /// The recordings on a car.
    pub fn files_of(&self, car: &CarName) -> CarFiles<'_> {
        CarFiles {
            client: self,
            car: car.clone(),
        }
    }

    /// Sends a car how late its poses arrive. A lost report is followed by the next.
    pub(crate) async fn report(&self, car: &CarName, report: &LinkReport) {
        let key = Key::new(car.clone(), Topic::Link).to_string();
        let Ok(bytes) = encode(report, stamps()) else {
            return;
        };
        if let Err(error) = self
            .session
            .put(&key, bytes)
            .congestion_control(CONGESTION)
            .priority(OPERATOR_PRIORITY)
            .await
        {
            tracing::debug!(%key, %error, "the link report could not be sent");
        }
    }

    /// Sends a marker to every pit wall on the network, this one included.
    pub(crate) async fn mark(&self, car: &CarName, who: &str, text: &str) {
        let key = marker::key(car);
        let sent = self.session.put(&key, marker::encode(who, text)).await;
        if let Err(error) = sent {
            tracing::warn!(%key, %error, "the marker is in this pit wall's log only");
            let (who, text) = (who.into(), text.into());
            self.emit(car, EventPayload::Marker { who, text });
        }
    }

    /// Emits an event that did not arrive as a message.
    pub(crate) fn emit(&self, car: &CarName, payload: EventPayload) {
        (self.sink)(FleetEvent {
            at: unix_now(),
            car: car.clone(),
            payload,
        });
    }

    /// The first reply, decoded. None when none arrives in time, or it cannot be decoded.
    async fn query_message<M: Message>(
        &self,
        car: &CarName,
        topic: Topic,
        request: Vec<u8>,
        timeout: Duration,
    ) -> Option<(Header, M)> {
        let bytes = first_reply(&self.session, car, topic, request, timeout, OPERATOR_PRIORITY).await?;
        decode::<M>(&bytes)
            .inspect_err(|error| tracing::debug!(%car, %error, "the reply cannot be decoded"))
            .ok()
    }
}

/// The verdict on a command that is refused before it is sent.
fn not_allowed(command: &Command, why: &str) -> Verdict {
    Verdict::Answered {
        answer: Answer {
            id: command.id,
            outcome: Outcome::Refused {
                faults: vec![why.to_owned()],
            },
            set: SetRef {
                name: String::new(),
                revision: 0,
            },
        },
        after_s: 0.0,
    }
}
