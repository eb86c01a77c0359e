//! Writes one recording.

use std::collections::{BTreeMap, HashMap};
use std::io::{Seek, Write};

use mcap::records::{MessageHeader, Metadata};
use mcap::{WriteOptions, Writer};
use protocol::{CarName, Key, Topic};

use super::foxglove::{self, Exported};
use super::note::Note;
use super::summary::{RecordingSummary, StreamSummary};
use crate::event::{EventPayload, FleetEvent, SentRange};
use crate::fleet::{SequenceStatus, SequenceTracker};

/// Encoding of messages that are stored as received.
pub(super) const WIRE_ENCODING: &str = "synpf-v1";
/// Name of the metadata record with the gaps of each stream.
pub(super) const SUMMARY_RECORD: &str = "pitwall.streams";

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
    channels: HashMap<String, u16>,
    schemas: HashMap<&'static str, u16>,
    streams: BTreeMap<Key, RecordedStream>,
    /// The end of each car that has answered the final sync.
    ends: BTreeMap<CarName, End>,
    notes: u32,
    messages: u64,
    first: Option<i64>,
    last: Option<i64>,
}

impl<W: Write + Seek> RecordingWriter<W> {
    pub(super) fn new(writer: W) -> Result<Self, mcap::McapError> {
        let options = WriteOptions::new()
            .profile("")
            .library(concat!("pitwall ", env!("CARGO_PKG_VERSION")));
        Ok(Self {
            writer: options.create(writer)?,
            channels: HashMap::new(),
            schemas: HashMap::new(),
            streams: BTreeMap::new(),
            ends: BTreeMap::new(),
            notes: 0,
            messages: 0,
            first: None,
            last: None,
        })
    }

    /// Writes an event, but not a duplicate and not a message from after the end.
    pub(super) fn write(&mut self, event: &FleetEvent) -> Result<(), mcap::McapError> {
        let FleetEvent { at, car, payload } = event;
        match payload {
            EventPayload::Message {
                topic,
                header,
                telemetry,
                bytes,
                ..
            } => {
                let published = (header.run_id, header.published);
                let key = Key::new(car.clone(), *topic);
                let name = key.to_string();
                let stream = self.streams.entry(key).or_default();
                let beyond_the_end = self.ends.get(car).is_some_and(|&(run_id, end)| {
                    if header.run_id == run_id {
                        header.published > end
                    } else {
                        !stream.gaps.has_run(header.run_id)
                    }
                });
                if beyond_the_end {
                    return Ok(());
                }
                if stream.gaps.arrive(header.run_id, header.sequence) == SequenceStatus::Duplicate {
                    return Ok(());
                }
                if stream.until.0 != published.0 || stream.until.1 < published.1 {
                    stream.until = published;
                }
                let times = Times {
                    arrived: *at,
                    published: header.published,
                    sequence: header.sequence as u32,
                };
                self.write_to(&name, WIRE_ENCODING, 0, times, bytes)?;
                // The full-rate streams would repeat the live ones.
                if !topic.recorded() || *topic == Topic::RecordedTruth {
                    for exported in foxglove::export(car, header, telemetry) {
                        self.write_json(car, &exported, times)?;
                    }
                }
            }
            EventPayload::Map { map, bytes } => {
                let name = Key::new(car.clone(), Topic::Map).to_string();
                let times = Times {
                    arrived: *at,
                    published: *at,
                    sequence: 0,
                };
                self.write_to(&name, WIRE_ENCODING, 0, times, bytes)?;
                self.write_json(car, &foxglove::export_map(map, *at), times)?;
            }
            EventPayload::StreamEnds {
                run_id,
                published,
                outstanding,
            } => {
                self.ends.insert(car.clone(), (*run_id, *published));
                for SentRange { topic, from, to } in outstanding {
                    let stream = self.streams.entry(Key::new(car.clone(), *topic)).or_default();
                    stream.gaps.sent(*run_id, *from, *to);
                }
                return Ok(());
            }
            other => {
                if let EventPayload::Rejected { topic, count, .. } = other {
                    let stream = self.streams.entry(Key::new(car.clone(), *topic)).or_default();
                    stream.rejected = stream.rejected.saturating_add(*count);
                }
                if let Some(note) = Note::of(other) {
                    self.notes += 1;
                    let times = Times {
                        arrived: *at,
                        published: *at,
                        sequence: self.notes,
                    };
                    let json = serde_json::to_vec(&note).map_err(|e| mcap::McapError::Io(e.into()))?;
                    self.write_to(&Note::channel(car), "json", 0, times, &json)?;
                }
            }
        }
        self.first.get_or_insert(*at);
        self.last = self.last.max(Some(*at));
        self.messages += 1;
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

    /// Content of the file so far.
    pub(super) fn summary(&self) -> RecordingSummary {
        let mut ends = self.ends.clone();
        for (key, stream) in &self.streams {
            let end = ends.entry(key.car.clone()).or_insert(stream.until);
            // Without a final sync, the end is the latest message of any topic.
            if !self.ends.contains_key(&key.car) && (end.0 != stream.until.0 || end.1 < stream.until.1) {
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
        let mut cars: Vec<_> = self.streams.into_keys().map(|key| key.car).collect();
        cars.dedup();
        cars.retain(|car| !self.ends.contains_key(car));
        summary.unanswered = cars;
        let metadata = summary
            .streams
            .iter()
            .map(|stream| {
                let key = Key::new(stream.car.clone(), stream.topic).to_string();
                (key, serde_json::to_string(&stream.gaps).unwrap_or_default())
            })
            .collect();
        self.writer.write_metadata(&Metadata {
            name: SUMMARY_RECORD.to_owned(),
            metadata,
        })?;
        self.writer.finish()?;
        Ok((summary, self.writer.into_inner()))
    }

    fn write_json(
        &mut self,
        car: &CarName,
        exported: &Exported,
        times: Times,
    ) -> Result<(), mcap::McapError> {
        let schema = if let Some(&schema) = self.schemas.get(exported.schema) {
            schema
        } else {
            let text = foxglove::schema(exported.schema, &exported.json).to_string();
            let schema = self
                .writer
                .add_schema(exported.schema, "jsonschema", text.as_bytes())?;
            self.schemas.insert(exported.schema, schema);
            schema
        };
        let channel = format!("/{car}/{}", exported.channel);
        self.write_to(
            &channel,
            "json",
            schema,
            times,
            exported.json.to_string().as_bytes(),
        )
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

#[derive(Clone, Copy)]
struct Times {
    arrived: i64,
    published: i64,
    sequence: u32,
}
