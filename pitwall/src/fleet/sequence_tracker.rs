//! Tracks which sequence numbers of a stream have arrived and which are missing.

use std::collections::VecDeque;

use serde::Serialize;

use crate::number_ranges::NumberRanges;

/// The arrivals of one stream: one sender, one key.
///
/// Counting begins with the first message that arrives: what was sent before it is not missing. A sender that restarts has
/// another `run_id` and begins a new count with number 1. Run ids have no order. What is missing from earlier runs stays
/// missing until it arrives.
#[derive(Debug, Clone, Default)]
pub struct SequenceTracker {
    /// The runs in the order in which they began, at most [`Self::MAX_RUNS`].
    runs: VecDeque<RunNumbers>,
    received: u64,
    restarts: u64,
    /// Missing numbers of runs and of ranges that are no longer listed.
    missing_before: u64,
    filled: u64,
}

/// The numbers of one run.
#[derive(Debug, Clone)]
struct RunNumbers {
    run_id: u64,
    first: u64,
    last: u64,
    missing: NumberRanges,
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
    /// Beyond this many missing ranges of a run, the oldest are counted and no longer listed.
    const MAX_RANGES: usize = 4096;
    /// Beyond this many runs, what is missing from the oldest is counted and no longer listed.
    const MAX_RUNS: usize = 16;

    /// Notes an arrival. Messages with sequence number 0 are not counted.
    pub fn arrive(&mut self, run_id: u64, sequence: u64) -> SequenceStatus {
        if sequence == 0 {
            return SequenceStatus::New;
        }
        let Some(run) = self.runs.iter_mut().rev().find(|run| run.run_id == run_id) else {
            self.begin(run_id, sequence);
            self.received += 1;
            return SequenceStatus::New;
        };
        if sequence > run.last {
            let gap = sequence > run.last + 1;
            if gap {
                self.missing_before += run.miss([run.last + 1, sequence - 1]);
            }
            run.last = sequence;
            self.received += 1;
            return if gap {
                SequenceStatus::AfterGap
            } else {
                SequenceStatus::New
            };
        }
        if !run.missing.remove(sequence) {
            return SequenceStatus::Duplicate;
        }
        self.received += 1;
        self.filled += 1;
        SequenceStatus::Late
    }

    /// Notes that messages of a run up to number `to` were sent. If none has arrived yet, the count begins with `from`.
    pub fn sent(&mut self, run_id: u64, from: u64, to: u64) {
        if to < from || from == 0 {
            return;
        }
        if let Some(run) = self.runs.iter_mut().rev().find(|run| run.run_id == run_id) {
            if to > run.last {
                self.missing_before += run.miss([run.last + 1, to]);
                run.last = to;
            }
            return;
        }
        let run = self.begin(run_id, from);
        run.miss([from, to]);
        run.last = to;
    }

    /// The missing numbers, with their runs.
    pub fn missing_by_run(&self) -> impl Iterator<Item = (u64, [u64; 2])> {
        self.runs
            .iter()
            .flat_map(|run| run.missing.iter().map(|range| (run.run_id, range)))
    }

    /// True when a message of this run has arrived.
    pub fn has_run(&self, run_id: u64) -> bool {
        self.runs.iter().any(|run| run.run_id == run_id)
    }

    /// Begins the count of a run with this number.
    fn begin(&mut self, run_id: u64, number: u64) -> &mut RunNumbers {
        let mut missing = NumberRanges::default();
        if !self.runs.is_empty() {
            self.restarts += 1;
            // A new run begins with number 1: what precedes this number is missing.
            missing.insert([1, number - 1], ());
        }
        if self.runs.len() == Self::MAX_RUNS
            && let Some(oldest) = self.runs.pop_front()
        {
            self.missing_before = self.missing_before.saturating_add(oldest.missing.count());
        }
        self.runs.push_back(RunNumbers {
            run_id,
            first: number,
            last: number,
            missing,
        });
        let last = self.runs.len() - 1;
        &mut self.runs[last]
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
        self.runs.iter().fold(self.missing_before, |sum, run| {
            sum.saturating_add(run.missing.count())
        })
    }

    /// The highest number of the last run that arrived or is known to have been sent.
    pub fn last(&self) -> u64 {
        self.runs.back().map_or(0, |run| run.last)
    }

    /// The counts and the missing ranges, for people and files.
    pub fn summary(&self) -> GapSummary {
        let run = self.runs.back();
        GapSummary {
            first: run.map_or(0, |run| run.first),
            last: self.last(),
            received: self.received,
            missing: self.missing(),
            missing_ranges: run.map(|run| run.missing.iter().collect()).unwrap_or_default(),
            filled_late: self.filled,
            sender_restarts: self.restarts,
        }
    }
}

impl RunNumbers {
    /// Adds missing numbers. Returns how many of others are no longer listed.
    fn miss(&mut self, range: [u64; 2]) -> u64 {
        let full = self.missing.range_count() == SequenceTracker::MAX_RANGES;
        let dropped = full.then(|| self.missing.pop_first()).flatten();
        self.missing.insert(range, ());
        dropped.map_or(0, |[from, to]| to - from + 1)
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
            SequenceStatus::Late,
            "a late message of the old run"
        );
        assert_eq!(gaps.arrive(1, 1), SequenceStatus::Duplicate);
        let summary = gaps.summary();
        assert_eq!((summary.missing, summary.sender_restarts), (2, 1));
        assert_eq!(summary.missing_ranges, [[1, 2]]);
    }

    // A car whose clock was behind after a power cut once counted as a duplicate of itself.
    #[test]
    fn a_run_with_a_lower_id_is_a_new_run() {
        let mut gaps = gaps(&[1, 2, 3]);
        assert_eq!(gaps.arrive(0, 1), SequenceStatus::New);
        assert_eq!(gaps.arrive(0, 2), SequenceStatus::New);
        let summary = gaps.summary();
        assert_eq!(
            (summary.received, summary.missing, summary.sender_restarts),
            (5, 0, 1)
        );
    }

    #[test]
    fn the_number_of_runs_is_limited_and_the_missing_ones_stay_counted() {
        let mut gaps = SequenceTracker::default();
        for run_id in 0..100 {
            gaps.arrive(run_id, 1);
            gaps.arrive(run_id, 3);
        }
        assert_eq!((gaps.missing(), gaps.restarts()), (100, 99));
        assert_eq!(gaps.runs.len(), SequenceTracker::MAX_RUNS);
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
        nothing_came.sent(1, 1, 5);
        assert_eq!(nothing_came.summary(), summary, "it is known already");
        nothing_came.sent(1, 1, 9);
        assert_eq!(nothing_came.missing(), 8, "the old run had sent more");
    }

    #[test]
    fn the_number_of_missing_ranges_is_limited() {
        let sequences: Vec<_> = (0..10_000).map(|i| 2 * i + 1).collect();
        let gaps = gaps(&sequences);
        assert_eq!(gaps.missing(), 9_999);
        assert_eq!(gaps.runs[0].missing.range_count(), SequenceTracker::MAX_RANGES);
    }
}
