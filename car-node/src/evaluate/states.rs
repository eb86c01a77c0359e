//! How often the health states are right, compared with the truth.

use std::collections::BTreeMap;

use maps::{Pose, wrap_angle};
use serde::Serialize;
use synpf::Stamp;

use super::Fault;
use super::errors::SETTLING;
use crate::health::State;

/// LOCALIZED is right within this distance of the truth \[m\].
const POSITION: f64 = 0.2;
/// LOCALIZED is right within this angle of the truth \[rad\].
const HEADING: f64 = 2.0 * std::f64::consts::PI / 180.0;

/// How often LOCALIZED and LOST are right, over all updates but those of the first 2 s.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StateTruth {
    /// Of the updates that were LOCALIZED, the share within 0.2 m and 2 deg of the truth; None without any.
    pub precision: Option<f64>,
    /// Of the updates within 0.2 m and 2 deg of the truth, the share that was LOCALIZED; None without any.
    pub recall: Option<f64>,
    /// Updates in state LOST within 0.2 m and 2 deg of the truth.
    pub false_lost: usize,
    /// Updates in state LOCALIZED more than 1 m from the truth.
    pub false_localized: usize,
}

/// A change of the state.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StateChange {
    /// Time since the first scan \[s\].
    pub at_s: f64,
    /// The new state.
    pub state: State,
    /// True when the estimate was within 0.2 m and 2 deg of the truth; None where that is not known.
    pub right: Option<bool>,
}

/// How the health state reacted to a fault.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FaultReport {
    /// The fault.
    pub fault: String,
    /// Time from its start to LOST \[s\]; None if the state was not LOST before the next fault.
    pub lost_after_s: Option<f64>,
    /// Time from its start to STALE \[s\]; None if the state was not STALE.
    pub stale_after_s: Option<f64>,
    /// Time from its start to LOCALIZED after LOST or STALE \[s\]; None if the car was not LOCALIZED again.
    pub localized_after_s: Option<f64>,
}

impl FaultReport {
    /// From the changes of the state before `until` \[s\].
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

    /// Records a change of the state between two updates, as when the sensors are silent.
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

    /// How often the states were right; None without truth.
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

/// True when an estimate is as near to the truth as LOCALIZED requires.
fn right(estimate: Pose, truth: Pose) -> bool {
    estimate.distance(truth) < POSITION && wrap_angle(estimate.heading - truth.heading).abs() < HEADING
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn precision_and_recall_count_the_right_updates() {
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
