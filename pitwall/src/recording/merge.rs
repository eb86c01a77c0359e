//! Merges recordings of a session, from the cars and from laptops, into one file without doubles.
//!
//! A message is the same where car, topic, run and sequence number are. What a laptop has received keeps the time at which it
//! arrived. What only the car has gets the time at which it was published, by the laptop's clock: the laptop's recording has the
//! difference between the clocks. It stays between its neighbours, so that each stream is in order.
//!
//! Of each run of a car the new file says how far its streams go, and how that is known: the car has answered a laptop, or its
//! own recording is completed, or that was cut off, so that nobody has what followed.
//!
//! Two passes: the first notes which numbers each recording has, and the clocks. The second merges by time, with a few hundred
//! messages of each file in memory.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap, HashSet};
use std::fs::{self, OpenOptions};
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use protocol::{CarName, Topic};
use serde::Serialize;

use super::error::RecordingError;
use super::fetch::PART;
use super::reader::{Recording, read_intact};
use super::summary::RecordingSummary;
use super::writer::RecordingWriter;
use crate::event::{EventPayload, FleetEvent, RunEnd};

/// Clocks whose difference changes by more than one part in so many were set in between.
const STEADY: u64 = 100;

/// Messages of one file in memory.
const AHEAD: usize = 512;

/// What a car had sent this long after the end of its own recording may not have reached its disk \[ns\].
const UNSYNCED: i64 = 1_500_000_000;

/// The result of a merge.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Merged {
    /// The recordings, in the order of their beginnings.
    pub inputs: Vec<MergedInput>,
    /// The new file, and what is missing in it.
    pub summary: RecordingSummary,
}

/// One of the recordings.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MergedInput {
    /// The file.
    pub file: PathBuf,
    /// True for a recording made on a car.
    pub on_car: bool,
    /// Its messages.
    pub messages: u64,
    /// Those that no other recording before it has.
    pub added: u64,
    /// Damaged places. What is intact is used.
    pub damage: Vec<String>,
}

/// Merges files, and the recordings in folders, into the new file `to`.
pub fn merge(inputs: &[PathBuf], to: &Path) -> Result<Merged, RecordingError> {
    let mut files = Vec::new();
    for input in inputs {
        if input.is_dir() {
            files.extend(recordings_in(input)?);
        } else {
            files.push(input.clone());
        }
    }
    files.sort();
    files.dedup();
    let mut known = Known::default();
    let mut scans = Vec::new();
    for path in files {
        scans.push(known.scan(path)?);
    }
    scans.retain(|scan| scan.first.is_some());
    if scans.is_empty() {
        let files: Vec<_> = inputs.iter().map(|path| path.display().to_string()).collect();
        return Err(RecordingError::Empty(files.join(", ")));
    }
    known.end_of_scans(&scans);
    let output = OpenOptions::new()
        .write(true)
        .create_new(true)
        .open(to)
        .map_err(|e| RecordingError::io(to, e))?;
    let merged = write(&known, scans, output, to);
    if merged.is_err() {
        // Only what was begun here is removed.
        fs::remove_file(to).map_err(|e| RecordingError::io(to, e))?;
    }
    merged
}

/// The recordings in a folder, by name; files that are still being fetched among them.
fn recordings_in(folder: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let io = |e| RecordingError::io(folder, e);
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        let recording = |path: &Path| path.extension().is_some_and(|end| end == "mcap");
        let fetched = path.extension().is_some_and(|end| end == PART) && recording(&path.with_extension(""));
        if path.is_file() && (recording(&path) || fetched) {
            files.push(path);
        }
    }
    Ok(files)
}

/// Identifies a stream in one run of a car.
type Stream = (CarName, Topic, u64);

/// What the first pass finds out.
#[derive(Default)]
struct Known {
    /// What the laptops have received.
    received: BTreeMap<Stream, Received>,
    /// Cars that a laptop has recorded.
    at_the_wall: BTreeSet<CarName>,
    /// Clock comparisons of each run: the car's time, and the car's clock minus the laptop's \[ns\], ascending. A clock may be
    /// another one after a reboot.
    clocks: BTreeMap<CarName, BTreeMap<u64, Vec<(i64, i64)>>>,
    /// The runs that no laptop has heard.
    unheard: BTreeSet<(CarName, u64)>,
}

/// The numbers that were received of one stream.
#[derive(Default)]
struct Received(BTreeMap<u64, ReceivedRange>);

/// Consecutive numbers, and when the first and the last of them arrived \[unix ns\].
#[derive(Clone, Copy)]
struct ReceivedRange {
    last: u64,
    arrived: [i64; 2],
}

impl Received {
    fn insert(&mut self, number: u64, at: i64) {
        let before = self
            .0
            .range(..=number)
            .next_back()
            .map(|(&first, &range)| (first, range));
        if before.is_some_and(|(_, range)| range.last >= number) {
            return;
        }
        let after = number
            .checked_add(1)
            .and_then(|next| self.0.get(&next).map(|&range| (next, range)));
        let (mut first, mut merged) = (
            number,
            ReceivedRange {
                last: number,
                arrived: [at, at],
            },
        );
        if let Some((start, range)) = before.filter(|(_, range)| range.last.checked_add(1) == Some(number)) {
            first = start;
            merged.arrived[0] = range.arrived[0];
        }
        if let Some((next, range)) = after {
            self.0.remove(&next);
            merged.last = range.last;
            merged.arrived[1] = range.arrived[1];
        }
        self.0.insert(first, merged);
    }

    fn contains(&self, number: u64) -> bool {
        let range = self.0.range(..=number).next_back();
        range.is_some_and(|(_, range)| range.last >= number)
    }

    /// `at`, but between the arrivals of the neighbours of a number that was not received.
    fn between(&self, number: u64, at: i64) -> i64 {
        let before = self
            .0
            .range(..=number)
            .next_back()
            .map(|(_, range)| range.arrived[1]);
        let after = self.0.range(number..).next().map(|(_, range)| range.arrived[0]);
        match (before, after) {
            // What was filled late did not arrive in order.
            (Some(before), Some(after)) if before <= after => at.clamp(before, after),
            (Some(before), None) => at.max(before),
            (None, Some(after)) => at.min(after),
            _ => at,
        }
    }
}

/// One input after the first pass.
struct Scan {
    path: PathBuf,
    on_car: bool,
    /// When its first event happened, by the clock of whoever recorded it; None without events.
    first: Option<(CarName, i64)>,
    messages: u64,
    /// The runs in it, by car.
    runs: BTreeMap<(CarName, u64), RunScan>,
    /// The run that it begins with, by car.
    first_run: BTreeMap<CarName, u64>,
    /// True for a file with its end.
    complete: bool,
}

/// A run in one input.
struct RunScan {
    /// When its first and its last message were published, by the car's clock \[unix ns\].
    published: [i64; 2],
    /// The end as this file knows it, by the car's clock.
    end: Option<(i64, RunEnd)>,
}

impl Scan {
    fn add_message(&mut self, car: &CarName, run_id: u64, published: i64) {
        /// Beyond this many, runs are left out.
        const MOST: usize = 10_000;
        self.messages += 1;
        if !self.first_run.contains_key(car) {
            self.first_run.insert(car.clone(), run_id);
        }
        if let Some(run) = self.runs.get_mut(&(car.clone(), run_id)) {
            let [from, to] = run.published;
            run.published = [from.min(published), to.max(published)];
        } else if self.runs.len() < MOST {
            let run = RunScan {
                published: [published; 2],
                end: None,
            };
            self.runs.insert((car.clone(), run_id), run);
        }
    }

    /// The report of this input before anything is added.
    fn report(&self) -> MergedInput {
        MergedInput {
            file: self.path.clone(),
            on_car: self.on_car,
            messages: self.messages,
            added: 0,
            damage: Vec::new(),
        }
    }

    /// True for a file that is still being fetched: its car records on.
    fn grows(&self) -> bool {
        self.path.extension().is_some_and(|end| end == PART)
    }
}

impl Known {
    fn scan(&mut self, path: PathBuf) -> Result<Scan, RecordingError> {
        let mut scan = Scan {
            on_car: false,
            first: None,
            messages: 0,
            runs: BTreeMap::new(),
            first_run: BTreeMap::new(),
            complete: false,
            path,
        };
        let mut last_run = BTreeMap::new();
        let mut events = read_intact(&scan.path)?;
        while let Some(event) = events.next() {
            let event = event?;
            scan.on_car = events.library().starts_with(super::CAR_LIBRARY);
            scan.first.get_or_insert_with(|| (event.car.clone(), event.at));
            if let EventPayload::Message { header, .. } = &event.payload {
                scan.add_message(&event.car, header.run_id, header.published);
                if last_run.get(&event.car) != Some(&header.run_id) {
                    last_run.insert(event.car.clone(), header.run_id);
                }
            }
            if scan.on_car {
                continue;
            }
            self.at_the_wall.insert(event.car.clone());
            match &event.payload {
                EventPayload::Message { topic, header, .. } if header.sequence > 0 => {
                    let stream = (event.car.clone(), *topic, header.run_id);
                    self.received
                        .entry(stream)
                        .or_default()
                        .insert(header.sequence, event.at);
                }
                EventPayload::Clock { run_id, offset, .. } => {
                    let run_id = run_id.or_else(|| last_run.get(&event.car).copied());
                    let clocks = self.clocks.entry(event.car.clone()).or_default();
                    clocks
                        .entry(run_id.unwrap_or_default())
                        .or_default()
                        .push((event.at.saturating_add(*offset), *offset));
                }
                EventPayload::StreamEnds {
                    run_id,
                    published,
                    end,
                    ..
                } => {
                    if let Some(run) = scan.runs.get_mut(&(event.car.clone(), *run_id)) {
                        run.end = Some((*published, *end));
                    }
                }
                _ => {}
            }
        }
        scan.complete = events.complete();
        Ok(scan)
    }

    fn end_of_scans(&mut self, scans: &[Scan]) {
        for clocks in self.clocks.values_mut().flat_map(BTreeMap::values_mut) {
            clocks.sort_unstable();
        }
        let cars: BTreeSet<_> = scans
            .iter()
            .flat_map(|scan| scan.runs.keys())
            .map(|(car, _)| car)
            .collect();
        for car in cars {
            self.place_unheard(car, scans);
        }
    }

    /// Gives the runs of a car that no laptop has heard a clock. The one of the neighbouring run may be another: then the run is
    /// placed right behind the run before it, in the order of the car's files.
    fn place_unheard(&mut self, car: &CarName, scans: &[Scan]) {
        let mut runs: Vec<(u64, [i64; 2])> = Vec::new();
        for scan in scans.iter().filter(|scan| scan.on_car) {
            for ((_, run_id), run) in scan.runs.iter().filter(|((name, _), _)| name == car) {
                let [from, to] = run.published;
                match runs.iter_mut().find(|(known, _)| known == run_id) {
                    Some((_, [first, last])) => (*first, *last) = (from.min(*first), to.max(*last)),
                    None => runs.push((*run_id, run.published)),
                }
            }
        }
        let known = |known: &Self, run_id: u64| {
            let clocks = known.clocks.get(car);
            clocks.is_some_and(|clocks| clocks.contains_key(&run_id))
        };
        if !runs.iter().any(|(run_id, _)| known(self, *run_id)) {
            return;
        }
        for place in 0..runs.len() {
            let (run_id, [from, to]) = runs[place];
            if known(self, run_id) {
                continue;
            }
            let before = place.checked_sub(1).map(|before| {
                let (before, [_, last]) = runs[before];
                self.by_the_laptop(car, before, last)
            });
            let after = runs[place + 1..].iter().find(|(run_id, _)| known(self, *run_id));
            let after = after.map(|(after, [first, _])| self.by_the_laptop(car, *after, *first));
            let same = from.saturating_sub(self.by_the_laptop(car, run_id, from));
            let fits = before.is_none_or(|before| from.saturating_sub(same) >= before)
                && after.is_none_or(|after| to.saturating_sub(same) <= after);
            let offset = match (fits, before, after) {
                (false, Some(before), _) => from.saturating_sub(before),
                (false, None, Some(after)) => to.saturating_sub(after),
                _ => same,
            };
            let clocks = self.clocks.entry(car.clone()).or_default();
            clocks.insert(run_id, vec![(from, offset)]);
            self.unheard.insert((car.clone(), run_id));
        }
    }

    /// The clock of a run that no laptop has heard, with its first message.
    fn clock_of(
        &self,
        event: &FleetEvent,
        run_id: u64,
        known: &mut BTreeSet<(CarName, u64)>,
    ) -> Option<FleetEvent> {
        /// It is a guess: any comparison is better \[ns\].
        const GUESS: i64 = 10_000_000_000;
        let key = (event.car.clone(), run_id);
        if known.contains(&key) || !self.unheard.contains(&key) {
            return None;
        }
        known.insert(key);
        let (_, offset) = *self.clocks.get(&event.car)?.get(&run_id)?.first()?;
        Some(FleetEvent {
            at: event.at,
            car: event.car.clone(),
            payload: EventPayload::Clock {
                run_id: Some(run_id),
                offset,
                round_trip: GUESS,
            },
        })
    }

    /// The ends of all runs that are known.
    fn ends(&self, scans: &[Scan]) -> Vec<FleetEvent> {
        let mut runs = BTreeMap::<_, (i64, Vec<&Scan>)>::new();
        for scan in scans {
            for ((car, run_id), run) in &scan.runs {
                let begin = self.by_the_laptop(car, *run_id, run.published[0]);
                let (first, inputs) = runs.entry((car, *run_id)).or_insert((begin, Vec::new()));
                *first = begin.min(*first);
                inputs.push(scan);
            }
        }
        let mut newest = BTreeMap::<&CarName, i64>::new();
        for ((car, _), (begin, _)) in &runs {
            let newest = newest.entry(car).or_insert(*begin);
            *newest = *begin.max(newest);
        }
        let mut ends = Vec::new();
        for ((car, run_id), (begin, inputs)) in &runs {
            let ended = newest.get(car).is_some_and(|newest| newest > begin);
            if let Some((published, end)) = end_of_run(car, *run_id, inputs, ended) {
                ends.push(FleetEvent {
                    at: self.by_the_laptop(car, *run_id, published),
                    car: (*car).clone(),
                    payload: EventPayload::StreamEnds {
                        run_id: *run_id,
                        published,
                        end,
                        outstanding: Vec::new(),
                    },
                });
            }
        }
        ends.sort_by_key(|event| event.at);
        ends
    }

    /// A time of the car's clock by the laptop's: between two comparisons their differences go over into each other, so that
    /// the order of times stays. Where the clock was set between them, the nearer one counts.
    fn by_the_laptop(&self, car: &CarName, run_id: u64, at: i64) -> i64 {
        let Some(runs) = self.clocks.get(car) else {
            return at;
        };
        let Some(clocks) = runs.get(&run_id) else {
            // The nearest comparison of another run.
            let all = runs.values().flatten();
            let nearest = all.min_by_key(|(time, _)| time.abs_diff(at));
            return at.saturating_sub(nearest.map_or(0, |(_, offset)| *offset));
        };
        let next = clocks.partition_point(|(time, _)| *time < at);
        let before = next.checked_sub(1).and_then(|index| clocks.get(index));
        let offset = match (before, clocks.get(next)) {
            (Some(&(from, first)), Some(&(to, second))) => {
                let (passed, between) = (at.abs_diff(from), to.abs_diff(from));
                if second.abs_diff(first) <= between / STEADY {
                    let share = passed as f64 / between.max(1) as f64;
                    first + ((second - first) as f64 * share) as i64
                } else if passed <= to.abs_diff(at) {
                    first
                } else {
                    second
                }
            }
            (Some((_, only)), None) | (None, Some((_, only))) => *only,
            (None, None) => 0,
        };
        at.saturating_sub(offset)
    }
}

/// An input in the second pass.
struct Input<'a> {
    known: &'a Known,
    events: Recording,
    on_car: bool,
    ended: bool,
    /// Events in memory, the earliest first.
    waiting: BinaryHeap<Reverse<Waiting>>,
    count: u64,
    /// The run that a car's file begins with, by car.
    first_run: &'a BTreeMap<CarName, u64>,
}

/// An event, ordered by time and then by its place in the file.
struct Waiting {
    at: i64,
    place: u64,
    event: FleetEvent,
}

impl PartialEq for Waiting {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Waiting {}

impl PartialOrd for Waiting {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Waiting {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.at, self.place).cmp(&(other.at, other.place))
    }
}

impl Input<'_> {
    /// Reads ahead.
    fn fill(&mut self) -> Result<(), RecordingError> {
        // A laptop's file is in order, as it is.
        let ahead = if self.on_car { AHEAD } else { 1 };
        while !self.ended && self.waiting.len() < ahead {
            let Some(event) = self.events.next().transpose()? else {
                self.ended = true;
                break;
            };
            if let Some(event) = self.placed(event) {
                self.count += 1;
                self.waiting.push(Reverse(Waiting {
                    at: event.at,
                    place: self.count,
                    event,
                }));
            }
        }
        Ok(())
    }

    /// The event at its time by the laptop's clock; None for one of a car's that a laptop has.
    fn placed(&mut self, mut event: FleetEvent) -> Option<FleetEvent> {
        if !self.on_car {
            return Some(event);
        }
        let run_id = match &event.payload {
            EventPayload::Message { header, .. } => header.run_id,
            _ => self.first_run.get(&event.car).copied().unwrap_or_default(),
        };
        let at = self.known.by_the_laptop(&event.car, run_id, event.at);
        event.at = at;
        let wanted = match &event.payload {
            EventPayload::Message { topic, header, .. } => {
                let stream = (event.car.clone(), *topic, header.run_id);
                let received = self.known.received.get(&stream);
                if let Some(received) = received {
                    event.at = received.between(header.sequence, at);
                }
                !received.is_some_and(|received| received.contains(header.sequence))
            }
            // The laptop has noted itself when the car came and went, and its map.
            _ => !self.known.at_the_wall.contains(&event.car),
        };
        wanted.then_some(event)
    }

    fn next_at(&self) -> Option<i64> {
        self.waiting.peek().map(|Reverse(waiting)| waiting.at)
    }
}

/// How far the streams of a run go, by the car's clock \[unix ns\], and how that is known. `ended` is true when another run follows.
fn end_of_run(car: &CarName, run_id: u64, inputs: &[&Scan], ended: bool) -> Option<(i64, RunEnd)> {
    let key = (car.clone(), run_id);
    let mut at_the_wall: Option<(i64, Option<RunEnd>)> = None;
    let mut on_car: Option<(i64, &Scan)> = None;
    for scan in inputs {
        let Some(run) = scan.runs.get(&key) else {
            continue;
        };
        if scan.on_car {
            if on_car.is_none_or(|(until, _)| until <= run.published[1]) {
                on_car = Some((run.published[1], scan));
            }
            continue;
        }
        let (until, end) = match run.end {
            Some((until, end)) => (until, Some(end)),
            None => (run.published[1], None),
        };
        if at_the_wall.is_none_or(|(known, _)| known <= until) {
            at_the_wall = Some((until, end));
        }
    }
    let answer = at_the_wall.and_then(|(until, end)| Some((until, end?)));
    let Some((until, file)) = on_car else {
        return answer;
    };
    if answer.is_some_and(|(answered, _)| answered >= until) {
        return answer;
    }
    let reaches = at_the_wall.is_none_or(|(seen, _)| seen <= until.saturating_add(UNSYNCED));
    if !reaches {
        // The recording on the car had ended before.
        return answer;
    }
    if file.complete {
        Some((until, RunEnd::Recorded))
    } else if ended || !file.grows() {
        Some((until, RunEnd::CutOff))
    } else {
        answer
    }
}

fn write(known: &Known, mut scans: Vec<Scan>, output: fs::File, to: &Path) -> Result<Merged, RecordingError> {
    let mcap = |e| RecordingError::mcap(to, e);
    let begin = |scan: &Scan| {
        let (car, at) = scan.first.as_ref()?;
        Some(if scan.on_car {
            let run_id = scan.first_run.get(car).copied().unwrap_or_default();
            known.by_the_laptop(car, run_id, *at)
        } else {
            *at
        })
    };
    scans.sort_by_key(|scan| (begin(scan), scan.on_car));
    let sync = output.try_clone().map_err(|e| RecordingError::io(to, e))?;
    let mut writer = RecordingWriter::new(BufWriter::new(output)).map_err(mcap)?;
    let mut report: Vec<_> = scans.iter().map(Scan::report).collect();
    // A file is opened when its time has come: a session on a car is hundreds of files.
    let mut closed: Vec<_> = scans.iter().enumerate().rev().collect();
    let mut open: Vec<(usize, Input<'_>)> = Vec::new();
    let mut written = 0;
    // What each car's first file begins with is enough.
    let mut introduced = HashSet::new();
    let mut clocked = BTreeSet::new();
    loop {
        let earliest = open.iter().filter_map(|(_, input)| input.next_at()).min();
        if let Some((_, scan)) = closed.last()
            && earliest.is_none_or(|at| begin(scan).is_some_and(|begin| begin <= at))
            && let Some((index, scan)) = closed.pop()
        {
            let mut input = Input {
                known,
                events: read_intact(&scan.path)?,
                on_car: scan.on_car,
                ended: false,
                waiting: BinaryHeap::new(),
                count: 0,
                first_run: &scan.first_run,
            };
            input.fill()?;
            open.push((index, input));
            continue;
        }
        let next = open
            .iter_mut()
            .filter(|(_, input)| input.next_at().is_some())
            .min_by_key(|(index, input)| (input.next_at(), *index));
        let Some((index, input)) = next else {
            break;
        };
        let index = *index;
        let Some(Reverse(Waiting { event, .. })) = input.waiting.pop() else {
            break;
        };
        input.fill()?;
        let on_car = input.on_car;
        open.retain_mut(|(index, input)| {
            let ended = input.next_at().is_none();
            if ended {
                report[*index].damage = input.events.damage().to_vec();
            }
            !ended
        });
        if let EventPayload::StreamEnds { .. } = event.payload {
            // What follows in other recordings is wanted, too.
            continue;
        }
        let message = matches!(event.payload, EventPayload::Message { .. });
        if on_car
            && !message
            && !introduced.insert((event.car.clone(), std::mem::discriminant(&event.payload)))
        {
            continue;
        }
        if on_car
            && let EventPayload::Message { header, .. } = &event.payload
            && let Some(clock) = known.clock_of(&event, header.run_id, &mut clocked)
        {
            writer.write(&clock).map_err(mcap)?;
            written = writer.messages();
        }
        writer.write(&event).map_err(mcap)?;
        let total = writer.messages();
        if message && total > written {
            report[index].added += 1;
        }
        written = total;
    }
    for end in known.ends(&scans) {
        writer.write(&end).map_err(mcap)?;
    }
    let (mut summary, writer) = writer.finish().map_err(mcap)?;
    // Nobody was asked here.
    summary.unanswered.clear();
    drop(writer);
    sync.sync_all().map_err(|e| RecordingError::io(to, e))?;
    Ok(Merged {
        inputs: report,
        summary,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::Delivery;
    use crate::recording::{check, read_events};
    use mcap::WriteOptions;
    use mcap::records::MessageHeader;
    use proptest::prelude::*;
    use protocol::{Event, EventKind, Key, Stamps, Telemetry, decode, encode};

    const SECOND: i64 = 1_000_000_000;
    /// The car's clock minus the laptop's.
    const OFFSET: i64 = -3600 * SECOND;

    fn car() -> CarName {
        "car-1".parse().expect("a name")
    }

    fn bytes(run_id: u64, sequence: u64, published: i64) -> Vec<u8> {
        let event = Event {
            kind: EventKind::SearchStarted,
            update: sequence,
            who: None,
            command: None,
        };
        let stamps = Stamps {
            run_id,
            sequence,
            sensor: published,
            published,
        };
        encode(&event, stamps).expect("a good message")
    }

    /// A message of the laptop, which it got a tenth of a second after it was published. `at` is the laptop's time.
    fn received(run_id: u64, sequence: u64, at: i64) -> FleetEvent {
        received_by(OFFSET, run_id, sequence, at)
    }

    /// The same, by a car's clock.
    fn received_by(offset: i64, run_id: u64, sequence: u64, at: i64) -> FleetEvent {
        let bytes = bytes(run_id, sequence, at + offset);
        let (header, event) = decode::<Event>(&bytes).expect("our own");
        FleetEvent {
            at: at + SECOND / 10,
            car: car(),
            payload: EventPayload::Message {
                topic: Topic::Event,
                delivery: Delivery::InOrder,
                header,
                telemetry: Box::new(Telemetry::Event(event)),
                bytes: bytes.into(),
            },
        }
    }

    fn laptop(path: &Path, events: impl IntoIterator<Item = FleetEvent>) {
        let mut writer = RecordingWriter::new(fs::File::create(path).expect("a file")).expect("begun");
        writer
            .write(&FleetEvent {
                at: 0,
                car: car(),
                payload: EventPayload::Clock {
                    run_id: Some(7),
                    offset: OFFSET,
                    round_trip: 0,
                },
            })
            .expect("written");
        for event in events {
            writer.write(&event).expect("written");
        }
        writer.finish().expect("ended");
    }

    /// A file as a car writes it, of messages with run, number and time by the laptop's clock.
    fn on_car(path: &Path, messages: impl IntoIterator<Item = (u64, u64, i64)>) {
        let file = fs::File::create(path).expect("a file");
        let mut writer = WriteOptions::new()
            .library("car-node 0")
            .create(file)
            .expect("begun");
        let none = BTreeMap::new();
        let note = writer
            .add_channel(0, "pitwall/car-1/note", "json", &none)
            .expect("a channel");
        let key = Key::new(car(), Topic::Event).to_string();
        let channel = writer
            .add_channel(0, &key, Key::RECORDED_ENCODING, &none)
            .expect("a channel");
        let header = |channel_id, sequence: u64, at: i64| MessageHeader {
            channel_id,
            sequence: sequence as u32,
            log_time: at as u64,
            publish_time: at as u64,
        };
        for (index, (run, number, at)) in messages.into_iter().enumerate() {
            let at = at + OFFSET;
            if index == 0 {
                writer
                    .write_to_known_channel(&header(note, 1, at), br#"{"note":"appeared"}"#)
                    .expect("written");
            }
            writer
                .write_to_known_channel(&header(channel, number, at), &bytes(run, number, at))
                .expect("written");
        }
        writer.finish().expect("ended");
    }

    /// Run, number and time of each message in a file.
    fn content(path: &Path) -> Vec<(u64, u64, i64)> {
        let events = read_events(path).expect("opens");
        events
            .filter_map(|event| {
                let event = event.expect("intact");
                match event.payload {
                    EventPayload::Message { header, .. } => Some((header.run_id, header.sequence, event.at)),
                    _ => None,
                }
            })
            .collect()
    }

    fn numbers(path: &Path) -> Vec<(u64, u64)> {
        content(path)
            .into_iter()
            .map(|(run, number, _)| (run, number))
            .collect()
    }

    const START: i64 = 1_700_000_000 * SECOND;

    fn at(number: u64) -> i64 {
        START + number as i64 * SECOND
    }

    #[test]
    fn holes_of_the_laptop_are_filled_from_the_car_in_order_and_by_the_laptops_clock() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        laptop(
            &path("laptop.mcap"),
            (1..=100)
                .filter(|number| !(20..=50).contains(number))
                .map(|number| received(7, number, at(number))),
        );
        on_car(
            &path("000001.mcap"),
            (1..=40).map(|number| (7, number, at(number))),
        );
        on_car(
            &path("000002.mcap"),
            (41..=90).map(|number| (7, number, at(number))),
        );
        let inputs = [path("laptop.mcap"), path("000001.mcap"), path("000002.mcap")];
        let merged = merge(&inputs, &path("merged.mcap")).expect("merged");
        assert_eq!(merged.summary.missing(), 0);
        let added: Vec<_> = merged
            .inputs
            .iter()
            .map(|input| (input.on_car, input.added))
            .collect();
        assert_eq!(added.iter().map(|(_, added)| added).sum::<u64>(), 100);
        let content = content(&path("merged.mcap"));
        assert_eq!(
            numbers(&path("merged.mcap")),
            (1..=100).map(|number| (7, number)).collect::<Vec<_>>()
        );
        for (_, number, time) in content {
            let late = time - at(number);
            let filled = (20..=50).contains(&number);
            let near_the_edge = number == 20 || number == 50;
            assert!(
                late == if filled { 0 } else { SECOND / 10 } || near_the_edge,
                "{number}: {late} ns"
            );
        }
        let error = merge(&inputs, &path("merged.mcap")).expect_err("never overwritten");
        assert!(error.to_string().contains("exists already"), "{error}");
    }

    /// By the nearest comparison alone, a message half way between two got an earlier time than the one before it.
    #[test]
    fn times_stay_in_order_between_two_comparisons_of_clocks() {
        let mut known = Known::default();
        known
            .clocks
            .insert(car(), [(7, vec![(0, 0), (SECOND, 2_000_000)])].into());
        let times: Vec<_> = (0..=1100)
            .map(|ms| known.by_the_laptop(&car(), 7, ms * 1_000_000))
            .collect();
        assert!(times.windows(2).all(|pair| pair[0] < pair[1]));
        assert_eq!([times[500], times[1100]], [499_000_000, 1_098_000_000]);
        // A clock that was set: there is nothing between.
        known
            .clocks
            .insert(car(), [(7, vec![(0, 0), (3601 * SECOND, 3600 * SECOND)])].into());
        let at = |seconds: i64| known.by_the_laptop(&car(), 7, seconds * SECOND);
        assert_eq!([at(1), at(3600)], [SECOND, 0]);
    }

    #[test]
    fn a_car_that_restarted_in_the_hole_keeps_both_runs() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        let first = (1..=10).map(|number| received(7, number, at(number)));
        let second = (5..=10).map(|number| received(8, number, at(20 + number)));
        laptop(&path("laptop.mcap"), first.chain(second));
        on_car(&path("a.mcap"), (1..=15).map(|number| (7, number, at(number))));
        on_car(
            &path("b.mcap"),
            (1..=12).map(|number| (8, number, at(20 + number))),
        );
        let inputs = [folder.path().to_owned()];
        let merged = merge(&inputs, &path("merged")).expect("merged");
        let expected: Vec<_> = (1..=15)
            .map(|number| (7, number))
            .chain((1..=12).map(|number| (8, number)))
            .collect();
        assert_eq!(numbers(&path("merged")), expected);
        assert_eq!(merged.summary.missing(), 0);
    }

    fn answered(run_id: u64, at: i64) -> FleetEvent {
        FleetEvent {
            at,
            car: car(),
            payload: EventPayload::StreamEnds {
                run_id,
                published: at + OFFSET,
                end: RunEnd::Answered,
                outstanding: Vec::new(),
            },
        }
    }

    /// Removes the summary and the end mark of a file.
    fn cut_off(path: &Path) {
        let bytes = fs::read(path).expect("read");
        fs::write(path, &bytes[..bytes.len() - 300]).expect("written");
    }

    // A car that died while the link was cut, and was back before the end, was once called complete.
    #[test]
    fn the_end_of_each_run_is_known_or_the_recording_is_not_complete() {
        for is_cut_off in [true, false] {
            let folder = tempfile::tempdir().expect("a folder");
            let path = |name: &str| folder.path().join(name);
            let first = (1..=10).map(|number| received(7, number, at(number)));
            let second = (1..=10).map(|number| received(8, number, at(20 + number)));
            let events = first.chain(second).chain([answered(8, at(31))]);
            laptop(&path("laptop.mcap"), events);
            let before = check(&path("laptop.mcap")).expect("a recording");
            assert!(!before.complete && !before.all_there_is, "{before}");
            let [old, new] = &before.cars[0].runs[..] else {
                panic!("two runs: {before}")
            };
            assert_eq!((old.run_id, old.end), (7, None));
            let hole = old.next_s.expect("the next run") - old.to_s;
            assert!((hole - 11.0).abs() < 1e-6, "{hole}");
            assert_eq!((new.run_id, new.end), (8, Some(RunEnd::Answered)));
            assert!(before.to_string().contains("the end is NOT known"), "{before}");

            on_car(&path("a.mcap"), (1..=15).map(|number| (7, number, at(number))));
            if is_cut_off {
                cut_off(&path("a.mcap"));
            }
            on_car(
                &path("b.mcap"),
                (1..=10).map(|number| (8, number, at(20 + number))),
            );
            merge(&[folder.path().to_owned()], &path("merged")).expect("merged");
            let after = check(&path("merged")).expect("a recording");
            let end = if is_cut_off {
                RunEnd::CutOff
            } else {
                RunEnd::Recorded
            };
            let ends: Vec<_> = after.cars[0].runs.iter().map(|run| run.end).collect();
            assert_eq!(ends, [Some(end), Some(RunEnd::Answered)], "{after}");
            assert_eq!((after.complete, after.all_there_is), (!is_cut_off, true));
            // A merged file can be merged again.
            merge(&[path("merged"), path("b.mcap")], &path("again")).expect("merged");
            let again = check(&path("again")).expect("a recording");
            assert_eq!(
                (again.complete, again.all_there_is),
                (after.complete, after.all_there_is)
            );
        }
    }

    #[test]
    fn a_recording_on_the_car_that_ended_before_says_nothing_about_the_end() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        laptop(
            &path("laptop.mcap"),
            (1..=30).map(|number| received(7, number, at(number))),
        );
        on_car(&path("a.mcap"), (1..=15).map(|number| (7, number, at(number))));
        merge(&[folder.path().to_owned()], &path("merged")).expect("merged");
        let check = check(&path("merged")).expect("a recording");
        assert!(!check.all_there_is, "{check}");
    }

    // Without a battery, a car's clock is behind after a power cut. Its messages once stood an hour too early.
    #[test]
    fn runs_with_other_clocks_stand_one_after_the_other() {
        const BEHIND: i64 = 3600 * SECOND;
        for (behind, exact) in [(BEHIND, true), (2 * BEHIND, false)] {
            let folder = tempfile::tempdir().expect("a folder");
            let path = |name: &str| folder.path().join(name);
            let first = (1..=10).map(|number| received(7, number, at(number)));
            let clock = FleetEvent {
                at: at(45),
                car: car(),
                payload: EventPayload::Clock {
                    run_id: Some(9),
                    offset: OFFSET - BEHIND,
                    round_trip: 0,
                },
            };
            let third = (5..=10).map(|number| received_by(OFFSET - BEHIND, 9, number, at(40 + number)));
            laptop(&path("laptop.mcap"), first.chain([clock]).chain(third));
            on_car(
                &path("000001.mcap"),
                (1..=15).map(|number| (7, number, at(number))),
            );
            on_car(
                &path("000002.mcap"),
                (1..=5).map(|number| (8, number, at(20 + number) - behind)),
            );
            on_car(
                &path("000003.mcap"),
                (1..=12).map(|number| (9, number, at(40 + number) - BEHIND)),
            );
            merge(&[folder.path().to_owned()], &path("merged")).expect("merged");
            let content = content(&path("merged"));
            let runs: Vec<_> = content.iter().map(|(run, ..)| *run).collect();
            assert!(runs.is_sorted() && runs.len() == 15 + 5 + 12, "{content:?}");
            assert!(content.is_sorted_by_key(|(_, _, at)| *at), "{content:?}");
            let of_the_second = |(run, number, _): &&(u64, u64, i64)| (*run, *number) == (8, 1);
            let (_, _, second) = content.iter().find(of_the_second).expect("its first message");
            assert_eq!(*second, if exact { at(21) } else { at(15) });
            let check = check(&path("merged")).expect("a recording");
            let begin: Vec<_> = check.cars[0].runs.iter().map(|run| run.from_s).collect();
            assert!(begin.is_sorted() && begin[2] - begin[0] < 60.0, "{check}");
        }
    }

    #[test]
    fn what_neither_has_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        let have = (1..=30).filter(|number| !(10..=20).contains(number));
        laptop(
            &path("laptop.mcap"),
            have.map(|number| received(7, number, at(number))),
        );
        on_car(&path("car.mcap"), (13..=30).map(|number| (7, number, at(number))));
        let merged = merge(&[path("laptop.mcap"), path("car.mcap")], &path("merged")).expect("merged");
        assert_eq!(merged.summary.missing(), 3);
        assert_eq!(merged.summary.streams[0].gaps.missing_ranges, [[10, 12]]);
    }

    #[test]
    fn a_file_that_was_cut_off_is_used_as_far_as_it_goes() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        laptop(&path("laptop.mcap"), [received(7, 1, at(1))]);
        on_car(&path("car.mcap"), (1..=30).map(|number| (7, number, at(number))));
        let bytes = fs::read(path("car.mcap")).expect("read");
        // Without the summary and the end mark.
        let cut = bytes.len() - 300;
        fs::write(path("car.mcap.part"), &bytes[..cut]).expect("written");
        fs::remove_file(path("car.mcap")).expect("removed");
        let merged = merge(&[folder.path().to_owned()], &path("merged")).expect("merged");
        assert_eq!(merged.summary.streams[0].gaps.last, 30);
        assert_eq!(merged.summary.missing(), 0);
    }

    #[test]
    fn recordings_of_a_car_alone_make_a_recording() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        on_car(&path("a.mcap"), (1..=5).map(|number| (7, number, at(number))));
        on_car(&path("b.mcap"), (6..=9).map(|number| (7, number, at(number))));
        let merged = merge(&[path("b.mcap"), path("a.mcap")], &path("merged")).expect("merged");
        assert_eq!(numbers(&path("merged")).len(), 9);
        assert_eq!(
            merged.inputs[0].file,
            path("a.mcap"),
            "in the order of their beginnings"
        );
        let events: Vec<_> = read_events(&path("merged"))
            .expect("opens")
            .map(|event| event.expect("intact").payload)
            .collect();
        let appeared = events
            .iter()
            .filter(|event| matches!(event, EventPayload::Appeared));
        assert_eq!(appeared.count(), 1, "the car is there once");
    }

    proptest! {
        #[test]
        fn whatever_is_received_twice_is_there_once(
            received in prop::collection::vec((1..60_u64, -50..50_i64), 0..80),
            probe in 0..62_u64,
        ) {
            let mut ranges = Received::default();
            let mut numbers = BTreeSet::new();
            for (number, at) in received {
                ranges.insert(number, at);
                numbers.insert(number);
            }
            for number in 0..62 {
                prop_assert_eq!(ranges.contains(number), numbers.contains(&number));
            }
            let count: u64 = ranges.0.iter().map(|(first, range)| range.last - first + 1).sum();
            prop_assert_eq!(count, numbers.len() as u64);
            // No two ranges touch.
            for first in ranges.0.keys() {
                prop_assert!(*first == 0 || !ranges.contains(first - 1));
            }
            let between = ranges.between(probe, 7);
            prop_assert!((-50..50).contains(&between));
        }
    }
}
