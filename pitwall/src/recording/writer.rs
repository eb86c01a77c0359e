//! Writes one recording.

use std::collections::{BTreeMap, HashMap};
use std::fmt::Write as _;
use std::io::{Seek, Write};

use mcap::records::{MessageHeader, Metadata};
use mcap::{WriteOptions, Writer};
use protocol::{CarName, Key, Telemetry, Topic};
use serde::Serialize;

use super::foxglove::{self, JsonSink};
use super::note::Note;
use super::session::Session;
use super::summary::{RecordingSummary, StreamSummary};
use crate::event::{EventPayload, FleetEvent, RunEnd, SentRange};
use crate::fleet::{SequenceStatus, SequenceTracker};

/// Encoding of messages that are stored as received.
pub(super) const WIRE_ENCODING: &str = "synpf-v1";
/// Name of the metadata record with the gaps of each stream.
pub(super) const SUMMARY_RECORD: &str = "pitwall.streams";

/// Largest chunk [bytes]: more than fifty cars send between two syncs.
const CHUNK: u64 = 8_000_000;

/// A stream being recorded.
#[derive(Default)]
struct RecordedStream {
    gaps: SequenceTracker,
    rejected: u64,
    /// When the newest message was published.
    until: PublishTime,
}

/// The run, and the time of publishing by the car's clock \[unix ns\].
type PublishTime = (u64, i64);

/// The end of a car's streams. Later messages are not recorded, so that all streams end together.
type End = PublishTime;

/// A recording being written.
pub(super) struct RecordingWriter<W: Write + Seek> {
    writer: Writer<W>,
    session: Session,
    channels: HashMap<String, u16>,
    schemas: HashMap<&'static str, u16>,
    streams: BTreeMap<Key, RecordedStream>,
    /// The end of each car that has answered the final sync.
    ends: BTreeMap<CarName, End>,
    /// The end of each car whose last run has stopped. Another run may follow.
    stopped: BTreeMap<CarName, End>,
    /// What the JSON channels of each car have.
    exported: BTreeMap<CarName, ExportedTimes>,
    /// Each car's clock minus the laptop's \[ns\], and the run in which they were compared, if that is known.
    offsets: BTreeMap<CarName, (Option<u64>, i64)>,
    notes: u32,
    messages: u64,
    first: Option<i64>,
    last: Option<i64>,
    /// For the name of a channel and a message: their memory is used again.
    buffers: (String, Vec<u8>),
}

impl<W: Write + Seek> RecordingWriter<W> {
    pub(super) fn new(writer: W) -> Result<Self, mcap::McapError> {
        Ok(Self {
            writer: begin(writer)?,
            session: Session::default(),
            channels: HashMap::new(),
            schemas: HashMap::new(),
            streams: BTreeMap::new(),
            ends: BTreeMap::new(),
            stopped: BTreeMap::new(),
            exported: BTreeMap::new(),
            offsets: BTreeMap::new(),
            notes: 0,
            messages: 0,
            first: None,
            last: None,
            buffers: Default::default(),
        })
    }

    /// Goes on in another file. The counts of the streams go on, too. Returns the old file, which is not completed.
    pub(super) fn continue_in(&mut self, writer: W) -> Result<Writer<W>, mcap::McapError> {
        let old = std::mem::replace(&mut self.writer, begin(writer)?);
        self.channels.clear();
        self.schemas.clear();
        self.exported.clear();
        self.session.begin_file();
        Ok(old)
    }

    /// Writes the metadata about the session.
    pub(super) fn describe(&mut self, started: i64, operator: &str) -> Result<(), mcap::McapError> {
        self.writer.write_metadata(&Session::first(started, operator))
    }

    /// Writes an event, but not a duplicate and not a message from after the end.
    pub(super) fn write(&mut self, event: &FleetEvent) -> Result<(), mcap::McapError> {
        if self.admits(event) {
            self.store(event)?;
            self.first.get_or_insert(event.at);
            self.last = self.last.max(Some(event.at));
            self.messages += 1;
        }
        Ok(())
    }

    /// Counts an event. False for a duplicate, and for a message from after the end.
    fn admits(&mut self, event: &FleetEvent) -> bool {
        let FleetEvent { car, payload, .. } = event;
        match payload {
            EventPayload::Message { topic, header, .. } => {
                let published = (header.run_id, header.published);
                let key = Key::new(car.clone(), *topic);
                let stream = self.streams.entry(key).or_default();
                let beyond_the_end = self.ends.get(car).is_some_and(|&(run_id, end)| {
                    if header.run_id == run_id {
                        header.published > end
                    } else {
                        !stream.gaps.has_run(header.run_id)
                    }
                });
                if beyond_the_end
                    || stream.gaps.arrive(header.run_id, header.sequence) == SequenceStatus::Duplicate
                {
                    return false;
                }
                if self
                    .stopped
                    .get(car)
                    .is_some_and(|&(run_id, end)| run_id != header.run_id || end < header.published)
                {
                    self.stopped.remove(car);
                }
                if stream.until.0 != published.0 || stream.until.1 < published.1 {
                    stream.until = published;
                }
            }
            EventPayload::StreamEnds {
                run_id,
                published,
                end,
                outstanding,
            } => {
                let ends = match end {
                    RunEnd::Stopped => &mut self.stopped,
                    _ => &mut self.ends,
                };
                ends.insert(car.clone(), (*run_id, *published));
                for SentRange { topic, from, to } in outstanding {
                    let stream = self.streams.entry(Key::new(car.clone(), *topic)).or_default();
                    stream.gaps.sent(*run_id, *from, *to);
                }
            }
            EventPayload::Rejected { topic, count, .. } => {
                let stream = self.streams.entry(Key::new(car.clone(), *topic)).or_default();
                stream.rejected = stream.rejected.saturating_add(*count);
            }
            _ => {}
        }
        true
    }

    /// Writes an event that has been counted.
    pub(super) fn store(&mut self, event: &FleetEvent) -> Result<(), mcap::McapError> {
        let FleetEvent { at, car, payload } = event;
        match payload {
            EventPayload::Message {
                topic,
                header,
                telemetry,
                bytes,
                ..
            } => {
                self.session.on_run(car, header.run_id);
                if let Telemetry::Params(params) = &**telemetry
                    && let Some(metadata) = self.session.on_set(car, params)
                {
                    self.writer.write_metadata(&metadata)?;
                }
                let name = Key::new(car.clone(), *topic).to_string();
                let times = Times {
                    arrived: *at,
                    published: header.published,
                    sequence: header.sequence as u32,
                };
                self.write_to(&name, WIRE_ENCODING, 0, times, bytes)?;
                // The full-rate streams fill in what is lost of the live ones.
                let is_new = match self.exported.get_mut(car) {
                    Some(exported) => exported.add(*topic, header.sensor),
                    None => self
                        .exported
                        .entry(car.clone())
                        .or_default()
                        .add(*topic, header.sensor),
                };
                if is_new {
                    // Other tools go by the log time: for them it is when a message would have arrived on a good link.
                    let known = self.offsets.get(car);
                    let offset =
                        known.filter(|(run_id, _)| run_id.is_none_or(|run_id| run_id == header.run_id));
                    let arrived = offset.map_or(*at, |(_, offset)| {
                        header.published.saturating_sub(*offset).min(*at)
                    });
                    let times = Times { arrived, ..times };
                    foxglove::export(car, header, telemetry, &mut self.json(car, times))?;
                }
            }
            EventPayload::Map { map, bytes } => {
                for file in self.session.on_map(map, *at) {
                    self.writer.attach(&file)?;
                }
                let name = Key::new(car.clone(), Topic::Map).to_string();
                let times = Times {
                    arrived: *at,
                    published: *at,
                    sequence: 0,
                };
                self.write_to(&name, WIRE_ENCODING, 0, times, bytes)?;
                foxglove::export_map(map, *at, &mut self.json(car, times))?;
            }
            other => {
                match other {
                    EventPayload::Clock {
                        run_id,
                        offset,
                        round_trip,
                    } => {
                        self.offsets.insert(car.clone(), (*run_id, *offset));
                        self.session.on_clock(car, *offset, *round_trip);
                    }
                    EventPayload::Info(info) => self.session.on_info(car, info),
                    _ => {}
                }
                self.write_note(car, other, *at)?;
            }
        }
        Ok(())
    }

    #[cfg(test)]
    pub(super) fn attach(&mut self, attachment: &mcap::Attachment<'_>) -> Result<(), mcap::McapError> {
        self.writer.attach(attachment)
    }

    /// Messages and notes written so far.
    pub(super) fn messages(&self) -> u64 {
        self.messages
    }

    /// Flushes everything written so far to the file.
    pub(super) fn flush(&mut self) -> Result<(), mcap::McapError> {
        self.writer.flush()
    }

    /// The end of each car that has one.
    fn known_ends(&self) -> BTreeMap<CarName, End> {
        let mut ends = self.stopped.clone();
        ends.extend(self.ends.iter().map(|(car, end)| (car.clone(), *end)));
        ends
    }

    fn has_end(&self, car: &CarName) -> bool {
        self.ends.contains_key(car) || self.stopped.contains_key(car)
    }

    /// Content of the file so far.
    pub(super) fn summary(&self) -> RecordingSummary {
        let mut ends = self.known_ends();
        for (key, stream) in &self.streams {
            let end = ends.entry(key.car.clone()).or_insert(stream.until);
            // Without a final sync, the end is the latest message of any topic.
            if !self.has_end(&key.car) && (end.0 != stream.until.0 || end.1 < stream.until.1) {
                *end = stream.until;
            }
        }
        let behind = |car: &CarName, until: PublishTime| {
            let end = ends.get(car).copied().unwrap_or(until);
            (end.0 == until.0).then(|| (end.1 - until.1) as f64 * 1e-9)
        };
        RecordingSummary {
            duration_s: self
                .first
                .zip(self.last)
                .map_or(0.0, |(a, b)| (b - a) as f64 * 1e-9),
            messages: self.messages,
            streams: self
                .streams
                .iter()
                .map(|(key, stream)| StreamSummary {
                    car: key.car.clone(),
                    topic: key.topic,
                    behind_s: behind(&key.car, stream.until),
                    rejected: stream.rejected,
                    gaps: stream.gaps.summary(),
                })
                .collect(),
            unanswered: Vec::new(),
        }
    }

    /// Writes the summary and the index, and completes the file.
    pub(super) fn finish(mut self) -> Result<(RecordingSummary, W), mcap::McapError> {
        let mut summary = self.summary();
        let mut cars: Vec<_> = self.streams.keys().map(|key| key.car.clone()).collect();
        cars.dedup();
        cars.retain(|car| !self.has_end(car));
        summary.unanswered = cars;
        complete(&mut self.writer, &summary, &self.session)?;
        Ok((summary, self.writer.into_inner()))
    }

    /// Completes a file that another one follows.
    pub(super) fn complete_part(&self, mut part: Writer<W>) -> Result<W, mcap::McapError> {
        complete(&mut part, &self.summary(), &self.session)?;
        Ok(part.into_inner())
    }

    fn write_note(&mut self, car: &CarName, payload: &EventPayload, at: i64) -> Result<(), mcap::McapError> {
        let Some(note) = Note::of(payload) else {
            return Ok(());
        };
        self.notes += 1;
        let times = Times {
            arrived: at,
            published: at,
            sequence: self.notes,
        };
        let json = serde_json::to_vec(&note).map_err(|e| mcap::McapError::Io(e.into()))?;
        self.write_to(&Note::channel(car), "json", 0, times, &json)
    }

    /// Where the JSON messages of a car at these times go.
    fn json<'a>(&'a mut self, car: &'a CarName, times: Times) -> JsonChannels<'a, W> {
        JsonChannels {
            recording: self,
            car,
            times,
        }
    }

    fn write_to(
        &mut self,
        topic: &str,
        encoding: &str,
        schema: u16,
        times: Times,
        data: &[u8],
    ) -> Result<(), mcap::McapError> {
        let channel_id = if let Some(&channel) = self.channels.get(topic) {
            channel
        } else {
            let channel = self
                .writer
                .add_channel(schema, topic, encoding, &BTreeMap::new())?;
            self.channels.insert(topic.to_owned(), channel);
            channel
        };
        let header = MessageHeader {
            channel_id,
            sequence: times.sequence,
            log_time: times.arrived.max(0) as u64,
            publish_time: times.published.max(0) as u64,
        };
        self.writer.write_to_known_channel(&header, data)
    }
}

/// The JSON channels of a car.
struct JsonChannels<'a, W: Write + Seek> {
    recording: &'a mut RecordingWriter<W>,
    car: &'a CarName,
    times: Times,
}

impl<W: Write + Seek> JsonSink for JsonChannels<'_, W> {
    type Error = mcap::McapError;

    fn write(
        &mut self,
        channel: &'static str,
        schema: &'static str,
        message: &impl Serialize,
    ) -> Result<(), mcap::McapError> {
        let recording = &mut *self.recording;
        let json = |e: serde_json::Error| mcap::McapError::Io(e.into());
        let id = if let Some(&id) = recording.schemas.get(schema) {
            id
        } else {
            let example = serde_json::to_value(message).map_err(json)?;
            let text = foxglove::schema(schema, &example).to_string();
            let id = recording
                .writer
                .add_schema(schema, "jsonschema", text.as_bytes())?;
            recording.schemas.insert(schema, id);
            id
        };
        let (mut name, mut text) = std::mem::take(&mut recording.buffers);
        name.clear();
        text.clear();
        // Writing to a string does not fail.
        write!(name, "/{}/{channel}", self.car).ok();
        let written = serde_json::to_writer(&mut text, message)
            .map_err(json)
            .and_then(|()| recording.write_to(&name, "json", id, self.times, &text));
        recording.buffers = (name, text);
        written
    }
}

/// The sensor times of the poses and health messages that the JSON channels of a car have \[unix ns\].
#[derive(Default)]
struct ExportedTimes {
    poses: RecentTimes,
    healths: RecentTimes,
}

impl ExportedTimes {
    /// Live health messages are this far apart, so that a hole is longer \[ns\].
    const HEALTH: i64 = 150_000_000;

    /// Adds a message. False when the channels have its content already, or should not have it.
    fn add(&mut self, topic: Topic, sensor: i64) -> bool {
        let (times, near) = match topic {
            Topic::Pose | Topic::RecordedPose => (&mut self.poses, 0),
            Topic::Health => (&mut self.healths, 0),
            Topic::RecordedHealth => (&mut self.healths, Self::HEALTH),
            topic => return !topic.recorded() || topic == Topic::RecordedTruth,
        };
        times.add(sensor, near)
    }
}

/// The last [`Self::MOST`] times.
#[derive(Default)]
struct RecentTimes {
    /// The times within each second, after its begin \[ns\], by the second.
    seconds: BTreeMap<i64, Vec<u32>>,
    count: usize,
}

impl RecentTimes {
    /// An hour of poses. A car keeps what it has sent for less, so that nothing comes later.
    const MOST: usize = 150_000;
    const SECOND: i64 = 1_000_000_000;

    /// Adds a time \[ns\]. False when there is one within `near` \[ns\] already.
    fn add(&mut self, time: i64, near: i64) -> bool {
        let around = time.saturating_sub(near)..=time.saturating_add(near);
        let [first, last] = [around.start(), around.end()].map(|time| time.div_euclid(Self::SECOND));
        let mut known = self
            .seconds
            .range(first..=last)
            .flat_map(|(second, times)| times.iter().map(move |time| Self::time(*second, *time)));
        if known.any(|known| around.contains(&known)) {
            return false;
        }
        if self.count >= Self::MOST
            && let Some((_, oldest)) = self.seconds.pop_first()
        {
            self.count -= oldest.len();
        }
        let within = time.rem_euclid(Self::SECOND) as u32;
        let second = time.div_euclid(Self::SECOND);
        self.seconds.entry(second).or_default().push(within);
        self.count += 1;
        true
    }

    /// The time of which these are the parts. The second alone may be out of range, and then wraps around twice.
    fn time(second: i64, within: u32) -> i64 {
        second.wrapping_mul(Self::SECOND).wrapping_add(i64::from(within))
    }
}

fn begin<W: Write + Seek>(writer: W) -> Result<Writer<W>, mcap::McapError> {
    WriteOptions::new()
        .profile("")
        .library(concat!("pitwall ", env!("CARGO_PKG_VERSION")))
        // A chunk ends with each sync. Its place in the index stays in memory until the end, so that more chunks cost more.
        .chunk_size(Some(CHUNK))
        // The recorder has a thread of its own: threads of the compressor would only cost memory.
        .compression_threads(0)
        .create(writer)
}

/// Writes what is known at the end, and the index.
fn complete<W: Write + Seek>(
    writer: &mut Writer<W>,
    summary: &RecordingSummary,
    session: &Session,
) -> Result<(), mcap::McapError> {
    let metadata = summary
        .streams
        .iter()
        .map(|stream| {
            let key = Key::new(stream.car.clone(), stream.topic).to_string();
            (key, serde_json::to_string(&stream.gaps).unwrap_or_default())
        })
        .collect();
    writer.write_metadata(&session.last())?;
    writer.write_metadata(&Metadata {
        name: SUMMARY_RECORD.to_owned(),
        metadata,
    })?;
    writer.finish()?;
    Ok(())
}

#[derive(Clone, Copy)]
struct Times {
    arrived: i64,
    published: i64,
    sequence: u32,
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;
    use std::sync::Arc;

    use protocol::{Header, Schema, Stamps};

    use super::*;
    use crate::event::Delivery;

    // Each chunk has an entry in the index for every channel, which stays in memory. Twenty cars once ended a chunk every tenth of
    // a second.
    #[test]
    fn a_chunk_ends_with_a_sync_and_not_before() {
        let mut recording = RecordingWriter::new(Cursor::new(Vec::new())).expect("begun");
        for number in 1..=80 {
            let stamps = Stamps {
                run_id: 1,
                sequence: number,
                sensor: number as i64,
                published: number as i64,
            };
            let event = FleetEvent {
                at: 1,
                car: "car-1".parse().expect("a name"),
                payload: EventPayload::Message {
                    topic: Topic::Pose,
                    delivery: Delivery::Live,
                    header: Header::new(Schema::Pose, 1, stamps),
                    telemetry: Box::new(Telemetry::Pose(foxglove::tests::pose())),
                    bytes: Arc::from(vec![number as u8; 50_000]),
                },
            };
            recording.write(&event).expect("written");
            if number == 40 {
                recording.flush().expect("synced");
            }
        }
        let (_, file) = recording.finish().expect("completed");
        let summary = mcap::Summary::read(file.get_ref()).expect("whole");
        assert_eq!(summary.expect("an index").chunk_indexes.len(), 2);
    }

    const SECOND: i64 = RecentTimes::SECOND;

    #[test]
    fn full_rate_messages_fill_what_is_missing_of_the_live_ones() {
        let mut times = ExportedTimes::default();
        let mut add = |topic, ms: i64| times.add(topic, ms * 1_000_000);
        assert!(add(Topic::Pose, 1000) && add(Topic::RecordedPose, 1025));
        assert!(!add(Topic::RecordedPose, 1000) && !add(Topic::Pose, 1025));
        assert!(add(Topic::Health, 2000));
        assert!(!add(Topic::RecordedHealth, 2100) && !add(Topic::RecordedHealth, 1900));
        assert!(add(Topic::RecordedHealth, 2200));
        assert!(add(Topic::RecordedTruth, 1000) && !add(Topic::RecordedScan, 1000));
    }

    // The times of a session once took more memory with each hour.
    #[test]
    fn an_hour_of_times_is_kept_and_no_more() {
        let mut times = RecentTimes::default();
        for tick in 0..3 * 3600 * 40 {
            assert!(times.add(tick * SECOND / 40, 0));
        }
        assert_eq!(times.count, times.seconds.values().map(Vec::len).sum::<usize>());
        assert!(times.count <= RecentTimes::MOST);
        let newest = (3 * 3600 * 40 - 1) * SECOND / 40;
        assert!(!times.add(newest - 3600 * SECOND, 0), "within the hour");
    }

    #[test]
    fn times_at_the_ends_of_the_range_are_times() {
        let mut times = RecentTimes::default();
        for time in [i64::MIN, i64::MIN + 1, -1, 0, i64::MAX] {
            assert!(times.add(time, 0) && !times.add(time, 150_000_000), "{time}");
        }
    }
}
