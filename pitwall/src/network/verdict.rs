//! The outcome of a command.

use std::time::Duration;

use protocol::{Answer, CarName, Command, Outcome, decode};
use serde::Serialize;

/// The outcome of a command, as the operator sees it.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "snake_case", tag = "verdict")]
pub enum Verdict {
    /// The car has answered: done, refused, or stale revision.
    Answered {
        /// The answer.
        answer: Answer,
        /// From the command to the answer \[s\].
        after_s: f64,
    },
    /// No car of this name is connected. Nothing has changed.
    NoSuchCar,
    /// The car was connected and has not answered in time. It may or may not have executed the command. Check the set in
    /// force, or send the same command again, which is harmless.
    NoAnswer {
        /// How long the program waited \[s\].
        waited_s: f64,
        /// True when the car has disconnected in the meantime.
        gone: bool,
    },
    /// The answer cannot be decoded. The car may or may not have executed the command.
    Unreadable {
        /// Why.
        error: String,
    },
}

impl Verdict {
    /// The verdict from a car's reply to `command`.
    pub(super) fn of(command: &Command, reply: &[u8], after: Duration) -> Self {
        match decode::<Answer>(reply) {
            Ok((_, answer)) if answer.id == command.id => Self::Answered {
                answer,
                after_s: after.as_secs_f64(),
            },
            Ok((_, answer)) => Self::Unreadable {
                error: format!("it answers command {} instead of {}", answer.id, command.id),
            },
            Err(error) => Self::Unreadable {
                error: error.to_string(),
            },
        }
    }

    /// The exit code of a program that sent the command: 0 done, 3 refused, 4 no such car, 5 no answer, 6 stale
    /// revision.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Answered { answer, .. } => match answer.outcome {
                Outcome::Done { .. } => 0,
                Outcome::Refused { .. } => 3,
                Outcome::StaleRevision { .. } => 6,
            },
            Self::NoSuchCar => 4,
            Self::NoAnswer { .. } | Self::Unreadable { .. } => 5,
        }
    }

    /// The outcome and the next step, for the operator.
    pub fn text(&self, car: &CarName) -> String {
        match self {
            Self::Answered { answer, after_s } => {
                let set = format!("{} (revision {})", answer.set.name, answer.set.revision);
                match &answer.outcome {
                    Outcome::Done { update, .. } => {
                        let since =
                            update.map_or_else(String::new, |update| format!(" from update {update}"));
                        let after = after_s * 1e3;
                        format!("{car}: done{since}; set in force is {set}; answered in {after:.0} ms")
                    }
                    Outcome::Refused { faults } => {
                        let faults = faults.join("\n  ");
                        format!("{car}: REFUSED, nothing has changed; set in force is {set}:\n  {faults}")
                    }
                    Outcome::StaleRevision { expected, who } => format!(
                        "{car}: REVISION CONFLICT, nothing has changed: expected revision {expected}, but {who} has \
                         put {set} in force. Check it, then give the command again"
                    ),
                }
            }
            Self::NoSuchCar => {
                format!(
                    "{car}: NO SUCH CAR connected, nothing has changed. `pitwall cars` lists the connected cars"
                )
            }
            Self::NoAnswer { waited_s, gone } => {
                let when = if *gone { " when it is back" } else { "" };
                let gone = if *gone { " and has disconnected" } else { "" };
                format!(
                    "{car}: NO ANSWER within {waited_s:.1} s{gone}; it may or may not have been done. See \
                     `pitwall params {car}`{when}, or give the command again: that is harmless"
                )
            }
            Self::Unreadable { error } => format!(
                "{car}: the ANSWER CANNOT BE READ ({error}); it may or may not have been done. Do car and pit wall \
                 have the same version?"
            ),
        }
    }
}
