//! The parameter sets of a car: which exist, which one is in force, which trial is pending.
//!
//! It has no clock and no file: the caller swaps the set in the filter, writes the file and passes the time. A change takes
//! two steps.
//! [`ParameterStore::plan`] checks it and changes nothing. After the filter has swapped the set,
//! [`ParameterStore::commit`] puts it in force.

use protocol::{ParameterSet, ParamsAction, PendingRevert, SetRef, StoredSet};
use synpf::Stamp;

use super::answer_cache::CachedAnswer;
use super::parameter_sets;
use super::persisted_state::{PersistedState, SavedSet};
use crate::localization::{EXTERNAL, LocalizerParameters};
use crate::wire;

/// The set in force.
#[derive(Debug, Clone, PartialEq)]
pub struct InForce {
    /// Its name.
    pub name: String,
    /// Its values.
    pub parameters: LocalizerParameters,
    /// Who put it in force.
    pub who: String,
    /// When, in wall time.
    pub when: Stamp,
    /// The first update under it.
    pub since_update: u64,
}

/// A trial that reverts by itself unless it is confirmed.
#[derive(Debug, Clone, PartialEq)]
struct PendingTrial {
    to: (String, LocalizerParameters),
    at: Stamp,
}

/// A change of the set in force that has been checked and not yet made.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedChange {
    /// The set's name.
    pub name: String,
    /// Its values.
    pub parameters: LocalizerParameters,
    /// True when the set is new on the car and must be stored.
    pub store: bool,
    /// Revert after this time unless confirmed \[s\].
    pub revert_after: Option<f64>,
}

/// What a command about sets leads to.
#[derive(Debug, Clone, PartialEq)]
pub enum Decision {
    /// Swap the set, then [`ParameterStore::commit`].
    Change(Box<PlannedChange>),
    /// The pending trial is confirmed; the set in force stays.
    Confirmed,
    /// A set was deleted.
    Deleted(String),
    /// All sets.
    Sets(Vec<StoredSet>),
    /// Run this shadow set, or none.
    Shadow(Option<(String, Box<LocalizerParameters>)>),
}

/// Why a command about sets is refused.
#[derive(Debug, Clone, PartialEq)]
pub enum Refusal {
    /// All faults of the values.
    Faults(Vec<String>),
    /// The command expects another revision than the one in force.
    Stale {
        /// The revision that it expects.
        expected: u64,
    },
}

/// Longest `revert_after` that is accepted \[s\].
const LONGEST_TRIAL: f64 = 3600.0;
/// Most sets on one car.
const MOST_SETS: usize = 64;

/// The parameter sets of one car.
#[derive(Debug)]
pub struct ParameterStore {
    persisted: PersistedState,
    in_force: InForce,
    previous: Option<(String, LocalizerParameters)>,
    pending: Option<PendingTrial>,
    /// The car has another localizer to follow.
    external: bool,
}

impl ParameterStore {
    /// A store that starts with the set `name` in force.
    pub fn new(
        mut persisted: PersistedState,
        name: String,
        parameters: LocalizerParameters,
        now: Stamp,
    ) -> Self {
        persisted.revision += 1;
        persisted.settled = Some(name.clone());
        Self {
            persisted,
            in_force: InForce {
                name,
                parameters,
                who: "start".into(),
                when: now,
                since_update: 1,
            },
            previous: None,
            pending: None,
            external: false,
        }
    }

    /// The same with the set that follows another localizer, if the car has one.
    #[must_use]
    pub fn with_external(self, external: bool) -> Self {
        Self { external, ..self }
    }

    /// Names of the sets that every car of this kind has.
    fn built_in(&self) -> impl Iterator<Item = &'static str> + use<> {
        let external = self.external.then_some(EXTERNAL);
        LocalizerParameters::NAMES.into_iter().chain(external)
    }

    /// The state that must survive a restart.
    pub fn persisted(&self) -> &PersistedState {
        &self.persisted
    }

    /// Keeps an answer over a restart.
    pub fn push_answer(&mut self, answer: CachedAnswer) {
        self.persisted.push_answer(answer);
    }

    /// The set in force.
    pub fn in_force(&self) -> &InForce {
        &self.in_force
    }

    /// The set in force by name and revision.
    pub fn reference(&self) -> SetRef {
        SetRef {
            name: self.in_force.name.clone(),
            revision: self.persisted.revision,
        }
    }

    /// The name and revision that a set of this name will have once it is in force.
    pub fn next_reference(&self, name: &str) -> SetRef {
        SetRef {
            name: name.into(),
            revision: self.persisted.revision + 1,
        }
    }

    /// The time at which the pending trial reverts.
    pub fn reverts_at(&self) -> Option<Stamp> {
        self.pending.as_ref().map(|pending| pending.at)
    }

    /// The message that publishes the set in force.
    pub fn params(&self) -> protocol::Params {
        protocol::Params {
            set: parameter_set(&self.in_force.name, &self.in_force.parameters),
            revision: self.persisted.revision,
            who: self.in_force.who.clone(),
            when: self.in_force.when.0,
            since_update: self.in_force.since_update,
            pending_revert: self.pending.as_ref().map(|pending| PendingRevert {
                to: pending.to.0.clone(),
                at: pending.at.0,
            }),
            available: self
                .built_in()
                .map(str::to_owned)
                .chain(self.persisted.sets.keys().cloned())
                .collect(),
        }
    }

    /// Checks a command. Confirming and deleting take effect here; a change needs [`Self::commit`].
    pub fn plan(
        &mut self,
        action: &ParamsAction,
        expected_revision: Option<u64>,
    ) -> Result<Decision, Refusal> {
        let reads_only = matches!(action, ParamsAction::List);
        if let Some(expected) = expected_revision
            && expected != self.persisted.revision
            && !reads_only
        {
            return Err(Refusal::Stale { expected });
        }
        let fault = |text: String| Refusal::Faults(vec![text]);
        match action {
            ParamsAction::Select {
                name,
                revert_after_ms,
            } => {
                let parameters = self.find(name).ok_or_else(|| fault(self.no_such_set(name)))?;
                Ok(Decision::Change(Box::new(PlannedChange {
                    name: name.clone(),
                    parameters,
                    store: false,
                    revert_after: trial(*revert_after_ms).map_err(fault)?,
                })))
            }
            ParamsAction::Put { set, revert_after_ms } => self.plan_put(set, *revert_after_ms),
            ParamsAction::Confirm => {
                if self.pending.take().is_none() {
                    return Err(fault("nothing to confirm: no trial is pending".into()));
                }
                self.persisted.settled = Some(self.in_force.name.clone());
                Ok(Decision::Confirmed)
            }
            ParamsAction::Revert => {
                let (name, parameters) = self
                    .previous
                    .clone()
                    .ok_or_else(|| fault("no other set was in force before this one".into()))?;
                Ok(Decision::Change(Box::new(PlannedChange {
                    name,
                    parameters,
                    store: false,
                    revert_after: None,
                })))
            }
            ParamsAction::Delete { name } => {
                if self.built_in().any(|known| known == name) {
                    return Err(fault(format!("{name} is built in and cannot be deleted")));
                }
                if *name == self.in_force.name {
                    return Err(fault(format!("{name} is in force and cannot be deleted")));
                }
                if self.pending.as_ref().is_some_and(|pending| pending.to.0 == *name) {
                    return Err(fault(format!(
                        "{name} cannot be deleted: the pending trial reverts to it"
                    )));
                }
                match self.persisted.sets.remove(name) {
                    Some(_) => Ok(Decision::Deleted(name.clone())),
                    None => Err(fault(self.no_such_set(name))),
                }
            }
            ParamsAction::List => Ok(Decision::Sets(self.list())),
            ParamsAction::Shadow { name: None } => Ok(Decision::Shadow(None)),
            ParamsAction::Shadow { name: Some(name) } => {
                if *name == self.in_force.name {
                    return Err(fault(format!("{name} is in force; a shadow needs another set")));
                }
                let parameters = self.find(name).ok_or_else(|| fault(self.no_such_set(name)))?;
                Ok(Decision::Shadow(Some((name.clone(), Box::new(parameters)))))
            }
        }
    }

    fn plan_put(&self, set: &ParameterSet, revert_after_ms: Option<u32>) -> Result<Decision, Refusal> {
        let mut faults = Vec::new();
        if set.name == EXTERNAL || LocalizerParameters::NAMES.contains(&set.name.as_str()) {
            faults.push(format!("{} is built in and cannot be overwritten", set.name));
        }
        if self.persisted.sets.len() >= MOST_SETS && !self.persisted.sets.contains_key(&set.name) {
            faults.push(format!("the car already has {MOST_SETS} sets; delete one first"));
        }
        let revert_after = trial(revert_after_ms).unwrap_or_else(|fault| {
            faults.push(fault);
            None
        });
        let given = set
            .values
            .iter()
            .map(|(key, value)| (key.clone(), wire::json(value)));
        match parameter_sets::with_values(&self.in_force.parameters, given) {
            Ok(parameters) if faults.is_empty() => Ok(Decision::Change(Box::new(PlannedChange {
                name: set.name.clone(),
                parameters,
                store: true,
                revert_after,
            }))),
            Ok(_) => Err(Refusal::Faults(faults)),
            Err(more) => {
                faults.extend(more.iter().map(ToString::to_string));
                Err(Refusal::Faults(faults))
            }
        }
    }

    /// Stores a planned set on the car before it is in force. Returns the set that it replaces.
    pub fn store(&mut self, change: &PlannedChange, who: &str) -> Option<SavedSet> {
        self.persisted.sets.insert(
            change.name.clone(),
            SavedSet {
                parameters: change.parameters.clone(),
                who: who.into(),
            },
        )
    }

    /// Undoes [`Self::store`].
    pub fn unstore(&mut self, name: &str, before: Option<SavedSet>) {
        match before {
            Some(stored) => self.persisted.sets.insert(name.into(), stored),
            None => self.persisted.sets.remove(name),
        };
    }

    /// Puts a planned set in force; the filter has swapped it from `update` on. Returns the previous one.
    pub fn commit(&mut self, change: PlannedChange, who: &str, now: Stamp, update: u64) -> SetRef {
        let before = self.reference();
        let in_force = InForce {
            name: change.name,
            parameters: change.parameters,
            who: who.into(),
            when: now,
            since_update: update,
        };
        let old = std::mem::replace(&mut self.in_force, in_force);
        // A trial during a trial reverts to the set that was in force before both.
        let settled = self
            .pending
            .take()
            .map_or((old.name.clone(), old.parameters.clone()), |pending| pending.to);
        self.previous = Some((old.name, old.parameters));
        self.persisted.revision += 1;
        match change.revert_after {
            Some(seconds) => {
                self.persisted.settled = Some(settled.0.clone());
                self.pending = Some(PendingTrial {
                    to: settled,
                    at: now.plus(seconds),
                });
            }
            None => self.persisted.settled = Some(self.in_force.name.clone()),
        }
        before
    }

    /// The change that reverts a trial whose time is over.
    pub fn revert_due(&self, now: Stamp) -> Option<PlannedChange> {
        let pending = self.pending.as_ref().filter(|pending| pending.at <= now)?;
        Some(PlannedChange {
            name: pending.to.0.clone(),
            parameters: pending.to.1.clone(),
            store: false,
            revert_after: None,
        })
    }

    fn find(&self, name: &str) -> Option<LocalizerParameters> {
        if name == EXTERNAL && !self.external {
            return None;
        }
        LocalizerParameters::named(name).or_else(|| Some(self.persisted.sets.get(name)?.parameters.clone()))
    }

    fn no_such_set(&self, name: &str) -> String {
        format!(
            "no set {name:?} on this car; known sets are {}",
            self.params().available.join(", ")
        )
    }

    fn list(&self) -> Vec<StoredSet> {
        let shipped = self.built_in().filter_map(|name| {
            Some(StoredSet {
                set: parameter_set(name, &LocalizerParameters::named(name)?),
                built_in: true,
                who: None,
            })
        });
        let put = self.persisted.sets.iter().map(|(name, stored)| StoredSet {
            set: parameter_set(name, &stored.parameters),
            built_in: false,
            who: Some(stored.who.clone()),
        });
        shipped.chain(put).collect()
    }
}

/// `revert_after` in seconds; an error when it is out of range.
fn trial(milliseconds: Option<u32>) -> Result<Option<f64>, String> {
    let Some(milliseconds) = milliseconds else {
        return Ok(None);
    };
    let seconds = f64::from(milliseconds) / 1000.0;
    if (0.1..=LONGEST_TRIAL).contains(&seconds) {
        Ok(Some(seconds))
    } else {
        Err(format!(
            "revert_after: {seconds} s is not between 0.1 and {LONGEST_TRIAL} s"
        ))
    }
}

/// A set as the protocol defines it.
fn parameter_set(name: &str, parameters: &LocalizerParameters) -> ParameterSet {
    ParameterSet {
        name: name.into(),
        values: parameter_sets::values(parameters)
            .iter()
            .filter_map(|(key, value)| Some((key.clone(), wire::value(value)?)))
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::Value;

    const NOW: Stamp = Stamp(1_000_000_000);

    fn store() -> ParameterStore {
        let hq = LocalizerParameters::named("hq").expect("ships");
        ParameterStore::new(PersistedState::default(), "hq".into(), hq, NOW)
    }

    fn particles_of(store: &ParameterStore) -> serde_json::Value {
        parameter_sets::values(&store.in_force().parameters)["max_particles"].clone()
    }

    fn select(name: &str, revert_after_ms: Option<u32>) -> ParamsAction {
        ParamsAction::Select {
            name: name.into(),
            revert_after_ms,
        }
    }

    fn put(name: &str, values: &[(&str, Value)]) -> ParamsAction {
        ParamsAction::Put {
            set: ParameterSet {
                name: name.into(),
                values: values
                    .iter()
                    .map(|(key, value)| ((*key).to_owned(), value.clone()))
                    .collect(),
            },
            revert_after_ms: None,
        }
    }

    fn change(store: &mut ParameterStore, action: &ParamsAction, now: Stamp) {
        match store.plan(action, None).expect("planned") {
            Decision::Change(plan) => {
                if plan.store {
                    store.store(&plan, "anna");
                }
                store.commit(*plan, "anna", now, 7);
            }
            other => panic!("no change: {other:?}"),
        }
    }

    #[test]
    fn another_localizer_is_a_set_of_the_cars_that_have_one() {
        let select = ParamsAction::Select {
            name: EXTERNAL.into(),
            revert_after_ms: None,
        };
        let shadow = ParamsAction::Shadow {
            name: Some(EXTERNAL.into()),
        };
        let mut without = store();
        assert!(without.plan(&select, None).is_err());
        assert!(!without.params().available.contains(&EXTERNAL.to_owned()));
        let mut with = store().with_external(true);
        assert!(matches!(with.plan(&select, None), Ok(Decision::Change(_))));
        assert!(matches!(with.plan(&shadow, None), Ok(Decision::Shadow(Some(_)))));
        assert!(with.params().available.contains(&EXTERNAL.to_owned()));
        let delete = ParamsAction::Delete {
            name: EXTERNAL.into(),
        };
        assert!(with.plan(&delete, None).is_err());
    }

    #[test]
    fn a_planned_change_that_is_not_made_leaves_no_trace() {
        let mut store = store();
        let before = store.params();
        store.plan(&select("lq", None), None).expect("planned");
        store
            .plan(&put("mine", &[("max_particles", Value::Int(1500))]), None)
            .expect("planned");
        assert_eq!(store.params(), before);
    }

    #[test]
    fn selecting_and_reverting_count_up() {
        let mut store = store();
        let first = store.reference().revision;
        change(&mut store, &select("lq", None), NOW);
        assert_eq!(
            store.reference(),
            SetRef {
                name: "lq".into(),
                revision: first + 1
            }
        );
        assert_eq!(store.params().since_update, 7);
        change(&mut store, &ParamsAction::Revert, NOW);
        assert_eq!(
            store.reference(),
            SetRef {
                name: "hq".into(),
                revision: first + 2
            }
        );
    }

    #[test]
    fn a_stale_revision_changes_nothing() {
        let mut store = store();
        let seen = store.reference().revision;
        change(&mut store, &select("lq", None), NOW);
        assert_eq!(
            store.plan(&select("adaptive", None), Some(seen)),
            Err(Refusal::Stale { expected: seen })
        );
        assert_eq!(store.reference().name, "lq");
        assert!(
            store.plan(&ParamsAction::List, Some(seen)).is_ok(),
            "a listing is always allowed"
        );
    }

    #[test]
    fn a_trial_falls_back_unless_confirmed() {
        let mut store = store();
        change(&mut store, &select("lq", Some(5000)), NOW);
        assert_eq!(store.persisted().settled.as_deref(), Some("hq"));
        // A trial within a trial reverts to the set before both.
        change(&mut store, &select("adaptive", Some(5000)), NOW.plus(1.0));
        assert_eq!(store.revert_due(NOW.plus(5.9)), None);
        let plan = store.revert_due(NOW.plus(6.0)).expect("due");
        assert_eq!(plan.name, "hq");
        store.commit(plan, "start", NOW.plus(6.0), 9);
        assert_eq!(store.reverts_at(), None);

        change(&mut store, &select("lq", Some(5000)), NOW);
        assert_eq!(store.plan(&ParamsAction::Confirm, None), Ok(Decision::Confirmed));
        assert_eq!(store.revert_due(NOW.plus(60.0)), None);
        assert_eq!(store.persisted().settled.as_deref(), Some("lq"));
        assert!(
            store.plan(&ParamsAction::Confirm, None).is_err(),
            "it is confirmed already"
        );
    }

    #[test]
    fn a_put_set_keeps_the_rest_of_the_one_in_force_and_survives() {
        let mut store = store();
        change(
            &mut store,
            &put("mine", &[("max_particles", Value::Int(1500))]),
            NOW,
        );
        assert_eq!(particles_of(&store), 1500);
        assert!(store.params().available.contains(&"mine".to_owned()));

        let text = serde_json::to_string(store.persisted()).expect("writes");
        let persisted: PersistedState = serde_json::from_str(&text).expect("reads");
        let mut again = ParameterStore::new(persisted, "hq".into(), LocalizerParameters::default(), NOW);
        assert!(again.reference().revision > store.reference().revision);
        change(&mut again, &select("mine", None), NOW);
        assert_eq!(particles_of(&again), 1500);

        let delete = ParamsAction::Delete { name: "mine".into() };
        assert!(again.plan(&delete, None).is_err(), "in force");
        change(&mut again, &select("hq", None), NOW);
        assert_eq!(again.plan(&delete, None), Ok(Decision::Deleted("mine".into())));
        assert!(again.plan(&select("mine", None), None).is_err());
    }

    #[test]
    fn a_faulty_set_is_refused_whole_with_every_fault() {
        let mut store = store();
        let action = put(
            "hq",
            &[
                ("max_particles", Value::Text("many".into())),
                ("speed_of_light", Value::Float(3e8)),
                ("no_such_key", Value::Bool(true)),
            ],
        );
        let Err(Refusal::Faults(faults)) = store.plan(&action, None) else {
            panic!("accepted");
        };
        for word in ["hq is built in", "max_particles", "speed_of_light", "no_such_key"] {
            assert!(
                faults.iter().any(|fault| fault.contains(word)),
                "{word} not in {faults:?}"
            );
        }
    }

    #[test]
    fn absurd_trials_are_refused() {
        let mut store = store();
        for milliseconds in [0, 50, u32::MAX] {
            assert!(store.plan(&select("lq", Some(milliseconds)), None).is_err());
        }
    }

    /// Pseudo-random numbers, the same in every run.
    struct Dice(u64);

    impl Dice {
        fn roll(&mut self, sides: usize) -> usize {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (self.0 >> 33) as usize % sides
        }

        /// A random command about sets, with known and unknown keys and with any value.
        fn action(&mut self, keys: &[String]) -> ParamsAction {
            let name = ["hq", "lq", "mine", "yours", "wet", "-"][self.roll(6)].to_owned();
            let revert_after_ms = [None, Some(0), Some(500), Some(u32::MAX)][self.roll(4)];
            match self.roll(8) {
                0 => ParamsAction::Select {
                    name,
                    revert_after_ms,
                },
                1 => ParamsAction::Confirm,
                2 => ParamsAction::Revert,
                3 => ParamsAction::Delete { name },
                4 => ParamsAction::Shadow { name: Some(name) },
                _ => {
                    let values =
                        (0..self.roll(4)).map(|_| (keys[self.roll(keys.len())].clone(), self.value()));
                    let values: std::collections::BTreeMap<String, Value> = values.collect();
                    ParamsAction::Put {
                        set: ParameterSet {
                            name,
                            values: values.into_iter().collect(),
                        },
                        revert_after_ms,
                    }
                }
            }
        }

        fn value(&mut self) -> Value {
            match self.roll(9) {
                0 => Value::Bool(true),
                1 => Value::Int(i64::MAX),
                2 => Value::Int(-1),
                3 => Value::Int(1000),
                4 => Value::Float(f64::NAN),
                5 => Value::Float(1e300),
                6 => Value::Float(0.25),
                7 => Value::Float(-0.0),
                _ => Value::Text("tum".into()),
            }
        }
    }

    /// For random commands in random order: a refused command changes nothing, an executed one raises the revision by one,
    /// and the set in force is always valid.
    #[test]
    fn no_sequence_of_commands_leads_astray() {
        let mut keys: Vec<String> = parameter_sets::values(&LocalizerParameters::default())
            .into_keys()
            .collect();
        keys.push("no_such_thing".into());
        let mut dice = Dice(1);
        let mut store = store();
        let (mut done, mut refused) = (0, 0);
        for _ in 0..3000 {
            let action = dice.action(&keys);
            let before = store.params();
            let expected = [None, Some(before.revision), Some(before.revision + 1)][dice.roll(3)];
            match store.plan(&action, expected) {
                Err(refusal) => {
                    refused += 1;
                    let stale = expected.is_some_and(|expected| expected != before.revision);
                    assert_eq!(matches!(refusal, Refusal::Stale { .. }), stale);
                    assert_eq!(store.params(), before);
                }
                Ok(Decision::Change(plan)) => {
                    done += 1;
                    assert_eq!(store.params(), before);
                    if plan.store {
                        store.store(&plan, "anna");
                    }
                    store.commit(*plan, "anna", NOW, 7);
                    assert_eq!(store.reference().revision, before.revision + 1);
                }
                Ok(_) => assert_eq!(store.reference().revision, before.revision),
            }
            assert!(store.in_force().parameters.validate().is_ok());
        }
        assert!(done > 200 && refused > 200, "{done} done, {refused} refused");
    }
}
