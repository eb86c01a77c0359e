//! Puts the messages of one stream in order and tracks which are missing. Pure: the caller passes the time.

use std::collections::BTreeMap;

use protocol::{Kept, Topic, Wanted};

use crate::number_ranges::NumberRanges;

/// Number of past messages that are requested when a stream is found. Of events, all are.
const HISTORY: u64 = 100;
/// Messages after a gap are held back for this long, so that the gap can be filled \[ns\].
pub(super) const HOLD: i64 = 5_000_000_000;
/// Beyond this many gaps, the oldest is given up: its messages stay missing.
const MAX_GAPS: usize = 4096;

/// The messages of a stream that are held back, and the numbers of those that are missing. `T` is a message.
#[derive(Debug)]
pub(super) struct ReorderBuffer<T> {
    /// True when the first number that we follow is known. Until then every message is held back.
    started: bool,
    /// The highest number that has arrived or is known to be missing.
    highest: u64,
    /// Missing numbers, each with the time from which on it is missing \[unix ns\].
    gaps: NumberRanges<i64>,
    /// A number that the car has sent, and when that became known \[unix ns\].
    announced: Option<(u64, i64)>,
    /// Messages after a gap, and when they arrived \[unix ns\].
    held: BTreeMap<u64, (i64, T)>,
}

impl<T> ReorderBuffer<T> {
    /// A stream of which the first number is not known.
    pub(super) fn new() -> Self {
        Self {
            started: false,
            highest: 0,
            gaps: NumberRanges::default(),
            announced: None,
            held: BTreeMap::new(),
        }
    }

    /// A stream that starts with number 1.
    pub(super) fn from_first() -> Self {
        Self {
            started: true,
            ..Self::new()
        }
    }

    /// Adds a message that arrived at `at` \[unix ns\]. Appends to `out` what is in order now.
    pub(super) fn arrive(&mut self, topic: Topic, number: u64, message: T, at: i64, out: &mut Vec<T>) {
        if self.started && number <= self.highest {
            let duplicate = !self.gaps.remove(number);
            if duplicate {
                return;
            }
        } else {
            if self.started && number > self.highest + 1 {
                self.miss([self.highest + 1, number - 1], at);
            }
            self.highest = self.highest.max(number);
        }
        // Health is shown on arrival: being new matters more than being in order.
        if topic == Topic::Health {
            out.push(message);
        } else {
            self.held.insert(number, (at, message));
        }
        self.release(out);
    }

    /// Notes at `now` \[unix ns\] which messages the car still has. One that it sent is not missing before `grace` \[ns\] has
    /// passed. Appends to `out` what need not be held back any more.
    pub(super) fn note_kept(&mut self, kept: Kept, now: i64, grace: i64, out: &mut Vec<T>) {
        let Kept { topic, first, last } = kept;
        if !self.started {
            self.start(topic, first, last, now);
        }
        // What the car no longer has cannot be recovered.
        self.gaps.remove_below(first);
        match self.announced {
            Some((number, since)) if number > self.highest && now - since >= grace => {
                self.miss([self.highest + 1, number], since);
                self.highest = number;
                self.announced = None;
            }
            Some((number, _)) if number > self.highest => {}
            _ => self.announced = (last > self.highest).then_some((last, now)),
        }
        self.release(out);
    }

    /// Starts with the first message to follow. What has not arrived of the rest is missing.
    fn start(&mut self, topic: Topic, first: u64, last: u64, now: i64) {
        self.started = true;
        let start = if topic == Topic::Event {
            first
        } else {
            first.max((last + 1).saturating_sub(HISTORY))
        };
        let mut next = self.held.keys().next().map_or(start, |held| start.min(*held));
        self.highest = self.highest.max(last);
        let arrived: Vec<_> = self.held.keys().copied().chain([self.highest + 1]).collect();
        for number in arrived {
            if number > next {
                self.miss([next, number - 1], now);
            }
            next = number + 1;
        }
    }

    /// Appends to `out` the messages that no gap precedes.
    fn release(&mut self, out: &mut Vec<T>) {
        if !self.started {
            return;
        }
        let first_gap = self.gaps.first().map_or(u64::MAX, |(from, _)| from);
        while let Some(next) = self.held.first_entry()
            && *next.key() < first_gap
        {
            out.push(next.remove().1);
        }
    }

    /// Appends to `out` what has been held back for too long at `now` \[unix ns\].
    pub(super) fn release_overdue(&mut self, now: i64, out: &mut Vec<T>) {
        // Released before the first number is known, a message would look like the first one.
        let hold = if self.started { HOLD } else { 3 * HOLD };
        while let Some(oldest) = self.held.first_entry()
            && now - oldest.get().0 > hold
        {
            out.push(oldest.remove().1);
        }
    }

    /// Removes and returns all messages that are held back, in order.
    pub(super) fn take_held(&mut self) -> impl Iterator<Item = T> {
        std::mem::take(&mut self.held)
            .into_values()
            .map(|(_, message)| message)
    }

    fn miss(&mut self, range: [u64; 2], since: i64) {
        if self.gaps.range_count() == MAX_GAPS {
            self.gaps.pop_first();
        }
        self.gaps.insert(range, since);
    }

    /// True when messages are missing.
    pub(super) fn has_gaps(&self) -> bool {
        !self.gaps.is_empty()
    }

    /// The first number that has not been released.
    pub(super) fn next(&self) -> u64 {
        let gap = self.gaps.first().map(|(from, _)| from);
        let held = self.held.keys().next().copied();
        gap.into_iter().chain(held).min().unwrap_or(self.highest + 1)
    }

    /// The number of messages up to `last` that have not arrived.
    pub(super) fn missing_up_to(&self, last: u64) -> u64 {
        self.gaps.count_up_to(last) + last.saturating_sub(self.highest)
    }

    /// The ranges to request: the oldest ones.
    pub(super) fn wanted(&self) -> Vec<[u64; 2]> {
        self.gaps.iter().take(Wanted::MAX_RANGES).collect()
    }

    /// Time from which on the first missing message is missing \[unix ns\].
    pub(super) fn missing_since(&self) -> i64 {
        self.gaps.first().map_or(i64::MAX, |(_, since)| since)
    }
}
