//! Commands from other threads to the filter.

use crossbeam_channel::Sender;
use maps::Pose;
use protocol::SetRef;
use synpf::{Hypothesis, Localizer, PreparedParameters};

/// The way in which a parameter set is put in force. Another thread has already done everything that takes time.
#[derive(Debug)]
pub enum LocalizerChange {
    /// The localizer takes the set and keeps its state.
    Tune(PreparedParameters),
    /// A localizer of another kind, with its own set and without a pose. It continues from the pose of the one before.
    Replace(Box<dyn Localizer>),
}

/// A command that the filter executes between two updates. A reply's number is the first update under the change.
#[derive(Debug)]
pub enum FilterCommand {
    /// Swap the parameter set.
    SetParameters {
        /// The set's name and revision, for proposals, laps and the shadow.
        set: SetRef,
        /// How the localizer changes.
        change: LocalizerChange,
        /// Receives the update.
        reply: Sender<Result<u64, String>>,
    },
    /// Start again from a pose.
    Initialize {
        /// `map_from_base_link`.
        pose: Pose,
        /// Receives the update.
        reply: Sender<Result<u64, String>>,
    },
    /// Search the whole map.
    Relocalize {
        /// Receives the update.
        reply: Sender<u64>,
    },
    /// List the candidates that a search has found so far, best first.
    Candidates {
        /// Receives the candidates.
        reply: Sender<Vec<Hypothesis>>,
    },
    /// Start from one of the candidates that were last listed.
    SelectCandidate {
        /// Counted from 1.
        number: usize,
        /// Receives the update, and the candidate's pose now.
        reply: Sender<Result<(u64, Pose), String>>,
    },
}
