//! What the health states are worth, held against the truth.

use std::collections::BTreeMap;

use maps::{Pose, wrap_angle};
use serde::Serialize;
use synpf::Stamp;

use super::Fault;
use super::errors::SETTLING;
use crate::health::State;

/// LOCALIZED promises a position within this [m]...
const POSITION: f64 = 0.2;
/// ...and a heading within this [rad].
const HEADING: f64 = 2.0 * std::f64::consts::PI / 180.0;

/// How far LOCALIZED and LOST can be believed, over all updates but those of the first 2 s.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StateTruth {
    /// Of the updates that were LOCALIZED, the share within 0.2 m and 2 deg of the truth; None without any.
    pub precision: Option<f64>,
    /// Of the updates within 0.2 m and 2 deg of the truth, the share that was LOCALIZED; None without any.
    pub recall: Option<f64>,
    /// Updates that were LOST though within 0.2 m and 2 deg of the truth.
    pub false_lost: usize,
    /// Updates further off than 1 m that were LOCALIZED.
    pub false_localized: usize,
}

/// A change of the state.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StateChange {
    /// When, from the first scan on [s].
    pub at_s: f64,
    /// The state from then on.
    pub state: State,
    /// True when the estimate was within 0.2 m and 2 deg of the truth; None where that is not known.
    pub right: Option<bool>,
}

/// What the state said to a fault.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FaultReport {
    /// The fault.
    pub fault: String,
    /// From its begin until LOST was said; None when it never was, up to the next fault [s].
    pub lost_after_s: Option<f64>,
    /// From its begin until STALE was said; None when it never was [s].
    pub stale_after_s: Option<f64>,
    /// From its begin until the car was LOCALIZED again after either of them; None when it never was [s].
    pub localized_after_s: Option<f64>,
}

impl FaultReport {
    /// From the changes of the state, of which those until `until` [s] count.
    pub fn new(fault: &Fault, until: f64, changes: &[StateChange]) -> Self {
        let during = || {
            changes
                .iter()
                .filter(move |change| (fault.at..until).contains(&change.at_s))
        };
        let first = |state: State| {
            let change = during().find(|change| change.state == state);
            change.map(|change| change.at_s - fault.at)
        };
        let (lost, stale) = (first(State::Lost), first(State::Stale));
        let bad = lost.into_iter().chain(stale).reduce(f64::min);
        Self {
            fault: fault.to_string(),
            lost_after_s: lost,
            stale_after_s: stale,
            localized_after_s: bad.and_then(|bad| {
                during()
                    .map(|change| (change.at_s - fault.at, change.state))
                    .find(|(at, state)| *at > bad && *state == State::Localized)
                    .map(|(at, _)| at)
            }),
        }
    }
}

/// Collects states, update by update.
#[derive(Debug, Default)]
pub struct States {
    changes: Vec<StateChange>,
    first: Option<Stamp>,
    counts: BTreeMap<State, usize>,
    judged: usize,
    right: usize,
    localized: usize,
    localized_and_right: usize,
    false_lost: usize,
    false_localized: usize,
}

impl States {
    /// Adds an update.
    pub fn push(&mut self, stamp: Stamp, state: State, estimate: Pose, truth: Option<Pose>) {
        *self.counts.entry(state).or_default() += 1;
        let right = truth.map(|truth| right(estimate, truth));
        self.change(stamp, state, right);
        let first = *self.first.get_or_insert(stamp);
        let Some(truth) = truth.filter(|_| stamp.since(first) >= SETTLING) else {
            return;
        };
        let distance = estimate.distance(truth);
        let right = right.unwrap_or_default();
        let localized = state == State::Localized;
        self.judged += 1;
        self.right += usize::from(right);
        self.localized += usize::from(localized);
        self.localized_and_right += usize::from(localized && right);
        self.false_lost += usize::from(state == State::Lost && right);
        self.false_localized += usize::from(localized && distance > 1.0);
    }

    /// Takes note of the state between two updates, as when the sensors fall silent.
    pub fn change(&mut self, stamp: Stamp, state: State, right: Option<bool>) {
        let first = *self.first.get_or_insert(stamp);
        if self.changes.last().is_none_or(|change| change.state != state) {
            self.changes.push(StateChange {
                at_s: stamp.since(first),
                state,
                right,
            });
        }
    }

    /// Every change of the state.
    pub fn changes(&self) -> &[StateChange] {
        &self.changes
    }

    /// How often a state was entered.
    pub fn entered(&self, state: State) -> usize {
        self.changes.iter().filter(|change| change.state == state).count()
    }

    /// Share of the updates in each state.
    pub fn shares(&self) -> BTreeMap<State, f64> {
        let all: usize = self.counts.values().sum();
        self.counts
            .iter()
            .map(|(state, count)| (*state, *count as f64 / all as f64))
            .collect()
    }

    /// What the states are worth; None without truth.
    pub fn truth(&self) -> Option<StateTruth> {
        let share = |part: usize, whole: usize| (whole > 0).then(|| part as f64 / whole as f64);
        (self.judged > 0).then(|| StateTruth {
            precision: share(self.localized_and_right, self.localized),
            recall: share(self.localized_and_right, self.right),
            false_lost: self.false_lost,
            false_localized: self.false_localized,
        })
    }
}

/// Whether an estimate is what LOCALIZED promises.
fn right(estimate: Pose, truth: Pose) -> bool {
    estimate.distance(truth) < POSITION && wrap_angle(estimate.heading - truth.heading).abs() < HEADING
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn precision_and_recall_count_what_they_should() {
        let mut states = States::default();
        let at = |second: i64| Stamp(second * 1_000_000_000);
        let (near, far) = (Pose::new(0.1, 0.0, 0.0), Pose::new(1.5, 0.0, 0.0));
        let truth = Some(Pose::IDENTITY);
        states.push(at(0), State::Converging, far, truth);
        states.push(at(2), State::Localized, near, truth);
        states.push(at(3), State::Degraded, near, truth);
        states.push(at(4), State::Lost, near, truth);
        states.push(at(5), State::Localized, far, truth);
        states.push(at(6), State::Localized, Pose::new(0.0, 0.0, 0.1), truth);
        states.push(at(7), State::Localized, far, None);
        let judged = states.truth().expect("judged");
        assert_eq!(judged.precision, Some(1.0 / 3.0));
        assert_eq!(judged.recall, Some(1.0 / 3.0));
        assert_eq!((judged.false_lost, judged.false_localized), (1, 1));
        assert!((states.shares()[&State::Localized] - 4.0 / 7.0).abs() < 1e-12);
    }
}
