//! Records on its own thread.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::BufWriter;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender};
use protocol::{CarName, Topic};
use serde::Serialize;

use super::error::RecordingError;
use super::summary::RecordingSummary;
use super::writer::RecordingWriter;
use crate::clock::{system_now, unix_now};
use crate::event::{EventPayload, FleetEvent};

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
    status: Arc<Mutex<RecorderStatus>>,
}

/// How to record.
#[derive(Debug, Clone, Default)]
pub struct RecorderOptions {
    /// Begin another file when this one has so many bytes. Then the files are numbered: `NAME-001.mcap`.
    pub split_bytes: Option<u64>,
    /// Begin another file after this time.
    pub split_after: Option<Duration>,
    /// Folder to go on in when the file cannot be written any more.
    pub spare: Option<PathBuf>,
    /// Who records.
    pub operator: String,
}

impl RecorderOptions {
    fn splits(&self) -> bool {
        self.split_bytes.is_some() || self.split_after.is_some()
    }
}

/// State of a recording.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct RecorderStatus {
    /// The file that is being written.
    pub file: PathBuf,
    /// Why an earlier file cannot be written any more, if recording goes on in the spare folder.
    pub moved: Option<String>,
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
    /// Why an earlier file cannot be written any more, if recording goes on in the spare folder.
    pub moved: Option<String>,
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
        Self::start_with(path, RecorderOptions::default())
    }

    /// Creates the file, or the first of several, and starts to record. Never overwrites a file.
    pub fn start_with(path: &Path, options: RecorderOptions) -> Result<Self, RecordingError> {
        let first = if options.splits() {
            part(path, None, 1)
        } else {
            path.to_owned()
        };
        let (file, writer) = create(&first)?;
        let mut recording = RecordingWriter::new(writer).map_err(|e| RecordingError::mcap(&first, e))?;
        recording
            .describe(system_now(), &options.operator)
            .map_err(|e| RecordingError::mcap(&first, e))?;
        let (events, queue) = crossbeam_channel::bounded(QUEUE);
        let status = Arc::new(Mutex::new(RecorderStatus {
            file: first.clone(),
            ..RecorderStatus::default()
        }));
        let work = Work {
            name: path.to_owned(),
            path: first,
            parts: 1,
            begun: Instant::now(),
            options,
            recording,
            sync: file,
            unsynced: Vec::new(),
            opening: Opening::default(),
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
            status,
        })
    }

    /// Records an event. Never waits.
    pub fn record(&self, event: &Arc<FleetEvent>) {
        if self.events.try_send(event.clone()).is_err() {
            self.status.lock().unwrap_or_else(PoisonError::into_inner).overrun += 1;
        }
    }

    /// The file that is being written.
    pub fn path(&self) -> PathBuf {
        self.status
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .file
            .clone()
    }

    /// The state.
    pub fn status(&self) -> RecorderStatus {
        self.status.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The progress. Cheap enough to call many times a second.
    pub fn progress(&self) -> RecordingProgress {
        let status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        RecordingProgress {
            moved: status.moved.clone(),
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
        let path = self.path();
        drop(self.events);
        self.thread.join().unwrap_or_else(|_| {
            let gone = std::io::Error::other("the recorder's thread panicked");
            Err(RecordingError::io(&path, gone))
        })
    }
}

/// The name of a part of a recording, in `folder` if one is given.
fn part(name: &Path, folder: Option<&Path>, number: u32) -> PathBuf {
    let stem = name.file_stem().unwrap_or_default().to_string_lossy();
    let file = format!("{stem}-{number:03}.mcap");
    folder.map_or_else(|| name.with_file_name(&file), |folder| folder.join(&file))
}

/// Creates a new file, and returns it twice: to sync and to write.
fn create(path: &Path) -> Result<(File, BufWriter<File>), RecordingError> {
    let file = OpenOptions::new()
        .write(true)
        .create_new(true)
        .open(path)
        .map_err(|e| RecordingError::io(path, e))?;
    let sync = file.try_clone().map_err(|e| RecordingError::io(path, e))?;
    Ok((sync, BufWriter::new(file)))
}

/// The newest events of each car that a file must begin with.
#[derive(Default)]
struct Opening(BTreeMap<(CarName, u8), Arc<FleetEvent>>);

impl Opening {
    fn add(&mut self, event: &Arc<FleetEvent>) {
        let kind = match &event.payload {
            EventPayload::Appeared | EventPayload::Vanished => 0,
            EventPayload::Info(_) => 1,
            EventPayload::Map { .. } => 2,
            EventPayload::Clock { .. } => 3,
            EventPayload::Message {
                topic: Topic::Params, ..
            } => 4,
            _ => return,
        };
        self.0.insert((event.car.clone(), kind), event.clone());
    }
}

struct Work {
    /// The name that was asked for.
    name: PathBuf,
    /// The present file.
    path: PathBuf,
    parts: u32,
    /// When the present file was begun.
    begun: Instant,
    options: RecorderOptions,
    recording: RecordingWriter<BufWriter<File>>,
    sync: File,
    /// Events since the last sync.
    unsynced: Vec<Arc<FleetEvent>>,
    opening: Opening,
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
        let mut schedule = SyncSchedule::new(Instant::now());
        loop {
            match self.queue.recv_timeout(schedule.left(Instant::now())) {
                Ok(event) => self.write(event)?,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            if schedule.due(Instant::now()) {
                // What came during a slow sync is written before the next one. Otherwise one event would follow each.
                for _ in 0..self.queue.len() {
                    let Ok(event) = self.queue.try_recv() else {
                        break;
                    };
                    self.write(event)?;
                }
                if let Err(error) = self.sync() {
                    self.move_on(error)?;
                }
                if self.is_full()
                    && let Err(error) = self.split()
                {
                    self.move_on(error)?;
                }
            }
        }
        if let Err(error) = self.sync() {
            self.move_on(error)?;
        }
        let path = self.path;
        let (summary, writer) = self
            .recording
            .finish()
            .map_err(|e| RecordingError::mcap(&path, e))?;
        drop(writer);
        self.sync.sync_all().map_err(|e| RecordingError::io(&path, e))?;
        Ok(summary)
    }

    fn write(&mut self, event: Arc<FleetEvent>) -> Result<(), RecordingError> {
        let written = self.recording.write(&event);
        self.opening.add(&event);
        self.unsynced.push(event);
        match written {
            Ok(()) => Ok(()),
            Err(error) => self.move_on(RecordingError::mcap(&self.path, error)),
        }
    }

    /// Brings everything to the disk.
    fn sync(&mut self) -> Result<(), RecordingError> {
        let io = |e| RecordingError::io(&self.path, e);
        self.recording
            .flush()
            .map_err(|e| RecordingError::mcap(&self.path, e))?;
        let begun = Instant::now();
        self.sync.sync_data().map_err(io)?;
        let took = begun.elapsed();
        if took > SLOW_SYNC {
            tracing::warn!(
                ?took,
                "the disk is slow: a power cut would lose more than a second"
            );
        }
        let written = self.sync.metadata().map_err(io)?;
        // A file that was deleted can still be written.
        let there = std::fs::metadata(&self.path).map_err(io)?;
        if (there.dev(), there.ino()) != (written.dev(), written.ino()) {
            return Err(io(std::io::Error::other("the file was replaced by another one")));
        }
        self.unsynced.clear();
        let mut status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        status.bytes = written.len();
        status.summary = self.recording.summary();
        Ok(())
    }

    fn is_full(&self) -> bool {
        let bytes = self.status.lock().unwrap_or_else(PoisonError::into_inner).bytes;
        self.options.split_bytes.is_some_and(|most| bytes >= most)
            || self
                .options
                .split_after
                .is_some_and(|time| self.begun.elapsed() >= time)
    }

    /// Completes the file and begins the next one.
    fn split(&mut self) -> Result<(), RecordingError> {
        let done = self.path.clone();
        let synced = self.sync.try_clone().map_err(|e| RecordingError::io(&done, e))?;
        let old = self.begin_next(None)?;
        let completed = self.recording.complete_part(old);
        completed.map_err(|e| RecordingError::mcap(&done, e))?;
        synced.sync_all().map_err(|e| RecordingError::io(&done, e))
    }

    /// Goes on in the spare folder, with everything that has not reached the disk. Returns the error when there is no spare
    /// folder, or it fails as well.
    fn move_on(&mut self, error: RecordingError) -> Result<(), RecordingError> {
        let Some(spare) = self.options.spare.clone() else {
            return Err(error);
        };
        // Once: a spare folder that fails, too, has no successor.
        if self.path.parent() == Some(spare.as_path()) {
            return Err(error);
        }
        let old = self.begin_next(Some(&spare))?;
        // It cannot be completed. Leaking it avoids another write to a disk that may hang.
        std::mem::forget(old);
        tracing::error!(%error, file = %self.path.display(), "recording goes on in another file");
        self.status.lock().unwrap_or_else(PoisonError::into_inner).moved = Some(error.to_string());
        for event in std::mem::take(&mut self.unsynced) {
            self.recording
                .store(&event)
                .map_err(|e| RecordingError::mcap(&self.path, e))?;
        }
        self.sync()
    }

    /// Begins the next file with what is known about the cars. Returns the old one.
    fn begin_next(&mut self, folder: Option<&Path>) -> Result<mcap::Writer<BufWriter<File>>, RecordingError> {
        let folder = folder.or_else(|| self.path.parent());
        let path = part(&self.name, folder, self.parts + 1);
        let (file, writer) = create(&path)?;
        let mcap = |e| RecordingError::mcap(&path, e);
        let old = self.recording.continue_in(writer).map_err(mcap)?;
        self.recording
            .describe(system_now(), &self.options.operator)
            .map_err(mcap)?;
        let now = unix_now();
        for event in self.opening.0.values() {
            let event = FleetEvent {
                at: now,
                ..FleetEvent::clone(event)
            };
            self.recording.store(&event).map_err(mcap)?;
        }
        self.parts += 1;
        self.sync = file;
        self.begun = Instant::now();
        let mut status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        status.file.clone_from(&path);
        status.bytes = 0;
        drop(status);
        self.path = path;
        Ok(old)
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
    use crate::recording::read_events;

    fn marker(number: i64) -> Arc<FleetEvent> {
        Arc::new(FleetEvent {
            at: number,
            car: "car-1".parse().expect("a name"),
            payload: EventPayload::Marker {
                who: "ana".into(),
                text: number.to_string().into(),
            },
        })
    }

    /// The markers of a file.
    fn markers(path: &Path) -> Vec<i64> {
        let events = read_events(path).expect("opens");
        let markers = events.filter_map(|event| {
            let event = event.ok()?;
            matches!(event.payload, EventPayload::Marker { .. }).then_some(event.at)
        });
        markers.collect()
    }

    fn wait(recorder: &Recorder, until: impl Fn(&RecorderStatus) -> bool) {
        let deadline = Instant::now() + Duration::from_mins(1);
        while !until(&recorder.status()) {
            assert!(Instant::now() < deadline, "{:?}", recorder.status());
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn a_recording_is_split_by_size_and_nothing_is_lost() {
        let folder = tempfile::tempdir().expect("a folder");
        let options = RecorderOptions {
            split_bytes: Some(1),
            ..RecorderOptions::default()
        };
        let recorder = Recorder::start_with(&folder.path().join("a.mcap"), options).expect("begun");
        let appeared = FleetEvent {
            payload: EventPayload::Appeared,
            ..FleetEvent::clone(&marker(0))
        };
        recorder.record(&Arc::new(appeared));
        for number in 0..3 {
            let before = recorder.path();
            recorder.record(&marker(number));
            wait(&recorder, |status| status.file != before);
        }
        let summary = recorder.finish().expect("ended");
        assert_eq!(summary.messages, 4);
        let mut files: Vec<_> = std::fs::read_dir(folder.path())
            .expect("a folder")
            .map(|file| file.expect("a file").path())
            .collect();
        files.sort();
        assert!(files[0].ends_with("a-001.mcap"), "{files:?}");
        let all: Vec<_> = files.iter().flat_map(|file| markers(file)).collect();
        assert_eq!(all, [0, 1, 2]);
        let last = files.last().expect("a file");
        let first = read_events(last).expect("opens").next().expect("an event");
        assert!(matches!(first.expect("whole").payload, EventPayload::Appeared));
    }

    // A USB stick that was pulled out once ended the recording without a word.
    #[test]
    fn a_file_that_vanishes_is_an_error_and_goes_on_in_the_spare_folder() {
        for has_spare in [false, true] {
            let [folder, spare] = [0, 1].map(|_| tempfile::tempdir().expect("a folder"));
            let path = folder.path().join("a.mcap");
            let options = RecorderOptions {
                spare: has_spare.then(|| spare.path().to_owned()),
                ..RecorderOptions::default()
            };
            let recorder = Recorder::start_with(&path, options).expect("begun");
            std::fs::remove_file(&path).expect("removed");
            recorder.record(&marker(7));
            if !has_spare {
                wait(&recorder, |status| status.error.is_some());
                let error = recorder.finish().expect_err("failed").to_string();
                assert!(error.contains("a.mcap"), "{error}");
                continue;
            }
            wait(&recorder, |status| status.moved.is_some());
            recorder.record(&marker(8));
            let file = recorder.path();
            recorder.finish().expect("ended");
            assert_eq!(file, spare.path().join("a-002.mcap"));
            assert_eq!(markers(&file), [7, 8]);
        }
    }

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
