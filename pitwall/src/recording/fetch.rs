//! Copies the recordings on a car's disk to the laptop: in pieces, with the lowest priority, at a limited rate.
//!
//! ```text
//! list ──► for each file: read ──► FILE.part ──► checksum ──► FILE
//! ```
//!
//! A copy that was interrupted goes on where it ended. A file gets its name only when its checksum is that of the car. One that the
//! car still writes stays a `.part` and grows with the next fetch; it can be merged as it is.
//!
//! Nothing that a car sends is used as a path, and the copy stops before the disk is full.

use std::fs::{self, File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use protocol::{CarName, FileInfo, FileName, FilesReply, FilesRequest};
use serde::Serialize;
use xxhash_rust::xxh3::Xxh3;

/// End of the name of a file that is not complete.
pub(super) const PART: &str = "part";
/// Limits of a piece's size \[bytes\]. It grows while replies come within the first time, and shrinks above the second.
const PIECE: [u32; 2] = [4_000, FilesRequest::MAX_READ];
const ROUND_TRIP: [Duration; 2] = [Duration::from_millis(50), Duration::from_millis(200)];
/// How long one reply may take. A checksum needs to read the file on the car.
const REPLY: Duration = Duration::from_secs(5);
const CHECKSUM: Duration = Duration::from_mins(1);
/// A fetch that gets no reply for this long ends; the next one goes on where it ended.
const PATIENCE: Duration = Duration::from_mins(1);
/// Free space that is left on the laptop's disk \[bytes\].
const RESERVE: u64 = 1_000_000_000;
/// Most recordings of a car.
const MAX_FILES: usize = 100_000;

/// Requests that a car answers.
pub trait FileSource {
    /// Sends a request. None when the car does not reply in time.
    fn request(
        &self,
        request: FilesRequest,
        timeout: Duration,
    ) -> impl Future<Output = Option<FilesReply>> + Send;
}

/// What to fetch, and how.
#[derive(Debug, Clone)]
pub struct FetchOptions {
    /// The folder for the copies.
    pub folder: PathBuf,
    /// Most bytes per second.
    pub rate: f64,
    /// Only recordings with a higher number.
    pub after: u64,
    /// Free space that must be left on the disk \[bytes\].
    pub reserve: u64,
    /// How long the car may be silent.
    pub patience: Duration,
}

impl FetchOptions {
    /// Rate by default \[bytes/s\]: a third of what common Wi-Fi carries beside the live view.
    pub const RATE: f64 = 2_000_000.0;

    /// Everything, into this folder.
    pub fn new(folder: PathBuf) -> Self {
        Self {
            folder,
            rate: Self::RATE,
            after: 0,
            reserve: RESERVE,
            patience: PATIENCE,
        }
    }
}

/// A recording that was fetched.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Fetched {
    /// Its number on the car.
    pub number: u64,
    /// The copy.
    pub file: PathBuf,
    /// Its length \[bytes\].
    pub bytes: u64,
    /// What came over the link now \[bytes\].
    pub received: u64,
    /// False for a file that the car still writes.
    pub finished: bool,
}

/// How far a fetch is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FetchProgress {
    /// Files before the present one, and of all.
    pub files: [usize; 2],
    /// Bytes here, and of all files.
    pub bytes: [u64; 2],
}

/// Why a fetch ends early. What was received is kept.
#[derive(Debug, thiserror::Error)]
pub enum FetchError {
    /// The car does not reply.
    #[error("{car} has not replied for {} s; the next fetch goes on here", waited.as_secs())]
    NoReply {
        /// The car.
        car: CarName,
        /// How long.
        waited: Duration,
    },
    /// The car refuses.
    #[error("{car}: {fault}")]
    Refused {
        /// The car.
        car: CarName,
        /// Why.
        fault: String,
    },
    /// The reply does not belong to the request.
    #[error("{car}: recording {number}: {fault}")]
    Reply {
        /// The car.
        car: CarName,
        /// The recording.
        number: u64,
        /// What is wrong.
        fault: String,
    },
    /// A file on the laptop.
    #[error("{}: {source}", file.display())]
    Io {
        /// The file.
        file: PathBuf,
        /// The error of the system.
        source: std::io::Error,
    },
    /// The disk is nearly full.
    #[error("{}: {free} MB are free, recordings of {needed} MB are to come, and {reserve} MB must be left", folder.display())]
    Full {
        /// The folder.
        folder: PathBuf,
        /// Free space \[MB\].
        free: u64,
        /// What is to come \[MB\].
        needed: u64,
        /// What must be left \[MB\].
        reserve: u64,
    },
    /// Another program fetches the same file.
    #[error("{}: another program fetches this recording", .0.display())]
    Locked(PathBuf),
}

/// Lists the recordings on a car.
async fn list(
    car: &CarName,
    source: &impl FileSource,
    options: &FetchOptions,
) -> Result<Vec<FileInfo>, FetchError> {
    let mut all: Vec<FileInfo> = Vec::new();
    let mut after = options.after;
    loop {
        let request = FilesRequest::List { after };
        match ask(car, source, request, REPLY, options.patience).await? {
            FilesReply::Files { files, more } => {
                let Some(last) = files.last().map(|file| file.number) else {
                    return Ok(all);
                };
                if files[0].number <= after || all.len() + files.len() > MAX_FILES {
                    return Err(unexpected(car, last, "the list is not in order, or too long"));
                }
                all.extend(files);
                after = last;
                if !more {
                    return Ok(all);
                }
            }
            other => return Err(refused(car, 0, other)),
        }
    }
}

/// Fetches the recordings that are not here yet. `on_progress` is called after each piece.
pub async fn fetch(
    car: &CarName,
    source: &impl FileSource,
    options: &FetchOptions,
    mut on_progress: impl FnMut(FetchProgress),
) -> Result<Vec<Fetched>, FetchError> {
    let io = |file: &Path| {
        let file = file.to_owned();
        move |source| FetchError::Io { file, source }
    };
    fs::create_dir_all(&options.folder).map_err(io(&options.folder))?;
    let files = list(car, source, options).await?;
    let mut progress = FetchProgress {
        files: [0, files.len()],
        bytes: [
            0,
            files.iter().map(|file| file.bytes).fold(0, u64::saturating_add),
        ],
    };
    let mut pace = Pace::new(options.rate);
    let mut fetched = Vec::new();
    for info in files {
        let before = progress.bytes[0];
        let name = FileName {
            number: info.number,
            started: info.started.max(0),
            car: car.clone(),
        };
        let path = options.folder.join(name.to_string());
        let mut one = FileFetch {
            car,
            source,
            options,
            info,
            part: path.with_extension(format!("mcap.{PART}")),
            path,
            pace: &mut pace,
        };
        let outcome = one
            .run(|here| {
                progress.bytes[0] = before + here;
                on_progress(progress);
            })
            .await?;
        progress.files[0] += 1;
        progress.bytes[0] = before.saturating_add(info.bytes);
        on_progress(progress);
        fetched.push(outcome);
    }
    Ok(fetched)
}

/// One file being fetched.
struct FileFetch<'a, S> {
    car: &'a CarName,
    source: &'a S,
    options: &'a FetchOptions,
    info: FileInfo,
    path: PathBuf,
    part: PathBuf,
    pace: &'a mut Pace,
}

impl<S: FileSource> FileFetch<'_, S> {
    async fn run(&mut self, mut on_bytes: impl FnMut(u64)) -> Result<Fetched, FetchError> {
        let FileInfo {
            number,
            bytes,
            finished,
            ..
        } = self.info;
        if let Ok(metadata) = fs::metadata(&self.path) {
            // It was verified when it got this name.
            if metadata.len() == bytes {
                on_bytes(bytes);
                return Ok(self.fetched(&self.path, 0, true));
            }
            let fault = format!(
                "{} has {} bytes and the car's has {bytes}; move it away to fetch it again",
                self.path.display(),
                metadata.len()
            );
            return Err(unexpected(self.car, number, &fault));
        }
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&self.part)
            .map_err(self.io())?;
        file.try_lock().map_err(|error| match error {
            fs::TryLockError::WouldBlock => FetchError::Locked(self.part.clone()),
            fs::TryLockError::Error(source) => self.io()(source),
        })?;
        let mut here = file.metadata().map_err(self.io())?.len();
        if here > bytes {
            file.set_len(0).map_err(self.io())?;
            here = 0;
        }
        let mut received = 0;
        for attempt in 1.. {
            received += self.copy(&mut file, here, &mut on_bytes).await?;
            if self.verified(&mut file).await? {
                break;
            }
            if attempt == 2 {
                return Err(unexpected(
                    self.car,
                    number,
                    "the checksum differs after two attempts",
                ));
            }
            tracing::warn!(car = %self.car, number, "the checksum differs: fetched again");
            file.set_len(0).map_err(self.io())?;
            here = 0;
        }
        file.sync_all().map_err(self.io())?;
        if !finished {
            return Ok(self.fetched(&self.part, received, false));
        }
        fs::rename(&self.part, &self.path).map_err(self.io())?;
        Ok(self.fetched(&self.path, received, true))
    }

    /// Fetches from byte `here` to the end. Returns how much came.
    async fn copy(
        &mut self,
        file: &mut File,
        here: u64,
        on_bytes: &mut impl FnMut(u64),
    ) -> Result<u64, FetchError> {
        let FileInfo { number, bytes, .. } = self.info;
        self.check_room(bytes - here)?;
        file.seek(SeekFrom::Start(here)).map_err(self.io())?;
        let mut at = here;
        while at < bytes {
            on_bytes(at);
            let length = u64::from(self.pace.piece).min(bytes - at) as u32;
            let request = FilesRequest::Read {
                number,
                offset: at,
                length,
            };
            let begun = Instant::now();
            let reply = ask(self.car, self.source, request, REPLY, self.options.patience).await?;
            let piece = match reply {
                FilesReply::Bytes {
                    number: of,
                    offset,
                    bytes,
                } if of == number && offset == at && !bytes.is_empty() && bytes.len() <= length as usize => {
                    bytes
                }
                FilesReply::Bytes { .. } => {
                    return Err(unexpected(
                        self.car,
                        number,
                        "the file has become shorter, or a piece is another one",
                    ));
                }
                other => return Err(refused(self.car, number, other)),
            };
            let took = begun.elapsed();
            file.write_all(&piece).map_err(self.io())?;
            at += piece.len() as u64;
            self.pace.wait(piece.len(), took).await;
        }
        on_bytes(at);
        Ok(at - here)
    }

    /// True when the car's checksum of what is here is the same.
    async fn verified(&self, file: &mut File) -> Result<bool, FetchError> {
        let FileInfo { number, bytes, .. } = self.info;
        file.rewind().map_err(self.io())?;
        let mut hash = Xxh3::new();
        let mut buffer = vec![0; 1 << 16];
        loop {
            let length = file.read(&mut buffer).map_err(self.io())?;
            if length == 0 {
                break;
            }
            hash.update(&buffer[..length]);
        }
        let request = FilesRequest::Checksum {
            number,
            length: bytes,
        };
        match ask(self.car, self.source, request, CHECKSUM, self.options.patience).await? {
            FilesReply::Checksum {
                number: of,
                length,
                xxh3,
            } if of == number && length == bytes => Ok(xxh3 == hash.digest()),
            FilesReply::Checksum { .. } => {
                Err(unexpected(self.car, number, "the checksum is of another file"))
            }
            other => Err(refused(self.car, number, other)),
        }
    }

    fn check_room(&self, needed: u64) -> Result<(), FetchError> {
        let folder = &self.options.folder;
        let Some(free) = crate::web::free_space(folder) else {
            return Ok(());
        };
        if free.saturating_sub(needed) >= self.options.reserve {
            return Ok(());
        }
        Err(FetchError::Full {
            folder: folder.clone(),
            free: free / 1_000_000,
            needed: needed / 1_000_000,
            reserve: self.options.reserve / 1_000_000,
        })
    }

    fn fetched(&self, file: &Path, received: u64, finished: bool) -> Fetched {
        Fetched {
            number: self.info.number,
            file: file.to_owned(),
            bytes: self.info.bytes,
            received,
            finished,
        }
    }

    fn io(&self) -> impl FnOnce(std::io::Error) -> FetchError + use<S> {
        let file = self.part.clone();
        move |source| FetchError::Io { file, source }
    }
}

/// Size of the pieces and time between them.
struct Pace {
    rate: f64,
    piece: u32,
}

impl Pace {
    fn new(rate: f64) -> Self {
        Self {
            rate,
            piece: PIECE[0],
        }
    }

    /// Waits after a piece, and adapts the size of the next. On a slow link, half of the time is left to others.
    async fn wait(&mut self, bytes: usize, took: Duration) {
        let [least, most] = PIECE;
        let [short, long] = ROUND_TRIP;
        let budget = Duration::try_from_secs_f64(bytes as f64 / self.rate).unwrap_or(long);
        let mut rest = budget.saturating_sub(took);
        if took < short {
            self.piece = (2 * self.piece).min(most);
        } else if took > long {
            self.piece = (self.piece / 2).max(least);
            rest = rest.max(took.min(REPLY));
        }
        if !rest.is_zero() {
            tokio::time::sleep(rest).await;
        }
    }
}

/// Asks until the car replies, for `patience`.
async fn ask(
    car: &CarName,
    source: &impl FileSource,
    request: FilesRequest,
    timeout: Duration,
    patience: Duration,
) -> Result<FilesReply, FetchError> {
    let begun = Instant::now();
    loop {
        if let Some(reply) = source.request(request, timeout).await {
            return Ok(reply);
        }
        let waited = begun.elapsed();
        if waited >= patience {
            return Err(FetchError::NoReply {
                car: car.clone(),
                waited,
            });
        }
        // A query to a car that is gone ends at once.
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
}

fn refused(car: &CarName, number: u64, reply: FilesReply) -> FetchError {
    match reply {
        FilesReply::Refused { fault } => FetchError::Refused {
            car: car.clone(),
            fault,
        },
        _ => unexpected(car, number, "the reply is to another request"),
    }
}

fn unexpected(car: &CarName, number: u64, fault: &str) -> FetchError {
    FetchError::Reply {
        car: car.clone(),
        number,
        fault: fault.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;
    use std::sync::Mutex;
    use xxhash_rust::xxh3::xxh3_64;

    /// A car with files in memory.
    #[derive(Default)]
    struct Car {
        files: Mutex<BTreeMap<u64, (Vec<u8>, bool)>>,
        /// Requests until the link is cut.
        left: Mutex<Option<u32>>,
        /// One byte of the first piece is damaged.
        damage: Mutex<bool>,
        read: Mutex<u64>,
    }

    impl FileSource for Car {
        async fn request(&self, request: FilesRequest, _: Duration) -> Option<FilesReply> {
            if let Some(left) = &mut *self.left.lock().expect("locks") {
                *left = left.checked_sub(1)?;
            }
            let files = self.files.lock().expect("locks");
            let file = |number| files.get(&number).map(|(bytes, _)| bytes);
            let gone = || FilesReply::Refused { fault: "gone".into() };
            Some(match request {
                FilesRequest::List { after } => FilesReply::Files {
                    files: files
                        .range(after + 1..)
                        .take(2)
                        .map(|(number, (bytes, finished))| FileInfo {
                            number: *number,
                            started: 0,
                            bytes: bytes.len() as u64,
                            finished: *finished,
                        })
                        .collect(),
                    more: files.range(after + 1..).count() > 2,
                },
                FilesRequest::Read {
                    number,
                    offset,
                    length,
                } => file(number).map_or_else(gone, |bytes| {
                    let from = bytes.len().min(offset as usize);
                    let to = bytes.len().min(from + length as usize);
                    *self.read.lock().expect("locks") += (to - from) as u64;
                    let mut bytes = bytes[from..to].to_vec();
                    if std::mem::take(&mut *self.damage.lock().expect("locks")) {
                        bytes[0] ^= 1;
                    }
                    FilesReply::Bytes {
                        number,
                        offset,
                        bytes,
                    }
                }),
                FilesRequest::Checksum { number, length } => {
                    file(number).map_or_else(gone, |bytes| FilesReply::Checksum {
                        number,
                        length,
                        xxh3: xxh3_64(&bytes[..length as usize]),
                    })
                }
            })
        }
    }

    fn bytes(length: usize) -> Vec<u8> {
        (0..length).map(|at| (at * at / 7) as u8).collect()
    }

    fn car(files: &[(u64, usize, bool)]) -> Car {
        let files = files
            .iter()
            .map(|(number, length, finished)| (*number, (bytes(*length), *finished)));
        Car {
            files: Mutex::new(files.collect()),
            ..Car::default()
        }
    }

    fn name() -> CarName {
        "car-1".parse().expect("a name")
    }

    fn options(folder: &Path) -> FetchOptions {
        FetchOptions {
            rate: 1e9,
            reserve: 0,
            patience: Duration::ZERO,
            ..FetchOptions::new(folder.join("copies"))
        }
    }

    fn content(fetched: &Fetched) -> Vec<u8> {
        fs::read(&fetched.file).expect("is there")
    }

    #[tokio::test]
    async fn all_files_are_copied_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let car = car(&[(3, 200_000, true), (4, 0, true), (7, 5, true)]);
        let options = options(folder.path());
        let mut progress = Vec::new();
        let fetched = fetch(&name(), &car, &options, |now| progress.push(now))
            .await
            .expect("fetched");
        let numbers: Vec<_> = fetched.iter().map(|file| (file.number, file.received)).collect();
        assert_eq!(numbers, [(3, 200_000), (4, 0), (7, 5)]);
        assert_eq!(content(&fetched[0]), bytes(200_000));
        assert_eq!(
            fetched[0].file.file_name().and_then(|name| name.to_str()),
            Some("000003_19700101-000000_car-1.mcap")
        );
        assert_eq!(
            progress.last(),
            Some(&FetchProgress {
                files: [3, 3],
                bytes: [200_005, 200_005]
            })
        );
        let again = fetch(&name(), &car, &options, |_| {}).await.expect("fetched");
        assert_eq!(again.iter().map(|file| file.received).sum::<u64>(), 0);
        assert_eq!(*car.read.lock().expect("locks"), 200_005);
    }

    #[tokio::test]
    async fn an_interrupted_copy_goes_on_where_it_ended() {
        let folder = tempfile::tempdir().expect("a folder");
        let car = car(&[(1, 300_000, true)]);
        let options = options(folder.path());
        *car.left.lock().expect("locks") = Some(4);
        let error = fetch(&name(), &car, &options, |_| {})
            .await
            .expect_err("the link is cut");
        assert!(matches!(error, FetchError::NoReply { .. }), "{error}");
        *car.left.lock().expect("locks") = None;
        let fetched = fetch(&name(), &car, &options, |_| {}).await.expect("fetched");
        assert!(fetched[0].received < 300_000 && fetched[0].received > 200_000);
        assert_eq!(content(&fetched[0]), bytes(300_000));
        assert_eq!(*car.read.lock().expect("locks"), 300_000, "nothing came twice");
    }

    #[tokio::test]
    async fn a_file_that_is_still_written_grows_with_the_next_fetch() {
        let folder = tempfile::tempdir().expect("a folder");
        let car = car(&[(1, 100_000, false)]);
        let options = options(folder.path());
        let fetched = fetch(&name(), &car, &options, |_| {}).await.expect("fetched");
        assert!(!fetched[0].finished && fetched[0].file.extension().is_some_and(|end| end == PART));
        car.files.lock().expect("locks").insert(1, (bytes(150_000), true));
        let fetched = fetch(&name(), &car, &options, |_| {}).await.expect("fetched");
        assert_eq!((fetched[0].received, fetched[0].finished), (50_000, true));
        assert_eq!(content(&fetched[0]), bytes(150_000));
    }

    #[tokio::test]
    async fn damage_is_found_by_the_checksum_and_fetched_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let car = car(&[(1, 100_000, true)]);
        *car.damage.lock().expect("locks") = true;
        let fetched = fetch(&name(), &car, &options(folder.path()), |_| {})
            .await
            .expect("fetched");
        assert_eq!(
            (fetched[0].received, content(&fetched[0])),
            (200_000, bytes(100_000))
        );
    }

    #[tokio::test]
    async fn a_disk_without_room_ends_the_fetch_before_it_is_full() {
        let folder = tempfile::tempdir().expect("a folder");
        let car = car(&[(1, 100, true)]);
        let options = FetchOptions {
            reserve: u64::MAX,
            ..options(folder.path())
        };
        let error = fetch(&name(), &car, &options, |_| {}).await.expect_err("no room");
        assert!(matches!(error, FetchError::Full { .. }), "{error}");
    }

    #[tokio::test]
    async fn a_car_that_answers_nonsense_is_an_error() {
        struct Liar(FilesReply);
        impl FileSource for Liar {
            async fn request(&self, request: FilesRequest, _: Duration) -> Option<FilesReply> {
                let info = FileInfo {
                    number: 1,
                    started: i64::MIN,
                    bytes: 10,
                    finished: true,
                };
                match request {
                    FilesRequest::List { after: 0 } => Some(FilesReply::Files {
                        files: vec![info],
                        more: false,
                    }),
                    _ => Some(self.0.clone()),
                }
            }
        }
        let piece = |number, offset, length| FilesReply::Bytes {
            number,
            offset,
            bytes: vec![0; length],
        };
        let list = FilesReply::Files {
            files: Vec::new(),
            more: true,
        };
        for reply in [
            piece(2, 0, 5),
            piece(1, 1, 5),
            piece(1, 0, 0),
            piece(1, 0, 11),
            list,
        ] {
            let folder = tempfile::tempdir().expect("a folder");
            let outcome = fetch(&name(), &Liar(reply), &options(folder.path()), |_| {}).await;
            assert!(
                matches!(outcome, Err(FetchError::Reply { number: 1, .. })),
                "{outcome:?}"
            );
        }
    }
}
