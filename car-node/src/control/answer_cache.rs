//! Caches answers by command id, so that a repeated command gets the same answer and is not executed again.

use std::collections::VecDeque;

use protocol::{Answer, CommandId};
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::xxh3_64;

/// Most answers that are kept. An operator repeats a command within seconds, so older answers are not needed.
const MOST: usize = 512;

/// Hash of a command's payload. Two commands under one id have different hashes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct PayloadHash(u64);

impl PayloadHash {
    /// Hashes a command's payload.
    pub fn of(payload: &[u8]) -> Self {
        Self(xxh3_64(payload))
    }
}

/// An answer with the command that it belongs to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CachedAnswer {
    /// The answer.
    #[serde(flatten)]
    pub answer: Answer,
    /// Hash of the command; None in files of older versions. Files keep it under `print`.
    #[serde(default, rename = "print")]
    pub payload_hash: Option<PayloadHash>,
}

/// The latest answers.
#[derive(Debug, Default)]
pub(super) struct AnswerCache(VecDeque<CachedAnswer>);

impl AnswerCache {
    /// A cache that starts with answers kept over a restart.
    pub(super) fn with(answers: impl Iterator<Item = CachedAnswer>) -> Self {
        Self(answers.collect())
    }

    /// The answer given under this id.
    pub(super) fn find(&self, id: CommandId) -> Option<&CachedAnswer> {
        self.0.iter().rev().find(|cached| cached.answer.id == id)
    }

    /// Adds an answer, and removes the oldest one if there are too many.
    pub(super) fn push(&mut self, answer: CachedAnswer) {
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

    fn given(id: u128) -> CachedAnswer {
        CachedAnswer {
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
            payload_hash: Some(PayloadHash::of(&id.to_le_bytes())),
        }
    }

    #[test]
    fn a_file_without_payload_hashes_is_read() {
        let given = given(u128::MAX);
        let text = serde_json::to_string(&given).expect("writes");
        assert_eq!(serde_json::from_str::<CachedAnswer>(&text).expect("reads"), given);
        let old = serde_json::to_string(&given.answer).expect("writes");
        let read: CachedAnswer = serde_json::from_str(&old).expect("reads");
        assert_eq!((read.answer, read.payload_hash), (given.answer, None));
    }

    #[test]
    fn the_latest_answers_are_found_and_the_oldest_dropped() {
        let mut answers = AnswerCache::default();
        for id in 0..=MOST as u128 {
            answers.push(given(id));
        }
        assert!(answers.find(CommandId(0)).is_none());
        assert!(answers.find(CommandId(1)).is_some());
        assert!(answers.find(CommandId(MOST as u128)).is_some());
    }
}
