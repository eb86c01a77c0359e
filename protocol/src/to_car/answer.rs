//! Answers to commands.

use serde::{Deserialize, Serialize};

use crate::{CommandId, Message, ParameterSet, Pose2, Rates, RecorderState, Schema, SetRef};

/// The answer to a command. If none arrives in time, the sender has to treat that as a fourth outcome.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// The command's id.
    pub id: CommandId,
    /// The outcome.
    pub outcome: Outcome,
    /// The set in force after it.
    pub set: SetRef,
}

/// The outcome of a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// Done.
    Done {
        /// The first filter update under it. None where the command does not concern the filter, or the filter has not run.
        update: Option<u64>,
        /// The data requested.
        reply: Reply,
    },
    /// Not done, and nothing has changed.
    Refused {
        /// Every reason, in words.
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

/// The data that a command requested.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reply {
    /// Nothing.
    Nothing,
    /// All sets on the car.
    Sets(Vec<StoredSet>),
    /// Possible poses of the car, the best first.
    Candidates(Vec<Candidate>),
    /// The telemetry rates.
    Rates(Rates),
    /// The recording on the car.
    Recorder(RecorderState),
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

/// A possible pose of the car.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    /// Number within this search; the best has 1.
    pub number: u32,
    /// `map_from_base_link`.
    pub pose: Pose2,
    /// Likelihood of the last scans at this pose, per beam, in `[0, 1]`. Only differences between candidates mean something.
    pub score: f32,
}

impl Message for Answer {
    const SCHEMA: Schema = Schema::Answer;
    const MAX_LEN: usize = 1024 * 1024;
}
