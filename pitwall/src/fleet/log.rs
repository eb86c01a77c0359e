//! The log: events of all cars, and entries of the pit wall itself.

use std::collections::VecDeque;

use protocol::{CarName, Severity, plain_text};
use serde::Serialize;

/// One entry of the log.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LogEntry {
    /// Number of the entry, counted from 1.
    pub number: u64,
    /// When it happened, by the laptop's clock \[unix ns\].
    pub at: i64,
    /// The car; None for the pit wall itself.
    pub car: Option<CarName>,
    /// The severity.
    pub severity: Severity,
    /// The kind, one word.
    pub kind: &'static str,
    /// The text.
    pub text: String,
    /// The operator who caused it; None for a car.
    pub who: Option<String>,
}

/// The last entries.
#[derive(Debug, Clone, Default)]
pub struct Log {
    entries: VecDeque<LogEntry>,
    count: u64,
    /// Alarms up to this entry are acknowledged.
    acknowledged: u64,
    /// Alarms that nobody has acknowledged, the oldest first. They stay when their entries have gone.
    open: VecDeque<LogEntry>,
}

impl Log {
    const MAX_ENTRIES: usize = 2000;
    /// Most open alarms that are kept.
    const MAX_OPEN: usize = 500;

    /// Adds an entry and sets its number.
    pub fn push(&mut self, mut entry: LogEntry) {
        self.count += 1;
        entry.number = self.count;
        entry.text = plain_text(&entry.text).into_owned();
        entry.who = entry.who.map(|who| plain_text(&who).into_owned());
        if self.entries.len() == Self::MAX_ENTRIES {
            self.entries.pop_front();
        }
        if entry.severity == Severity::Critical {
            if self.open.len() == Self::MAX_OPEN {
                self.open.pop_front();
            }
            self.open.push_back(entry.clone());
        }
        self.entries.push_back(entry);
    }

    /// The entries after number `after`, the oldest first.
    pub fn since(&self, after: u64) -> impl Iterator<Item = &LogEntry> {
        let skip = self.entries.partition_point(|entry| entry.number <= after);
        self.entries.iter().skip(skip)
    }

    /// Number of critical entries that nobody has acknowledged.
    pub fn alarms(&self) -> usize {
        self.open.len()
    }

    /// The critical entries that nobody has acknowledged, the oldest first.
    pub fn open(&self) -> impl Iterator<Item = &LogEntry> {
        self.open.iter()
    }

    /// The number of the last acknowledged entry; 0 for none.
    pub fn acknowledged(&self) -> u64 {
        self.acknowledged
    }

    /// Acknowledges every entry so far; returns how many of them were open alarms.
    pub(crate) fn acknowledge(&mut self) -> usize {
        let alarms = self.alarms();
        self.acknowledged = self.count;
        self.open.clear();
        alarms
    }

    /// The number of the last entry; 0 for none.
    pub fn last(&self) -> u64 {
        self.count
    }
}
