//! Reads a recording back: the same events as the live pit wall had. A message that cannot be read is an event, too
//! ([`EventPayload::Unreadable`]), as it is live; a channel that is of no kind known here is passed over with a warning.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::io::MessageReader;
use protocol::{Header, Key, MapReply, Telemetry, Topic, decode};

use super::error::RecordingError;
use super::note::Note;
use super::salvage::reader_options;
use super::writer::WIRE_ENCODING;
use crate::event::{Delivery, EventPayload, FleetEvent};

/// The events of a recording, in the order in which they were written.
pub struct Recording<R: Read> {
    messages: MessageReader<R>,
    path: PathBuf,
    /// Channels that were passed over.
    foreign: BTreeSet<String>,
}

/// Opens a recording. An unfinished one is an error at its end: [`recover`](super::recover()) it first.
pub fn read_events(path: &Path) -> Result<Recording<BufReader<File>>, RecordingError> {
    let file = open(path)?;
    Ok(Recording {
        messages: MessageReader::new_with_options(BufReader::new(file), reader_options()),
        path: path.to_owned(),
        foreign: BTreeSet::new(),
    })
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

impl<R: Read> Iterator for Recording<R> {
    type Item = Result<FleetEvent, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let message = match self.messages.next()? {
                Ok(message) => message,
                Err(error) => return Some(Err(RecordingError::broken(&self.path, error))),
            };
            let channel = message.channel.topic.as_str();
            let at = message.log_time as i64;
            let event = if message.channel.message_encoding == WIRE_ENCODING {
                let key = channel.parse::<Key>().map_err(|e| e.to_string());
                key.and_then(|key| Ok((payload(key.topic, &message.data)?, key.car)))
            } else if let Some(car) = Note::car(channel) {
                let note = serde_json::from_slice::<Note>(&message.data);
                note.map(|note| (note.into(), car)).map_err(|e| e.to_string())
            } else {
                // For other tools.
                continue;
            };
            match event {
                Ok((payload, car)) => return Some(Ok(FleetEvent { at, car, payload })),
                Err(error) => {
                    if self.foreign.insert(channel.to_owned()) {
                        tracing::warn!(channel, error, "passed over; was it recorded by a newer pitwall?");
                    }
                }
            }
        }
    }
}

/// What a message as it came says. An error for a topic that is not recorded.
fn payload(topic: Topic, data: &[u8]) -> Result<EventPayload, String> {
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

    /// An event that arrived at `number` \[unix ns\].
    fn event(number: u64) -> FleetEvent {
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
        let bytes = encode(&event, stamps).expect("a good message");
        let (header, _) = decode::<Event>(&bytes).expect("our own");
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
            recording.write(&event(number)).expect("written");
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
