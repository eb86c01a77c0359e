//! One stream of a car: rate, age, losses.

use std::collections::{BTreeSet, VecDeque};

use protocol::Header;
use serde::Serialize;

use super::sequence_tracker::{SequenceStatus, SequenceTracker};

/// Statistics of one topic of one car.
#[derive(Debug, Clone, Default)]
pub struct StreamStatistics {
    gaps: SequenceTracker,
    /// When the last messages were published, and when the newest arrived \[unix ns\].
    published: VecDeque<i64>,
    arrived: i64,
    newest: Option<Header>,
    unreadable: u64,
    /// The header of the newest message, if that one cannot be decoded.
    newest_unreadable: Option<Header>,
    /// Run and number of messages that cannot be decoded. They are counted when a later message of the same run is decoded,
    /// which proves that the run exists.
    unproven: BTreeSet<(u64, u64)>,
    rejected: u64,
    late_by: f64,
    /// Messages of the last second: when each arrived \[unix ns\], and how late \[s\].
    transits: VecDeque<(i64, f64)>,
}

/// The place of a message in its stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Freshness {
    /// Newer than all before it.
    Newest,
    /// It was missing until now.
    Older,
    /// It has arrived already.
    Duplicate,
}

/// \[ns\]
const SECOND: i64 = 1_000_000_000;

impl StreamStatistics {
    /// Number of messages from which the rate is computed.
    const WINDOW: usize = 64;
    /// Number of messages whose delay is the present one.
    const NEWEST: usize = 10;
    /// Maximum number of entries in `unproven`.
    const UNPROVEN: usize = 4096;

    /// Notes a message that arrived at `at` \[unix ns\].
    pub fn arrive(&mut self, header: &Header, at: i64) -> Freshness {
        if !self.unproven.is_empty() {
            let proven = (header.run_id, 0)..(header.run_id, header.sequence);
            let proven: Vec<_> = self.unproven.range(proven).copied().collect();
            for number in proven {
                self.unproven.remove(&number);
                self.gaps.arrive(number.0, number.1);
            }
        }
        let arrival = self.gaps.arrive(header.run_id, header.sequence);
        if arrival == SequenceStatus::Duplicate {
            return Freshness::Duplicate;
        }
        let newer = self
            .newest
            .is_none_or(|newest| newest.run_id != header.run_id || header.sequence > newest.sequence)
            && arrival != SequenceStatus::Late;
        if newer {
            if self.newest.is_some_and(|newest| newest.run_id != header.run_id) {
                self.published.clear();
            }
            if self.published.len() == Self::WINDOW {
                self.published.pop_front();
            }
            self.published.push_back(header.published);
            self.arrived = at;
            self.newest = Some(*header);
            self.newest_unreadable = None;
            self.late_by = (at - header.published) as f64 * 1e-9;
            self.transits.push_back((at, self.late_by));
            while self.transits.front().is_some_and(|(then, _)| at - then > SECOND) {
                self.transits.pop_front();
            }
        }
        if newer {
            Freshness::Newest
        } else {
            Freshness::Older
        }
    }

    /// Notes a message that cannot be decoded; returns how many there were. It has arrived, so it is not missing.
    pub fn note_unreadable(&mut self, header: Option<&Header>) -> u64 {
        self.unreadable += 1;
        if let Some(header) = header {
            if self
                .newest
                .is_none_or(|newest| newest.run_id != header.run_id || header.sequence > newest.sequence)
            {
                self.newest_unreadable = Some(*header);
                self.unproven.insert((header.run_id, header.sequence));
                if self.unproven.len() > Self::UNPROVEN {
                    self.unproven.pop_first();
                }
            } else {
                // In the current run it fills its gap.
                self.gaps.arrive(header.run_id, header.sequence);
            }
        }
        self.unreadable
    }

    /// Notes messages that were dropped; returns how many there were.
    pub(crate) fn note_rejected(&mut self, count: u64) -> u64 {
        self.rejected = self.rejected.saturating_add(count);
        self.rejected
    }

    /// What has arrived, by number.
    pub(crate) fn gaps(&self) -> &SequenceTracker {
        &self.gaps
    }

    /// Time between two messages of a steady stream \[s\]; None before the second one.
    pub(crate) fn interval(&self) -> Option<f64> {
        let intervals = self.published.len().checked_sub(1).filter(|n| *n > 0)?;
        let span = (self.published.back()? - self.published.front()?) as f64 * 1e-9;
        Some(span / intervals as f64)
    }

    /// Number of messages that cannot be decoded.
    pub fn unreadable(&self) -> u64 {
        self.unreadable
    }

    /// The header of the newest message, if that one cannot be decoded.
    pub fn newest_unreadable(&self) -> Option<Header> {
        self.newest_unreadable
    }

    /// The newest message's header.
    pub fn newest(&self) -> Option<Header> {
        self.newest
    }

    /// Median delay of the last messages in the second before `now` \[unix ns\], by the uncorrected clocks \[s\], and the number of
    /// messages in that second. None when there were none.
    pub fn transit(&self, now: i64) -> Option<(f64, usize)> {
        let mut recent: Vec<f64> = self
            .transits
            .iter()
            .filter(|(at, _)| now - at <= SECOND)
            .map(|(_, late)| *late)
            .collect();
        let count = recent.len();
        let newest = &mut recent[count.saturating_sub(Self::NEWEST)..];
        newest.sort_by(f64::total_cmp);
        Some((*newest.get(newest.len() / 2)?, count))
    }

    /// When the last message arrived \[unix ns\].
    pub fn last_arrival(&self) -> Option<i64> {
        self.newest.map(|_| self.arrived)
    }

    /// Message rate at `now` \[unix ns\], in Hz; it falls when nothing arrives. It is computed from the publish times,
    /// because recovered messages arrive all at once.
    pub fn rate(&self, now: i64) -> f64 {
        let (Some(first), Some(last)) = (self.published.front(), self.published.back()) else {
            return 0.0;
        };
        // A pause of one interval is what a steady stream has anyway.
        let intervals = (self.published.len() - 1) as f64;
        let span = (last - first) as f64 * 1e-9;
        let pause = (now - self.arrived) as f64 * 1e-9;
        if intervals == 0.0 {
            return if pause < 1.5 { 1.0 } else { 0.0 };
        }
        let usual = span / intervals;
        intervals / (span + (pause - usual).max(0.0)).max(1e-9)
    }

    /// The stream at `now` \[unix ns\]. The car's clock is `offset` \[ns\] ahead of the laptop's.
    pub fn view(&self, now: i64, offset: i64) -> StreamView {
        let seconds = |ns: i64| ns as f64 * 1e-9;
        StreamView {
            rate_hz: self.rate(now),
            age_s: self.newest.map(|h| seconds(now + offset - h.sensor)),
            transit_s: self.newest.map(|_| self.late_by + seconds(offset)),
            received: self.gaps.received(),
            missing: self.gaps.missing(),
            filled_late: self.gaps.filled(),
            sender_restarts: self.gaps.restarts(),
            unreadable: self.unreadable,
            rejected: self.rejected,
        }
    }
}

/// A stream in numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StreamView {
    /// Message rate \[Hz\].
    pub rate_hz: f64,
    /// Age of the newest content \[s\].
    pub age_s: Option<f64>,
    /// From publishing to arrival, of the newest message \[s\].
    pub transit_s: Option<f64>,
    /// Messages that arrived, duplicates not counted.
    pub received: u64,
    /// Messages that were sent and did not arrive.
    pub missing: u64,
    /// Messages that arrived late, from the sender's cache.
    pub filled_late: u64,
    /// How often the sender restarted.
    pub sender_restarts: u64,
    /// Messages that cannot be decoded.
    pub unreadable: u64,
    /// Messages that were dropped because their run or their number is not plausible.
    pub rejected: u64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::{Schema, Stamps};

    fn header(sequence: u64) -> Header {
        published(sequence, 0)
    }

    fn published(sequence: u64, published: i64) -> Header {
        let stamps = Stamps {
            run_id: 1,
            sequence,
            sensor: 0,
            published,
        };
        Header::new(Schema::Pose, 1, stamps)
    }

    #[test]
    fn the_rate_is_steady_and_falls_in_silence() {
        let mut stream = StreamStatistics::default();
        for i in 0..100 {
            let at = i as i64 * SECOND / 40;
            stream.arrive(&published(i + 1, at), at);
        }
        let last = 99 * SECOND / 40;
        assert!((stream.rate(last) - 40.0).abs() < 0.01);
        assert!((stream.rate(last + SECOND / 41) - 40.0).abs() < 0.01);
        assert!(stream.rate(last + 2 * SECOND) < 20.0);
        assert!(stream.rate(last + 100 * SECOND) < 1.0);
    }

    #[test]
    fn recovered_messages_do_not_raise_the_rate() {
        let mut stream = StreamStatistics::default();
        for i in 0..20 {
            stream.arrive(&published(i + 1, i as i64 * SECOND), 20 * SECOND);
        }
        assert!((stream.rate(20 * SECOND) - 1.0).abs() < 0.01);
    }

    #[test]
    fn an_older_message_fills_a_gap_but_is_not_newer() {
        let mut stream = StreamStatistics::default();
        let freshness = [1, 3, 2, 3].map(|number| stream.arrive(&header(number), 0));
        assert_eq!(
            freshness,
            [
                Freshness::Newest,
                Freshness::Newest,
                Freshness::Older,
                Freshness::Duplicate
            ]
        );
        let view = stream.view(0, 0);
        assert_eq!((view.received, view.missing, view.filled_late), (3, 0, 1));
    }

    #[test]
    fn an_unreadable_message_is_not_missing() {
        let mut stream = StreamStatistics::default();
        stream.arrive(&header(1), 0);
        stream.note_unreadable(Some(&header(2)));
        stream.note_unreadable(Some(&header(3)));
        stream.arrive(&header(6), 0);
        stream.note_unreadable(Some(&header(5)));
        let view = stream.view(0, 0);
        assert_eq!((view.received, view.missing, view.unreadable), (5, 1, 3));
    }

    #[test]
    fn a_forged_header_does_not_stop_a_stream() {
        let mut stream = StreamStatistics::default();
        let mut forged = header(u64::MAX);
        forged.run_id = u64::MAX;
        for number in 1..4 {
            stream.note_unreadable(Some(&forged));
            assert_eq!(stream.arrive(&header(number), 0), Freshness::Newest);
        }
        let view = stream.view(0, 0);
        assert_eq!((view.received, view.missing, view.sender_restarts), (3, 0, 0));
    }
}
