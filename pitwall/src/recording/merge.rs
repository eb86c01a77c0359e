//! Merges recordings of a session, from the cars and from laptops, into one file without doubles.
//!
//! A message is the same where car, topic, run and sequence number are. What a laptop has received keeps the time at which it
//! arrived. What only the car has gets the time at which it was published, by the laptop's clock: the laptop's recording has the
//! difference between the clocks. It stays between its neighbours, so that each stream is in order.
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
use crate::event::{EventPayload, FleetEvent};

/// Clocks whose difference changes by more than one part in so many were set in between.
const STEADY: u64 = 100;

/// Messages of one file in memory.
const AHEAD: usize = 512;

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
    known.end_of_scans();
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
    /// Clock comparisons by car: the car's time, and the car's clock minus the laptop's \[ns\], ascending.
    clocks: BTreeMap<CarName, Vec<(i64, i64)>>,
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
}

impl Known {
    fn scan(&mut self, path: PathBuf) -> Result<Scan, RecordingError> {
        let mut scan = Scan {
            on_car: false,
            first: None,
            messages: 0,
            path,
        };
        let mut events = read_intact(&scan.path)?;
        while let Some(event) = events.next() {
            let event = event?;
            scan.on_car = events.library().starts_with(super::CAR_LIBRARY);
            scan.first.get_or_insert_with(|| (event.car.clone(), event.at));
            if let EventPayload::Message { .. } = &event.payload {
                scan.messages += 1;
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
                EventPayload::Clock { offset, .. } => {
                    let clocks = self.clocks.entry(event.car.clone()).or_default();
                    clocks.push((event.at.saturating_add(*offset), *offset));
                }
                _ => {}
            }
        }
        Ok(scan)
    }

    fn end_of_scans(&mut self) {
        for clocks in self.clocks.values_mut() {
            clocks.sort_unstable();
        }
    }

    /// A time of the car's clock by the laptop's: between two comparisons their differences go over into each other, so that
    /// the order of times stays. Where the clock was set between them, the nearer one counts.
    fn by_the_laptop(&self, car: &CarName, at: i64) -> i64 {
        let Some(clocks) = self.clocks.get(car) else {
            return at;
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
    /// The last message of a car's file.
    last: Option<Last>,
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
        let at = self.known.by_the_laptop(&event.car, event.at);
        event.at = at;
        if let EventPayload::Message { header, .. } = &event.payload {
            self.last = Some(Last {
                at,
                car: event.car.clone(),
                run_id: header.run_id,
                published: header.published,
            });
        }
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

/// The last message of a car's file, at its time by the laptop's clock.
struct Last {
    at: i64,
    car: CarName,
    run_id: u64,
    published: i64,
}

/// How far the streams of each car go.
#[derive(Default)]
struct Ends {
    /// What a car answered at the end of a laptop's recording, the last of each car.
    at_the_wall: BTreeMap<CarName, FleetEvent>,
    /// The end of each car's own recording, and whether that was completed.
    on_car: BTreeMap<CarName, (Last, bool)>,
}

impl Ends {
    fn at_the_wall(&mut self, event: FleetEvent) {
        let known = self.at_the_wall.get(&event.car);
        if known.is_none_or(|known| known.at <= event.at) {
            self.at_the_wall.insert(event.car.clone(), event);
        }
    }

    fn file_ended(&mut self, last: Option<Last>, complete: bool) {
        if let Some(last) = last
            && self
                .on_car
                .get(&last.car)
                .is_none_or(|(known, _)| known.at <= last.at)
        {
            self.on_car.insert(last.car.clone(), (last, complete));
        }
    }

    /// The ends that are certain. A car that has completed its recording has said how far it goes.
    fn last(mut self) -> Vec<FleetEvent> {
        for (car, (last, complete)) in self.on_car {
            let before = self
                .at_the_wall
                .get(&car)
                .is_some_and(|event| event.at >= last.at);
            if before {
                continue;
            }
            // Without a completed file it is not certain that nothing followed.
            self.at_the_wall.remove(&car);
            if complete {
                let payload = EventPayload::StreamEnds {
                    run_id: last.run_id,
                    published: last.published,
                    outstanding: Vec::new(),
                };
                let at = last.at;
                self.at_the_wall
                    .insert(car.clone(), FleetEvent { at, car, payload });
            }
        }
        self.at_the_wall.into_values().collect()
    }
}

fn write(known: &Known, mut scans: Vec<Scan>, output: fs::File, to: &Path) -> Result<Merged, RecordingError> {
    let mcap = |e| RecordingError::mcap(to, e);
    let begin = |scan: &Scan| {
        let (car, at) = scan.first.as_ref()?;
        Some(if scan.on_car {
            known.by_the_laptop(car, *at)
        } else {
            *at
        })
    };
    scans.sort_by_key(|scan| (begin(scan), scan.on_car));
    let sync = output.try_clone().map_err(|e| RecordingError::io(to, e))?;
    let mut writer = RecordingWriter::new(BufWriter::new(output)).map_err(mcap)?;
    let mut report: Vec<_> = scans
        .iter()
        .map(|scan| MergedInput {
            file: scan.path.clone(),
            on_car: scan.on_car,
            messages: scan.messages,
            added: 0,
            damage: Vec::new(),
        })
        .collect();
    // A file is opened when its time has come: a session on a car is hundreds of files.
    let mut closed: Vec<_> = scans.iter().enumerate().rev().collect();
    let mut open: Vec<(usize, Input<'_>)> = Vec::new();
    let mut written = 0;
    // What each car's first file begins with is enough.
    let mut introduced = HashSet::new();
    let mut ends = Ends::default();
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
                last: None,
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
                if input.on_car {
                    ends.file_ended(input.last.take(), input.events.complete());
                }
            }
            !ended
        });
        if let EventPayload::StreamEnds { .. } = event.payload {
            // What follows in other recordings is wanted, too.
            ends.at_the_wall(event);
            continue;
        }
        let message = matches!(event.payload, EventPayload::Message { .. });
        if on_car
            && !message
            && !introduced.insert((event.car.clone(), std::mem::discriminant(&event.payload)))
        {
            continue;
        }
        writer.write(&event).map_err(mcap)?;
        let total = writer.messages();
        if message && total > written {
            report[index].added += 1;
        }
        written = total;
    }
    for end in ends.last() {
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
    use crate::recording::read_events;
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
        let bytes = bytes(run_id, sequence, at + OFFSET);
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
        known.clocks.insert(car(), vec![(0, 0), (SECOND, 2_000_000)]);
        let times: Vec<_> = (0..=1100)
            .map(|ms| known.by_the_laptop(&car(), ms * 1_000_000))
            .collect();
        assert!(times.windows(2).all(|pair| pair[0] < pair[1]));
        assert_eq!([times[500], times[1100]], [499_000_000, 1_098_000_000]);
        // A clock that was set: there is nothing between.
        known
            .clocks
            .insert(car(), vec![(0, 0), (3601 * SECOND, 3600 * SECOND)]);
        let at = |seconds: i64| known.by_the_laptop(&car(), seconds * SECOND);
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
