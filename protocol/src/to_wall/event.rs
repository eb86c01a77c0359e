//! What happened on a car.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::older_event;
use crate::codec::Payload;
use crate::{Cause, CodecError, CommandId, Message, Pose2, Rates, Schema, Severity, State, Value};

/// Something that happened at the header's sensor time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// What happened.
    pub kind: EventKind,
    /// The last filter update before it; 0 before the first.
    pub update: u64,
    /// Who caused it: an operator's name, `auto`, or None for the car itself.
    pub who: Option<String>,
    /// The command that caused it.
    pub command: Option<CommandId>,
}

/// A parameter set by name, at a revision.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SetRef {
    /// The set's name.
    pub name: String,
    /// The revision, see [`Params::revision`](crate::Params::revision).
    pub revision: u64,
}

/// A parameter that has another value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ValueChange {
    /// The parameter.
    pub key: String,
    /// Its value before.
    pub before: Value,
    /// Its value now.
    pub after: Value,
}

impl fmt::Display for ValueChange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} -> {}", self.key, self.before, self.after)
    }
}

/// The kinds of event.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// The node started.
    Started {
        /// Its version.
        version: String,
    },
    /// The node stops. This is the last message of its run; it answers queries for missing messages for a while.
    Stopping {
        /// Why.
        reason: String,
    },
    /// The health state changed.
    StateChanged {
        /// Before.
        from: State,
        /// Now.
        to: State,
        /// Why, the worst first.
        causes: Vec<Cause>,
    },
    /// Another set is in force.
    ParametersChanged {
        /// Before.
        from: SetRef,
        /// Now.
        to: SetRef,
        /// The first filter update under it.
        update: u64,
        /// The car falls back by itself after this time unless the set is confirmed \[s\].
        revert_after: Option<f32>,
    },
    /// The set in force was confirmed: the car will not fall back by itself.
    ParametersConfirmed {
        /// The set.
        set: SetRef,
    },
    /// The car fell back to the earlier set by itself, because nobody confirmed the new one.
    ParametersFellBack {
        /// Before.
        from: SetRef,
        /// Now.
        to: SetRef,
        /// The first filter update under it.
        update: u64,
    },
    /// A set was stored on the car.
    SetStored {
        /// Its name.
        name: String,
        /// The set that `changes` compare it with. A replaced set is compared with its old values; a new set with the set in
        /// force, which it takes the remaining values from. Empty where a car of an older version did not send it.
        from: String,
        /// Every value that differs.
        changes: Vec<ValueChange>,
    },
    /// A set was deleted from the car.
    SetDeleted {
        /// Its name.
        name: String,
    },
    /// A pose to start from was given.
    PoseInitialized {
        /// The estimate before, if there was one.
        before: Option<Pose2>,
        /// `map_from_base_link`.
        pose: Pose2,
    },
    /// A search of the whole map began.
    SearchStarted,
    /// A search of the whole map ended with a pose.
    Relocalized {
        /// `map_from_base_link`.
        pose: Pose2,
    },
    /// The start line was crossed.
    Lap {
        /// The lap that ended, from 1.
        lap: u32,
        /// Its time \[s\]; None for the first crossing, which ends no whole lap.
        time: Option<f64>,
        /// The set in force at its end.
        set: String,
    },
    /// The wheels began to slip.
    SlipStarted {
        /// See [`Metrics::slip`](crate::Metrics::slip).
        slip: f32,
    },
    /// The wheels grip again.
    SlipEnded {
        /// The worst in between, see [`Metrics::slip`](crate::Metrics::slip).
        worst: f32,
        /// How long it lasted \[s\].
        duration: f32,
    },
    /// The car proposes another set.
    Proposed {
        /// That set.
        set: String,
        /// Why.
        evidence: String,
    },
    /// Automatic switching was turned on or off.
    AutoChanged {
        /// On.
        on: bool,
    },
    /// The telemetry rates were changed.
    RatesChanged {
        /// Before.
        from: Rates,
        /// Now.
        to: Rates,
    },
    /// A command was refused.
    CommandRefused {
        /// Every reason.
        faults: Vec<String>,
    },
    /// A bag or a race came to its end.
    SourceEnded,
    /// Something is wrong; the car goes on.
    Warning {
        /// What is wrong.
        text: String,
    },
    /// Something failed.
    Error {
        /// What is wrong.
        text: String,
    },
    /// A second set runs on the same scans as the set in force.
    ShadowStarted {
        /// That set.
        set: String,
    },
    /// The second set was ended on request.
    ShadowEnded {
        /// That set.
        set: String,
    },
    /// The car ended the second set, because there was not enough CPU for both.
    ShadowDropped {
        /// That set.
        set: String,
        /// Why, in words with numbers.
        evidence: String,
    },
    /// The link is slow: the car sends less than requested.
    RatesLowered {
        /// From publishing a pose to its arrival \[s\].
        transit: f32,
        /// Poses per second now \[Hz\].
        pose: f32,
        /// True while the full-rate streams for the recorder go on. Otherwise the car keeps them and sends them when the link
        /// allows.
        recorded: bool,
    },
    /// The link has recovered: the car sends what was requested.
    RatesRestored,
    /// The car records on its own disk from here.
    RecordingStarted {
        /// Number of the first file.
        file: u64,
    },
    /// The recording on the car has ended.
    RecordingEnded {
        /// Why.
        reason: String,
    },
}

impl EventKind {
    /// How severe it is.
    pub fn severity(&self) -> Severity {
        match self {
            Self::StateChanged { to, .. } => match to {
                State::Lost | State::Stale => Severity::Critical,
                State::Degraded | State::Relocalizing => Severity::Warning,
                State::Init | State::Converging | State::Localized => Severity::Info,
            },
            Self::Error { .. } => Severity::Critical,
            Self::ParametersFellBack { .. }
            | Self::SearchStarted
            | Self::SlipStarted { .. }
            | Self::Proposed { .. }
            | Self::CommandRefused { .. }
            | Self::ShadowDropped { .. }
            | Self::RatesLowered { .. }
            | Self::Stopping { .. }
            | Self::Warning { .. } => Severity::Warning,
            _ => Severity::Info,
        }
    }
}

impl fmt::Display for EventKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let set = |set: &SetRef| format!("{} (revision {})", set.name, set.revision);
        let pose = |p: &Pose2| format!("({:.2}, {:.2}) m, {:.1} deg", p.x, p.y, p.heading.to_degrees());
        match self {
            Self::Started { version } => write!(f, "node started, version {version}"),
            Self::Stopping { reason } => write!(f, "node stopping: {reason}"),
            Self::StateChanged { from, to, causes } => {
                write!(f, "{from} -> {to}")?;
                for (i, cause) in causes.iter().enumerate() {
                    write!(f, "{} {cause}", if i == 0 { ":" } else { ";" })?;
                }
                Ok(())
            }
            Self::ParametersChanged {
                from,
                to,
                update,
                revert_after,
            } => {
                write!(f, "set {} replaces {} from update {update}", set(to), set(from))?;
                match revert_after {
                    Some(seconds) => write!(f, "; falls back after {seconds:.0} s unless confirmed"),
                    None => Ok(()),
                }
            }
            Self::ParametersConfirmed { set: name } => write!(f, "set {} confirmed", set(name)),
            Self::ParametersFellBack { from, to, update } => {
                let (from, to) = (set(from), set(to));
                write!(f, "{from} was not confirmed: back to {to} from update {update}")
            }
            Self::SetStored { name, from, changes } => fmt_stored(f, name, from, changes),
            Self::SetDeleted { name } => write!(f, "set {name} deleted"),
            Self::PoseInitialized { before, pose: at } => {
                write!(f, "initial pose {}", pose(at))?;
                match before {
                    Some(before) => write!(f, ", was {}", pose(before)),
                    None => Ok(()),
                }
            }
            Self::SearchStarted => f.write_str("searching the whole map"),
            Self::Relocalized { pose: at } => write!(f, "relocalized at {}", pose(at)),
            Self::Lap { lap, time, set } => match time {
                Some(time) => write!(f, "lap {lap}: {time:.3} s on {set}"),
                None => write!(f, "start line crossed, on {set}"),
            },
            Self::SlipStarted { slip } => write!(f, "wheels slip, {:.0} %", slip * 100.0),
            Self::SlipEnded { worst, duration } => {
                write!(
                    f,
                    "wheels grip again after {duration:.1} s, worst slip {:.0} %",
                    worst * 100.0
                )
            }
            Self::Proposed { set, evidence } => write!(f, "proposes {set}: {evidence}"),
            Self::AutoChanged { on } => {
                write!(f, "automatic switching {}", if *on { "on" } else { "off" })
            }
            Self::RatesChanged { from, to } => write!(f, "telemetry rates: {to}; were: {from}"),
            Self::CommandRefused { faults } => write!(f, "command refused: {}", faults.join("; ")),
            Self::SourceEnded => f.write_str("end of the sensor data"),
            Self::Warning { text } | Self::Error { text } => f.write_str(text),
            Self::ShadowStarted { set } => write!(f, "{set} runs in the shadow"),
            Self::ShadowEnded { set } => write!(f, "{set} no longer runs in the shadow"),
            Self::ShadowDropped { set, evidence } => write!(f, "shadow {set} dropped: {evidence}"),
            Self::RatesLowered {
                transit,
                pose,
                recorded,
            } => {
                let rest = if *recorded {
                    "less of everything else"
                } else {
                    "full-rate streams when the link allows"
                };
                write!(
                    f,
                    "slow link, poses arrive after {transit:.2} s: sends {pose:.0} poses per second and {rest}"
                )
            }
            Self::RatesRestored => f.write_str("link recovered: requested rates again"),
            Self::RecordingStarted { file } => write!(f, "recording on the car, from file {file}"),
            Self::RecordingEnded { reason } => write!(f, "recording on the car ended: {reason}"),
        }
    }
}

/// Values of a stored set that the text lists.
const LISTED: usize = 8;

fn fmt_stored(f: &mut fmt::Formatter<'_>, name: &str, from: &str, changes: &[ValueChange]) -> fmt::Result {
    if from.is_empty() {
        return write!(f, "set {name} stored");
    }
    let (stored, but) = if from == name {
        (format!("set {name} replaced"), ": ")
    } else {
        (format!("set {name} stored from {from}"), " with ")
    };
    if changes.is_empty() {
        return write!(f, "{stored}: no value differs");
    }
    let listed: Vec<_> = changes.iter().take(LISTED).map(ToString::to_string).collect();
    write!(f, "{stored}{but}{}", listed.join(", "))?;
    match changes.len() - listed.len() {
        0 => Ok(()),
        more => write!(f, " and {more} more"),
    }
}

impl Message for Event {
    const SCHEMA: Schema = Schema::Event;
    /// Version 2 added the pose and the rates before a change, and whether the full-rate streams go on over a slow link.
    /// Version 3 added the values in which a stored set differs.
    const VERSION: u16 = 3;

    fn older(version: u16, payload: &Payload<'_>) -> Option<Result<Self, CodecError>> {
        older_event::read(version, payload)
    }
}
