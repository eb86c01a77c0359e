//! Answers given, so that a command sent again is answered again and not done again.

use std::collections::VecDeque;

use protocol::{Answer, CommandId};
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::xxh3_64;

/// Answers remembered: an operator repeats within seconds, not after hundreds of other commands.
const MOST: usize = 512;

/// Tells one command from another under the same id: a hash of all that it says.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Print(u64);

impl Print {
    /// Of a command's payload.
    pub fn of(payload: &[u8]) -> Self {
        Self(xxh3_64(payload))
    }
}

/// An answer, and what to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Answered {
    /// The answer.
    #[serde(flatten)]
    pub answer: Answer,
    /// The command; None in files from before this was kept.
    #[serde(default)]
    pub print: Option<Print>,
}

/// The last answers.
#[derive(Debug, Default)]
pub(super) struct Answers(VecDeque<Answered>);

impl Answers {
    /// With those that were kept over a restart.
    pub(super) fn kept(answers: impl Iterator<Item = Answered>) -> Self {
        Self(answers.collect())
    }

    /// The answer given under this id.
    pub(super) fn find(&self, id: CommandId) -> Option<&Answered> {
        self.0.iter().rev().find(|given| given.answer.id == id)
    }

    /// Remembers an answer.
    pub(super) fn remember(&mut self, given: Answered) {
        if self.0.len() >= MOST {
            self.0.pop_front();
        }
        self.0.push_back(given);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::{Outcome, Reply, SetRef};

    fn given(id: u128) -> Answered {
        Answered {
            answer: Answer {
                id: CommandId(id),
                outcome: Outcome::Done {
                    update: None,
                    reply: Reply::Nothing,
                },
                set: SetRef {
                    name: "hq".into(),
                    revision: 1,
                },
            },
            print: Some(Print::of(&id.to_le_bytes())),
        }
    }

    #[test]
    fn a_file_from_before_commands_were_told_apart_is_read() {
        let given = given(u128::MAX);
        let text = serde_json::to_string(&given).expect("writes");
        assert_eq!(serde_json::from_str::<Answered>(&text).expect("reads"), given);
        let old = serde_json::to_string(&given.answer).expect("writes");
        let read: Answered = serde_json::from_str(&old).expect("reads");
        assert_eq!((read.answer, read.print), (given.answer, None));
    }

    #[test]
    fn the_last_answers_are_found_and_the_oldest_forgotten() {
        let mut answers = Answers::default();
        for id in 0..=MOST as u128 {
            answers.remember(given(id));
        }
        assert!(answers.find(CommandId(0)).is_none());
        assert!(answers.find(CommandId(1)).is_some());
        assert!(answers.find(CommandId(MOST as u128)).is_some());
    }
}
