//! Answers to commands.

use serde::{Deserialize, Serialize};

use crate::{CommandId, Message, ParameterSet, Pose2, Rates, Schema, SetRef};

/// What became of a command. No answer at all is an outcome of its own, which the asker sees by the clock.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// The command's id.
    pub id: CommandId,
    /// What became of it.
    pub outcome: Outcome,
    /// The set in force after it.
    pub set: SetRef,
}

/// What became of a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// Done.
    Done {
        /// The first filter update under it; None where the filter was not concerned, or has not run yet.
        update: Option<u64>,
        /// What was asked for.
        reply: Reply,
    },
    /// Not done, and nothing has changed.
    Refused {
        /// Every fault, in words.
        faults: Vec<String>,
    },
    /// Not done, because the set in force is not at the expected revision.
    StaleRevision {
        /// The revision that the command expected.
        expected: u64,
        /// Who put the one in force.
        who: String,
    },
}

/// What a command asked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reply {
    /// Nothing.
    Nothing,
    /// All sets on the car.
    Sets(Vec<StoredSet>),
    /// Where the car may be, the best first.
    Candidates(Vec<Candidate>),
    /// The telemetry rates.
    Rates(Rates),
}

/// A set on a car.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoredSet {
    /// The set, every value given.
    pub set: ParameterSet,
    /// True for a set that ships with the node and cannot be deleted or overwritten.
    pub built_in: bool,
    /// Who put it there; None for one that ships.
    pub who: Option<String>,
}

/// A place where the car may be.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    /// Tells it from the others of this search; the best is 1.
    pub number: u32,
    /// `map_from_base_link`.
    pub pose: Pose2,
    /// How likely the last scans are there, per beam, in `[0, 1]`; only good for comparing candidates.
    pub score: f32,
}

impl Message for Answer {
    const SCHEMA: Schema = Schema::Answer;
    const MAX_LEN: usize = 1024 * 1024;
}
