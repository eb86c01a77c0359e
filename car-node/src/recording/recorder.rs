//! The thread that records, and the queue to it.

use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use mcap::McapError;
use protocol::{EventKind, RecorderState, Topic};

use super::file_writer::{FileHead, FileWriter, describe};
use super::folder::{RESERVE, RecordingFolder};
use super::ros_channels::RosMessage;
use crate::sensors::clock::wall_now;

/// Period of writing and syncing. With the time of a sync it is what a power cut may lose.
const PERIOD: Duration = Duration::from_millis(400);
/// A sync that takes longer than this is reported, because then a power cut can lose more than a second.
const SLOW_SYNC: Duration = Duration::from_millis(600);
/// Time between two reports of slow syncs.
const SLOW_SYNC_AGAIN: Duration = Duration::from_mins(1);
/// After a failure, recording is tried again this often.
const RETRY: Duration = Duration::from_secs(5);
/// Most entries that wait: some seconds of all streams, for a disk that stalls.
const QUEUE: usize = 4096;
/// Most bytes that wait.
const QUEUE_BYTES: usize = 16 * 1024 * 1024;
/// How long a command waits for the thread.
const PATIENCE: Duration = Duration::from_secs(2);
/// Smallest files: each begins with the map.
const LEAST_SPLIT: u64 = 1024 * 1024;

/// Where and how much to record.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordOptions {
    /// The folder.
    pub folder: PathBuf,
    /// Most bytes of all files together; then the oldest are deleted.
    pub limit: u64,
    /// A file that has this many bytes is followed by the next.
    pub split: u64,
    /// Record from the start. Otherwise, record if the car did when it last ran, or when a pit wall asks for it.
    pub start: bool,
}

impl RecordOptions {
    /// Limit by default: some ten hours.
    pub const LIMIT: u64 = 8 * 1024 * 1024 * 1024;
    /// Size of a file by default: some five minutes.
    pub const SPLIT: u64 = 64 * 1024 * 1024;

    /// The defaults for a folder.
    pub fn new(folder: PathBuf, start: bool) -> Self {
        Self {
            folder,
            limit: Self::LIMIT,
            split: Self::SPLIT,
            start,
        }
    }
}

/// Why recording cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The folder cannot be made or read.
    #[error("{}: {source}", folder.display())]
    Folder {
        /// The folder.
        folder: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// The files would be too small.
    #[error(
        "recordings of {split} bytes a file and {limit} bytes in all: a file needs {LEAST_SPLIT} bytes at least, and there must be \
         room for two"
    )]
    Sizes {
        /// Size of a file.
        split: u64,
        /// Size of all.
        limit: u64,
    },
    /// The first file cannot be written.
    #[error("{0}")]
    File(String),
}

/// What is recorded.
#[derive(Debug)]
pub enum Entry {
    /// A message as on the wire.
    Message {
        /// Its topic.
        topic: Topic,
        /// Its sequence number.
        sequence: u64,
        /// When it was published \[unix ns\].
        published: i64,
        /// All of it, with its header.
        bytes: Vec<u8>,
    },
    /// Sensor data, written as a ROS 2 message.
    Ros {
        /// When it was published \[unix ns\].
        at: i64,
        /// The data.
        message: RosMessage,
    },
}

impl Entry {
    fn size(&self) -> usize {
        match self {
            Self::Message { bytes, .. } => bytes.len() + 64,
            Self::Ros { message, .. } => message.size(),
        }
    }
}

/// A command to the thread, and where its answer goes.
struct Control {
    on: bool,
    reply: Sender<Result<RecorderState, String>>,
}

/// The recorder as the other threads see it. None of its methods waits, except for [`Recorder::set_recording`].
#[derive(Debug)]
pub struct Recorder {
    queue: Sender<Entry>,
    queued_bytes: AtomicUsize,
    recording: AtomicBool,
    dropped: AtomicU64,
    control: Sender<Control>,
    state: Mutex<RecorderState>,
    folder: RecordingFolder,
    /// Length of the file being written that is safely on the disk.
    synced: AtomicU64,
}

impl Recorder {
    /// True while the car records.
    pub fn recording(&self) -> bool {
        self.recording.load(Ordering::Relaxed)
    }

    /// Records an entry. A full queue drops it and counts it.
    pub fn offer(&self, entry: Entry) {
        if !self.recording() {
            return;
        }
        let size = entry.size();
        let room = self.queued_bytes.fetch_add(size, Ordering::Relaxed) + size <= QUEUE_BYTES;
        if !room || self.queue.try_send(entry).is_err() {
            self.queued_bytes.fetch_sub(size, Ordering::Relaxed);
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Starts or ends the recording. Waits for the thread, for 2 s at most.
    pub fn set_recording(&self, on: bool) -> Result<RecorderState, String> {
        let (reply, answer) = bounded(1);
        self.control
            .send_timeout(Control { on, reply }, PATIENCE)
            .map_err(|_| "the recorder takes no commands".to_owned())?;
        answer
            .recv_timeout(PATIENCE)
            .map_err(|_| format!("the disk did not answer within {} s", PATIENCE.as_secs()))?
    }

    /// The state.
    pub fn state(&self) -> RecorderState {
        RecorderState {
            dropped: self.dropped.load(Ordering::Relaxed),
            ..self.state.lock().unwrap_or_else(PoisonError::into_inner).clone()
        }
    }

    /// The folder of the recordings.
    pub fn folder(&self) -> &RecordingFolder {
        &self.folder
    }

    /// The number of the file being written, and how much of it is safely on the disk \[bytes\].
    pub fn writing(&self) -> Option<(u64, u64)> {
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        (state.file > 0).then(|| (state.file, self.synced.load(Ordering::Relaxed)))
    }
}

/// The thread.
#[derive(Debug)]
pub struct RecorderThread {
    stop: Sender<()>,
    thread: JoinHandle<()>,
}

impl RecorderThread {
    /// Makes the folder. The thread waits for [`Launch::run`], so that events can go where the recorder is part of.
    pub fn prepare(options: RecordOptions, head: FileHead) -> Result<(Arc<Recorder>, Launch), RecordError> {
        let RecordOptions {
            folder: path,
            limit,
            split,
            start,
        } = options;
        if split < LEAST_SPLIT || limit / 2 < split {
            return Err(RecordError::Sizes { split, limit });
        }
        let folder = RecordingFolder::open(&path, &head.car).map_err(|source| RecordError::Folder {
            folder: path.clone(),
            source,
        })?;
        let (queue, entries) = bounded(QUEUE);
        let (control, controls) = bounded(4);
        let recorder = Arc::new(Recorder {
            queue,
            queued_bytes: AtomicUsize::new(0),
            recording: AtomicBool::new(false),
            dropped: AtomicU64::new(0),
            control,
            state: Mutex::new(RecorderState {
                limit,
                ..RecorderState::default()
            }),
            folder: folder.clone(),
            synced: AtomicU64::new(0),
        });
        let bytes = folder
            .list()
            .map_err(|source| RecordError::Folder { folder: path, source })?
            .iter()
            .map(|file| file.bytes)
            .sum();
        let launch = Launch {
            work: Work {
                recorder: Arc::clone(&recorder),
                folder,
                limit,
                split,
                head,
                entries,
                controls,
                file: None,
                others: bytes,
                retry_at: None,
                slow_reported: None,
                on_event: Box::new(|_| {}),
            },
            start,
        };
        Ok((recorder, launch))
    }

    /// Writes what is queued, completes the file and ends the thread.
    pub fn shutdown(self) {
        drop(self.stop);
        if self.thread.join().is_err() {
            tracing::error!("the recorder's thread has panicked");
        }
    }
}

/// A recorder whose thread does not run yet.
pub struct Launch {
    work: Work,
    start: bool,
}

impl Launch {
    /// Starts the thread. `on_event` gets what happens. Fails when the recording should start at once and cannot.
    pub fn run(self, on_event: impl Fn(EventKind) + Send + 'static) -> Result<RecorderThread, RecordError> {
        let Self { mut work, start } = self;
        work.on_event = Box::new(on_event);
        if start {
            work.start().map_err(RecordError::File)?;
        } else if work.folder.resumes()
            && let Err(error) = work.start()
        {
            work.fail(error);
            work.recorder.recording.store(true, Ordering::Relaxed);
        }
        work.publish_state();
        let (stop, stops) = bounded(0);
        let thread = thread::Builder::new()
            .name("recorder".into())
            .spawn(move || work.run(&stops))
            .map_err(|error| RecordError::File(error.to_string()))?;
        Ok(RecorderThread { stop, thread })
    }
}

struct OpenFile {
    number: u64,
    path: PathBuf,
    writer: FileWriter,
    bytes: u64,
}

/// What the thread owns.
struct Work {
    recorder: Arc<Recorder>,
    folder: RecordingFolder,
    limit: u64,
    split: u64,
    head: FileHead,
    entries: Receiver<Entry>,
    controls: Receiver<Control>,
    file: Option<OpenFile>,
    /// Size of the other files in the folder.
    others: u64,
    /// When a failed recording is tried again.
    retry_at: Option<Instant>,
    slow_reported: Option<Instant>,
    on_event: Box<dyn Fn(EventKind) + Send>,
}

impl Work {
    fn run(mut self, stop: &Receiver<()>) {
        loop {
            // Entries wait for the period: a thread that wakes for each of them costs more than writing them.
            let stopped = stop.recv_timeout(PERIOD) != Err(RecvTimeoutError::Timeout);
            self.write_queued();
            while let Ok(Control { on, reply }) = self.controls.try_recv() {
                // Whoever asked may have given up.
                reply.send(self.control(on)).ok();
            }
            if stopped {
                break;
            }
            self.maintain(Instant::now());
        }
        if let Err(error) = self.finish_file() {
            tracing::error!(error, "the last file of the recording on the car is not complete");
        }
    }

    fn control(&mut self, on: bool) -> Result<RecorderState, String> {
        let recording = self.recorder.recording();
        if on && !recording {
            self.start()?;
        } else if !on && recording {
            self.recorder.recording.store(false, Ordering::Relaxed);
            self.retry_at = None;
            let finished = self.finish_file();
            self.set_error(None);
            self.folder
                .set_resume(false)
                .map_err(|error| format!("{}: {error}", self.folder.path().display()))?;
            (self.on_event)(EventKind::RecordingEnded {
                reason: finished.err().unwrap_or_else(|| "stopped".to_owned()),
            });
        }
        self.publish_state();
        Ok(self.recorder.state())
    }

    /// Begins the first file of a recording.
    fn start(&mut self) -> Result<(), String> {
        self.open_next()?;
        self.folder
            .set_resume(true)
            .map_err(|error| format!("{}: {error}", self.folder.path().display()))?;
        self.recorder.recording.store(true, Ordering::Relaxed);
        let file = self.file.as_ref().map_or(0, |file| file.number);
        (self.on_event)(EventKind::RecordingStarted { file });
        Ok(())
    }

    fn open_next(&mut self) -> Result<(), String> {
        let in_folder =
            |folder: &RecordingFolder, error: io::Error| format!("{}: {error}", folder.path().display());
        self.others = self
            .folder
            .make_room(self.limit - self.split, 0)
            .map_err(|error| in_folder(&self.folder, error))?;
        if let Some(free) = self.folder.free()
            && free < RESERVE
        {
            let (free, reserve) = (free >> 20, RESERVE >> 20);
            let folder = self.folder.path().display();
            return Err(format!(
                "{folder}: {free} MiB are free; recording leaves {reserve} MiB"
            ));
        }
        let now = wall_now();
        let (name, path, file) = self
            .folder
            .create_next(now)
            .map_err(|error| in_folder(&self.folder, error))?;
        let written = |error: McapError| describe(&path, &error);
        let mut writer = FileWriter::new(file, self.head.clone(), now).map_err(written)?;
        let bytes = writer.sync().map_err(written)?;
        self.recorder.synced.store(bytes, Ordering::Relaxed);
        self.file = Some(OpenFile {
            number: name.number,
            path,
            writer,
            bytes,
        });
        Ok(())
    }

    fn finish_file(&mut self) -> Result<(), String> {
        let Some(file) = self.file.take() else {
            return Ok(());
        };
        let bytes = file
            .writer
            .finish()
            .map_err(|error| describe(&file.path, &error))?;
        self.others += bytes;
        Ok(())
    }

    fn write_queued(&mut self) {
        while let Ok(entry) = self.entries.try_recv() {
            self.recorder
                .queued_bytes
                .fetch_sub(entry.size(), Ordering::Relaxed);
            let Some(file) = &mut self.file else {
                // Nothing can be written at present.
                self.recorder.dropped.fetch_add(1, Ordering::Relaxed);
                continue;
            };
            if let Err(error) = file.writer.write(&entry) {
                let error = describe(&file.path, &error);
                self.recorder.dropped.fetch_add(1, Ordering::Relaxed);
                self.fail(error);
            }
        }
    }

    /// Syncs, begins the next file when this one is full, and tries again after a failure.
    fn maintain(&mut self, now: Instant) {
        if let Some(file) = &mut self.file {
            match file.writer.sync() {
                Ok(_) if !file.path.exists() => {
                    let error = format!("{}: the file was deleted", file.path.display());
                    self.fail(error);
                }
                Ok(bytes) => {
                    file.bytes = bytes;
                    self.recorder.synced.store(bytes, Ordering::Relaxed);
                    self.report_slow_sync(now);
                }
                Err(error) => {
                    let error = describe(&file.path, &error);
                    self.fail(error);
                }
            }
        }
        let full = self.file.as_ref().is_some_and(|file| file.bytes >= self.split);
        let scarce = self.file.is_some() && self.folder.free().is_some_and(|free| free < RESERVE);
        let next = if full {
            self.finish_file().and_then(|()| self.open_next())
        } else if scarce {
            let keep = self.file.as_ref().map_or(0, |file| file.number);
            self.make_room(keep)
        } else if self.retry_at.is_some_and(|at| now >= at) {
            self.open_next().inspect(|()| {
                let file = self.file.as_ref().map_or(0, |file| file.number);
                (self.on_event)(EventKind::RecordingStarted { file });
            })
        } else {
            Ok(())
        };
        match next {
            Ok(()) if self.file.is_some() => {
                self.retry_at = None;
                self.set_error(None);
            }
            Ok(()) => {}
            Err(error) => self.fail(error),
        }
        self.publish_state();
    }

    /// Deletes old files because the disk is nearly full. An error when that is not enough: the file is completed then.
    fn make_room(&mut self, keep: u64) -> Result<(), String> {
        let all = self
            .folder
            .make_room(self.limit, keep)
            .map_err(|error| format!("{}: {error}", self.folder.path().display()))?;
        self.others = all.saturating_sub(self.file.as_ref().map_or(0, |file| file.bytes));
        match self.folder.free() {
            Some(free) if free < RESERVE => {
                self.finish_file()?;
                let (free, reserve) = (free >> 20, RESERVE >> 20);
                let folder = self.folder.path().display();
                Err(format!(
                    "{folder}: {free} MiB are free; recording leaves {reserve} MiB"
                ))
            }
            _ => Ok(()),
        }
    }

    /// Gives up the present file. The recording is tried again later.
    fn fail(&mut self, error: String) {
        if let Some(file) = self.file.take() {
            self.others += file.bytes;
        }
        let known = {
            let state = self.recorder.state.lock().unwrap_or_else(PoisonError::into_inner);
            state.error.is_some()
        };
        // The first time at once: another file may work.
        self.retry_at = Some(Instant::now() + if known { RETRY } else { Duration::ZERO });
        if !known {
            tracing::error!(error, "recording on the car has failed");
            let text = format!("recording on the car has failed: {error}");
            (self.on_event)(EventKind::Error { text });
        }
        self.set_error(Some(error));
    }

    fn set_error(&self, error: Option<String>) {
        let mut state = self.recorder.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.error = error.map(|mut error| {
            error.truncate(error.floor_char_boundary(RecorderState::MAX_ERROR));
            error
        });
    }

    fn report_slow_sync(&mut self, begun: Instant) {
        let took = begun.elapsed();
        let quiet = |at: Instant| at.elapsed() < SLOW_SYNC_AGAIN;
        if took > SLOW_SYNC && !self.slow_reported.is_some_and(quiet) {
            self.slow_reported = Some(Instant::now());
            let text = format!(
                "the car's disk is slow: a sync took {:.1} s, and a power cut would lose more than a second of the recording",
                took.as_secs_f64()
            );
            (self.on_event)(EventKind::Warning { text });
        }
    }

    fn publish_state(&self) {
        let free = self.folder.free().unwrap_or(0);
        let mut state = self.recorder.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.recording = self.recorder.recording();
        state.file = self.file.as_ref().map_or(0, |file| file.number);
        state.bytes = self.others + self.file.as_ref().map_or(0, |file| file.bytes);
        state.free = free;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::file_server;
    use protocol::{CarInfo, FilesReply, FilesRequest, Pose2};
    use std::collections::BTreeMap;
    use std::path::Path;
    use xxhash_rust::xxh3::xxh3_64;

    fn head() -> FileHead {
        FileHead {
            car: "car-1".parse().expect("a name"),
            run_id: 1,
            map: vec![7; 1000],
            info: CarInfo {
                version: "0".into(),
                started: 1,
                source: "test".into(),
                map: "room".into(),
                lap_length: None,
                base_link_from_laser: Pose2::default(),
                host: "host".into(),
            },
        }
    }

    fn options(folder: &Path) -> RecordOptions {
        RecordOptions {
            folder: folder.join("recordings"),
            limit: 4 * LEAST_SPLIT,
            split: LEAST_SPLIT,
            start: true,
        }
    }

    /// A message that does not compress.
    fn message(sequence: u64) -> Entry {
        let mut bits = sequence + 1;
        let bytes = std::iter::repeat_with(|| {
            bits ^= bits << 13;
            bits ^= bits >> 7;
            bits ^= bits << 17;
            bits as u8
        });
        Entry::Message {
            topic: Topic::RecordedScan,
            sequence,
            published: sequence as i64,
            bytes: bytes.take(16 * 1024).collect(),
        }
    }

    /// The sequence numbers in each file, as far as it can be read.
    fn recorded(folder: &RecordingFolder) -> BTreeMap<u64, Vec<u64>> {
        let files = folder.list().expect("listed");
        let sequences = |name: String| {
            let bytes = std::fs::read(folder.path().join(name)).expect("read");
            let options = mcap::read::Options::IgnoreEndMagic.into();
            let messages = mcap::MessageStream::new_with_options(&bytes, options).expect("a file");
            messages
                .map_while(Result::ok)
                .filter(|message| message.channel.topic.ends_with("recorded/scan"))
                .map(|message| message.log_time)
                .collect()
        };
        files
            .iter()
            .map(|file| (file.name.number, sequences(file.name.to_string())))
            .collect()
    }

    /// Waits until the thread has synced what it was given.
    fn until(condition: impl Fn() -> bool) {
        let deadline = Instant::now() + Duration::from_secs(30);
        while !condition() {
            assert!(Instant::now() < deadline, "in 30 s");
            thread::sleep(Duration::from_millis(10));
        }
    }

    #[test]
    fn files_are_split_and_the_oldest_deleted() {
        let temporary = tempfile::tempdir().expect("a folder");
        let (recorder, launch) =
            RecorderThread::prepare(options(temporary.path()), head()).expect("prepared");
        let thread = launch.run(|_| {}).expect("runs");
        for number in 0..480 {
            recorder.offer(message(number));
            if number % 80 == 79 {
                // So that the files are full where they are expected to be.
                until(|| recorder.queue.is_empty());
            }
        }
        thread.shutdown();
        let files = recorded(recorder.folder());
        assert_eq!(recorder.state().dropped, 0);
        assert!(files.len() > 1 && !files.contains_key(&1), "{:?}", files.keys());
        let numbers: Vec<_> = files.into_values().flatten().collect();
        let first = numbers[0];
        assert_eq!(
            numbers,
            (first..480).collect::<Vec<_>>(),
            "the newest, without a gap"
        );
        let bytes: u64 = recorder
            .folder()
            .list()
            .expect("listed")
            .iter()
            .map(|file| file.bytes)
            .sum();
        // A file is found to be full only when it is.
        assert!(bytes < 5 * LEAST_SPLIT + (1 << 20), "{bytes}");
    }

    #[test]
    fn what_was_synced_is_read_though_the_file_was_never_completed() {
        let temporary = tempfile::tempdir().expect("a folder");
        let (recorder, launch) =
            RecorderThread::prepare(options(temporary.path()), head()).expect("prepared");
        let thread = launch.run(|_| {}).expect("runs");
        let before = recorder.writing().expect("a file").1;
        for number in 0..10 {
            recorder.offer(message(number));
        }
        until(|| {
            recorder
                .writing()
                .is_some_and(|(_, synced)| synced > before + 100_000)
        });
        // The file as a power cut leaves it.
        let (number, synced) = recorder.writing().expect("a file");
        let cut = RecordingFolder::open(&temporary.path().join("cut"), &head().car).expect("made");
        let name = recorder.folder().list().expect("listed")[0].name.clone();
        let bytes = std::fs::read(recorder.folder().path().join(name.to_string())).expect("read");
        std::fs::write(cut.path().join(name.to_string()), &bytes[..synced as usize]).expect("written");
        assert_eq!(recorded(&cut)[&number], (0..10).collect::<Vec<_>>());
        thread.shutdown();
    }

    #[test]
    fn a_full_queue_drops_and_never_waits() {
        let temporary = tempfile::tempdir().expect("a folder");
        let (recorder, _launch) =
            RecorderThread::prepare(options(temporary.path()), head()).expect("prepared");
        recorder.offer(message(0));
        assert_eq!(recorder.queue.len(), 0, "it does not record");
        recorder.recording.store(true, Ordering::Relaxed);
        for number in 0..QUEUE as u64 {
            recorder.offer(message(number));
        }
        let kept = recorder.queue.len();
        assert!(kept * 16 * 1024 <= QUEUE_BYTES && kept > 900, "{kept}");
        assert_eq!(recorder.state().dropped, (QUEUE - kept) as u64);
    }

    #[test]
    fn it_is_stopped_and_started_and_resumes_after_a_restart() {
        let temporary = tempfile::tempdir().expect("a folder");
        let mut options = options(temporary.path());
        options.start = false;
        let events = Arc::new(Mutex::new(Vec::new()));
        let log = |kind| events.lock().unwrap_or_else(PoisonError::into_inner).push(kind);
        let run = |log: Box<dyn Fn(EventKind) + Send>| {
            let (recorder, launch) = RecorderThread::prepare(options.clone(), head()).expect("prepared");
            (recorder, launch.run(log).expect("runs"))
        };
        let (recorder, thread) = run(Box::new({
            let events = Arc::clone(&events);
            move |kind| events.lock().unwrap_or_else(PoisonError::into_inner).push(kind)
        }));
        assert!(!recorder.recording());
        let state = recorder.set_recording(true).expect("starts");
        assert!(
            state.recording && state.file == 1 && state.bytes > 500,
            "{state:?}"
        );
        assert_eq!(recorder.set_recording(true).expect("goes on").file, 1);
        thread.shutdown();
        log(EventKind::SourceEnded);

        let (recorder, thread) = run(Box::new(|_| {}));
        assert_eq!(recorder.state().file, 2, "it goes on after a restart");
        assert!(!recorder.set_recording(false).expect("stops").recording);
        thread.shutdown();
        let (recorder, thread) = run(Box::new(|_| {}));
        assert!(!recorder.recording(), "it was stopped");
        thread.shutdown();
        let events = events.lock().unwrap_or_else(PoisonError::into_inner);
        assert_eq!(
            *events,
            [EventKind::RecordingStarted { file: 1 }, EventKind::SourceEnded]
        );
    }

    #[test]
    fn a_folder_that_vanishes_is_an_event_and_recording_goes_on_when_it_is_back() {
        let temporary = tempfile::tempdir().expect("a folder");
        let options = options(temporary.path());
        let failed = Arc::new(AtomicUsize::new(0));
        let (recorder, launch) = RecorderThread::prepare(options.clone(), head()).expect("prepared");
        let thread = launch
            .run({
                let failed = Arc::clone(&failed);
                move |kind| {
                    if matches!(kind, EventKind::Error { .. }) {
                        failed.fetch_add(1, Ordering::Relaxed);
                    }
                }
            })
            .expect("runs");
        std::fs::remove_dir_all(&options.folder).expect("removed");
        for number in 0..70 {
            recorder.offer(message(number));
        }
        until(|| recorder.state().error.is_some());
        assert_eq!(failed.load(Ordering::Relaxed), 1);
        std::fs::create_dir_all(&options.folder).expect("made");
        until(|| recorder.state().error.is_none());
        assert!(recorder.recording() && recorder.writing().is_some());
        thread.shutdown();
    }

    #[test]
    fn impossible_options_are_refused() {
        let temporary = tempfile::tempdir().expect("a folder");
        let small = RecordOptions {
            limit: LEAST_SPLIT,
            ..options(temporary.path())
        };
        let error = RecorderThread::prepare(small, head())
            .err()
            .expect("refused")
            .to_string();
        assert!(error.contains("1048576 bytes in all"), "{error}");
        let file = temporary.path().join("file");
        std::fs::write(&file, b"").expect("written");
        let error = RecorderThread::prepare(options(&file), head())
            .err()
            .expect("refused")
            .to_string();
        assert!(error.contains("file/recordings: "), "{error}");
    }

    #[test]
    fn pieces_of_a_file_make_up_the_file_and_its_checksum() {
        let temporary = tempfile::tempdir().expect("a folder");
        let (recorder, launch) =
            RecorderThread::prepare(options(temporary.path()), head()).expect("prepared");
        let thread = launch.run(|_| {}).expect("runs");
        for number in 0..10 {
            recorder.offer(message(number));
        }
        thread.shutdown();
        let reply = |request| file_server::reply(&recorder, request).expect("replies");
        let FilesReply::Files { files, more: false } = reply(FilesRequest::List { after: 0 }) else {
            panic!("a list")
        };
        assert_eq!(files.len(), 1);
        let (number, length) = (files[0].number, files[0].bytes);
        let mut all = Vec::new();
        loop {
            let request = FilesRequest::Read {
                number,
                offset: all.len() as u64,
                length: 50_000,
            };
            match reply(request) {
                FilesReply::Bytes { bytes, .. } if bytes.is_empty() => break,
                FilesReply::Bytes { bytes, .. } => all.extend(bytes),
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(all.len() as u64, length);
        let checksum = reply(FilesRequest::Checksum { number, length });
        let xxh3 = xxh3_64(&all);
        assert_eq!(checksum, FilesReply::Checksum { number, length, xxh3 });
        assert_eq!(
            reply(FilesRequest::List { after: number }),
            FilesReply::Files {
                files: Vec::new(),
                more: false
            }
        );
        // Whatever is asked, there is an answer.
        for request in [
            FilesRequest::Checksum {
                number,
                length: length + 1,
            },
            FilesRequest::Checksum {
                number: 99,
                length: 0,
            },
            FilesRequest::Read {
                number: u64::MAX,
                offset: 0,
                length: 1,
            },
        ] {
            assert!(
                matches!(reply(request), FilesReply::Refused { .. }),
                "{request:?}"
            );
        }
        let beyond = FilesRequest::Read {
            number,
            offset: u64::MAX,
            length: u32::MAX,
        };
        assert!(matches!(
            file_server::reply(&recorder, beyond),
            Err(_) | Ok(FilesReply::Bytes { .. })
        ));
    }
}
