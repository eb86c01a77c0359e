//! Executes commands: decodes each one, refuses or executes it, publishes events, and answers. It takes and returns bytes
//! and does not use the network.

mod command_limit;
mod parameters;
mod pose;
mod replay_guard;

use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use command_limit::CommandLimit;
use crossbeam_channel::{Receiver, Sender};
use keys::Refusal;
use maps::Pose;
use protocol::{
    Action, Answer, Command, CommandId, EventKind, Header, Outcome, ParamsAction, RatesAction, RecordAction,
    Reply, Stamps, Topic, decode, encode,
};
use synpf::TrackMap;

use replay_guard::ReplayGuard;

use super::answer_cache::{AnswerCache, CachedAnswer, PayloadHash};
use super::parameter_store::ParameterStore;
use super::state_file::StateFile;
use crate::localization::filter_command::FilterCommand;
use crate::localization::shadow::ShadowCommand;
use crate::sensors::clock::{SensorClock, wall_now};
use crate::telemetry::shared_state::SharedState;
use crate::wire;

/// Longest wait for the filter. It takes commands between two messages; after this time it counts as hanging.
const PATIENCE: Duration = Duration::from_secs(2);
/// Time that the answer to a search waits for candidates.
pub const SEARCH_PATIENCE: Duration = Duration::from_secs(1);

/// Everything that the command handler owns from its start.
#[derive(Debug)]
pub struct CommandHandlerConfig {
    /// The parameter sets.
    pub store: ParameterStore,
    /// Keeps the sets over a restart; None forgets them.
    pub file: Option<StateFile>,
    /// Commands to the filter.
    pub filter_commands: Sender<FilterCommand>,
    /// Commands to the shadow set.
    pub shadow_commands: Sender<ShadowCommand>,
    /// Pose of the laser on the car, for a shadow's localizer.
    pub base_link_from_laser: Pose,
    /// State shared with the other threads.
    pub shared: Arc<SharedState>,
    /// The sensors' clock, for events.
    pub clock: SensorClock,
    /// This run of the node.
    pub run_id: u64,
    /// The map, to prepare sets for it.
    pub track_map: Arc<TrackMap>,
    /// The answer to a search waits this long for candidates.
    pub search_patience: Duration,
}

/// Executes the commands of one car.
#[derive(Debug)]
pub struct CommandHandler {
    config: CommandHandlerConfig,
    answers: AnswerCache,
    replays: ReplayGuard,
    limit: CommandLimit,
    sequence: u64,
    update: u64,
    params_due: Instant,
    auto_rests_until: Option<Instant>,
}

impl CommandHandler {
    /// Starts with the answers of the last run, and saves the set that is now in force.
    pub fn new(config: CommandHandlerConfig) -> Self {
        let handler = Self {
            answers: AnswerCache::with(config.store.persisted().answers.iter().cloned()),
            config,
            replays: ReplayGuard::default(),
            limit: CommandLimit::default(),
            sequence: 0,
            update: 0,
            params_due: Instant::now(),
            auto_rests_until: None,
        };
        handler.save();
        handler
    }

    /// The parameter sets.
    pub fn store(&self) -> &ParameterStore {
        &self.config.store
    }

    /// Executes a command and returns the encoded answer. A payload that cannot be decoded changes nothing; it is counted,
    /// and the error names the fault.
    pub fn answer(&mut self, topic: Topic, payload: Option<&[u8]>) -> Result<Vec<u8>, String> {
        self.answer_signed(topic, payload, Ok(None))
    }

    /// The same for a command whose signature was checked: `signer` is the name of who signed it, or why it is refused. None
    /// where commands need no signature.
    pub fn answer_signed(
        &mut self,
        topic: Topic,
        payload: Option<&[u8]>,
        signer: Result<Option<String>, Refusal>,
    ) -> Result<Vec<u8>, String> {
        match self.decode_and_execute(topic, payload, signer) {
            Err(Unanswered::Unreadable(error)) => Err(self.count_unreadable(topic, error)),
            Err(Unanswered::TooMany(error)) => Err(error),
            Ok(bytes) => Ok(bytes),
        }
    }

    /// Counts a payload that cannot be decoded. Logs at powers of two, so that a flood does not fill the disk.
    pub(super) fn count_unreadable(&self, topic: Topic, error: String) -> String {
        let count = self.config.shared.counters.bad_payload() + 1;
        if count.is_power_of_two() {
            tracing::warn!(%topic, count, error, "a command cannot be read");
        }
        error
    }

    #[expect(clippy::needless_pass_by_value, reason = "it is the one use of the signer")]
    fn decode_and_execute(
        &mut self,
        topic: Topic,
        payload: Option<&[u8]>,
        signer: Result<Option<String>, Refusal>,
    ) -> Result<Vec<u8>, Unanswered> {
        let payload = payload.ok_or("a command needs a payload")?;
        let (header, mut command) = decode::<Command>(payload).map_err(|error| error.to_string())?;
        let belongs = command.action.topic();
        if belongs != topic {
            return Err(format!("this command belongs under {belongs}, not {topic}").into());
        }
        // Whoever has no valid signature shares one limit: names that are not proved are free to invent.
        let who = match &signer {
            Ok(Some(signer)) => signer.clone(),
            Ok(None) => command.operator.clone(),
            Err(_) => "unknown".to_owned(),
        };
        self.within_limit(&who, &command)?;
        if let Ok(Some(signer)) = &signer {
            command.operator = signed_name(&command.operator, signer);
        }
        let payload_hash = PayloadHash::of(&payload[Header::LEN..]);
        let refusal = match &signer {
            Err(refusal) => Some(refusal.to_string()),
            Ok(Some(signer)) => self.replays.check(signer, command.id, header.published).err(),
            Ok(None) => None,
        };
        let answer = match self.answers.find(command.id) {
            _ if refusal.is_some() => self.refuse(&command, refusal.unwrap_or_default()),
            Some(cached) if cached.payload_hash.is_none_or(|hash| hash == payload_hash) => {
                cached.answer.clone()
            }
            Some(_) => self.refuse_used_id(&command),
            None => self.execute(&command, payload_hash),
        };
        let stamps = Stamps {
            run_id: self.config.run_id,
            sequence: self.sequence + 1,
            sensor: wall_now().0,
            published: wall_now().0,
        };
        self.sequence += 1;
        Ok(encode(&answer, stamps).map_err(|error| error.to_string())?)
    }

    /// Refuses a command without executing it, and without caching the answer.
    fn refuse(&self, command: &Command, fault: String) -> Answer {
        let faults = vec![fault];
        let kind = EventKind::CommandRefused {
            faults: faults.clone(),
        };
        self.event(kind, Some(command));
        Answer {
            id: command.id,
            outcome: Outcome::Refused { faults },
            set: self.config.store.reference(),
        }
    }

    /// Refuses commands that come too fast. The first refusal of a flood is an event, with the name.
    fn within_limit(&mut self, who: &str, command: &Command) -> Result<(), Unanswered> {
        let Err(too_many) = self.limit.take(who, Instant::now()) else {
            return Ok(());
        };
        if too_many.first {
            let text = format!(
                "{who} sends more than {} commands a second; the rest is ignored",
                too_many.rate
            );
            self.event(EventKind::Warning { text }, Some(command));
        }
        let error = format!("too many commands from {who}: {} a second at most", too_many.rate);
        Err(Unanswered::TooMany(error))
    }

    /// Executes a command that was not executed before, and caches the answer.
    fn execute(&mut self, command: &Command, payload_hash: PayloadHash) -> Answer {
        let mut outcome = match &command.action {
            Action::Params(action) => self.apply_params(command, action),
            Action::Pose(_)
            | Action::Relocalize(_)
            | Action::Rates(_)
            | Action::Auto(_)
            | Action::Record(_)
                if command
                    .expected_revision
                    .is_some_and(|expected| expected != self.config.store.reference().revision) =>
            {
                self.stale(command.expected_revision.unwrap_or_default())
            }
            Action::Pose(pose) => self.initialize(command, wire::pose(*pose)),
            Action::Relocalize(action) => self.relocalize(command, *action),
            Action::Rates(action) => self.apply_rates(command, action),
            Action::Auto(on) => self.set_auto(command, *on),
            Action::Record(action) => self.record(*action),
        };
        if let Outcome::Refused { faults } = &mut outcome {
            faults.iter_mut().for_each(shorten);
            let faults = faults.clone();
            self.event(EventKind::CommandRefused { faults }, Some(command));
        }
        let answer = Answer {
            id: command.id,
            outcome,
            set: self.config.store.reference(),
        };
        let cached = CachedAnswer {
            answer: answer.clone(),
            payload_hash: Some(payload_hash),
        };
        self.answers.push(cached.clone());
        let changes = matches!(
            &command.action,
            Action::Params(action) if !matches!(action, ParamsAction::List | ParamsAction::Shadow { .. })
        );
        if changes && matches!(answer.outcome, Outcome::Done { .. }) {
            // The answer and the change that it reports are saved in one write.
            self.config.store.push_answer(cached);
            self.save();
        }
        answer
    }

    /// Refuses a different command under an id that was used before; its sender must not get the other one's answer.
    fn refuse_used_id(&self, command: &Command) -> Answer {
        let fault = format!(
            "the id {} was already used for another command; send this one under a new id",
            command.id
        );
        self.refuse(command, fault)
    }

    fn apply_rates(&mut self, command: &Command, action: &RatesAction) -> Outcome {
        let mut rates = self
            .config
            .shared
            .rates
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let from = *rates;
        let to = match action {
            RatesAction::Set(wanted) => *wanted,
            RatesAction::Get => from,
        };
        *rates = to;
        drop(rates);
        if matches!(action, RatesAction::Set(_)) {
            self.event(EventKind::RatesChanged { from, to }, Some(command));
        }
        done(None, Reply::Rates(to))
    }

    /// Starts or ends the recording on the car. The recorder publishes the event.
    fn record(&self, action: RecordAction) -> Outcome {
        let Some(recorder) = &self.config.shared.recorder else {
            return refused("this car has no folder for recordings; start it with --record FOLDER".into());
        };
        let state = match action {
            RecordAction::Get => Ok(recorder.state()),
            RecordAction::Start => recorder.set_recording(true),
            RecordAction::Stop => recorder.set_recording(false),
        };
        match state {
            Ok(state) => done(None, Reply::Recorder(state)),
            Err(fault) => refused(fault),
        }
    }

    fn stale(&self, expected: u64) -> Outcome {
        Outcome::StaleRevision {
            expected,
            who: self.config.store.in_force().who.clone(),
        }
    }

    /// Periodic work: reverts a trial that nobody confirmed, follows a proposal, publishes the set in force.
    pub fn tick(&mut self) {
        self.revert_unconfirmed();
        self.follow_proposal();
        if Instant::now() >= self.params_due {
            self.publish_params();
        }
    }

    /// Sends a command to the filter and waits for its reply.
    fn send_to_filter<T>(&self, command: FilterCommand, reply: &Receiver<T>) -> Result<T, String> {
        self.config
            .filter_commands
            .send_timeout(command, PATIENCE)
            .map_err(|_| "the filter takes no commands".to_owned())?;
        reply
            .recv_timeout(PATIENCE)
            .map_err(|_| format!("the filter did not answer within {} s", PATIENCE.as_secs()))
    }

    /// The latest pose estimate.
    fn current_pose(&self) -> Option<Pose> {
        self.config.shared.latest_pose().map(|estimate| estimate.pose)
    }

    fn event(&self, kind: EventKind, command: Option<&Command>) {
        self.event_by(
            kind,
            command.map(|command| command.operator.as_str()),
            command.map(|command| command.id),
        );
    }

    fn event_by(&self, kind: EventKind, who: Option<&str>, command: Option<CommandId>) {
        self.config
            .shared
            .event(self.config.clock.now(), self.update, kind, who, command);
    }

    /// Saves the persisted state. A failure is reported as an event, because the change is already in force.
    fn save(&self) {
        if let Err(faults) = self.write_state() {
            let text = faults.join("; ");
            self.event_by(EventKind::Error { text }, None, None);
        }
    }

    fn write_state(&self) -> Result<(), Vec<String>> {
        self.config.file.as_ref().map_or(Ok(()), |file| {
            file.write(self.config.store.persisted())
                .map_err(|error| vec![error.to_string()])
        })
    }
}

/// Why a command gets no answer.
enum Unanswered {
    /// It cannot be read.
    Unreadable(String),
    /// Its sender sends too many.
    TooMany(String),
}

impl<T: Into<String>> From<T> for Unanswered {
    fn from(error: T) -> Self {
        Self::Unreadable(error.into())
    }
}

/// The operator's name with the name of the keys behind it: `ana@laptop`.
fn signed_name(operator: &str, signer: &str) -> String {
    if operator == signer {
        return operator.to_owned();
    }
    let room = Command::MAX_OPERATOR.saturating_sub(signer.len() + 1);
    format!("{}@{signer}", &operator[..operator.floor_char_boundary(room)])
}

/// Longest fault \[bytes\]. One fault for every value of a set then fits into an event.
const LONGEST_FAULT: usize = 200;

fn shorten(fault: &mut String) {
    if fault.len() > LONGEST_FAULT {
        fault.truncate(fault.floor_char_boundary(LONGEST_FAULT - '…'.len_utf8()));
        fault.push('…');
    }
}

fn done(update: Option<u64>, reply: Reply) -> Outcome {
    Outcome::Done { update, reply }
}

fn refused(fault: String) -> Outcome {
    Outcome::Refused { faults: vec![fault] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_fault_is_cut_between_two_characters() {
        for long in [
            "no such parameter: ".to_owned() + &"\u{e9}".repeat(5000),
            "short".into(),
        ] {
            let mut fault = long.clone();
            shorten(&mut fault);
            assert!(fault.len() <= LONGEST_FAULT);
            assert!(long.starts_with(fault.trim_end_matches('…')), "{fault}");
        }
    }
}
