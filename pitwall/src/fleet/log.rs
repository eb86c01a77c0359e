//! The list of what happened, of all cars, with what the pit wall itself noticed.

use std::collections::VecDeque;

use protocol::{CarName, Severity};
use serde::Serialize;

/// One line of the log.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LogEntry {
    /// Counts lines, from 1.
    pub number: u64,
    /// When it happened, by the laptop's clock [unix ns].
    pub at: i64,
    /// The car; None for the pit wall itself.
    pub car: Option<CarName>,
    /// How much it counts.
    pub severity: Severity,
    /// Which kind of thing it is, one word.
    pub kind: &'static str,
    /// What happened.
    pub text: String,
    /// Who caused it; None for a car by itself.
    pub who: Option<String>,
}

/// The last lines.
#[derive(Debug, Clone, Default)]
pub struct Log {
    entries: VecDeque<LogEntry>,
    count: u64,
    /// Alarms up to this line have been seen.
    acknowledged: u64,
}

impl Log {
    const MAX_ENTRIES: usize = 2000;

    /// Adds a line; its number is given here.
    pub fn push(&mut self, mut entry: LogEntry) {
        self.count += 1;
        entry.number = self.count;
        if self.entries.len() == Self::MAX_ENTRIES {
            self.entries.pop_front();
        }
        self.entries.push_back(entry);
    }

    /// The lines after number `after`, the oldest first.
    pub fn since(&self, after: u64) -> impl Iterator<Item = &LogEntry> {
        let skip = self.entries.partition_point(|entry| entry.number <= after);
        self.entries.iter().skip(skip)
    }

    /// Critical lines that nobody has acknowledged.
    pub fn alarms(&self) -> usize {
        self.since(self.acknowledged)
            .filter(|entry| entry.severity == Severity::Critical)
            .count()
    }

    /// The number of the last line that was acknowledged; 0 for none.
    pub fn acknowledged(&self) -> u64 {
        self.acknowledged
    }

    /// Takes every line so far as seen; returns how many of them were open alarms.
    pub(crate) fn acknowledge(&mut self) -> usize {
        let alarms = self.alarms();
        self.acknowledged = self.count;
        alarms
    }

    /// The number of the last line; 0 for none.
    pub fn last(&self) -> u64 {
        self.count
    }
}
