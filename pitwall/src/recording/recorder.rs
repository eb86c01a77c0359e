//! Records on its own thread.

use std::fs::{File, OpenOptions};
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender};
use serde::Serialize;

use super::error::RecordingError;
use super::summary::RecordingSummary;
use super::writer::RecordingWriter;
use crate::event::FleetEvent;

/// Period at which events are flushed and synced to the disk. A power cut loses the events of one period and of one sync,
/// which must be less than a second together.
const SYNC_EVERY: Duration = Duration::from_millis(300);
/// A sync that takes longer than this is reported, because then a power cut can lose more than a second.
const SLOW_SYNC: Duration = Duration::from_millis(700);
/// Maximum number of events that wait for a slow disk: about a minute of ten cars.
const QUEUE: usize = 200_000;

/// A recording in progress.
pub struct Recorder {
    events: Sender<Arc<FleetEvent>>,
    thread: JoinHandle<Result<RecordingSummary, RecordingError>>,
    path: PathBuf,
    status: Arc<Mutex<RecorderStatus>>,
}

/// State of a recording.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct RecorderStatus {
    /// Bytes in the file.
    pub bytes: u64,
    /// Events that were not recorded because the disk was too slow.
    pub overrun: u64,
    /// Content of the file so far.
    pub summary: RecordingSummary,
    /// Why the recording has failed; None while it has not.
    pub error: Option<String>,
}

/// Progress of a recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingProgress {
    /// Bytes in the file.
    pub bytes: u64,
    /// From the first event to the last \[s\].
    pub seconds: f64,
    /// Messages and notes.
    pub messages: u64,
    /// Messages that were sent and are not in the file.
    pub missing: u64,
    /// Events that were not recorded because the disk was too slow.
    pub overrun: u64,
    /// Why the recording has failed; None while it has not.
    pub error: Option<String>,
}

impl Recorder {
    /// Creates the file and starts to record. Never overwrites a file.
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

    /// Records an event. Never waits.
    pub fn record(&self, event: &Arc<FleetEvent>) {
        if self.events.try_send(event.clone()).is_err() {
            self.status.lock().unwrap_or_else(PoisonError::into_inner).overrun += 1;
        }
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The state.
    pub fn status(&self) -> RecorderStatus {
        self.status.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The progress. Cheap enough to call many times a second.
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

    /// Writes the remaining events, completes the file and returns its summary. Waits for the disk.
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
        let mut schedule = SyncSchedule::new(Instant::now());
        loop {
            match self.queue.recv_timeout(schedule.left(Instant::now())) {
                Ok(event) => self.recording.write(&event).map_err(mcap)?,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            if schedule.due(Instant::now()) {
                self.recording.flush().map_err(mcap)?;
                let begun = Instant::now();
                self.sync.sync_data().map_err(io)?;
                let took = begun.elapsed();
                if took > SLOW_SYNC {
                    tracing::warn!(
                        ?took,
                        "the disk is slow: a power cut would lose more than a second"
                    );
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

/// When to sync.
struct SyncSchedule(Instant);

impl SyncSchedule {
    fn new(now: Instant) -> Self {
        Self(now)
    }

    /// Time until the next sync.
    fn left(&self, now: Instant) -> Duration {
        SYNC_EVERY.saturating_sub(now.saturating_duration_since(self.0))
    }

    /// True when it is time to sync; the next period begins then.
    fn due(&mut self, now: Instant) -> bool {
        let due = self.left(now).is_zero();
        if due {
            self.0 = now;
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_most_a_second_is_not_yet_on_the_disk() {
        let begin = Instant::now();
        let mut schedule = SyncSchedule::new(begin);
        let mut oldest = None;
        for number in 0..1000 {
            let now = begin + number * Duration::from_millis(25);
            let unsynced = *oldest.get_or_insert(now);
            assert!(
                now - unsynced + SLOW_SYNC <= Duration::from_secs(1),
                "event {number}"
            );
            if schedule.due(now) {
                oldest = None;
            }
        }
    }
}
