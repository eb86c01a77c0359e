//! The state of a car that survives a restart.

use std::collections::{BTreeMap, VecDeque};

use serde::{Deserialize, Serialize};

use super::answer_cache::CachedAnswer;
use crate::localization::LocalizerParameters;

/// Answers that survive a restart.
const MOST_ANSWERS: usize = 64;

/// A set that an operator has put on the car.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SavedSet {
    /// The values.
    pub parameters: LocalizerParameters,
    /// Who put it there.
    pub who: String,
}

/// The parameter sets and answers that a car keeps over a restart.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PersistedState {
    /// Changes of the set in force since the car was first set up.
    pub revision: u64,
    /// The set to start with: the last one in force that no pending trial can revert.
    pub settled: Option<String>,
    /// The sets that were put on the car, by name.
    pub sets: BTreeMap<String, SavedSet>,
    /// The last answers to commands that changed a set, newest last. A command repeated after a restart gets its answer
    /// again and is not executed again.
    #[serde(default)]
    pub answers: VecDeque<CachedAnswer>,
}

impl PersistedState {
    /// Keeps an answer over a restart, and removes the oldest one if there are too many.
    pub fn push_answer(&mut self, answer: CachedAnswer) {
        if self.answers.len() >= MOST_ANSWERS {
            self.answers.pop_front();
        }
        self.answers.push_back(answer);
    }
}
