//! One stream of a car: rate, age, losses.

use std::collections::{BTreeSet, VecDeque};

use protocol::Header;
use serde::Serialize;

use super::sequence_tracker::{SequenceStatus, SequenceTracker};

/// What is known of one topic of one car.
#[derive(Debug, Clone, Default)]
pub struct StreamStatistics {
    gaps: SequenceTracker,
    /// When the last messages were published, and when the newest arrived [unix ns].
    published: VecDeque<i64>,
    arrived: i64,
    newest: Option<Header>,
    unreadable: u64,
    /// The newest message of all, where that one could not be read.
    refused: Option<Header>,
    /// Run and number of messages that could not be read, until one of a later number can: only that one proves that
    /// there is such a run.
    unproven: BTreeSet<(u64, u64)>,
    late_by: f64,
    /// Of the last second: when each arrived [unix ns], and how late [s].
    transits: VecDeque<(i64, f64)>,
}

/// What a message was to its stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Freshness {
    /// Newer than all before it.
    Newest,
    /// It was missing until now.
    Older,
    /// It had come already.
    Duplicate,
}

/// [ns]
const SECOND: i64 = 1_000_000_000;

impl StreamStatistics {
    /// Messages that a rate is taken over.
    const WINDOW: usize = 64;
    /// Messages that could not be read and are remembered by their numbers.
    const UNPROVEN: usize = 4096;

    /// Takes note of a message that arrived at `at` [unix ns].
    pub fn arrive(&mut self, header: &Header, at: i64) -> Freshness {
        let order = |h: &Header| (h.run_id, h.sequence);
        let later = self.unproven.split_off(&order(header));
        for (run_id, sequence) in std::mem::replace(&mut self.unproven, later) {
            if run_id == header.run_id {
                self.gaps.arrive(run_id, sequence);
            }
        }
        let arrival = self.gaps.arrive(header.run_id, header.sequence);
        if arrival == SequenceStatus::Duplicate {
            return Freshness::Duplicate;
        }
        let newer = self.newest.is_none_or(|newest| order(header) > order(&newest));
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
            self.refused = None;
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

    /// Takes note of bytes that could not be read; returns how many there were. What came and cannot be read is not
    /// missing.
    pub fn refuse(&mut self, header: Option<&Header>) -> u64 {
        self.unreadable += 1;
        if let Some(header) = header {
            let order = |h: &Header| (h.run_id, h.sequence);
            if self.newest.is_none_or(|newest| order(header) > order(&newest)) {
                self.refused = Some(*header);
                self.unproven.insert(order(header));
                if self.unproven.len() > Self::UNPROVEN {
                    self.unproven.pop_first();
                }
            } else {
                // In the current run it fills its gap; one of an earlier run is left alone.
                self.gaps.arrive(header.run_id, header.sequence);
            }
        }
        self.unreadable
    }

    /// How many payloads could not be read.
    pub fn unreadable(&self) -> u64 {
        self.unreadable
    }

    /// The newest message of all, where that one could not be read.
    pub fn refused(&self) -> Option<Header> {
        self.refused
    }

    /// The newest message's header.
    pub fn newest(&self) -> Option<Header> {
        self.newest
    }

    /// How late messages arrived in the second before `now` [unix ns], the median by both clocks as they are [s], and how
    /// many did; None when none did.
    pub fn transit(&self, now: i64) -> Option<(f64, usize)> {
        let mut recent: Vec<f64> = self
            .transits
            .iter()
            .filter(|(at, _)| now - at <= SECOND)
            .map(|(_, late)| *late)
            .collect();
        recent.sort_by(f64::total_cmp);
        Some((*recent.get(recent.len() / 2)?, recent.len()))
    }

    /// When the last message arrived [unix ns].
    pub fn last_arrival(&self) -> Option<i64> {
        self.newest.map(|_| self.arrived)
    }

    /// Messages per second, up to `now` [unix ns]; falls when nothing comes. Freshness from when they were published,
    /// because what a car has kept for us arrives all at once.
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

    /// The stream at `now` [unix ns], the car's clock being `offset` [ns] ahead of the laptop's.
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
        }
    }
}

/// A stream in numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StreamView {
    /// Messages per second [Hz].
    pub rate_hz: f64,
    /// Time since the newest content was true [s].
    pub age_s: Option<f64>,
    /// From publishing to arrival, of the newest message [s].
    pub transit_s: Option<f64>,
    /// Different messages that came.
    pub received: u64,
    /// Messages that were sent and did not come.
    pub missing: u64,
    /// Messages that came late, out of the sender's cache.
    pub filled_late: u64,
    /// How often the sender started again.
    pub sender_restarts: u64,
    /// Payloads that could not be read.
    pub unreadable: u64,
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
    fn a_burst_of_what_was_kept_is_no_high_rate() {
        let mut stream = StreamStatistics::default();
        for i in 0..20 {
            stream.arrive(&published(i + 1, i as i64 * SECOND), 20 * SECOND);
        }
        assert!((stream.rate(20 * SECOND) - 1.0).abs() < 0.01);
    }

    #[test]
    fn an_older_message_fills_a_gap_but_is_not_newer() {
        let mut stream = StreamStatistics::default();
        let taken = [1, 3, 2, 3].map(|number| stream.arrive(&header(number), 0));
        assert_eq!(
            taken,
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
    fn what_came_and_cannot_be_read_is_not_missing() {
        let mut stream = StreamStatistics::default();
        stream.arrive(&header(1), 0);
        stream.refuse(Some(&header(2)));
        stream.refuse(Some(&header(3)));
        stream.arrive(&header(6), 0);
        stream.refuse(Some(&header(5)));
        let view = stream.view(0, 0);
        assert_eq!((view.received, view.missing, view.unreadable), (5, 1, 3));
    }

    #[test]
    fn an_unreadable_header_of_nobody_stops_no_stream() {
        let mut stream = StreamStatistics::default();
        let mut forged = header(u64::MAX);
        forged.run_id = u64::MAX;
        for number in 1..4 {
            stream.refuse(Some(&forged));
            assert_eq!(stream.arrive(&header(number), 0), Freshness::Newest);
        }
        let view = stream.view(0, 0);
        assert_eq!((view.received, view.missing, view.sender_restarts), (3, 0, 0));
    }
}
