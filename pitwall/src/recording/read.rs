//! Reads a recording back: the same events as the live pit wall had.

use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::io::MessageReader;
use mcap::sans_io::LinearReaderOptions;
use protocol::{Key, MapReply, Telemetry, Topic, decode};

use super::file::{RecordingError, WIRE_ENCODING};
use super::note::Note;
use crate::event::{FleetEvent, Happening, Lane};

/// The events of a recording, in the order in which they were written.
pub struct Recording<R: Read> {
    messages: MessageReader<R>,
    path: PathBuf,
}

/// Opens a recording. An unfinished one is an error at its end: [`recover`](super::recover()) it first.
pub fn read_events(path: &Path) -> Result<Recording<BufReader<File>>, RecordingError> {
    let file = open(path)?;
    Ok(Recording {
        messages: MessageReader::new_with_options(BufReader::new(file), LinearReaderOptions::default()),
        path: path.to_owned(),
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
            let fault = |reason: String| RecordingError::Message {
                file: self.path.display().to_string(),
                channel: channel.to_owned(),
                sequence: message.sequence,
                reason,
            };
            if message.channel.message_encoding == WIRE_ENCODING {
                let event = channel
                    .parse::<Key>()
                    .map_err(|e| e.to_string())
                    .and_then(|key| event_of(key, &message.data, at));
                return Some(event.map_err(fault));
            }
            if let Some(car) = Note::car(channel) {
                let note = serde_json::from_slice::<Note>(&message.data).map_err(|e| fault(e.to_string()));
                return Some(note.map(|note| FleetEvent {
                    at,
                    car,
                    happening: note.into(),
                }));
            }
        }
    }
}

fn event_of(key: Key, data: &[u8], at: i64) -> Result<FleetEvent, String> {
    let bytes: Arc<[u8]> = data.into();
    let happening = if key.topic == Topic::Map {
        let (_, map) = decode::<MapReply>(data).map_err(|e| e.to_string())?;
        Happening::Map {
            map: Arc::new(map),
            bytes,
        }
    } else {
        let (header, telemetry) = Telemetry::decode(key.topic, data)
            .ok_or_else(|| format!("{} carries no telemetry", key.topic))?
            .map_err(|e| e.to_string())?;
        Happening::Message {
            topic: key.topic,
            lane: Lane::Complete,
            header,
            telemetry: Box::new(telemetry),
            bytes,
        }
    };
    Ok(FleetEvent {
        at,
        car: key.car,
        happening,
    })
}
