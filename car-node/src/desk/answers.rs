//! Answers given, so that a command sent again is answered again and not done again.

use std::collections::VecDeque;

use protocol::{Answer, CommandId};

/// Answers remembered: an operator repeats within seconds, not after hundreds of other commands.
const MOST: usize = 512;

/// The last answers.
#[derive(Debug, Default)]
pub(super) struct Answers(VecDeque<Answer>);

impl Answers {
    /// With those that were kept over a restart.
    pub(super) fn kept(answers: impl Iterator<Item = Answer>) -> Self {
        Self(answers.collect())
    }

    /// The answer given to this command.
    pub(super) fn find(&self, id: CommandId) -> Option<&Answer> {
        self.0.iter().rev().find(|answer| answer.id == id)
    }

    /// Remembers an answer.
    pub(super) fn remember(&mut self, answer: Answer) {
        if self.0.len() >= MOST {
            self.0.pop_front();
        }
        self.0.push_back(answer);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::{Outcome, Reply, SetRef};

    #[test]
    fn the_last_answers_are_found_and_the_oldest_forgotten() {
        let mut answers = Answers::default();
        for id in 0..=MOST as u128 {
            answers.remember(Answer {
                id: CommandId(id),
                outcome: Outcome::Done {
                    update: None,
                    reply: Reply::Nothing,
                },
                set: SetRef {
                    name: "hq".into(),
                    revision: 1,
                },
            });
        }
        assert!(answers.find(CommandId(0)).is_none());
        assert!(answers.find(CommandId(1)).is_some());
        assert!(answers.find(CommandId(MOST as u128)).is_some());
    }
}
