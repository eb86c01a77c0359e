//! Commands.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::to_wall::set_name;
use crate::{Invalid, Message, ParameterSet, Pose2, Schema, Topic};

/// A command to a car. The car executes it once; sent again with the same id, it only gets the same answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Command {
    /// Unique id of this command.
    pub id: CommandId,
    /// Who gives it, at most [`Command::MAX_OPERATOR`] bytes.
    pub operator: String,
    /// Execute the command only if the set in force has this revision. None: at any revision.
    pub expected_revision: Option<u64>,
    /// What to do.
    pub action: Action,
}

impl Command {
    /// Longest name of an operator \[bytes\].
    pub const MAX_OPERATOR: usize = 64;
}

/// What to do. Each action has its own topic, so that a router can restrict who may send it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Action {
    /// Under [`Topic::CmdParams`].
    Params(ParamsAction),
    /// Under [`Topic::CmdPose`]: the initial pose `map_from_base_link`, valid now.
    Pose(Pose2),
    /// Under [`Topic::CmdRelocalize`].
    Relocalize(RelocalizeAction),
    /// Under [`Topic::CmdRates`].
    Rates(RatesAction),
    /// Under [`Topic::CmdAuto`]: turn automatic switching of sets on or off.
    Auto(bool),
    /// Under [`Topic::CmdRecord`].
    Record(RecordAction),
}

impl Action {
    /// The topic under which it is sent.
    pub fn topic(&self) -> Topic {
        match self {
            Self::Params(_) => Topic::CmdParams,
            Self::Pose(_) => Topic::CmdPose,
            Self::Relocalize(_) => Topic::CmdRelocalize,
            Self::Rates(_) => Topic::CmdRates,
            Self::Auto(_) => Topic::CmdAuto,
            Self::Record(_) => Topic::CmdRecord,
        }
    }
}

/// About parameter sets.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ParamsAction {
    /// Put a set of the car in force.
    Select {
        /// Its name.
        name: String,
        /// Fall back by itself after this time unless confirmed \[ms\].
        revert_after_ms: Option<u32>,
    },
    /// Store a set on the car and put it in force. It replaces a stored set of the same name.
    Put {
        /// The set. Values that are not given are taken from the set in force.
        set: ParameterSet,
        /// Fall back by itself after this time unless confirmed \[ms\].
        revert_after_ms: Option<u32>,
    },
    /// Keep the set in force: do not fall back.
    Confirm,
    /// Go back to the set that was in force before.
    Revert,
    /// Delete a set that was put on the car.
    Delete {
        /// Its name.
        name: String,
    },
    /// Answer with all sets.
    List,
    /// Run a set of the car as the shadow set, in place of the present one; None ends it.
    Shadow {
        /// Its name.
        name: Option<String>,
    },
}

/// About global relocalization.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RelocalizeAction {
    /// Search the whole map; answer with the candidates, the best first, and follow the best one.
    Search,
    /// Follow another candidate of the last search.
    Pick {
        /// Its [`Candidate::number`](crate::Candidate::number).
        candidate: u32,
    },
}

/// About the recording on the car.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordAction {
    /// Answer with the state.
    Get,
    /// Start to record; nothing changes while the car records.
    Start,
    /// Complete the file and stop; nothing changes while the car does not record.
    Stop,
}

/// About telemetry rates.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RatesAction {
    /// Answer with the rates.
    Get,
    /// Set all rates.
    Set(Rates),
}

/// The rates of a car's telemetry.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rates {
    /// Most poses per second \[Hz\]; 0 for none, 1000 for every pose.
    pub pose: f32,
    /// Clouds per second \[Hz\].
    pub cloud: f32,
    /// Scan views per second \[Hz\].
    pub scan: f32,
    /// Health messages per second \[Hz\], in addition to one on each change of state.
    pub health: f32,
    /// Send the full-rate streams for the recorder.
    pub recorded: bool,
}

impl Rates {
    /// Highest rate that can be set \[Hz\].
    pub const MAX: f32 = 1000.0;
}

impl fmt::Display for Rates {
    /// `every pose, cloud 10 Hz, no scan, health 10 Hz, full-rate streams on`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (what, rate) in [
            ("pose", self.pose),
            ("cloud", self.cloud),
            ("scan", self.scan),
            ("health", self.health),
        ] {
            if rate <= 0.0 {
                write!(f, "no {what}, ")?;
            } else if rate >= Self::MAX {
                write!(f, "every {what}, ")?;
            } else {
                write!(f, "{what} {rate} Hz, ")?;
            }
        }
        write!(
            f,
            "full-rate streams {}",
            if self.recorded { "on" } else { "off" }
        )
    }
}

impl Message for Command {
    const SCHEMA: Schema = Schema::Command;

    fn validate(&self) -> Result<(), Invalid> {
        if self.operator.is_empty() {
            return Err(Invalid::new("operator", "is empty"));
        }
        Invalid::unless_at_most("operator", self.operator.len(), Self::MAX_OPERATOR)?;
        match &self.action {
            Action::Params(
                ParamsAction::Select { name, .. }
                | ParamsAction::Delete { name }
                | ParamsAction::Shadow { name: Some(name) },
            ) => set_name("name", name),
            Action::Params(ParamsAction::Put { set, .. }) => set.validate(),
            Action::Rates(RatesAction::Set(rates)) => [
                ("pose", rates.pose),
                ("cloud", rates.cloud),
                ("scan", rates.scan),
                ("health", rates.health),
            ]
            .into_iter()
            .find(|(_, rate)| !(0.0..=Rates::MAX).contains(rate))
            .map_or(Ok(()), |(field, rate)| {
                Err(Invalid::new(
                    field,
                    format!("{rate} Hz is not between 0 and {} Hz", Rates::MAX),
                ))
            }),
            _ => Ok(()),
        }
    }
}

/// Unique id of a command: 128 random bits, 32 hexadecimal digits in text.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CommandId(pub u128);

impl fmt::Display for CommandId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", self.0)
    }
}

/// Not 32 hexadecimal digits.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("command id {0:?} is not 32 hexadecimal digits")]
pub struct IdError(String);

impl FromStr for CommandId {
    type Err = IdError;

    fn from_str(text: &str) -> Result<Self, IdError> {
        if text.len() == 32 && text.bytes().all(|b| b.is_ascii_hexdigit()) {
            u128::from_str_radix(text, 16)
                .map(Self)
                .map_err(|_| IdError(text.to_owned()))
        } else {
            Err(IdError(text.to_owned()))
        }
    }
}

// Digits in formats for people, such as JSON; 16 bytes in binary formats.
impl Serialize for CommandId {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            serializer.collect_str(self)
        } else {
            self.0.to_le_bytes().serialize(serializer)
        }
    }
}

impl<'de> Deserialize<'de> for CommandId {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        if deserializer.is_human_readable() {
            let text = String::deserialize(deserializer)?;
            text.parse().map_err(serde::de::Error::custom)
        } else {
            <[u8; 16]>::deserialize(deserializer).map(|bytes| Self(u128::from_le_bytes(bytes)))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn parse_undoes_format(id: u128) {
            prop_assert_eq!(CommandId(id).to_string().parse(), Ok(CommandId(id)));
        }
    }

    #[test]
    fn other_text_is_no_id() {
        for text in ["", "1", "+0000000000000000000000000000001", &"g".repeat(32)] {
            assert!(text.parse::<CommandId>().is_err(), "{text}");
        }
    }
}
