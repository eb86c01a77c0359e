//! Decodes what arrives, on a thread of its own.
//!
//! Each message is decoded once and forwarded as a [`FleetEvent`]. [`GapRecovery`] puts the messages in order and finds
//! the missing ones; a task queries the cars for those.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, select};
use protocol::{CarName, EventKind, Header, Key, MissingReply, Resent, Telemetry, Topic, decode, encode};
use tokio::sync::{mpsc, oneshot, watch};
use zenoh::qos::Priority;
use zenoh::sample::{Sample, SampleKind};

use super::gap_recovery::{GapRecovery, MessageId, MissingQuery, Outstanding};
use super::query::{first_reply, stamps};
use super::run_gate::{Rejected, RunGate};
use crate::clock::unix_now;
use crate::event::{Delivery, EventPayload, EventSink, FleetEvent};

/// How often overdue messages and due queries are looked for.
const TICK: Duration = Duration::from_millis(50);
/// How long a car may take to send missing messages.
const MISSING_TIMEOUT: Duration = Duration::from_secs(3);

/// An input of the decoder's thread.
#[expect(clippy::large_enum_variant, reason = "nearly all of them are samples")]
pub(super) enum DecoderInput {
    /// A sample, with the time of its arrival \[unix ns\].
    Sample {
        at: i64,
        delivery: Delivery,
        key: Key,
        sample: Sample,
    },
    /// A car's liveliness token has appeared.
    Appeared(CarName),
    /// The liveliness token of a car's run has appeared, or has vanished.
    RunToken {
        car: CarName,
        run_id: u64,
        present: bool,
    },
    /// The full-rate topics are wanted, or no longer. The sender hears when held-back messages have been forwarded.
    WantRecorded(bool, oneshot::Sender<()>),
    /// A recording is about to end. The sender hears what is still outstanding.
    FinalSync(watch::Sender<Outstanding>),
}

/// The result of a query for missing messages.
pub(super) struct MissingAnswer {
    at: i64,
    car: CarName,
    /// None when the car did not answer.
    reply: Option<(Header, MissingReply)>,
}

/// A message of a known car and topic.
struct ReceivedMessage {
    at: i64,
    delivery: Delivery,
    key: Key,
    bytes: Arc<[u8]>,
}

/// Decodes messages and recovers missing ones.
pub(super) struct Decoder {
    runs: RunGate<ReceivedMessage>,
    recovery: GapRecovery<ReceivedMessage>,
    sink: EventSink,
    queries: mpsc::UnboundedSender<MissingQuery>,
    /// Who waits for the end of a recording.
    final_sync: Option<watch::Sender<Outstanding>>,
}

impl Decoder {
    /// Events go to `sink`, queries for missing messages to `queries`.
    pub(super) fn new(sink: EventSink, queries: mpsc::UnboundedSender<MissingQuery>) -> Self {
        Self {
            runs: RunGate::default(),
            recovery: GapRecovery::default(),
            sink,
            queries,
            final_sync: None,
        }
    }

    /// Runs until the connection is closed.
    pub(super) fn run(mut self, inputs: &Receiver<DecoderInput>, answers: &Receiver<MissingAnswer>) {
        let mut ticked = Instant::now();
        loop {
            select! {
                recv(inputs) -> input => match input {
                    Ok(input) => self.handle(input),
                    Err(_) => return,
                },
                // When this channel closes, so does the other.
                recv(answers) -> answer => if let Ok(answer) = answer {
                    self.handle_answer(answer);
                    self.send_due_queries(unix_now());
                },
                default(TICK) => {}
            }
            if ticked.elapsed() >= TICK {
                ticked = Instant::now();
                let now = unix_now();
                for (_, id, received) in self.runs.tick(now) {
                    self.put_in_order(id, received);
                }
                for rejected in self.runs.take_rejected(now) {
                    self.report(rejected, now);
                }
                for received in self.recovery.overdue(now) {
                    self.forward(received);
                }
                self.send_due_queries(now);
                if let Some(progress) = &self.final_sync {
                    progress.send_replace(self.recovery.outstanding());
                }
            }
        }
    }

    fn send_due_queries(&mut self, now: i64) {
        for query in self.recovery.due(now) {
            // Fails only when the connection is being closed.
            self.queries.send(query).ok();
        }
    }

    fn handle(&mut self, input: DecoderInput) {
        match input {
            DecoderInput::Appeared(car) => self.recovery.appeared(&car),
            DecoderInput::RunToken { car, run_id, present } => {
                for (id, received) in self.runs.token(&car, run_id, present, unix_now()) {
                    self.put_in_order(id, received);
                }
            }
            DecoderInput::WantRecorded(on, done) => {
                self.final_sync = None;
                for received in self.recovery.want_recorded(on) {
                    self.forward(received);
                }
                // The other side may have stopped waiting.
                done.send(()).ok();
            }
            DecoderInput::FinalSync(progress) => {
                let now = unix_now();
                self.recovery.final_sync(now);
                self.final_sync = Some(progress);
                self.send_due_queries(now);
            }
            DecoderInput::Sample {
                at,
                delivery,
                key,
                sample,
            } => {
                if sample.kind() != SampleKind::Put {
                    return;
                }
                let bytes = sample.payload().to_bytes().into();
                let received = ReceivedMessage {
                    at,
                    delivery,
                    key,
                    bytes,
                };
                self.handle_message(received, false);
            }
        }
    }

    /// Handles a message. `resent` is true for one that the car sent on request.
    fn handle_message(&mut self, received: ReceivedMessage, resent: bool) {
        let Ok(header) = Header::read(&received.bytes) else {
            return self.forward(received);
        };
        let id = MessageId {
            topic: received.key.topic,
            run_id: header.run_id,
            number: header.sequence,
        };
        let (car, at) = (received.key.car.clone(), received.at);
        for (id, received) in self.runs.arrive(&car, id, resent, received, at) {
            self.put_in_order(id, received);
        }
    }

    /// Forwards a message of the followed run: in order, if its stream must be complete.
    fn put_in_order(&mut self, id: MessageId, received: ReceivedMessage) {
        if !id.topic.recovered() {
            return self.forward(received);
        }
        let (car, at) = (received.key.car.clone(), received.at);
        for received in self.recovery.arrive(&car, id, received, at) {
            self.forward(received);
        }
    }

    /// Sends the event that messages were dropped.
    fn report(&self, rejected: Rejected, at: i64) {
        let Rejected {
            car,
            id:
                MessageId {
                    topic,
                    run_id,
                    number,
                },
            count,
            reason,
        } = rejected;
        tracing::debug!(%car, %topic, run_id, number, count, %reason, "dropped messages");
        (self.sink)(FleetEvent {
            at,
            car,
            payload: EventPayload::Rejected {
                topic,
                run_id,
                sequence: number,
                count,
                reason,
            },
        });
    }

    fn handle_answer(&mut self, MissingAnswer { at, car, reply }: MissingAnswer) {
        let Some((header, MissingReply { streams, messages })) = reply else {
            return self.recovery.unanswered(&car, at);
        };
        if !self.runs.answered(&car, header.run_id, at) {
            return self.recovery.unanswered(&car, at);
        }
        let more = !messages.is_empty();
        for Resent { topic, bytes } in messages {
            let received = ReceivedMessage {
                at,
                delivery: Delivery::InOrder,
                key: Key::new(car.clone(), topic),
                bytes: bytes.into(),
            };
            self.handle_message(received, true);
        }
        let (released, stream_ends) = self.recovery.answered(&car, header.run_id, &streams, more, at);
        if let Some((end, outstanding)) = stream_ends {
            (self.sink)(FleetEvent {
                at,
                car,
                payload: EventPayload::StreamEnds {
                    run_id: header.run_id,
                    published: header.published,
                    end,
                    outstanding,
                },
            });
        }
        for received in released {
            self.forward(received);
        }
    }

    /// Decodes a message and sends the event. A car that is stopping is asked for the ends of its streams.
    fn forward(&mut self, received: ReceivedMessage) {
        let ReceivedMessage {
            at,
            delivery,
            key,
            bytes,
        } = received;
        let payload = match Telemetry::decode(key.topic, &bytes) {
            Some(Ok((header, telemetry))) => {
                if let Telemetry::Event(event) = &telemetry
                    && matches!(event.kind, EventKind::Stopping { .. })
                {
                    self.recovery.stopped(&key.car, header.run_id, unix_now());
                }
                EventPayload::Message {
                    topic: key.topic,
                    delivery,
                    header,
                    telemetry: Box::new(telemetry),
                    bytes,
                }
            }
            Some(Err(error)) => EventPayload::Unreadable {
                topic: key.topic,
                header: Header::read(&bytes).ok(),
                error: error.to_string(),
            },
            None => return,
        };
        (self.sink)(FleetEvent {
            at,
            car: key.car,
            payload,
        });
    }
}

/// Sends the queries for missing messages, until the decoder has ended.
pub(super) async fn send_missing_queries(
    session: zenoh::Session,
    mut queries: mpsc::UnboundedReceiver<MissingQuery>,
    answers: Sender<MissingAnswer>,
) {
    while let Some(query) = queries.recv().await {
        let (session, answers) = (session.clone(), answers.clone());
        tokio::spawn(async move {
            let car = query.car.clone();
            let reply = query_missing(&session, query).await;
            let at = unix_now();
            // Fails only when the connection is closed.
            answers.send(MissingAnswer { at, car, reply }).ok();
        });
    }
}

/// Queries a car for missing messages. None without a reply in time.
async fn query_missing(session: &zenoh::Session, query: MissingQuery) -> Option<(Header, MissingReply)> {
    // Before what can wait, after what an operator waits for.
    let priority = if query.urgent {
        Priority::DataHigh
    } else {
        Priority::Data
    };
    let (car, topic) = (&query.car, Topic::Missing);
    let request = encode(&query.request, stamps()).ok()?;
    let bytes = first_reply(session, car, topic, request, MISSING_TIMEOUT, priority).await?;
    decode::<MissingReply>(&bytes)
        .inspect_err(|error| tracing::debug!(%car, %error, "the reply cannot be decoded"))
        .ok()
}
