//! Does what commands say: decides with the keeper, has the filter do it, tells everybody, and answers. No network:
//! bytes come in, bytes go out.

use std::sync::{Arc, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, bounded};
use maps::Pose;
use protocol::{
    Action, Answer, Candidate, Command, CommandId, EventKind, Header, Outcome, ParamsAction, RatesAction,
    RelocalizeAction, Reply, Stamps, Topic, decode, encode,
};
use synpf::{Parameters, SynPf, TrackMap, Tuning};

use super::answers::{Answered, Answers, Print};
use super::file::StateFile;
use crate::clock::{SensorClock, wall_now};
use crate::filter::{Order, Shared};
use crate::keeper::{Decision, Keeper, Plan, Refusal};
use crate::outbox::Record;
use crate::sets;
use crate::shadow::Wish;
use crate::wire;

/// The filter looks at orders between two messages; longer than this and it hangs.
const PATIENCE: Duration = Duration::from_secs(2);
/// The set in force is told this often, change or not.
const PARAMS_PERIOD: Duration = Duration::from_secs(1);
/// How long an operator who lets a car search waits for candidates.
pub const SEARCH_PATIENCE: Duration = Duration::from_secs(1);
/// A search that has found nothing is asked again after this time.
const SEARCH_AGAIN: Duration = Duration::from_millis(50);
/// After a switch by itself, the car keeps that set at least this long.
const AUTO_HOLD: Duration = Duration::from_secs(10);
/// Candidates that an operator can choose from.
const MOST_CANDIDATES: usize = 10;
/// Who switches when the car does it by itself.
const AUTO: &str = "auto";

/// Everything that the desk owns.
pub struct Desk {
    /// The sets.
    pub keeper: Keeper,
    /// Where they are kept over a restart.
    pub file: Option<StateFile>,
    /// Orders to the filter.
    pub orders: Sender<Order>,
    /// Wishes to the shadow.
    pub shadow: Sender<Wish>,
    /// Where the laser is, for a localizer in the shadow.
    pub base_link_from_laser: Pose,
    /// What goes out.
    pub shared: Arc<Shared>,
    /// The sensors' time, for events.
    pub clock: SensorClock,
    /// This run of the node.
    pub run_id: u64,
    /// The map, to make sets ready for it.
    pub track_map: Arc<TrackMap>,
    /// A search of the map answers with what it has after this time.
    pub search_patience: Duration,
}

/// The desk at work.
pub struct Clerk {
    desk: Desk,
    answers: Answers,
    sequence: u64,
    update: u64,
    params_due: Instant,
    auto_rests_until: Option<Instant>,
}

impl Clerk {
    /// Begins, and writes down what the car has begun with.
    pub fn new(desk: Desk) -> Self {
        let clerk = Self {
            answers: Answers::kept(desk.keeper.memory().answers.iter().cloned()),
            desk,
            sequence: 0,
            update: 0,
            params_due: Instant::now(),
            auto_rests_until: None,
        };
        clerk.save();
        clerk
    }

    /// The sets, as they are now.
    pub fn keeper(&self) -> &Keeper {
        &self.desk.keeper
    }

    /// The answer to a command, as bytes. An error says what is wrong with a payload that cannot be read; it is counted,
    /// logged now and then, and changes nothing.
    pub fn answer(&mut self, topic: Topic, payload: Option<&[u8]>) -> Result<Vec<u8>, String> {
        self.command(topic, payload)
            .map_err(|error| self.unreadable(topic, error))
    }

    /// Counts what cannot be read, and logs it now and then: a stranger at 100 Hz must not fill the disk.
    pub(super) fn unreadable(&self, topic: Topic, error: String) -> String {
        let count = self.desk.shared.counters.bad_payload() + 1;
        if count.is_power_of_two() {
            tracing::warn!(%topic, count, error, "a command cannot be read");
        }
        error
    }

    /// Reads a command, does it, and gives the answer's bytes.
    fn command(&mut self, topic: Topic, payload: Option<&[u8]>) -> Result<Vec<u8>, String> {
        let payload = payload.ok_or("a command needs a payload")?;
        let (_, command) = decode::<Command>(payload).map_err(|error| error.to_string())?;
        let belongs = command.action.topic();
        if belongs != topic {
            return Err(format!("this command goes under {belongs}, not {topic}"));
        }
        let print = Print::of(&payload[Header::LEN..]);
        let answer = match self.answers.find(command.id) {
            Some(given) if given.print.is_none_or(|known| known == print) => given.answer.clone(),
            Some(_) => self.refuse_used_id(&command),
            None => self.obey(&command, print),
        };
        let stamps = Stamps {
            run_id: self.desk.run_id,
            sequence: self.sequence + 1,
            sensor: wall_now().0,
            published: wall_now().0,
        };
        self.sequence += 1;
        encode(&answer, stamps).map_err(|error| error.to_string())
    }

    /// Does a command that was not done before, and remembers the answer.
    fn obey(&mut self, command: &Command, print: Print) -> Answer {
        let mut outcome = match &command.action {
            Action::Params(action) => self.about_sets(command, action),
            Action::Pose(_) | Action::Relocalize(_) | Action::Rates(_) | Action::Auto(_)
                if command
                    .expected_revision
                    .is_some_and(|expected| expected != self.desk.keeper.reference().revision) =>
            {
                self.stale(command.expected_revision.unwrap_or_default())
            }
            Action::Pose(pose) => self.initialize(command, wire::pose(*pose)),
            Action::Relocalize(action) => self.relocalize(command, *action),
            Action::Rates(action) => self.about_rates(command, action),
            Action::Auto(on) => self.set_auto(command, *on),
        };
        if let Outcome::Refused { faults } = &mut outcome {
            faults.iter_mut().for_each(shorten);
            let faults = faults.clone();
            self.event(EventKind::CommandRefused { faults }, Some(command));
        }
        let answer = Answer {
            id: command.id,
            outcome,
            set: self.desk.keeper.reference(),
        };
        let given = Answered {
            answer: answer.clone(),
            print: Some(print),
        };
        self.answers.remember(given.clone());
        let changes = matches!(
            &command.action,
            Action::Params(action) if !matches!(action, ParamsAction::List | ParamsAction::Shadow { .. })
        );
        if changes && matches!(answer.outcome, Outcome::Done { .. }) {
            // With what it has changed, in one piece.
            self.desk.keeper.remember(given);
            self.save();
        }
        answer
    }

    /// Another command under an id that was used already: whoever gave it must not take the first one's answer for its own.
    fn refuse_used_id(&self, command: &Command) -> Answer {
        let faults = vec![format!(
            "the id {} was used for another command already: give this one an id of its own",
            command.id
        )];
        let kind = EventKind::CommandRefused {
            faults: faults.clone(),
        };
        self.event(kind, Some(command));
        Answer {
            id: command.id,
            outcome: Outcome::Refused { faults },
            set: self.desk.keeper.reference(),
        }
    }

    fn about_sets(&mut self, command: &Command, action: &ParamsAction) -> Outcome {
        match self.desk.keeper.plan(action, command.expected_revision) {
            Err(Refusal::Stale { expected }) => self.stale(expected),
            Err(Refusal::Faults(faults)) => Outcome::Refused { faults },
            Ok(Decision::Sets(sets)) => done(None, Reply::Sets(sets)),
            Ok(Decision::Confirmed) => {
                let set = self.desk.keeper.reference();
                self.event(EventKind::ParametersConfirmed { set }, Some(command));
                self.tell_params();
                done(None, Reply::Nothing)
            }
            Ok(Decision::Shadow(set)) => self.run_in_shadow(command, set),
            Ok(Decision::Deleted(name)) => {
                self.event(EventKind::SetDeleted { name }, Some(command));
                self.tell_params();
                done(None, Reply::Nothing)
            }
            Ok(Decision::Change(plan)) => match self.change(*plan, &command.operator, Some(command.id)) {
                Ok(update) => done(Some(update), Reply::Nothing),
                Err(faults) => Outcome::Refused { faults },
            },
        }
    }

    /// Stores, swaps, commits, tells: in this order, so that whatever goes wrong, what was in force stays so.
    fn change(&mut self, plan: Plan, who: &str, command: Option<CommandId>) -> Result<u64, Vec<String>> {
        let replaced = plan.store.then(|| self.desk.keeper.store(&plan, who));
        let stored = replaced.as_ref().map(|replaced| {
            let in_force = self.desk.keeper.in_force();
            let (from, before) = replaced.as_ref().map_or_else(
                || (in_force.name.clone(), &in_force.parameters),
                |stored| (plan.name.clone(), &stored.parameters),
            );
            let changes = sets::changes(before, &plan.parameters);
            EventKind::SetStored {
                name: plan.name.clone(),
                from,
                changes,
            }
        });
        let taken = self.write_memory().and_then(|()| self.swap(&plan));
        let update = match taken {
            Ok(update) => update,
            Err(faults) => {
                if let Some(replaced) = replaced {
                    self.desk.keeper.unstore(&plan.name, replaced);
                    self.save();
                }
                return Err(faults);
            }
        };
        self.update = update.saturating_sub(1);
        let revert_after = plan.revert_after;
        let falls_back = who == FALL_BACK;
        let now = wall_now();
        let from = self.desk.keeper.commit(plan, who, now, update);
        let to = self.desk.keeper.reference();
        if let Some(stored) = stored {
            self.event_by(stored, Some(who), command);
        }
        let kind = if falls_back {
            EventKind::ParametersFellBack { from, to, update }
        } else {
            EventKind::ParametersChanged {
                from,
                to,
                update,
                revert_after: revert_after.map(|seconds| seconds as f32),
            }
        };
        self.event_by(kind, (!falls_back).then_some(who), command);
        // A set needs no shadow of itself.
        let doubled = {
            let shadow = self
                .desk
                .shared
                .shadow
                .lock()
                .unwrap_or_else(PoisonError::into_inner);
            shadow.as_ref() == Some(&self.desk.keeper.in_force().name)
        };
        if doubled {
            self.end_shadow(who, command);
        }
        // A command's answer is kept with it, see `obey`.
        if command.is_none() {
            self.save();
        }
        self.tell_params();
        Ok(update)
    }

    /// Has the filter swap its set. What takes time, the tables of the set, is made ready here.
    fn swap(&self, plan: &Plan) -> Result<u64, Vec<String>> {
        let map = &self.desk.track_map;
        map.prepare(self.believed(), &plan.parameters);
        let tuning = Tuning::new(plan.parameters.clone(), map)
            .map_err(|faults| faults.iter().map(ToString::to_string).collect::<Vec<_>>())?;
        let (answer, answered) = bounded(1);
        let order = Order::SetParameters {
            set: self.desk.keeper.next_reference(&plan.name),
            tuning: Box::new(tuning),
            answer,
        };
        self.order(order, &answered).map_err(|fault| vec![fault])
    }

    /// Starts a set beside the one in force, or ends it. What takes time, its tables, is made ready here.
    fn run_in_shadow(&mut self, command: &Command, set: Option<(String, Box<Parameters>)>) -> Outcome {
        let who = command.operator.clone();
        let Some((name, parameters)) = set else {
            return if self.end_shadow(&who, Some(command.id)) {
                done(None, Reply::Nothing)
            } else {
                refused("no set runs in the shadow".into())
            };
        };
        self.desk.track_map.prepare(self.believed(), &parameters);
        let localizer = SynPf::new(
            Arc::clone(&self.desk.track_map),
            self.desk.base_link_from_laser,
            *parameters,
            SHADOW_SEED,
        );
        let localizer = match localizer {
            Ok(localizer) => Box::new(localizer),
            Err(fault) => return refused(fault.to_string()),
        };
        let wish = Wish::Run {
            name: name.clone(),
            who,
            localizer,
        };
        if self.desk.shadow.send(wish).is_err() {
            return refused("the shadow's thread is gone".into());
        }
        self.desk.shared.set_shadow(Some(name.clone()));
        self.event(EventKind::ShadowStarted { set: name }, Some(command));
        done(None, Reply::Nothing)
    }

    /// Ends the set in the shadow; false when there is none.
    fn end_shadow(&self, who: &str, command: Option<CommandId>) -> bool {
        let Some(set) = self.desk.shared.set_shadow(None) else {
            return false;
        };
        // The thread lives as long as this one.
        self.desk.shadow.send(Wish::End { who: who.into() }).ok();
        self.event_by(EventKind::ShadowEnded { set }, Some(who), command);
        true
    }

    /// Where the car believes to be.
    fn believed(&self) -> Option<Pose> {
        self.desk
            .shared
            .belief
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .map(|belief| belief.pose)
    }

    /// Gives the filter an order and waits for its answer.
    fn order<T>(&self, order: Order, answered: &Receiver<T>) -> Result<T, String> {
        self.desk
            .orders
            .send_timeout(order, PATIENCE)
            .map_err(|_| "the filter takes no orders".to_owned())?;
        answered
            .recv_timeout(PATIENCE)
            .map_err(|_| format!("the filter did not answer within {} s", PATIENCE.as_secs()))
    }

    fn initialize(&mut self, command: &Command, pose: Pose) -> Outcome {
        let (answer, answered) = bounded(1);
        let before = self.believed().map(wire::pose2);
        match self
            .order(Order::Initialize { pose, answer }, &answered)
            .and_then(|taken| taken)
        {
            Ok(update) => {
                let pose = wire::pose2(pose);
                self.event(EventKind::PoseInitialized { before, pose }, Some(command));
                done(Some(update), Reply::Nothing)
            }
            Err(fault) => refused(fault),
        }
    }

    fn relocalize(&mut self, command: &Command, action: RelocalizeAction) -> Outcome {
        match action {
            RelocalizeAction::Search => {
                let (answer, answered) = bounded(1);
                match self.order(Order::Relocalize { answer }, &answered) {
                    Ok(update) => {
                        self.event(EventKind::SearchStarted, Some(command));
                        done(Some(update), Reply::Candidates(self.candidates()))
                    }
                    Err(fault) => refused(fault),
                }
            }
            RelocalizeAction::Pick { candidate } => {
                let (answer, answered) = bounded(1);
                let order = Order::Pick {
                    number: candidate as usize,
                    answer,
                };
                match self.order(order, &answered).and_then(|picked| picked) {
                    Ok((update, pose)) => {
                        let pose = wire::pose2(pose);
                        self.event(EventKind::Relocalized { pose }, Some(command));
                        done(Some(update), Reply::Nothing)
                    }
                    Err(fault) => refused(fault),
                }
            }
        }
    }

    /// What the search finds with the next scans: asked for until there is something, for a second at most. Empty
    /// when there is nothing by then, or when one candidate won at once.
    fn candidates(&self) -> Vec<Candidate> {
        let until = Instant::now() + self.desk.search_patience;
        while Instant::now() < until {
            let (answer, answered) = bounded(1);
            match self.order(Order::Candidates { answer }, &answered) {
                Ok(found) if !found.is_empty() => {
                    return found
                        .iter()
                        .take(MOST_CANDIDATES)
                        .enumerate()
                        .map(|(index, hypothesis)| wire::candidate(index, hypothesis))
                        .collect();
                }
                Ok(_) => thread::sleep(SEARCH_AGAIN),
                Err(_) => break,
            }
        }
        Vec::new()
    }

    fn about_rates(&mut self, command: &Command, action: &RatesAction) -> Outcome {
        let mut rates = self
            .desk
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

    fn set_auto(&mut self, command: &Command, on: bool) -> Outcome {
        self.desk
            .shared
            .advice
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .auto = on;
        self.event(EventKind::AutoChanged { on }, Some(command));
        done(None, Reply::Nothing)
    }

    fn stale(&self, expected: u64) -> Outcome {
        Outcome::StaleRevision {
            expected,
            who: self.desk.keeper.in_force().who.clone(),
        }
    }

    /// Falls back where nobody confirmed, switches where the car may, and tells the set in force.
    pub fn look_at_the_clock(&mut self) {
        if let Some(plan) = self.desk.keeper.fall_back(wall_now()) {
            let name = plan.name.clone();
            if let Err(faults) = self.change(plan, FALL_BACK, None) {
                let text = format!("cannot fall back to {name}: {}", faults.join("; "));
                self.event_by(EventKind::Error { text }, None, None);
            }
        }
        self.follow_proposal();
        if Instant::now() >= self.params_due {
            self.tell_params();
        }
    }

    fn follow_proposal(&mut self) {
        let resting = self.auto_rests_until.is_some_and(|until| Instant::now() < until);
        // A trial is somebody's experiment: hands off until it is over.
        if resting || self.desk.keeper.falls_back_at().is_some() {
            return;
        }
        let advice = self
            .desk
            .shared
            .advice
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone();
        let Some(proposal) = advice.proposal.filter(|_| advice.auto) else {
            return;
        };
        if proposal.set == self.desk.keeper.in_force().name {
            return;
        }
        self.auto_rests_until = Some(Instant::now() + AUTO_HOLD);
        let action = ParamsAction::Select {
            name: proposal.set,
            revert_after_ms: None,
        };
        if let Ok(Decision::Change(plan)) = self.desk.keeper.plan(&action, None)
            && let Err(faults) = self.change(*plan, AUTO, None)
        {
            let text = format!("cannot switch: {}", faults.join("; "));
            self.event_by(EventKind::Error { text }, Some(AUTO), None);
        }
    }

    fn tell_params(&mut self) {
        self.params_due = Instant::now() + PARAMS_PERIOD;
        let params = self.desk.keeper.params();
        self.desk.shared.outbox.record(Record::Params(Box::new(params)));
    }

    fn event(&self, kind: EventKind, command: Option<&Command>) {
        self.event_by(
            kind,
            command.map(|command| command.operator.as_str()),
            command.map(|command| command.id),
        );
    }

    fn event_by(&self, kind: EventKind, who: Option<&str>, command: Option<CommandId>) {
        self.desk
            .shared
            .event(self.desk.clock.now(), self.update, kind, who, command);
    }

    /// Writes the memory to its file; the set is not worth losing over a full disk, so that this only warns.
    fn save(&self) {
        if let Err(faults) = self.write_memory() {
            let text = faults.join("; ");
            self.event_by(EventKind::Error { text }, None, None);
        }
    }

    fn write_memory(&self) -> Result<(), Vec<String>> {
        self.desk.file.as_ref().map_or(Ok(()), |file| {
            file.write(self.desk.keeper.memory())
                .map_err(|error| vec![error.to_string()])
        })
    }
}

/// The shadow's random numbers are its own, and the same in every run.
const SHADOW_SEED: u64 = 1;

/// Who puts a set back in force when nobody confirmed.
const FALL_BACK: &str = "fall-back";

/// Longest fault [bytes]: one of each of a set's values still fits an event, whatever they quote.
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
    fn a_fault_that_quotes_a_novel_is_cut_between_two_letters() {
        for novel in [
            "no such parameter: ".to_owned() + &"\u{e9}".repeat(5000),
            "short".into(),
        ] {
            let mut fault = novel.clone();
            shorten(&mut fault);
            assert!(fault.len() <= LONGEST_FAULT);
            assert!(novel.starts_with(fault.trim_end_matches('…')), "{fault}");
        }
    }
}
