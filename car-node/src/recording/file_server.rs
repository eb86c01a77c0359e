//! The thread that sends recordings to a pit wall, piece by piece. It reads one piece at a time, so that it needs little of the
//! disk and of memory, whatever is asked.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::sync::Arc;
use std::thread::JoinHandle;

use crossbeam_channel::Receiver;
use protocol::{FileInfo, FilesReply, FilesRequest, Stamps, decode, encode};
use xxhash_rust::xxh3::Xxh3;

use super::recorder::Recorder;
use crate::control::{Request, serve};
use crate::sensors::clock::wall_now;
use crate::telemetry::shared_state::SharedState;

/// Answers requests for recordings.
pub struct FileServer {
    /// The recordings; None on a car without a folder for them.
    pub recorder: Option<Arc<Recorder>>,
    /// Counts requests that cannot be read.
    pub shared: Arc<SharedState>,
    /// This run of the node.
    pub run_id: u64,
}

impl FileServer {
    /// Starts the thread. It ends when `stop` is dropped.
    pub fn start(self, requests: Receiver<Request>, stop: Receiver<()>) -> io::Result<JoinHandle<()>> {
        serve("file-server", requests, stop, move |topic, payload| {
            self.answer(payload).inspect_err(|error| {
                let count = self.shared.counters.bad_payload() + 1;
                if count.is_power_of_two() {
                    tracing::warn!(%topic, count, error, "a request cannot be read");
                }
            })
        })
    }

    /// The encoded reply; an error names what is wrong with a request that cannot be decoded.
    fn answer(&self, payload: Option<&[u8]>) -> Result<Vec<u8>, String> {
        let payload = payload.ok_or("this query needs a payload")?;
        let (_, request) = decode::<FilesRequest>(payload).map_err(|error| error.to_string())?;
        let reply = match &self.recorder {
            Some(recorder) => reply(recorder, request).unwrap_or_else(|fault| refused(fault.to_string())),
            None => refused("this car has no folder for recordings".to_owned()),
        };
        let now = wall_now().0;
        let stamps = Stamps {
            run_id: self.run_id,
            sequence: 0,
            sensor: now,
            published: now,
        };
        encode(&reply, stamps).map_err(|error| error.to_string())
    }
}

fn refused(mut fault: String) -> FilesReply {
    fault.truncate(fault.floor_char_boundary(FilesReply::MAX_FAULT));
    FilesReply::Refused { fault }
}

/// The reply to a request. Of the file being written, only what is safely on the disk is there.
pub(super) fn reply(recorder: &Recorder, request: FilesRequest) -> io::Result<FilesReply> {
    match request {
        FilesRequest::List { after } => {
            let writing = recorder.writing();
            let files = recorder.folder().list()?;
            let mut later = files.iter().filter(|file| file.name.number > after);
            let files = later
                .by_ref()
                .take(FilesReply::MAX_FILES)
                .map(|file| {
                    let number = file.name.number;
                    let open = writing.filter(|(open, _)| *open == number);
                    FileInfo {
                        number,
                        started: file.name.started,
                        bytes: open.map_or(file.bytes, |(_, synced)| synced.min(file.bytes)),
                        finished: open.is_none(),
                    }
                })
                .collect();
            Ok(FilesReply::Files {
                files,
                more: later.next().is_some(),
            })
        }
        FilesRequest::Read {
            number,
            offset,
            length,
        } => {
            let Some((mut file, bytes)) = open(recorder, number)? else {
                return Ok(gone(number));
            };
            let left = bytes.saturating_sub(offset);
            let length = u64::from(length.min(FilesRequest::MAX_READ)).min(left);
            let mut piece = vec![0; length as usize];
            file.seek(SeekFrom::Start(offset))?;
            file.read_exact(&mut piece)?;
            Ok(FilesReply::Bytes {
                number,
                offset,
                bytes: piece,
            })
        }
        FilesRequest::Checksum { number, length } => {
            let Some((mut file, bytes)) = open(recorder, number)? else {
                return Ok(gone(number));
            };
            if length > bytes {
                return Ok(refused(format!(
                    "recording {number} has {bytes} bytes, not {length}"
                )));
            }
            let mut hash = Xxh3::new();
            let mut left = length;
            let mut piece = vec![0; FilesRequest::MAX_READ as usize];
            while left > 0 {
                let part = left.min(piece.len() as u64) as usize;
                file.read_exact(&mut piece[..part])?;
                hash.update(&piece[..part]);
                left -= part as u64;
            }
            Ok(FilesReply::Checksum {
                number,
                length,
                xxh3: hash.digest(),
            })
        }
    }
}

/// The file and how much of it may be read.
fn open(recorder: &Recorder, number: u64) -> io::Result<Option<(File, u64)>> {
    let writing = recorder.writing();
    Ok(recorder.folder().open_file(number)?.map(|(file, bytes)| {
        let open = writing.filter(|(open, _)| *open == number);
        (file, open.map_or(bytes, |(_, synced)| synced.min(bytes)))
    }))
}

fn gone(number: u64) -> FilesReply {
    refused(format!(
        "there is no recording {number}; the oldest are deleted when the recordings reach their limit"
    ))
}
