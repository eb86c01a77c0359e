//! Tracks which sequence numbers of a stream have arrived and which are missing.

use serde::Serialize;

use crate::number_ranges::NumberRanges;

/// The arrivals of one stream: one sender, one key.
///
/// Counting begins with the first message that arrives: what was sent before it is not missing. A sender that restarts
/// has a higher `run_id` and begins a new count. What was missing from earlier runs stays missing.
#[derive(Debug, Clone, Default)]
pub struct SequenceTracker {
    run_id: u64,
    first: u64,
    last: u64,
    received: u64,
    restarts: u64,
    /// Missing numbers of the current run.
    missing: NumberRanges,
    /// Missing numbers of earlier runs, and of ranges beyond [`Self::MAX_RANGES`].
    missing_before: u64,
    filled: u64,
}

/// The place of an arrival in its stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SequenceStatus {
    /// The next number, or the first one.
    New,
    /// A higher number: some before it are missing.
    AfterGap,
    /// A lower number that was missing until now.
    Late,
    /// A number that has arrived already, or was sent before the count began.
    Duplicate,
}

impl SequenceTracker {
    /// Beyond this many missing ranges, the oldest are counted and no longer listed.
    const MAX_RANGES: usize = 4096;

    /// Notes an arrival. Messages with sequence number 0 are not counted.
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
                self.miss([self.last + 1, sequence - 1]);
            }
            self.last = sequence;
            self.received += 1;
            return if gap {
                SequenceStatus::AfterGap
            } else {
                SequenceStatus::New
            };
        }
        if !self.missing.remove(sequence) {
            return SequenceStatus::Duplicate;
        }
        self.received += 1;
        self.filled += 1;
        SequenceStatus::Late
    }

    /// Notes that messages up to number `to` were sent. If none has arrived yet, the count begins with `from`.
    pub fn sent(&mut self, run_id: u64, from: u64, to: u64) {
        if run_id < self.run_id || to < from || from == 0 {
            return;
        }
        if self.last == 0 || run_id > self.run_id {
            self.begin(run_id, from);
            self.miss([from, to]);
        } else if to > self.last {
            self.miss([self.last + 1, to]);
        }
        self.last = self.last.max(to);
    }

    /// Begins the count of a run with this number.
    fn begin(&mut self, run_id: u64, number: u64) {
        if self.last > 0 {
            self.restarts += 1;
            self.missing_before += self.missing.count();
            self.missing.clear();
            // A new run begins with number 1: what precedes this number is missing.
            self.missing.insert([1, number - 1], ());
        }
        self.run_id = run_id;
        self.first = number;
        self.last = number;
    }

    fn miss(&mut self, range: [u64; 2]) {
        if self.missing.range_count() == Self::MAX_RANGES
            && let Some([from, to]) = self.missing.pop_first()
        {
            self.missing_before += to - from + 1;
        }
        self.missing.insert(range, ());
    }

    /// Messages that arrived, duplicates not counted.
    pub fn received(&self) -> u64 {
        self.received
    }

    /// Messages that were missing for a while and arrived late.
    pub fn filled(&self) -> u64 {
        self.filled
    }

    /// How often the sender restarted.
    pub fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Messages that are missing.
    pub fn missing(&self) -> u64 {
        self.missing_before + self.missing.count()
    }

    /// The highest number that arrived or is known to have been sent.
    pub fn last(&self) -> u64 {
        self.last
    }

    /// The counts and the missing ranges, for people and files.
    pub fn summary(&self) -> GapSummary {
        GapSummary {
            first: self.first,
            last: self.last,
            received: self.received,
            missing: self.missing(),
            missing_ranges: self.missing.iter().collect(),
            filled_late: self.filled,
            sender_restarts: self.restarts,
        }
    }
}

/// What arrived of a stream and what is missing.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct GapSummary {
    /// The number with which the count of the last run begins.
    pub first: u64,
    /// The highest number that arrived or is known to have been sent.
    pub last: u64,
    /// Messages that arrived, duplicates not counted.
    pub received: u64,
    /// Messages that are missing.
    pub missing: u64,
    /// The missing numbers of the last run, as `[from, to]`.
    pub missing_ranges: Vec<[u64; 2]>,
    /// Messages that arrived late.
    pub filled_late: u64,
    /// How often the sender restarted.
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
    fn a_gap_is_listed_and_fills_in_any_order() {
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
    fn a_sender_that_restarts_begins_a_new_count_and_keeps_what_was_missing() {
        let mut gaps = gaps(&[1, 3]);
        assert_eq!(gaps.arrive(2, 3), SequenceStatus::New);
        assert_eq!(
            gaps.arrive(1, 2),
            SequenceStatus::Duplicate,
            "a late message of the old run"
        );
        let summary = gaps.summary();
        assert_eq!((summary.missing, summary.sender_restarts), (3, 1));
        assert_eq!(summary.missing_ranges, [[1, 2]]);
    }

    #[test]
    fn what_was_sent_is_missing_until_it_arrives() {
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
        assert_eq!(nothing_came.summary(), summary, "a late message of the old run");
    }

    #[test]
    fn the_number_of_missing_ranges_is_limited() {
        let sequences: Vec<_> = (0..10_000).map(|i| 2 * i + 1).collect();
        let gaps = gaps(&sequences);
        assert_eq!(gaps.missing(), 9_999);
        assert_eq!(gaps.missing.range_count(), SequenceTracker::MAX_RANGES);
    }
}
