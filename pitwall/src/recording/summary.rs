//! The content of a recording, and what is missing in it.

use std::fmt;

use protocol::{CarName, Topic};
use serde::Serialize;

use super::survey::full_rate;
use crate::fleet::GapSummary;

/// The content of a recording, and what is missing in it.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct RecordingSummary {
    /// From the first event to the last \[s\].
    pub duration_s: f64,
    /// Messages and notes.
    pub messages: u64,
    /// Every stream.
    pub streams: Vec<StreamSummary>,
    /// Cars that did not answer the final sync. Their last messages may be missing and are not counted.
    pub unanswered: Vec<CarName>,
}

/// One stream of a recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StreamSummary {
    /// The car.
    pub car: CarName,
    /// The topic.
    pub topic: Topic,
    /// Time from the stream's last message to the end of the car's recording \[s\]. The end is the final sync, or else the
    /// car's last message on any topic. None when the stream has no message in the car's last run.
    pub behind_s: Option<f64>,
    /// Messages that were dropped because their run or their number is not plausible. They are not missing.
    pub rejected: u64,
    /// What arrived and what is missing.
    #[serde(flatten)]
    pub gaps: GapSummary,
}

/// Missing messages of one car, counted by content. Each item is a topic, how many arrived and how many are missing.
///
/// Live poses and health messages are copies of those at full rate: what is missing of them counts only where the full-rate
/// stream is not there. Of clouds, scan views, load and sets only the newest matters, so that none of those is missing.
pub fn missing_content(streams: impl Iterator<Item = (Topic, u64, u64)>) -> u64 {
    let streams: Vec<_> = streams.collect();
    let received = |topic| {
        streams
            .iter()
            .find(|(other, ..)| *other == topic)
            .map_or(0, |(_, received, _)| *received)
    };
    let counts = |topic: Topic, count: u64| match full_rate(topic) {
        Some(full) => received(full) < count.max(1),
        None => topic.recovered(),
    };
    streams
        .iter()
        .filter(|(topic, received, _)| counts(*topic, *received))
        .fold(0, |sum, (_, _, missing)| sum.saturating_add(*missing))
}

impl RecordingSummary {
    /// Messages whose content was sent and is not in the file, see [`missing_content`].
    pub fn missing(&self) -> u64 {
        let mut cars: Vec<_> = self.streams.iter().map(|stream| &stream.car).collect();
        cars.dedup();
        let missing = |car: &CarName| {
            let streams = self.streams.iter().filter(|stream| stream.car == *car);
            missing_content(streams.map(|stream| (stream.topic, stream.gaps.received, stream.gaps.missing)))
        };
        cars.into_iter().map(missing).sum()
    }
}

impl fmt::Display for RecordingSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:<12} {:<18} {:>9} {:>9} {:>9} {:>9} {:>9}",
            "car", "stream", "first", "last", "received", "missing", "behind"
        )?;
        for StreamSummary {
            car,
            topic,
            behind_s,
            rejected,
            gaps,
        } in &self.streams
        {
            let behind = behind_s.map_or_else(|| "-".to_owned(), |s| format!("{s:.2} s"));
            writeln!(
                f,
                "{car:<12} {topic:<18} {:>9} {:>9} {:>9} {:>9} {behind:>9}",
                gaps.first, gaps.last, gaps.received, gaps.missing
            )?;
            if *rejected > 0 {
                writeln!(
                    f,
                    "{:<12} {:<18} dropped {rejected}: not of the run that was followed, or an implausible number",
                    "", ""
                )?;
            }
            for [from, to] in gaps.missing_ranges.iter().take(10) {
                writeln!(f, "{:<12} {:<18} missing {from} to {to}", "", "")?;
            }
            if gaps.missing_ranges.len() > 10 {
                writeln!(f, "{:<31} and {} more ranges", "", gaps.missing_ranges.len() - 10)?;
            }
        }
        for car in &self.unanswered {
            writeln!(
                f,
                "{car} did not answer at the end: its last messages may be missing, too"
            )?;
        }
        let missing = match self.missing() {
            0 => "nothing is missing".to_owned(),
            1 => "1 message is missing".to_owned(),
            n => format!("{n} messages are missing"),
        };
        write!(
            f,
            "{} messages in {:.1} s; {missing}",
            self.messages, self.duration_s
        )
    }
}
