//! Which messages of a session a recording has, and which are missing from when to when.

use std::fmt;
use std::path::Path;

use protocol::{CarName, Topic};
use serde::Serialize;

use super::error::RecordingError;
use super::survey::{Gap, Survey, survey};
use crate::event::RunEnd;

/// The outcome of a check.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Check {
    /// The recording.
    pub file: String,
    /// From the first event to the last \[s\].
    pub duration_s: f64,
    /// True when nothing is missing of any car, and it is known how far the streams of each run go.
    pub complete: bool,
    /// True when nothing is missing but what a car itself has lost, because its own recording was cut off.
    pub all_there_is: bool,
    /// The cars by name.
    pub cars: Vec<CarCheck>,
}

/// One car.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CarCheck {
    /// Its name.
    pub car: CarName,
    /// Messages that are missing of the streams that must be complete.
    pub missing: u64,
    /// Share of the messages published that are here, of the streams that must be complete, in `[0, 1]`.
    pub coverage: f64,
    /// True when it is known of each run how far its streams go. Otherwise later messages may be missing.
    pub confirmed: bool,
    /// Its runs, in the order in which they began.
    pub runs: Vec<RunCheck>,
    /// Its streams.
    pub streams: Vec<StreamCheck>,
}

/// One run of a car.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunCheck {
    /// Its id.
    pub run_id: u64,
    /// When its first message was published, since the recording's start \[s\].
    pub from_s: f64,
    /// When its last message was published.
    pub to_s: f64,
    /// How it is known that nothing follows; None where it is not.
    pub end: Option<RunEnd>,
    /// When the next run begins; None for the last one.
    pub next_s: Option<f64>,
}

/// One stream.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StreamCheck {
    /// Its topic.
    pub topic: Topic,
    /// True when each message counts. Otherwise the newest counts, or the messages are copies of a full-rate stream.
    pub required: bool,
    /// Messages published since the first one that is here, as far as that is known.
    pub published: u64,
    /// Messages that are here.
    pub received: u64,
    /// Messages of these that arrived late, because the link had lost them or was cut.
    pub recovered: u64,
    /// Messages that are missing.
    pub missing: u64,
    /// Messages that came and cannot be decoded.
    pub unreadable: u64,
    /// Messages that were dropped because their run or their number was not plausible.
    pub rejected: u64,
    /// What is missing.
    pub gaps: Vec<GapCheck>,
}

/// Messages of a stream that are missing.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GapCheck {
    /// The run of the car.
    pub run_id: u64,
    /// The first and the last number.
    pub numbers: [u64; 2],
    /// How many.
    pub count: u64,
    /// From when, since the recording's start \[s\]; None where that is not known.
    pub from_s: Option<f64>,
    /// Until when; None where that is not known.
    pub to_s: Option<f64>,
}

/// Checks a recording.
pub fn check(path: &Path) -> Result<Check, RecordingError> {
    let survey = survey(path)?;
    let Some((from, to)) = survey.span else {
        return Err(RecordingError::Empty(path.display().to_string()));
    };
    let cars: Vec<_> = survey
        .cars()
        .into_iter()
        .map(|car| check_car(&survey, car, from))
        .collect();
    if cars.is_empty() {
        return Err(RecordingError::Empty(path.display().to_string()));
    }
    Ok(Check {
        file: path.display().to_string(),
        duration_s: (to - from) as f64 * 1e-9,
        complete: cars
            .iter()
            .all(|car| car.missing == 0 && car.confirmed && !car.lost_an_end()),
        all_there_is: cars.iter().all(|car| car.missing == 0 && car.confirmed),
        cars,
    })
}

fn check_car(survey: &Survey, car: CarName, begin: i64) -> CarCheck {
    let seconds = |run_id: u64, at: i64| {
        let offset = survey.offset_in(&car, run_id);
        at.saturating_sub(offset).saturating_sub(begin) as f64 * 1e-9
    };
    let runs = survey.runs(&car);
    // What is missing before the first message of a run was published after the end of the run before it.
    let before = |run_id: u64| {
        let place = runs.iter().position(|run| run.run_id == run_id)?;
        let before = runs.get(place.checked_sub(1)?)?;
        Some(seconds(before.run_id, before.published[1]))
    };
    let mut sent = 0_u64;
    let mut streams = Vec::new();
    for (topic, stream) in survey.of(&car) {
        let required = survey.must_be_complete(&car, topic);
        let gaps = stream.gaps(topic).into_iter().map(
            |Gap {
                 run_id,
                 numbers,
                 count,
                 from,
                 to,
                 ..
             }| GapCheck {
                run_id,
                numbers,
                count,
                from_s: from
                    .map(|at| seconds(run_id, at))
                    .or_else(|| if numbers[0] == 1 { before(run_id) } else { None }),
                to_s: to.map(|at| seconds(run_id, at)),
            },
        );
        let (received, missing) = (stream.numbers.received(), stream.numbers.missing());
        let published = received.saturating_add(missing);
        if required {
            sent = sent.saturating_add(published);
        }
        streams.push(StreamCheck {
            topic,
            required,
            published,
            received,
            recovered: stream.recovered,
            missing,
            unreadable: stream.unreadable,
            rejected: stream.rejected,
            gaps: gaps.collect(),
        });
    }
    let missing = survey.missing_content(&car);
    let next = runs.iter().skip(1).map(Some).chain([None]);
    let runs: Vec<_> = runs
        .iter()
        .zip(next)
        .map(|(run, next)| RunCheck {
            run_id: run.run_id,
            from_s: seconds(run.run_id, survey.begin_of(&car, run)),
            to_s: seconds(run.run_id, run.published[1]),
            end: run.end,
            next_s: next.map(|next| seconds(next.run_id, survey.begin_of(&car, next))),
        })
        .collect();
    CarCheck {
        missing,
        coverage: 1.0 - missing as f64 / (sent.max(1)) as f64,
        confirmed: !runs.is_empty() && runs.iter().all(|run| run.end.is_some()),
        runs,
        streams,
        car,
    }
}

impl CarCheck {
    /// True when the own recording of one of its runs was cut off.
    fn lost_an_end(&self) -> bool {
        self.runs.iter().any(|run| run.end == Some(RunEnd::CutOff))
    }
}

impl fmt::Display for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for car in &self.cars {
            writeln!(f, "{car}")?;
        }
        let total: u64 = self.cars.iter().map(|car| car.missing).sum();
        write!(f, "{}, {:.1} s: ", self.file, self.duration_s)?;
        match total {
            0 if self.complete => f.write_str("nothing is missing"),
            0 if self.all_there_is => f.write_str("nothing is missing but what the car itself has lost"),
            0 => f.write_str("no gap, but NOT every end is known"),
            1 => f.write_str("1 message is MISSING"),
            n => write!(f, "{n} messages are MISSING"),
        }
    }
}

impl fmt::Display for CarCheck {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{}: {:.3} % of what it published is here",
            self.car,
            self.coverage * 100.0
        )?;
        writeln!(
            f,
            "  {:<20} {:>10} {:>10} {:>10} {:>10}",
            "stream", "published", "received", "recovered", "missing"
        )?;
        for stream in self.streams.iter().filter(|stream| stream.required) {
            write!(f, "{stream}")?;
        }
        let others: Vec<_> = self.streams.iter().filter(|stream| !stream.required).collect();
        if !others.is_empty() {
            writeln!(f, "  live copies and views, of which the newest counts:")?;
        }
        for stream in others {
            write!(f, "{stream}")?;
        }
        for run in &self.runs {
            write!(f, "{run}")?;
        }
        Ok(())
    }
}

impl fmt::Display for RunCheck {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            run_id,
            from_s,
            to_s,
            end,
            next_s,
        } = self;
        write!(f, "  run {run_id}, {from_s:.3} s to {to_s:.3} s: ")?;
        match (end, next_s) {
            (Some(RunEnd::Answered), _) => writeln!(f, "the car has confirmed the end"),
            (Some(RunEnd::Stopped), _) => writeln!(f, "the car has stopped, and has confirmed the end"),
            (Some(RunEnd::Recorded), _) => writeln!(f, "the car's own recording confirms the end"),
            (Some(RunEnd::CutOff), _) => writeln!(
                f,
                "the car was cut off; what it had not brought to its disk then, a second at most, is lost"
            ),
            (None, Some(next)) => writeln!(
                f,
                "the end is NOT known: messages between {to_s:.3} s and {next:.3} s may be missing, too"
            ),
            (None, None) => writeln!(
                f,
                "the end is NOT known: messages after {to_s:.3} s may be missing, too"
            ),
        }
    }
}

impl fmt::Display for StreamCheck {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const LISTED: usize = 20;
        writeln!(
            f,
            "  {:<20} {:>10} {:>10} {:>10} {:>10}",
            self.topic, self.published, self.received, self.recovered, self.missing
        )?;
        if self.rejected > 0 {
            writeln!(
                f,
                "    {} dropped: of another run, or an implausible number",
                self.rejected
            )?;
        }
        if self.unreadable > 0 {
            writeln!(f, "    {} cannot be decoded", self.unreadable)?;
        }
        if !self.required {
            return Ok(());
        }
        for gap in self.gaps.iter().take(LISTED) {
            let [from, to] = gap.numbers;
            let when = match (gap.from_s, gap.to_s) {
                (Some(from), Some(to)) => format!("between {from:.3} s and {to:.3} s"),
                (Some(from), None) => format!("after {from:.3} s"),
                (None, Some(to)) => format!("before {to:.3} s"),
                (None, None) => "at an unknown time".to_owned(),
            };
            writeln!(f, "    missing {from} to {to}, {} messages {when}", gap.count)?;
        }
        if self.gaps.len() > LISTED {
            writeln!(f, "    and {} more gaps", self.gaps.len() - LISTED)?;
        }
        Ok(())
    }
}
