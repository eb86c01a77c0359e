//! Which sequence numbers of a stream have come, and which are missing.

use std::ops::RangeInclusive;

use serde::Serialize;

/// The arrivals of one stream: one sender, one key.
///
/// Counting begins with the first message that comes in: what was sent before that is not missing. A sender that
/// starts again, which its run_id tells, begins a new count; what was missing of the old one stays missing.
#[derive(Debug, Clone, Default)]
pub struct SequenceTracker {
    run_id: u64,
    first: u64,
    last: u64,
    received: u64,
    restarts: u64,
    /// Missing ranges of the present run_id, ascending.
    missing: Vec<RangeInclusive<u64>>,
    /// Missing numbers of earlier runs, and of ranges that no longer fit the list.
    missing_before: u64,
    filled: u64,
}

/// What an arrival was.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SequenceStatus {
    /// The next one, or the first.
    New,
    /// A later one: some before it are missing.
    AfterGap,
    /// An earlier one that was missing until now.
    Late,
    /// One that had come already, or was sent before the count began.
    Duplicate,
}

impl SequenceTracker {
    /// A stream with more holes than this is counted, not listed.
    const MAX_RANGES: usize = 4096;

    /// Takes note of a message. Those with sequence number 0 are not counted.
    pub fn arrive(&mut self, run_id: u64, sequence: u64) -> SequenceStatus {
        if sequence == 0 {
            return SequenceStatus::New;
        }
        if self.last == 0 || run_id > self.run_id {
            self.begin(run_id, sequence);
            self.received += 1;
            return SequenceStatus::New;
        }
        if run_id < self.run_id {
            return SequenceStatus::Duplicate;
        }
        if sequence > self.last {
            let gap = sequence > self.last + 1;
            if gap {
                self.miss(self.last + 1..=sequence - 1);
            }
            self.last = sequence;
            self.received += 1;
            return if gap {
                SequenceStatus::AfterGap
            } else {
                SequenceStatus::New
            };
        }
        let Some(at) = self.missing.iter().position(|range| range.contains(&sequence)) else {
            return SequenceStatus::Duplicate;
        };
        let range = self.missing.remove(at);
        let rest = [*range.start()..=sequence - 1, sequence + 1..=*range.end()];
        for part in rest.into_iter().rev().filter(|part| !part.is_empty()) {
            self.missing.insert(at, part);
        }
        self.received += 1;
        self.filled += 1;
        SequenceStatus::Late
    }

    /// Takes note that the messages up to number `to` were sent. Where none has come yet, the count begins with `from`.
    pub fn sent(&mut self, run_id: u64, from: u64, to: u64) {
        if run_id < self.run_id || to < from || from == 0 {
            return;
        }
        if self.last == 0 || run_id > self.run_id {
            self.begin(run_id, from);
            self.miss(from..=to);
        } else if to > self.last {
            self.miss(self.last + 1..=to);
        }
        self.last = self.last.max(to);
    }

    /// Begins with this number of a run_id.
    fn begin(&mut self, run_id: u64, number: u64) {
        if self.last > 0 {
            self.restarts += 1;
            self.missing_before += self.missing_now();
            self.missing.clear();
            // A new sender's first message is number 1: what precedes the one that came is missing.
            if number > 1 {
                self.missing.push(1..=number - 1);
            }
        }
        self.run_id = run_id;
        self.first = number;
        self.last = number;
    }

    fn miss(&mut self, range: RangeInclusive<u64>) {
        if self.missing.len() == Self::MAX_RANGES {
            let oldest = self.missing.remove(0);
            self.missing_before += oldest.end() - oldest.start() + 1;
        }
        self.missing.push(range);
    }

    /// Different messages that came.
    pub fn received(&self) -> u64 {
        self.received
    }

    /// Messages that were missing for a while and came late.
    pub fn filled(&self) -> u64 {
        self.filled
    }

    /// How often the sender started again.
    pub fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Messages missing in all.
    pub fn missing(&self) -> u64 {
        self.missing_before + self.missing_now()
    }

    /// The highest number that came or is known to have been sent.
    pub fn last(&self) -> u64 {
        self.last
    }

    /// What there is and what is missing, for people and files.
    pub fn summary(&self) -> GapSummary {
        GapSummary {
            first: self.first,
            last: self.last,
            received: self.received,
            missing: self.missing(),
            missing_ranges: self.missing.iter().map(|r| [*r.start(), *r.end()]).collect(),
            filled_late: self.filled,
            sender_restarts: self.restarts,
        }
    }

    fn missing_now(&self) -> u64 {
        self.missing.iter().map(|r| r.end() - r.start() + 1).sum()
    }
}

/// What came of a stream and what did not.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct GapSummary {
    /// The number with which the count begins, of the sender's last run_id.
    pub first: u64,
    /// The highest number that came or is known to have been sent.
    pub last: u64,
    /// Different messages that came.
    pub received: u64,
    /// Messages missing in all.
    pub missing: u64,
    /// The missing numbers of the sender's last run_id, as `[from, to]`.
    pub missing_ranges: Vec<[u64; 2]>,
    /// Messages that came late.
    pub filled_late: u64,
    /// How often the sender started again.
    pub sender_restarts: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gaps(sequences: &[u64]) -> SequenceTracker {
        let mut gaps = SequenceTracker::default();
        for &sequence in sequences {
            gaps.arrive(1, sequence);
        }
        gaps
    }

    #[test]
    fn counting_begins_with_the_first_arrival() {
        assert_eq!(gaps(&[100, 101, 102]).missing(), 0);
        assert_eq!(gaps(&[100, 99]).received(), 1);
    }

    #[test]
    fn a_hole_is_named_and_fills_from_anywhere() {
        let mut gaps = gaps(&[1, 2, 7]);
        assert_eq!(gaps.summary().missing_ranges, [[3, 6]]);
        assert_eq!(gaps.arrive(1, 4), SequenceStatus::Late);
        assert_eq!(gaps.summary().missing_ranges, [[3, 3], [5, 6]]);
        assert_eq!(gaps.arrive(1, 3), SequenceStatus::Late);
        assert_eq!(gaps.arrive(1, 6), SequenceStatus::Late);
        assert_eq!(gaps.arrive(1, 5), SequenceStatus::Late);
        assert_eq!((gaps.missing(), gaps.filled(), gaps.received()), (0, 4, 7));
        assert_eq!(gaps.arrive(1, 5), SequenceStatus::Duplicate);
        assert_eq!(gaps.received(), 7);
    }

    #[test]
    fn a_sender_that_starts_again_counts_anew_and_forgives_nothing() {
        let mut gaps = gaps(&[1, 3]);
        assert_eq!(gaps.arrive(2, 3), SequenceStatus::New);
        assert_eq!(
            gaps.arrive(1, 2),
            SequenceStatus::Duplicate,
            "a straggler of the old run_id"
        );
        let summary = gaps.summary();
        assert_eq!((summary.missing, summary.sender_restarts), (3, 1));
        assert_eq!(summary.missing_ranges, [[1, 2]]);
    }

    #[test]
    fn what_is_known_to_have_been_sent_is_missing_until_it_comes() {
        let mut gaps = gaps(&[5, 6]);
        gaps.sent(1, 5, 6);
        assert_eq!(gaps.missing(), 0);
        gaps.sent(1, 7, 9);
        assert_eq!((gaps.last(), gaps.summary().missing_ranges), (9, vec![[7, 9]]));
        assert_eq!(gaps.arrive(1, 8), SequenceStatus::Late);
        assert_eq!(gaps.arrive(1, 10), SequenceStatus::New);
        assert_eq!(gaps.summary().missing_ranges, [[7, 7], [9, 9]]);

        let mut nothing_came = SequenceTracker::default();
        nothing_came.sent(1, 3, 5);
        assert_eq!((nothing_came.missing(), nothing_came.received()), (3, 0));
        assert_eq!(nothing_came.arrive(1, 3), SequenceStatus::Late);
        assert_eq!(nothing_came.missing(), 2);

        nothing_came.sent(2, 1, 2);
        let summary = nothing_came.summary();
        assert_eq!((summary.missing, summary.sender_restarts), (4, 1));
        nothing_came.sent(1, 1, 9);
        assert_eq!(nothing_came.summary(), summary, "a straggler of the old run_id");
    }

    #[test]
    fn endless_holes_take_no_endless_memory() {
        let sequences: Vec<_> = (0..10_000).map(|i| 2 * i + 1).collect();
        let gaps = gaps(&sequences);
        assert_eq!(gaps.missing(), 9_999);
        assert_eq!(gaps.missing.len(), SequenceTracker::MAX_RANGES);
    }
}
