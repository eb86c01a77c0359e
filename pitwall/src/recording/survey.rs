//! Which messages a recording has, by their headers. Nothing is decoded, so that a long recording is read quickly.

use std::collections::BTreeMap;
use std::path::Path;

use protocol::{CarName, Header, Topic};
use serde::Serialize;

use super::error::RecordingError;
use super::note::Note;
use super::reader::{RawEvent, read_raw};
use super::summary::missing_content;
use crate::event::{RunEnd, SentRange};
use crate::fleet::{Fleet, SequenceStatus, SequenceTracker};

/// The streams of a recording.
#[derive(Debug, Default)]
pub(crate) struct Survey {
    pub(crate) streams: BTreeMap<(CarName, Topic), StreamSurvey>,
    /// When the first message of each car's run was published that is not an event, by the car's clock \[unix ns\]. Events
    /// may be older than the recording.
    pub(crate) begun: BTreeMap<(CarName, u64), i64>,
    /// The runs of each car, in the order in which they begin.
    runs: BTreeMap<CarName, Vec<RunSurvey>>,
    /// Each car's clock minus the laptop's, by the last comparison \[ns\].
    offsets: BTreeMap<CarName, i64>,
    /// The same of runs that have not sent anything yet.
    early_offsets: BTreeMap<(CarName, u64), i64>,
    /// The first and the last log time \[unix ns\].
    pub(crate) span: Option<(i64, i64)>,
}

/// One run of a car.
#[derive(Debug, Clone)]
pub(crate) struct RunSurvey {
    pub(crate) run_id: u64,
    /// When its first and its last message were published, by the car's clock \[unix ns\].
    pub(crate) published: [i64; 2],
    /// The car's clock minus the laptop's in this run \[ns\]; None where they were not compared.
    offset: Option<i64>,
    /// How it is known that nothing follows; None where it is not.
    pub(crate) end: Option<RunEnd>,
    /// When the car stopped, by its own clock \[unix ns\]; None where it has not said so.
    stopped: Option<i64>,
}

/// One stream.
#[derive(Debug, Default)]
pub(crate) struct StreamSurvey {
    pub(crate) numbers: SequenceTracker,
    /// Messages that arrived after a later one, or much later than others.
    pub(crate) recovered: u64,
    /// Messages that the recorder dropped.
    pub(crate) rejected: u64,
    /// Messages that the recorder could not decode.
    pub(crate) unreadable: u64,
    /// Bytes of the messages.
    pub(crate) bytes: u64,
    /// The last number before and the first number after each gap of the order, with the times of publishing \[unix ns\]. Only
    /// used to find when a missing message was published.
    pub(crate) edges: BTreeMap<(u64, u64), i64>,
    last: Option<(u64, u64, i64)>,
}

impl StreamSurvey {
    /// More gaps than these have no times.
    const MAX_EDGES: usize = 20_000;

    /// Adds a message. `late` is true for one that arrived much later than others.
    fn add(&mut self, header: &Header, late: bool) {
        let Header {
            run_id,
            sequence,
            published,
            ..
        } = *header;
        let status = self.numbers.arrive(run_id, sequence);
        if status == SequenceStatus::Duplicate {
            return;
        }
        self.recovered += u64::from(late || status == SequenceStatus::Late);
        let follows = self
            .last
            .is_some_and(|(run, number, _)| run == run_id && number + 1 == sequence);
        if !follows && self.edges.len() + 2 <= Self::MAX_EDGES {
            if let Some((run, number, at)) = self.last {
                self.edges.insert((run, number), at);
            }
            self.edges.insert((run_id, sequence), published);
        }
        self.last = Some((run_id, sequence, published));
    }

    /// What is missing.
    pub(crate) fn gaps(&self, topic: Topic) -> Vec<Gap> {
        let gap = |(run_id, numbers): (u64, [u64; 2])| {
            let (from, to) = self.published(run_id, numbers);
            Gap {
                topic,
                run_id,
                numbers,
                count: numbers[1] - numbers[0] + 1,
                from,
                to,
            }
        };
        self.numbers.missing_by_run().map(gap).collect()
    }

    /// When the numbers `from` to `to` of a run were published, by the neighbours that are there \[unix ns\].
    pub(crate) fn published(&self, run_id: u64, [from, to]: [u64; 2]) -> (Option<i64>, Option<i64>) {
        let before = self.edges.range((run_id, 0)..(run_id, from)).next_back();
        let after = self.edges.range((run_id, to + 1)..=(run_id, u64::MAX)).next();
        let before = before
            .filter(|((_, number), _)| *number + 1 == from)
            .map(|(_, at)| *at);
        (before, after.map(|(_, at)| *at))
    }
}

/// Reads the headers of a whole recording.
pub(crate) fn survey(path: &Path) -> Result<Survey, RecordingError> {
    survey_with(path, |_, _, _, _| ())
}

/// Reads the headers of a whole recording, and passes on each message with an intact one.
pub(super) fn survey_with(
    path: &Path,
    mut pass_on: impl FnMut(&CarName, Topic, &Header, Vec<u8>),
) -> Result<Survey, RecordingError> {
    /// A message that takes this much longer than the fastest was recovered \[ns\].
    const LATE: i64 = 1_000_000_000;
    let mut survey = Survey::default();
    let mut delays = BTreeMap::new();
    for event in read_raw(path)? {
        let (at, car, event) = event?;
        survey.span = Some(
            survey
                .span
                .map_or((at, at), |(from, to)| (from.min(at), to.max(at))),
        );
        match event {
            RawEvent::Message { topic, header, bytes } => {
                let stream = survey.streams.entry((car.clone(), topic)).or_default();
                stream.bytes += bytes.len() as u64;
                let Some(header) = header else {
                    stream.unreadable += 1;
                    continue;
                };
                let delay = at.saturating_sub(header.published);
                let least = delays.entry((car.clone(), header.run_id)).or_insert(delay);
                *least = delay.min(*least);
                stream.add(&header, delay - *least > LATE);
                survey.add_to_run(&car, &header);
                if topic != Topic::Event {
                    let begun = survey
                        .begun
                        .entry((car.clone(), header.run_id))
                        .or_insert(header.published);
                    *begun = header.published.min(*begun);
                }
                pass_on(&car, topic, &header, bytes);
            }
            RawEvent::Note(Note::Unreadable { topic, header, .. }) => {
                let stream = survey.streams.entry((car, topic)).or_default();
                stream.unreadable += 1;
                // It came, so it is not missing.
                if let Some(header) = header.filter(|header| stream.numbers.has_run(header.run_id)) {
                    stream.numbers.arrive(header.run_id, header.sequence);
                }
            }
            RawEvent::Note(Note::Rejected { topic, count, .. }) => {
                let stream = survey.streams.entry((car, topic)).or_default();
                stream.rejected = stream.rejected.saturating_add(count);
            }
            RawEvent::Note(Note::StreamEnds {
                run_id,
                published,
                end,
                outstanding,
            }) => {
                let runs = survey.runs.entry(car.clone()).or_default();
                if let Some(run) = runs.iter_mut().rev().find(|run| run.run_id == run_id) {
                    run.end = Some(end);
                    run.stopped = (end == RunEnd::Stopped).then_some(published);
                }
                for SentRange { topic, from, to } in outstanding {
                    let stream = survey.streams.entry((car.clone(), topic)).or_default();
                    stream.numbers.sent(run_id, from, to);
                }
            }
            RawEvent::Note(Note::Clock { run_id, offset, .. }) => {
                let runs = survey.runs.entry(car.clone()).or_default();
                let run = match run_id {
                    Some(run_id) => runs.iter_mut().rev().find(|run| run.run_id == run_id),
                    None => runs.last_mut(),
                };
                match (run, run_id) {
                    (Some(run), _) => run.offset = Some(offset),
                    (None, Some(run_id)) if survey.early_offsets.len() < Survey::MOST_RUNS => {
                        survey.early_offsets.insert((car.clone(), run_id), offset);
                    }
                    (None, _) => {}
                }
                survey.offsets.insert(car, offset);
            }
            RawEvent::Note(_) => {}
        }
    }
    for stream in survey.streams.values_mut() {
        if let Some((run, number, at)) = stream.last {
            stream.edges.insert((run, number), at);
        }
    }
    Ok(survey)
}

/// Messages of a stream that are missing.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Gap {
    #[serde(skip)]
    pub(crate) topic: Topic,
    /// The run of the car.
    pub(crate) run_id: u64,
    /// The numbers, both included.
    pub(crate) numbers: [u64; 2],
    /// How many.
    pub(crate) count: u64,
    /// When the last message before them was published, by the car's clock \[unix ns\]; None where that is not known.
    pub(crate) from: Option<i64>,
    /// When the first message after them was published; None where that is not known.
    pub(crate) to: Option<i64>,
}

impl Survey {
    /// Prepares a fleet for the car's events: which streams are used, and which laps count.
    pub(crate) fn prepare(&self, fleet: &mut Fleet, car: &CarName) {
        let runs = self.begun.iter().filter(|((name, _), _)| name == car);
        let begun = runs.map(|((_, run_id), begun)| (*run_id, *begun)).collect();
        // A car may send full-rate poses and no full-rate health.
        let complete = [Topic::Pose, Topic::Health].map(|topic| self.is_copy(car, topic));
        fleet.read_from(car.clone(), complete, begun);
    }

    /// Prepares a fleet for a replay, which shows the live streams as they came.
    pub(crate) fn prepare_replay(&self, fleet: &mut Fleet) {
        for car in self.cars() {
            let runs = self.begun.iter().filter(|((name, _), _)| *name == car);
            let begun = runs.map(|((_, run_id), begun)| (*run_id, *begun)).collect();
            fleet.read_from(car, [false; 2], begun);
        }
    }

    /// The cars.
    pub(crate) fn cars(&self) -> Vec<CarName> {
        let mut cars: Vec<_> = self.streams.keys().map(|(car, _)| car.clone()).collect();
        cars.dedup();
        cars
    }

    /// Beyond this many, a run of a car is not told apart from the last one.
    const MOST_RUNS: usize = 1000;

    /// Notes a message of a run.
    fn add_to_run(&mut self, car: &CarName, header: &Header) {
        let Header {
            run_id, published, ..
        } = *header;
        let runs = self.runs.entry(car.clone()).or_default();
        let Some(run) = runs.iter_mut().rev().find(|run| run.run_id == run_id) else {
            if runs.len() < Self::MOST_RUNS {
                runs.push(RunSurvey {
                    run_id,
                    published: [published; 2],
                    offset: self.early_offsets.remove(&(car.clone(), run_id)),
                    end: None,
                    stopped: None,
                });
            } else if let Some(last) = runs.last_mut() {
                last.end = None;
            }
            return;
        };
        if run.stopped.is_some_and(|stopped| published > stopped) {
            // It had not stopped.
            (run.end, run.stopped) = (None, None);
        }
        let [from, to] = run.published;
        run.published = [from.min(published), to.max(published)];
    }

    /// The runs of a car, in the order in which they begin.
    pub(crate) fn runs(&self, car: &CarName) -> &[RunSurvey] {
        self.runs.get(car).map_or(&[], Vec::as_slice)
    }

    /// When the first message of a run was published that is not an event, by the car's clock \[unix ns\].
    pub(crate) fn begin_of(&self, car: &CarName, run: &RunSurvey) -> i64 {
        let begun = self.begun.get(&(car.clone(), run.run_id));
        begun.copied().unwrap_or(run.published[0])
    }

    /// The car's clock minus the laptop's in a run, or else in another one \[ns\]; None where they were never compared.
    pub(crate) fn compared(&self, car: &CarName, run_id: u64) -> Option<i64> {
        let run = self.runs(car).iter().rev().find(|run| run.run_id == run_id);
        run.and_then(|run| run.offset).or_else(|| self.offset(car))
    }

    /// The same; 0 where they were never compared.
    pub(crate) fn offset_in(&self, car: &CarName, run_id: u64) -> i64 {
        self.compared(car, run_id).unwrap_or_default()
    }

    /// The streams of a car.
    pub(crate) fn of<'a>(&'a self, car: &'a CarName) -> impl Iterator<Item = (Topic, &'a StreamSurvey)> {
        let streams = self.streams.iter().filter(move |((name, _), _)| name == car);
        streams.map(|((_, topic), stream)| (*topic, stream))
    }

    /// Messages of a car that are missing, see [`missing_content`].
    pub(crate) fn missing_content(&self, car: &CarName) -> u64 {
        missing_content(
            self.of(car)
                .map(|(topic, stream)| (topic, stream.numbers.received(), stream.numbers.missing())),
        )
    }

    /// The car's clock minus the laptop's \[ns\]; None where they were not compared.
    pub(crate) fn offset(&self, car: &CarName) -> Option<i64> {
        self.offsets.get(car).copied()
    }

    /// True for a stream whose missing messages count as lost.
    pub(crate) fn must_be_complete(&self, car: &CarName, topic: Topic) -> bool {
        topic.recovered() && !self.is_copy(car, topic)
    }

    /// What is missing of the streams that must be complete.
    pub(crate) fn gaps(&self, car: &CarName) -> Vec<Gap> {
        let streams = self
            .of(car)
            .filter(|(topic, _)| self.must_be_complete(car, *topic));
        streams.flat_map(|(topic, stream)| stream.gaps(topic)).collect()
    }

    /// How many messages of the streams that must be complete are there of which run, and from when to when they were
    /// published, by the car's clock \[unix ns\].
    pub(crate) fn received(&self, car: &CarName) -> Vec<(u64, i64, i64, u64)> {
        let mut out = Vec::new();
        for (_, stream) in self
            .of(car)
            .filter(|(topic, _)| self.must_be_complete(car, *topic))
        {
            let edges: Vec<_> = stream.edges.iter().collect();
            let mut missing: Vec<_> = stream.numbers.missing_by_run().collect();
            missing.sort_unstable();
            for pair in edges.windows(2) {
                let [((run, a), begin), ((other, b), end)] = pair else {
                    continue;
                };
                if run != other {
                    continue;
                }
                // A gap lies either whole between two neighbouring edges, or not at all.
                let gap = missing
                    .binary_search_by_key(&(*run, a + 1), |(run, [from, _])| (*run, *from))
                    .map_or(0, |at| missing[at].1[1] - missing[at].1[0] + 1);
                out.push((*run, **begin, **end, (b - a).saturating_sub(gap)));
            }
        }
        out
    }
    /// True when a stream is complete in another one of the same car: the live poses and health messages are copies of those at
    /// full rate.
    pub(crate) fn is_copy(&self, car: &CarName, topic: Topic) -> bool {
        let Some(full) = full_rate(topic) else {
            return false;
        };
        let received = |topic| {
            let stream = self.streams.get(&(car.clone(), topic));
            stream.map_or(0, |stream| stream.numbers.received())
        };
        received(full) > 0 && received(full) >= received(topic)
    }
}

/// The stream at full rate that has the content of a live one.
pub(crate) fn full_rate(topic: Topic) -> Option<Topic> {
    match topic {
        Topic::Pose => Some(Topic::RecordedPose),
        Topic::Health => Some(Topic::RecordedHealth),
        _ => None,
    }
}
