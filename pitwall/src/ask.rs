//! Questions and commands to a car, and what can become of them.

use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher, Hasher};
use std::sync::Arc;
use std::time::{Duration, Instant};

use protocol::{
    Action, Answer, CarInfo, CarName, ClockReply, ClockRequest, CodecError, Command, CommandId, Header, Key,
    LinkReport, MapReply, Message, Outcome, Stamps, Topic, decode, encode,
};
use serde::Serialize;
use tokio::sync::mpsc;
use zenoh::Session;
use zenoh::qos::Priority;
use zenoh::query::ConsolidationMode;

use crate::event::Happening;
use crate::link::{ASK_CONGESTION, ASK_PRIORITY, Link, unix_now};

/// How long a car may take to answer: as long as a link may be silent before it counts as cut.
pub const PATIENCE: Duration = Duration::from_secs(4);
/// How long a map may take, which is long and goes when there is nothing else to send.
const MAP_PATIENCE: Duration = Duration::from_secs(20);
/// A command that is not answered for so long is sent again: the radio may have lost it, or its answer.
const REPEAT: Duration = Duration::from_millis(500);
/// A car that has not been seen for so long since it was asked is not there. Asked once is not enough: over a slow link,
/// or on a laptop that has just started, the answer that it is there may be on its way.
const ABSENT: Duration = Duration::from_millis(2500);

/// What became of a command, as the operator sees it.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "snake_case", tag = "verdict")]
pub enum Verdict {
    /// The car has answered: done, refused, or not at the expected revision.
    Answered {
        /// The answer.
        answer: Answer,
        /// From asking to the answer [s].
        after_s: f64,
    },
    /// No car of that name is there. Nothing has changed.
    NoSuchCar,
    /// The car was there and has not answered in time. It may have done it or not: look at the set in force, or
    /// send the same command again, which is harmless.
    NoAnswer {
        /// How long was waited [s].
        waited_s: f64,
        /// The car has left the link meanwhile.
        gone: bool,
    },
    /// Something answered that cannot be read. It may have been done or not.
    Unreadable {
        /// What is wrong with it.
        error: String,
    },
}

impl Verdict {
    /// What a car's reply to a command says.
    fn of(command: &Command, reply: &[u8], after: Duration) -> Self {
        match decode::<Answer>(reply) {
            Ok((_, answer)) if answer.id == command.id => Self::Answered {
                answer,
                after_s: after.as_secs_f64(),
            },
            Ok((_, answer)) => Self::Unreadable {
                error: format!("it answers command {} instead of {}", answer.id, command.id),
            },
            Err(error) => Self::Unreadable {
                error: error.to_string(),
            },
        }
    }

    /// The exit code of a program that gave the command: 0 done, 3 refused, 4 no such car, 5 no answer, 6 stale
    /// revision.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Answered { answer, .. } => match answer.outcome {
                Outcome::Done { .. } => 0,
                Outcome::Refused { .. } => 3,
                Outcome::StaleRevision { .. } => 6,
            },
            Self::NoSuchCar => 4,
            Self::NoAnswer { .. } | Self::Unreadable { .. } => 5,
        }
    }

    /// What the operator should know: which it was, and what to do next.
    pub fn text(&self, car: &CarName) -> String {
        match self {
            Self::Answered { answer, after_s } => {
                let set = format!("{} (revision {})", answer.set.name, answer.set.revision);
                match &answer.outcome {
                    Outcome::Done { update, .. } => {
                        let since =
                            update.map_or_else(String::new, |update| format!(" from update {update}"));
                        let after = after_s * 1e3;
                        format!("{car}: done{since}; set in force is {set}; answered in {after:.0} ms")
                    }
                    Outcome::Refused { faults } => {
                        let faults = faults.join("\n  ");
                        format!("{car}: REFUSED, nothing has changed; set in force is {set}:\n  {faults}")
                    }
                    Outcome::StaleRevision { expected, who } => format!(
                        "{car}: REVISION CONFLICT, nothing has changed: expected revision {expected}, but {who} has \
                         put {set} in force. Look at it, then give the command again"
                    ),
                }
            }
            Self::NoSuchCar => format!(
                "{car}: NO SUCH CAR on this link, nothing has changed. `pitwall cars` lists those there are"
            ),
            Self::NoAnswer { waited_s, gone } => {
                let when = if *gone { " when it is back" } else { "" };
                let gone = if *gone { " and has left the link" } else { "" };
                format!(
                    "{car}: NO ANSWER within {waited_s:.1} s{gone}; it may or may not have been done. See \
                     `pitwall params {car}`{when}, or give the command again: that is harmless"
                )
            }
            Self::Unreadable { error } => format!(
                "{car}: the ANSWER CANNOT BE READ ({error}); it may or may not have been done. Are car and pit wall \
                 of the same version?"
            ),
        }
    }
}

/// A new command id.
pub fn new_command_id() -> CommandId {
    // The keys of a RandomState come from the operating system's random numbers.
    let random = || u128::from(RandomState::new().build_hasher().finish());
    CommandId(random() << 64 | (random() ^ unix_now() as u128))
}

impl Link {
    /// Gives a car a command and waits for its answer.
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
        self.send(car, &command, PATIENCE).await
    }

    /// Sends a command, possibly not for the first time, and again until it is answered or `patience` is over. The
    /// car does it once, whatever the number of copies that arrive.
    pub async fn send(
        &self,
        car: &CarName,
        command: &Command,
        patience: Duration,
    ) -> Result<Verdict, CodecError> {
        let begun = Instant::now();
        let bytes = encode(command, stamps())?;
        // Every copy may still be answered after the next one was sent: on a slow link an answer takes longer than that.
        let (answers, mut answered) = mpsc::unbounded_channel();
        let (mut was_there, mut there) = (false, true);
        let mut presence = Box::pin(self.alive_after(Duration::ZERO, car));
        loop {
            let left = patience.saturating_sub(begun.elapsed());
            pose(
                &self.session,
                car,
                command.action.topic(),
                bytes.clone(),
                left,
                ASK_PRIORITY,
                &answers,
            )
            .await;
            let again = tokio::time::sleep(REPEAT.min(left));
            tokio::pin!(again);
            loop {
                tokio::select! {
                    biased;
                    Some(bytes) = answered.recv() => {
                        return Ok(Verdict::of(command, &bytes, begun.elapsed()));
                    }
                    seen = &mut presence => {
                        (was_there, there) = (was_there || seen, seen);
                        presence = Box::pin(self.alive_after(REPEAT, car));
                    }
                    () = &mut again => break,
                }
            }
            let waited = begun.elapsed();
            if waited >= patience && was_there {
                return Ok(Verdict::NoAnswer {
                    waited_s: waited.as_secs_f64(),
                    gone: !there,
                });
            }
            if waited >= ABSENT.min(patience) && !was_there {
                return Ok(Verdict::NoSuchCar);
            }
        }
    }

    /// The same, asked after a pause.
    async fn alive_after(&self, pause: Duration, car: &CarName) -> bool {
        tokio::time::sleep(pause).await;
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

    /// Fetches the car's map and hands it on as an event. None when the car does not answer.
    pub async fn fetch_map(&self, car: &CarName) -> Option<()> {
        let bytes = first_answer(
            &self.session,
            car,
            Topic::Map,
            Vec::new(),
            MAP_PATIENCE,
            Priority::Background,
        )
        .await?;
        match decode::<MapReply>(&bytes) {
            Ok((_, map)) => self.hand_on(
                car,
                Happening::Map {
                    map: Arc::new(map),
                    bytes: bytes.into(),
                },
            ),
            Err(error) => self.hand_on(
                car,
                Happening::Unreadable {
                    topic: Topic::Map,
                    header: Header::read(&bytes).ok(),
                    error: error.to_string(),
                },
            ),
        }
        Some(())
    }

    /// Asks what runs on the car and hands it on as an event. None when the car does not answer.
    pub async fn fetch_info(&self, car: &CarName) -> Option<CarInfo> {
        let info = self
            .ask::<CarInfo>(car, Topic::Info, Vec::new(), PATIENCE)
            .await?;
        self.hand_on(car, Happening::Info(info.clone()));
        Some(info)
    }

    /// Compares the car's clock with this one and hands the result on as an event.
    pub async fn compare_clocks(&self, car: &CarName) -> Option<(i64, i64)> {
        let question = encode(&ClockRequest { sent: unix_now() }, stamps()).ok()?;
        let reply = self
            .ask::<ClockReply>(car, Topic::Clock, question, Duration::from_secs(1))
            .await?;
        let (offset, round_trip) = reply.offset_and_round_trip(unix_now());
        self.hand_on(car, Happening::Clock { offset, round_trip });
        Some((offset, round_trip))
    }

    /// Tells a car how late its poses arrive. One that gets lost is followed by the next.
    pub(crate) async fn report(&self, car: &CarName, report: &LinkReport) {
        let key = Key::new(car.clone(), Topic::Link).to_string();
        let Ok(bytes) = encode(report, stamps()) else {
            return;
        };
        if let Err(error) = self
            .session
            .put(&key, bytes)
            .congestion_control(ASK_CONGESTION)
            .priority(ASK_PRIORITY)
            .await
        {
            tracing::debug!(%key, %error, "the report could not be sent");
        }
    }

    /// The first reply; None when there is none in time, or it cannot be read.
    async fn ask<M: Message>(
        &self,
        car: &CarName,
        topic: Topic,
        question: Vec<u8>,
        patience: Duration,
    ) -> Option<M> {
        let bytes = first_answer(&self.session, car, topic, question, patience, ASK_PRIORITY).await?;
        decode::<M>(&bytes)
            .inspect_err(|error| tracing::debug!(%car, %error, "an answer that cannot be read"))
            .map(|(_, message)| message)
            .ok()
    }
}

/// Poses a question of which every answer, within `patience`, goes to `answers`.
async fn pose(
    session: &Session,
    car: &CarName,
    topic: Topic,
    question: Vec<u8>,
    patience: Duration,
    priority: Priority,
    answers: &mpsc::UnboundedSender<Vec<u8>>,
) {
    let key = Key::new(car.clone(), topic).to_string();
    let answers = answers.clone();
    let sent = session
        .get(&key)
        .payload(question)
        .timeout(patience)
        .consolidation(ConsolidationMode::None)
        .congestion_control(ASK_CONGESTION)
        .priority(priority)
        .callback(move |reply| match reply.into_result() {
            // Nobody waits any more after the first.
            Ok(sample) => drop(answers.send(sample.payload().to_bytes().into_owned())),
            Err(error) => tracing::debug!(?error, "an error in place of a reply"),
        })
        .await;
    if let Err(error) = sent {
        tracing::debug!(%key, %error, "the question could not be sent");
    }
}

/// The first answer to a question; None when there is none within `patience`. Answers come with the question's priority.
pub(crate) async fn first_answer(
    session: &Session,
    car: &CarName,
    topic: Topic,
    question: Vec<u8>,
    patience: Duration,
    priority: Priority,
) -> Option<Vec<u8>> {
    let (answers, mut answered) = mpsc::unbounded_channel();
    pose(session, car, topic, question, patience, priority, &answers).await;
    // With the last sender, which the question holds until it is answered or given up, the wait ends.
    drop(answers);
    answered.recv().await
}

/// Stamps of a question or a command: only when it was sent is of interest.
pub(crate) fn stamps() -> Stamps {
    Stamps {
        published: unix_now(),
        ..Stamps::default()
    }
}
