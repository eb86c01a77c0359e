//! Records on a thread of its own.

use std::fs::{File, OpenOptions};
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender};
use serde::Serialize;

use super::writer::{RecordingError, RecordingSummary, RecordingWriter};
use crate::event::FleetEvent;

/// How often what was recorded goes to the operating system: a crash of the program loses no more than this.
const FLUSH_EVERY: Duration = Duration::from_millis(300);
/// How often it goes to the disk.
const SYNC_EVERY: Duration = Duration::from_secs(2);
/// Events that may wait for a slow disk: about a minute of ten cars.
const QUEUE: usize = 200_000;

/// A recording in progress.
pub struct Recorder {
    events: Sender<Arc<FleetEvent>>,
    thread: JoinHandle<Result<RecordingSummary, RecordingError>>,
    path: PathBuf,
    status: Arc<Mutex<RecorderStatus>>,
}

/// How a recording is getting on.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct RecorderStatus {
    /// Bytes in the file.
    pub bytes: u64,
    /// Events that were not recorded because the disk was too slow.
    pub overrun: u64,
    /// What is in the file so far.
    pub summary: RecordingSummary,
    /// Why recording has failed, if it has.
    pub error: Option<String>,
}

/// How a recording is getting on, in short.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingProgress {
    /// Bytes in the file.
    pub bytes: u64,
    /// From the first event to the last [s].
    pub seconds: f64,
    /// Messages and notes.
    pub messages: u64,
    /// Messages that were sent and are not in the file.
    pub missing: u64,
    /// Events that were not recorded because the disk was too slow.
    pub overrun: u64,
    /// Why recording has failed, if it has.
    pub error: Option<String>,
}

impl Recorder {
    /// Creates the file and begins. Never overwrites.
    pub fn start(path: &Path) -> Result<Self, RecordingError> {
        let file = OpenOptions::new()
            .write(true)
            .create_new(true)
            .open(path)
            .map_err(|e| RecordingError::io(path, e))?;
        let sync = file.try_clone().map_err(|e| RecordingError::io(path, e))?;
        let recording =
            RecordingWriter::new(BufWriter::new(file)).map_err(|e| RecordingError::mcap(path, e))?;
        let (events, queue) = crossbeam_channel::bounded(QUEUE);
        let status = Arc::new(Mutex::new(RecorderStatus::default()));
        let work = Work {
            path: path.to_owned(),
            recording,
            sync,
            queue,
            status: status.clone(),
        };
        let thread = std::thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(move || work.run())
            .map_err(|e| RecordingError::io(path, e))?;
        Ok(Self {
            events,
            thread,
            path: path.to_owned(),
            status,
        })
    }

    /// Takes in an event; never waits.
    pub fn record(&self, event: &Arc<FleetEvent>) {
        if self.events.try_send(event.clone()).is_err() {
            self.status.lock().unwrap_or_else(PoisonError::into_inner).overrun += 1;
        }
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// How it is getting on.
    pub fn status(&self) -> RecorderStatus {
        self.status.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// How it is getting on, in short: cheap enough to be asked for many times a second.
    pub fn progress(&self) -> RecordingProgress {
        let status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        RecordingProgress {
            bytes: status.bytes,
            seconds: status.summary.duration_s,
            messages: status.summary.messages,
            missing: status.summary.missing(),
            overrun: status.overrun,
            error: status.error.clone(),
        }
    }

    /// Writes what is left, ends the file and says what is in it. Waits for the disk.
    pub fn finish(self) -> Result<RecordingSummary, RecordingError> {
        drop(self.events);
        self.thread.join().unwrap_or_else(|_| {
            let gone = std::io::Error::other("the recorder's thread panicked");
            Err(RecordingError::io(&self.path, gone))
        })
    }
}

struct Work {
    path: PathBuf,
    recording: RecordingWriter<BufWriter<File>>,
    sync: File,
    queue: Receiver<Arc<FleetEvent>>,
    status: Arc<Mutex<RecorderStatus>>,
}

impl Work {
    fn run(self) -> Result<RecordingSummary, RecordingError> {
        let status = self.status.clone();
        let outcome = self.record();
        if let Err(error) = &outcome {
            tracing::error!(%error, "recording has failed");
            status.lock().unwrap_or_else(PoisonError::into_inner).error = Some(error.to_string());
        }
        outcome
    }

    fn record(mut self) -> Result<RecordingSummary, RecordingError> {
        let path = self.path.clone();
        let io = |e| RecordingError::io(&path, e);
        let mcap = |e| RecordingError::mcap(&path, e);
        let mut flushed = Instant::now();
        let mut synced = Instant::now();
        loop {
            match self
                .queue
                .recv_timeout(FLUSH_EVERY.saturating_sub(flushed.elapsed()))
            {
                Ok(event) => self.recording.write(&event).map_err(mcap)?,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            if flushed.elapsed() >= FLUSH_EVERY {
                self.recording.flush().map_err(mcap)?;
                flushed = Instant::now();
                if synced.elapsed() >= SYNC_EVERY {
                    self.sync.sync_data().map_err(io)?;
                    synced = Instant::now();
                }
                let bytes = self.sync.metadata().map_err(io)?.len();
                let mut status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
                status.bytes = bytes;
                status.summary = self.recording.summary();
            }
        }
        let (summary, writer) = self.recording.finish().map_err(mcap)?;
        drop(writer);
        self.sync.sync_all().map_err(io)?;
        Ok(summary)
    }
}
