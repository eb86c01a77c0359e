//! Commands about parameter sets: switching, trials, the shadow set, and the switches that the car makes by itself.

use maps::Pose;
use std::sync::PoisonError;
use std::time::{Duration, Instant};

use crossbeam_channel::bounded;
use protocol::{Command, CommandId, EventKind, Outcome, ParamsAction, Reply};

use super::{CommandHandler, done, refused};
use crate::control::parameter_sets;
use crate::control::parameter_store::{Decision, PlannedChange, Refusal};
use crate::localization::LocalizerParameters;
use crate::localization::filter_command::{FilterCommand, LocalizerChange};
use crate::localization::shadow::ShadowCommand;
use crate::sensors::clock::wall_now;
use crate::telemetry::queue::Record;

/// The set in force is published at least this often.
const PARAMS_PERIOD: Duration = Duration::from_secs(1);
/// After an automatic switch, the car keeps that set at least this long.
const AUTO_HOLD: Duration = Duration::from_secs(10);
/// The operator's name in automatic switches.
const AUTO: &str = "auto";
/// The operator's name when a trial is reverted because nobody confirmed it.
const FALL_BACK: &str = "fall-back";
/// Seed of the localizers that are made here: the same in every run.
const SEED: u64 = 1;

impl CommandHandler {
    pub(super) fn apply_params(&mut self, command: &Command, action: &ParamsAction) -> Outcome {
        match self.config.store.plan(action, command.expected_revision) {
            Err(Refusal::Stale { expected }) => self.stale(expected),
            Err(Refusal::Faults(faults)) => Outcome::Refused { faults },
            Ok(Decision::Sets(sets)) => done(None, Reply::Sets(sets)),
            Ok(Decision::Confirmed) => {
                let set = self.config.store.reference();
                self.event(EventKind::ParametersConfirmed { set }, Some(command));
                self.publish_params();
                done(None, Reply::Nothing)
            }
            Ok(Decision::Shadow(set)) => self.run_shadow(command, set),
            Ok(Decision::Deleted(name)) => {
                self.event(EventKind::SetDeleted { name }, Some(command));
                self.publish_params();
                done(None, Reply::Nothing)
            }
            Ok(Decision::Change(change)) => match self.change(*change, &command.operator, Some(command.id)) {
                Ok(update) => done(Some(update), Reply::Nothing),
                Err(faults) => Outcome::Refused { faults },
            },
        }
    }

    /// Stores, swaps, commits and publishes, in this order: if a step fails, the set in force stays.
    fn change(
        &mut self,
        change: PlannedChange,
        who: &str,
        command: Option<CommandId>,
    ) -> Result<u64, Vec<String>> {
        let replaced = change.store.then(|| self.config.store.store(&change, who));
        let stored = replaced.as_ref().map(|replaced| {
            let in_force = self.config.store.in_force();
            let (from, before) = replaced.as_ref().map_or_else(
                || (in_force.name.clone(), &in_force.parameters),
                |stored| (change.name.clone(), &stored.parameters),
            );
            let changes = parameter_sets::changes(before, &change.parameters);
            EventKind::SetStored {
                name: change.name.clone(),
                from,
                changes,
            }
        });
        let update = match self.write_state().and_then(|()| self.swap(&change)) {
            Ok(update) => update,
            Err(faults) => {
                if let Some(replaced) = replaced {
                    self.config.store.unstore(&change.name, replaced);
                    self.save();
                }
                return Err(faults);
            }
        };
        self.update = update.saturating_sub(1);
        let revert_after = change.revert_after;
        let reverts = who == FALL_BACK;
        let from = self.config.store.commit(change, who, wall_now(), update);
        let to = self.config.store.reference();
        if let Some(stored) = stored {
            self.event_by(stored, Some(who), command);
        }
        let kind = if reverts {
            EventKind::ParametersFellBack { from, to, update }
        } else {
            EventKind::ParametersChanged {
                from,
                to,
                update,
                revert_after: revert_after.map(|seconds| seconds as f32),
            }
        };
        self.event_by(kind, (!reverts).then_some(who), command);
        self.end_shadow_of_set_in_force(who, command);
        // A command's answer is saved together with its change, see `execute`.
        if command.is_none() {
            self.save();
        }
        self.publish_params();
        Ok(update)
    }

    /// Has the filter swap its set, and its localizer if the set is for another kind. Tables and localizers are made here,
    /// not in the filter's thread.
    fn swap(&self, change: &PlannedChange) -> Result<u64, Vec<String>> {
        let (map, set) = (&self.config.track_map, &change.parameters);
        let prepared = set
            .prepare(map, self.current_pose())
            .map_err(|faults| faults.iter().map(ToString::to_string).collect::<Vec<_>>())?;
        let localizer_change = if set.kind() == self.config.store.in_force().parameters.kind() {
            LocalizerChange::Tune(prepared)
        } else {
            let localizer = set
                .build(map, self.laser(), SEED)
                .map_err(|fault| vec![fault.to_string()])?;
            LocalizerChange::Replace(localizer)
        };
        let (reply, replied) = bounded(1);
        let command = FilterCommand::SetParameters {
            set: self.config.store.next_reference(&change.name),
            change: localizer_change,
            reply,
        };
        self.send_to_filter(command, &replied)
            .and_then(|changed| changed)
            .map_err(|fault| vec![fault])
    }

    /// The laser's pose on `base_link`.
    fn laser(&self) -> Pose {
        self.config
            .shared
            .laser()
            .unwrap_or(self.config.base_link_from_laser)
    }

    /// Runs a shadow set, or ends it. The set's tables are built here, not in the shadow's thread.
    fn run_shadow(&mut self, command: &Command, set: Option<(String, Box<LocalizerParameters>)>) -> Outcome {
        let who = command.operator.clone();
        let Some((name, parameters)) = set else {
            return if self.end_shadow(&who, Some(command.id)) {
                done(None, Reply::Nothing)
            } else {
                refused("no shadow set is running".into())
            };
        };
        let map = &self.config.track_map;
        parameters.prepare_tables(map, self.current_pose());
        let localizer = match parameters.build(map, self.laser(), SEED) {
            Ok(localizer) => localizer,
            Err(fault) => return refused(fault.to_string()),
        };
        let run = ShadowCommand::Run {
            name: name.clone(),
            who,
            localizer,
        };
        if self.config.shadow_commands.send(run).is_err() {
            return refused("the shadow's thread has ended".into());
        }
        self.config.shared.set_shadow(Some(name.clone()));
        self.event(EventKind::ShadowStarted { set: name }, Some(command));
        done(None, Reply::Nothing)
    }

    /// Ends the shadow set; false when none runs.
    fn end_shadow(&self, who: &str, command: Option<CommandId>) -> bool {
        let Some(set) = self.config.shared.set_shadow(None) else {
            return false;
        };
        // The shadow's thread lives as long as this one.
        let end = ShadowCommand::End { who: who.into() };
        self.config.shadow_commands.send(end).ok();
        self.event_by(EventKind::ShadowEnded { set }, Some(who), command);
        true
    }

    /// Ends a shadow of the set that is now in force, because there is nothing to compare.
    fn end_shadow_of_set_in_force(&self, who: &str, command: Option<CommandId>) {
        let shadow = self
            .config
            .shared
            .shadow
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let same = shadow.as_ref() == Some(&self.config.store.in_force().name);
        drop(shadow);
        if same {
            self.end_shadow(who, command);
        }
    }

    pub(super) fn set_auto(&mut self, command: &Command, on: bool) -> Outcome {
        self.config
            .shared
            .advice
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .auto = on;
        self.event(EventKind::AutoChanged { on }, Some(command));
        done(None, Reply::Nothing)
    }

    /// Reverts a trial whose time is over.
    pub(super) fn revert_unconfirmed(&mut self) {
        if let Some(change) = self.config.store.revert_due(wall_now()) {
            let name = change.name.clone();
            if let Err(faults) = self.change(change, FALL_BACK, None) {
                let text = format!("cannot revert to {name}: {}", faults.join("; "));
                self.event_by(EventKind::Error { text }, None, None);
            }
        }
    }

    /// Switches to the proposed set, if the car may switch by itself.
    pub(super) fn follow_proposal(&mut self) {
        let resting = self.auto_rests_until.is_some_and(|until| Instant::now() < until);
        // A pending trial belongs to an operator; the car does not switch during it.
        if resting || self.config.store.reverts_at().is_some() {
            return;
        }
        let advice = self
            .config
            .shared
            .advice
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone();
        let Some(proposal) = advice.proposal.filter(|_| advice.auto) else {
            return;
        };
        if proposal.set == self.config.store.in_force().name {
            return;
        }
        self.auto_rests_until = Some(Instant::now() + AUTO_HOLD);
        let action = ParamsAction::Select {
            name: proposal.set,
            revert_after_ms: None,
        };
        if let Ok(Decision::Change(change)) = self.config.store.plan(&action, None)
            && let Err(faults) = self.change(*change, AUTO, None)
        {
            let text = format!("cannot switch: {}", faults.join("; "));
            self.event_by(EventKind::Error { text }, Some(AUTO), None);
        }
    }

    /// Publishes the set in force.
    pub(super) fn publish_params(&mut self) {
        self.params_due = Instant::now() + PARAMS_PERIOD;
        let params = self.config.store.params();
        self.config
            .shared
            .telemetry
            .record(Record::Params(Box::new(params)));
    }
}
