//! Reads a recording: the same events as the live pit wall had.
//!
//! A message that cannot be decoded is an event, too ([`EventPayload::Unreadable`]), as it is live. Channels of other
//! programs are skipped with a warning. A thread reads and decompresses ahead, so that this and what the events are for take turns
//! on two cores.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs::File;
use std::io::{ErrorKind, Read, Seek};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{io, thread};

use crossbeam_channel::{Receiver, bounded};
use mcap::records::{Channel, MessageHeader};
use protocol::{CarName, Header, Key, MapReply, Telemetry, Topic, decode};

use super::error::RecordingError;
use super::note::Note;
use super::salvage::{Salvage, Salvaged};
use super::writer::WIRE_ENCODING;
use crate::event::{Delivery, EventPayload, FleetEvent};

/// The events of a recording, in the order in which they were written. The first error is the last item.
pub struct Recording {
    path: PathBuf,
    source: Source,
    /// Records that are read and not yet handled.
    records: VecDeque<Salvaged>,
    channels: BTreeMap<u16, Channel>,
    progress: Progress,
    /// Channels that are skipped.
    skipped: BTreeSet<String>,
    /// The program that made the file.
    library: String,
    complete: bool,
    /// Damaged places are passed over, and noted here; None: they are errors.
    passed_over: Option<Vec<String>>,
    /// The topics of the messages that are read.
    wanted: fn(Topic) -> bool,
}

/// Where the records come from.
enum Source {
    /// The file, before the first record.
    File(File),
    /// The thread that reads it: one record, or all those of a chunk. The last ones are empty.
    Thread(Receiver<io::Result<Vec<Salvaged>>>),
}

/// A message or a note, not decoded.
#[derive(Debug)]
pub(super) enum RawEvent {
    Message {
        topic: Topic,
        /// None where it is damaged.
        header: Option<Header>,
        bytes: Vec<u8>,
    },
    Note(Note),
}

/// What a message on a channel is: its content and its car. None for one that is not wanted.
type Decoded<P> = Result<Option<(P, CarName)>, String>;

#[derive(PartialEq)]
enum Progress {
    Data,
    /// The summary repeats the channels and has no messages.
    Summary,
    /// The end was reached, or an error was returned.
    Done,
}

/// Opens a recording. An unfinished one ends with an error: [`recover`](super::recover()) it first.
pub fn read_events(path: &Path) -> Result<Recording, RecordingError> {
    let file = open(path)?;
    Ok(Recording {
        path: path.to_owned(),
        source: Source::File(file),
        records: VecDeque::new(),
        channels: BTreeMap::new(),
        progress: Progress::Data,
        skipped: BTreeSet::new(),
        library: String::new(),
        complete: false,
        passed_over: None,
        wanted: |_| true,
    })
}

/// Opens a recording to read what is intact: damaged places are passed over, and so is a missing end.
pub(super) fn read_intact(path: &Path) -> Result<Recording, RecordingError> {
    let mut recording = read_events(path)?;
    recording.passed_over = Some(Vec::new());
    Ok(recording)
}

/// Reads the headers of a recording's messages, and its notes: time of arrival \[unix ns\], car, content.
pub(super) fn read_raw(
    path: &Path,
) -> Result<impl Iterator<Item = Result<(i64, CarName, RawEvent), RecordingError>>, RecordingError> {
    let mut recording = read_events(path)?;
    Ok(std::iter::from_fn(move || {
        let next = recording
            .next_with(|channel, encoding, data, _| {
                if encoding == WIRE_ENCODING {
                    let key = channel.parse::<Key>().map_err(|e| e.to_string())?;
                    let header = Header::read(&data).ok();
                    let topic = key.topic;
                    let carries = Telemetry::carried_by(topic);
                    let message = |bytes| RawEvent::Message { topic, header, bytes };
                    return Ok(carries.then(|| (message(data), key.car)));
                }
                note(channel, &data).map(|note| note.map(|(note, car)| (RawEvent::Note(note), car)))
            })
            .transpose();
        if !matches!(next, Some(Ok(_))) {
            recording.progress = Progress::Done;
        }
        next
    }))
}

/// Opens a file that begins as an MCAP file does.
pub(super) fn open(path: &Path) -> Result<File, RecordingError> {
    let io = |e| RecordingError::io(path, e);
    let mut file = File::open(path).map_err(io)?;
    let mut begin = [0; mcap::MAGIC.len()];
    match file.read_exact(&mut begin) {
        Ok(()) if begin == mcap::MAGIC => {}
        Err(error) if error.kind() != ErrorKind::UnexpectedEof => return Err(io(error)),
        _ => return Err(RecordingError::Foreign(path.display().to_string())),
    }
    file.rewind().map_err(io)?;
    Ok(file)
}

impl Iterator for Recording {
    type Item = Result<FleetEvent, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        let next = self.next_event().transpose();
        if !matches!(next, Some(Ok(_))) {
            self.progress = Progress::Done;
        }
        next
    }
}

impl Recording {
    /// True when the end of the file has been read, and it is that of a complete one.
    pub(super) fn complete(&self) -> bool {
        self.complete
    }

    /// The program that made the file; empty before the first event.
    pub(super) fn library(&self) -> &str {
        &self.library
    }

    /// The damaged places that were passed over.
    pub(super) fn damage(&self) -> &[String] {
        self.passed_over.as_deref().unwrap_or_default()
    }

    /// Leaves out the messages of the topics that are not wanted. They are not decoded.
    pub(super) fn only(mut self, wanted: fn(Topic) -> bool) -> Self {
        self.wanted = wanted;
        self
    }

    /// The next event; None at the end of a complete recording.
    fn next_event(&mut self) -> Result<Option<FleetEvent>, RecordingError> {
        let next = self.next_with(|channel, encoding, data, wanted| {
            if encoding == WIRE_ENCODING {
                return wire_message(channel, &data, wanted);
            }
            note(channel, &data).map(|note| note.map(|(note, car)| (note.into(), car)))
        })?;
        Ok(next.map(|(at, car, payload)| FleetEvent { at, car, payload }))
    }

    /// The next message that `decode` makes something of.
    fn next_with<P>(
        &mut self,
        decode: impl Fn(&str, &str, Vec<u8>, fn(Topic) -> bool) -> Decoded<P>,
    ) -> Result<Option<(i64, CarName, P)>, RecordingError> {
        while self.progress != Progress::Done {
            let Some(record) = self.next_record()? else {
                return Ok(None);
            };
            match record {
                Salvaged::Channel(channel) if self.progress == Progress::Data => {
                    self.channels.insert(channel.id, channel);
                }
                Salvaged::Message(header, data) => {
                    if let Some((payload, car)) = self.decoded(&header, data, &decode)? {
                        return Ok(Some((header.log_time as i64, car, payload)));
                    }
                }
                Salvaged::DataEnd => self.progress = Progress::Summary,
                Salvaged::Complete => {
                    self.complete = true;
                    return Ok(None);
                }
                Salvaged::Damage(reason) => match &mut self.passed_over {
                    Some(passed_over) => passed_over.push(reason),
                    None => return Err(RecordingError::broken(&self.path, reason)),
                },
                Salvaged::Header { library, .. } => self.library = library,
                _ => {}
            }
        }
        Ok(None)
    }

    /// The next record; None at an end that is missing and passed over.
    fn next_record(&mut self) -> Result<Option<Salvaged>, RecordingError> {
        if self.records.is_empty() {
            let records = self.next_records();
            self.records = records.map_err(|e| RecordingError::io(&self.path, e))?.into();
        }
        match (self.records.pop_front(), &self.passed_over) {
            (None, None) => Err(RecordingError::broken(
                &self.path,
                "the file was cut off".to_owned(),
            )),
            (record, _) => Ok(record),
        }
    }

    /// The next record, or all those of a chunk; none at the end of the file.
    fn next_records(&mut self) -> io::Result<Vec<Salvaged>> {
        if let Source::File(file) = &self.source {
            self.source = Source::Thread(read_ahead(file.try_clone()?, self.wanted)?);
        }
        match &self.source {
            // It has ended.
            Source::Thread(records) => records.recv().unwrap_or_else(|_| Ok(Vec::new())),
            Source::File(_) => Ok(Vec::new()),
        }
    }

    /// What a message holds; None for one that is not wanted, and for one for other programs.
    fn decoded<P>(
        &mut self,
        header: &MessageHeader,
        data: Vec<u8>,
        decode: impl Fn(&str, &str, Vec<u8>, fn(Topic) -> bool) -> Decoded<P>,
    ) -> Result<Option<(P, CarName)>, RecordingError> {
        let Some(channel) = self.channels.get(&header.channel_id) else {
            let reason = format!("a message is on the unknown channel {}", header.channel_id);
            if let Some(passed_over) = &mut self.passed_over {
                // The channel was defined in a damaged chunk.
                if passed_over.last() != Some(&reason) {
                    passed_over.push(reason);
                }
                return Ok(None);
            }
            return Err(RecordingError::broken(&self.path, reason));
        };
        match decode(&channel.topic, &channel.message_encoding, data, self.wanted) {
            Ok(decoded) => Ok(decoded),
            Err(error) => {
                let channel = channel.topic.as_str();
                if self.skipped.insert(channel.to_owned()) {
                    tracing::warn!(channel, error, "skipped; was it recorded by a newer pitwall?");
                }
                Ok(None)
            }
        }
    }
}

/// Starts the thread that reads a file. It ends with the file, with an error, or when nobody takes the records any more.
fn read_ahead(file: File, wanted: fn(Topic) -> bool) -> io::Result<Receiver<io::Result<Vec<Salvaged>>>> {
    // The next chunk is decompressed while this one is used. More would be kept in memory for nothing.
    let (records, taken) = bounded(0);
    // Foreign channels of the protocol's encoding stay, so that they are reported.
    let mut salvage = Salvage::new(file)?.only(move |channel| {
        let foreign = channel.message_encoding != WIRE_ENCODING;
        match channel.topic.parse::<Key>() {
            _ if foreign => Note::car(&channel.topic).is_some(),
            Ok(key) => wanted(key.topic),
            Err(_) => true,
        }
    });
    thread::Builder::new().name("recording".into()).spawn(move || {
        loop {
            let next = salvage.next(true);
            let last = next.as_ref().map_or(true, Vec::is_empty);
            if records.send(next).is_err() || last {
                return;
            }
        }
    })?;
    Ok(taken)
}

/// The note on a channel; None on a channel for other programs.
fn note(channel: &str, data: &[u8]) -> Decoded<Note> {
    let Some(car) = Note::car(channel) else {
        return Ok(None);
    };
    let note = serde_json::from_slice::<Note>(data).map_err(|e| e.to_string())?;
    Ok(Some((note, car)))
}

fn wire_message(channel: &str, data: &[u8], wanted: fn(Topic) -> bool) -> Decoded<EventPayload> {
    let key = channel.parse::<Key>().map_err(|e| e.to_string())?;
    if !wanted(key.topic) {
        return Ok(None);
    }
    Ok(Some((payload(key.topic, data)?, key.car)))
}

/// The payload of a message as it came. An error for a topic that is not recorded.
pub(super) fn payload(topic: Topic, data: &[u8]) -> Result<EventPayload, String> {
    let bytes = || data.into();
    let payload = if topic == Topic::Map {
        decode::<MapReply>(data).map(|(_, map)| EventPayload::Map {
            map: Arc::new(map),
            bytes: bytes(),
        })
    } else {
        let telemetry =
            Telemetry::decode(topic, data).ok_or_else(|| format!("{topic} carries no telemetry"))?;
        telemetry.map(|(header, telemetry)| EventPayload::Message {
            topic,
            delivery: Delivery::InOrder,
            header,
            telemetry: Box::new(telemetry),
            bytes: bytes(),
        })
    };
    Ok(payload.unwrap_or_else(|error| EventPayload::Unreadable {
        topic,
        header: Header::read(data).ok(),
        error: error.to_string(),
    }))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::recording::writer::RecordingWriter;
    use protocol::{Event, EventKind, Stamps, Telemetry, encode};
    use std::borrow::Cow;
    use std::io::Cursor;

    /// Event `number` of a car, which arrived at `number` \[unix ns\]; its bytes have the version that `version` gives.
    pub(in super::super) fn event(number: u64, version: Option<u16>) -> FleetEvent {
        let event = Event {
            kind: EventKind::SearchStarted,
            update: number,
            who: None,
            command: None,
        };
        let stamps = Stamps {
            run_id: 1,
            sequence: number + 1,
            ..Stamps::default()
        };
        let mut bytes = encode(&event, stamps).expect("a good message");
        let (header, _) = decode::<Event>(&bytes).expect("our own");
        if let Some(version) = version {
            // Behind the magic and the schema.
            bytes[6..8].copy_from_slice(&version.to_le_bytes());
        }
        FleetEvent {
            at: number as i64,
            car: "car-1".parse().expect("a name"),
            payload: EventPayload::Message {
                topic: Topic::Event,
                delivery: Delivery::InOrder,
                header,
                telemetry: Box::new(Telemetry::Event(event)),
                bytes: bytes.into(),
            },
        }
    }

    /// A recording of a hundred events, ten to a chunk, with an attachment and metadata.
    pub(in super::super) fn small_recording() -> Vec<u8> {
        let mut recording = RecordingWriter::new(Cursor::new(Vec::new())).expect("begun");
        for number in 0..100 {
            recording.write(&event(number, None)).expect("written");
            if number % 10 == 9 {
                recording.flush().expect("flushed");
            }
        }
        let attachment = mcap::Attachment {
            log_time: 1,
            create_time: 1,
            name: "notes.txt".into(),
            media_type: "text/plain".into(),
            data: Cow::Borrowed(b"wet track"),
        };
        recording.attach(&attachment).expect("written");
        let (_, bytes) = recording.finish().expect("ended");
        bytes.into_inner()
    }

    #[test]
    fn a_file_cut_off_between_two_records_ends_with_one_error() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("session.mcap");
        let bytes = small_recording();
        // Without its end mark, the file ends after a whole record.
        std::fs::write(&path, &bytes[..bytes.len() - mcap::MAGIC.len()]).expect("written");
        let events: Vec<_> = read_events(&path).expect("opens").collect();
        assert_eq!(events.len(), 101);
        let error = events[100].as_ref().expect_err("the last").to_string();
        assert!(error.contains("session.mcap: the file was cut off"), "{error}");
    }

    #[test]
    fn what_was_written_is_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("session.mcap");
        std::fs::write(&path, small_recording()).expect("written");
        let times: Vec<_> = read_events(&path)
            .expect("opens")
            .map(|event| event.expect("whole").at)
            .collect();
        assert_eq!(times, (0..100).collect::<Vec<_>>());
    }
}
