//! An index of the recordings in a folder: what is in each, so that a session is found without opening them all.
//!
//! The index is a SQLite file in the folder. It only repeats what the recordings say: a recording that has changed is read again,
//! and an index that is lost, damaged or of another version is made anew.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use protocol::{CarName, Telemetry, Topic, UtcTime};
use rusqlite::{Connection, params};
use serde::{Deserialize, Serialize};

use super::error::RecordingError;
use super::reader::read_intact;
use super::summary::missing_content;
use crate::event::{EventPayload, FleetEvent};
use crate::fleet::{Fleet, SequenceTracker};

/// Name of the index in the folder.
const FILE: &str = ".sessions.sqlite";
/// Version of the index. Another one is made anew.
const VERSION: i64 = 1;
/// Folders below the folder are searched this deep.
const DEPTH: usize = 3;
/// Most recordings.
const MAX_FILES: usize = 20_000;
/// Most sets, markers and cars of one recording.
const MAX_WORDS: usize = 100;

/// What a recording holds.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Session {
    /// The recording, from the folder on.
    pub file: PathBuf,
    /// When its first event was recorded \[unix ns\].
    pub started: i64,
    /// From the first event to the last \[s\].
    pub duration_s: f64,
    /// Its length \[bytes\].
    pub bytes: u64,
    /// True for a recording made on a car.
    pub on_car: bool,
    /// The map; None in a recording without info.
    pub track: Option<String>,
    /// The cars.
    pub cars: Vec<CarName>,
    /// Laps of all cars.
    pub laps: usize,
    /// The best lap and the car that drove it.
    pub best_lap: Option<(CarName, f64)>,
    /// The sets that were in force.
    pub sets: Vec<String>,
    /// The markers that operators set.
    pub markers: Vec<String>,
    /// Messages that were sent and are not in it, of the streams that must be complete.
    pub missing: u64,
    /// False for a file that was cut off or is still being recorded, and for a damaged one.
    pub complete: bool,
    /// What is wrong with the file.
    pub error: Option<String>,
}

impl Session {
    /// What a search looks at, in small letters.
    fn words(&self) -> String {
        let mut words = vec![self.file.display().to_string(), UtcTime(self.started).to_string()];
        words.extend(self.track.clone());
        words.extend(self.cars.iter().map(ToString::to_string));
        words.extend(self.sets.iter().chain(&self.markers).cloned());
        words.join("\n").to_lowercase()
    }
}

/// Why the index cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SessionIndexError {
    /// The folder cannot be read.
    #[error("{}: {source}", folder.display())]
    Folder {
        /// The folder.
        folder: PathBuf,
        /// The error of the system.
        source: std::io::Error,
    },
    /// The index cannot be read or written.
    #[error("{}: {source}; it may be deleted, for it is made from the recordings", file.display())]
    Index {
        /// The index.
        file: PathBuf,
        /// What SQLite says.
        source: rusqlite::Error,
    },
}

/// The index of a folder.
pub struct SessionIndex {
    folder: PathBuf,
    file: PathBuf,
    index: Connection,
}

impl SessionIndex {
    /// Opens the index, or makes an empty one. In a folder that cannot be written, it is in memory.
    pub fn open(folder: &Path) -> Result<Self, SessionIndexError> {
        let file = folder.join(FILE);
        let index = match connect(&file) {
            Ok(index) => index,
            Err(error) => {
                tracing::warn!(file = %file.display(), %error, "the index of the sessions is made anew");
                // What is damaged, or no index at all.
                fs::remove_file(&file).ok();
                let source = |source| SessionIndexError::Index {
                    file: file.clone(),
                    source,
                };
                connect(&file)
                    .or_else(|_| Connection::open_in_memory().and_then(prepare))
                    .map_err(source)?
            }
        };
        Ok(Self {
            folder: folder.to_owned(),
            file,
            index,
        })
    }

    /// Forgets everything, so that the next [`SessionIndex::refresh`] reads every recording.
    pub fn clear(&mut self) -> Result<(), SessionIndexError> {
        let cleared = self.index.execute("DELETE FROM session", []);
        cleared.map(drop).map_err(|error| self.error(error))
    }

    /// Reads what is new and what has changed, and forgets what is gone. `skip` is left as it is: the file being recorded.
    /// `on_file` is called before each recording is read.
    pub fn refresh(
        &mut self,
        skip: Option<&Path>,
        mut on_file: impl FnMut(&Path),
    ) -> Result<(), SessionIndexError> {
        let mut found = BTreeMap::new();
        find(&self.folder, DEPTH, &mut found).map_err(|source| SessionIndexError::Folder {
            folder: self.folder.clone(),
            source,
        })?;
        let known = self.known().map_err(|error| self.error(error))?;
        for file in known.keys() {
            if !found.contains_key(file) {
                self.forget(file).map_err(|error| self.error(error))?;
            }
        }
        for (file, stamp) in found {
            let path = self.folder.join(&file);
            if known.get(&file) == Some(&stamp) || skip.is_some_and(|skip| same(skip, &path)) {
                continue;
            }
            on_file(&path);
            let session = read(&path, &file, stamp.bytes);
            self.keep(&session, stamp).map_err(|error| self.error(error))?;
        }
        Ok(())
    }

    /// The sessions in which each word of `text` occurs, the newest first.
    pub fn search(&self, text: &str) -> Result<Vec<Session>, SessionIndexError> {
        let words: Vec<_> = text.split_whitespace().map(str::to_lowercase).collect();
        let query = || {
            let mut statement = self
                .index
                .prepare("SELECT content, words FROM session ORDER BY started DESC, file DESC")?;
            let rows =
                statement.query_map([], |row| Ok((row.get::<_, String>(0)?, row.get::<_, String>(1)?)))?;
            rows.collect::<Result<Vec<_>, _>>()
        };
        let rows = query().map_err(|error| self.error(error))?;
        let sessions = rows
            .into_iter()
            .filter(|(_, all)| words.iter().all(|word| all.contains(word)))
            .filter_map(|(content, _)| serde_json::from_str(&content).ok());
        Ok(sessions.collect())
    }

    fn error(&self, source: rusqlite::Error) -> SessionIndexError {
        SessionIndexError::Index {
            file: self.file.clone(),
            source,
        }
    }

    fn known(&self) -> rusqlite::Result<BTreeMap<PathBuf, Stamp>> {
        let mut statement = self.index.prepare("SELECT file, bytes, modified FROM session")?;
        let rows = statement.query_map([], |row| {
            let stamp = Stamp {
                bytes: row.get::<_, i64>(1)?.unsigned_abs(),
                modified: row.get(2)?,
            };
            Ok((PathBuf::from(row.get::<_, String>(0)?), stamp))
        })?;
        rows.collect()
    }

    fn forget(&self, file: &Path) -> rusqlite::Result<()> {
        let file = file.to_string_lossy();
        self.index
            .execute("DELETE FROM session WHERE file = ?1", [file])
            .map(drop)
    }

    fn keep(&self, session: &Session, stamp: Stamp) -> rusqlite::Result<()> {
        let content = serde_json::to_string(session).unwrap_or_default();
        let (bytes, modified) = (stamp.bytes as i64, stamp.modified);
        let file = session.file.to_string_lossy();
        self.index
            .execute(
                "INSERT OR REPLACE INTO session (file, bytes, modified, started, content, words) VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
                params![file, bytes, modified, session.started, content, session.words()],
            )
            .map(drop)
    }
}

/// A file's state when it was read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Stamp {
    bytes: u64,
    /// When it was last written \[unix ns\].
    modified: i64,
}

fn connect(file: &Path) -> rusqlite::Result<Connection> {
    prepare(Connection::open(file)?)
}

fn prepare(index: Connection) -> rusqlite::Result<Connection> {
    // A page and a terminal may look at the same time.
    index.busy_timeout(Duration::from_secs(5))?;
    let version: i64 = index.query_row("PRAGMA user_version", [], |row| row.get(0))?;
    if version != VERSION {
        index.execute_batch(&format!(
            "BEGIN;
             DROP TABLE IF EXISTS session;
             CREATE TABLE session (file TEXT PRIMARY KEY, bytes INTEGER, modified INTEGER, started INTEGER, content TEXT, words TEXT);
             PRAGMA user_version = {VERSION};
             COMMIT;"
        ))?;
    }
    // Fails for a damaged table.
    index.query_row("SELECT count(*), max(started) FROM session", [], |_| Ok(()))?;
    Ok(index)
}

/// The recordings in a folder and those below it, from the folder on. Links to folders are not followed.
fn find(folder: &Path, depth: usize, found: &mut BTreeMap<PathBuf, Stamp>) -> std::io::Result<()> {
    fn walk(
        root: &Path,
        below: &Path,
        depth: usize,
        found: &mut BTreeMap<PathBuf, Stamp>,
    ) -> std::io::Result<()> {
        for entry in fs::read_dir(root.join(below))? {
            let entry = entry?;
            let name = entry.file_name();
            let Some(name) = name.to_str().filter(|name| !name.starts_with('.')) else {
                continue;
            };
            let (path, kind) = (below.join(name), entry.file_type()?);
            if kind.is_dir() && depth > 0 {
                // A folder that cannot be read is no reason not to show the others.
                if let Err(error) = walk(root, &path, depth - 1, found) {
                    tracing::warn!(folder = %path.display(), %error, "skipped");
                }
            } else if kind.is_file()
                && path.extension().is_some_and(|end| end == "mcap")
                && found.len() < MAX_FILES
            {
                let metadata = entry.metadata()?;
                let modified = metadata
                    .modified()
                    .ok()
                    .and_then(|at| at.duration_since(UNIX_EPOCH).ok());
                let stamp = Stamp {
                    bytes: metadata.len(),
                    modified: modified.map_or(0, |at| at.as_nanos() as i64),
                };
                found.insert(path, stamp);
            }
        }
        Ok(())
    }
    walk(folder, Path::new(""), depth, found)
}

fn same(a: &Path, b: &Path) -> bool {
    match (a.canonicalize(), b.canonicalize()) {
        (Ok(a), Ok(b)) => a == b,
        _ => a == b,
    }
}

/// Reads a recording. One that cannot be read is a session with an error.
fn read(path: &Path, file: &Path, bytes: u64) -> Session {
    let mut content = Content {
        session: Session {
            file: file.to_owned(),
            bytes,
            ..Session::default()
        },
        ..Content::default()
    };
    if let Err(error) = content.read(path) {
        content.session.error = Some(error.to_string());
        content.session.complete = false;
    }
    content.finish()
}

/// A recording being read.
#[derive(Default)]
struct Content {
    session: Session,
    fleet: Fleet,
    span: Option<(i64, i64)>,
    sets: BTreeSet<String>,
    streams: BTreeMap<(CarName, Topic), SequenceTracker>,
}

impl Content {
    fn read(&mut self, path: &Path) -> Result<(), RecordingError> {
        let mut events = read_intact(path)?;
        for event in events.by_ref() {
            self.add(&event?);
        }
        self.session.on_car = events.library().starts_with(super::CAR_LIBRARY);
        self.session.complete = events.complete() && events.damage().is_empty();
        self.session.error = events.damage().first().cloned();
        Ok(())
    }

    fn add(&mut self, event: &FleetEvent) {
        let at = event.at;
        let (from, to) = self.span.unwrap_or((at, at));
        self.span = Some((from.min(at), to.max(at)));
        match &event.payload {
            EventPayload::Info(info) => self.session.track = Some(info.map.clone()),
            EventPayload::Marker { text, .. } if self.session.markers.len() < MAX_WORDS => {
                self.session.markers.push(text.to_string());
            }
            EventPayload::Message {
                topic,
                header,
                telemetry,
                ..
            } => {
                if topic.recovered() && (self.streams.len() < MAX_WORDS * 10) {
                    let stream = self.streams.entry((event.car.clone(), *topic)).or_default();
                    stream.arrive(header.run_id, header.sequence);
                }
                if let Telemetry::Params(params) = &**telemetry
                    && self.sets.len() < MAX_WORDS
                {
                    self.sets.insert(params.set.name.clone());
                }
            }
            _ => {}
        }
        self.fleet.apply(event);
    }

    fn finish(self) -> Session {
        let mut session = self.session;
        let (from, to) = self.span.unwrap_or_default();
        session.started = from;
        session.duration_s = (to - from) as f64 * 1e-9;
        session.sets = self.sets.into_iter().collect();
        for car in self.fleet.cars() {
            let streams = self.streams.iter().filter(|((name, _), _)| *name == car.name);
            session.missing += missing_content(
                streams.map(|((_, topic), numbers)| (*topic, numbers.received(), numbers.missing())),
            );
        }
        for car in self.fleet.cars().take(MAX_WORDS) {
            session.cars.push(car.name.clone());
            session.laps += car.laps().len();
            for lap in car.laps().iter().filter(|lap| lap.void.is_none()) {
                if session
                    .best_lap
                    .as_ref()
                    .is_none_or(|(_, best)| lap.time_s < *best)
                {
                    session.best_lap = Some((car.name.clone(), lap.time_s));
                }
            }
        }
        session
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::reader::tests::small_recording;

    /// Refreshes the index; returns the names of the files that were read.
    fn refresh(folder: &Path) -> (SessionIndex, Vec<String>) {
        let mut index = SessionIndex::open(folder).expect("opens");
        let mut read = Vec::new();
        let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
        index
            .refresh(None, |path| read.extend(name(path)))
            .expect("refreshed");
        read.sort();
        (index, read)
    }

    fn files(index: &SessionIndex, text: &str) -> Vec<String> {
        let found = index.search(text).expect("searches");
        let mut files: Vec<_> = found
            .iter()
            .map(|session| session.file.display().to_string())
            .collect();
        files.sort();
        files
    }

    #[test]
    fn a_recording_is_read_once_and_again_when_it_changes() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        fs::create_dir(path("club")).expect("made");
        fs::write(path("club/one.mcap"), small_recording()).expect("written");
        fs::write(path("two.mcap"), &small_recording()[..500]).expect("written");
        fs::write(path("three.mcap"), b"not a recording").expect("written");
        fs::write(path("notes.txt"), b"wet").expect("written");
        let (index, read) = refresh(folder.path());
        assert_eq!(read, ["one.mcap", "three.mcap", "two.mcap"]);
        let sessions = index.search("club").expect("searches");
        assert_eq!(sessions.len(), 1);
        let session = &sessions[0];
        assert!(
            session.complete && session.error.is_none() && session.missing == 0,
            "{session:?}"
        );
        assert_eq!(session.cars, ["car-1".parse().expect("a name")]);
        let foreign = &index.search("three").expect("searches")[0];
        assert!(
            foreign
                .error
                .as_ref()
                .is_some_and(|error| error.contains("is not a recording"))
        );
        assert!(!index.search("two").expect("searches")[0].complete);
        drop(index);

        assert_eq!(refresh(folder.path()).1, [""; 0], "nothing has changed");
        fs::write(path("two.mcap"), small_recording()).expect("written");
        fs::remove_file(path("three.mcap")).expect("removed");
        let (index, read) = refresh(folder.path());
        assert_eq!(read, ["two.mcap"]);
        assert_eq!(files(&index, ""), ["club/one.mcap", "two.mcap"]);
        assert_eq!(files(&index, "CAR-1 mcap club"), ["club/one.mcap"]);
        assert_eq!(files(&index, "car-2"), [""; 0]);
    }

    #[test]
    fn an_index_that_is_damaged_or_lost_is_made_anew() {
        let folder = tempfile::tempdir().expect("a folder");
        fs::write(folder.path().join("one.mcap"), small_recording()).expect("written");
        refresh(folder.path());
        let index = folder.path().join(FILE);
        let good = fs::read(&index).expect("there is one");
        for damaged in [
            b"not SQLite, and long enough to be looked at".repeat(10),
            good[..good.len() / 3].to_vec(),
            Vec::new(),
        ] {
            fs::write(&index, damaged).expect("written");
            let (index, read) = refresh(folder.path());
            assert_eq!(read, ["one.mcap"]);
            assert_eq!(files(&index, "one"), ["one.mcap"]);
        }
    }

    #[test]
    fn the_file_being_recorded_is_left_alone() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("one.mcap");
        fs::write(&path, small_recording()).expect("written");
        let mut index = SessionIndex::open(folder.path()).expect("opens");
        index
            .refresh(Some(&path), |path| panic!("{}", path.display()))
            .expect("refreshed");
        assert!(index.search("").expect("searches").is_empty());
    }
}
