//! The folder of a car's recordings: which files are in it, the next one, and the deletion of the oldest.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};

use protocol::{CarName, FileName};
use synpf::Stamp;

/// Free space that recording leaves on the disk \[bytes\]: the car needs some for its logs and its state.
pub(super) const RESERVE: u64 = 256 * 1024 * 1024;
/// While this file is there, the car records when it starts.
const RESUME: &str = ".recording";

/// A file of the folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordedFile {
    /// Its name.
    pub name: FileName,
    /// Its length \[bytes\].
    pub bytes: u64,
}

/// The folder of one car's recordings. Files of other cars and other files are left alone.
#[derive(Debug, Clone)]
pub struct RecordingFolder {
    path: PathBuf,
    car: CarName,
}

impl RecordingFolder {
    /// Makes the folder if it is not there.
    pub fn open(path: &Path, car: &CarName) -> io::Result<Self> {
        fs::create_dir_all(path)?;
        Ok(Self {
            path: path.to_owned(),
            car: car.clone(),
        })
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The recordings, ascending by number.
    pub fn list(&self) -> io::Result<Vec<RecordedFile>> {
        let mut files = Vec::new();
        for entry in fs::read_dir(&self.path)? {
            let entry = entry?;
            let name = entry.file_name().to_str().and_then(|name| name.parse().ok());
            let Some(name) = name.filter(|name: &FileName| name.car == self.car) else {
                continue;
            };
            // Not through a link: what is read here is sent over the network.
            match fs::symlink_metadata(entry.path()) {
                Ok(metadata) if metadata.is_file() => files.push(RecordedFile {
                    name,
                    bytes: metadata.len(),
                }),
                _ => {}
            }
        }
        files.sort_by_key(|file| file.name.number);
        Ok(files)
    }

    /// Creates the next file. Its name is safely on the disk when this returns.
    pub(super) fn create_next(&self, now: Stamp) -> io::Result<(FileName, PathBuf, File)> {
        let last = self.list()?.last().map_or(0, |file| file.name.number);
        let name = FileName {
            number: last + 1,
            started: now.0.max(0),
            car: self.car.clone(),
        };
        let path = self.path.join(name.to_string());
        let file = OpenOptions::new().write(true).create_new(true).open(&path)?;
        self.sync()?;
        Ok((name, path, file))
    }

    /// Deletes the oldest files, but not number `keep`, until all together have at most `limit` bytes and `RESERVE` is free on
    /// the disk. Returns the size of those left.
    pub(super) fn make_room(&self, limit: u64, keep: u64) -> io::Result<u64> {
        let files = self.list()?;
        let mut bytes = files.iter().map(|file| file.bytes).sum();
        for file in files {
            let room = bytes <= limit && self.free().is_none_or(|free| free >= RESERVE);
            if room || file.name.number == keep {
                break;
            }
            fs::remove_file(self.path.join(file.name.to_string()))?;
            bytes -= file.bytes;
        }
        Ok(bytes)
    }

    /// Opens a recording to read it; None when there is none of this number.
    pub fn open_file(&self, number: u64) -> io::Result<Option<(File, u64)>> {
        let files = self.list()?;
        let Some(found) = files.iter().find(|file| file.name.number == number) else {
            return Ok(None);
        };
        let file = File::open(self.path.join(found.name.to_string()))?;
        Ok(Some((file, found.bytes)))
    }

    /// Free space on the disk \[bytes\]; None when the system does not say.
    pub(super) fn free(&self) -> Option<u64> {
        let disk = rustix::fs::statvfs(&self.path).ok()?;
        Some(disk.f_bavail.saturating_mul(disk.f_frsize))
    }

    /// True when the car was recording when it last ran.
    pub(super) fn resumes(&self) -> bool {
        self.path.join(RESUME).exists()
    }

    /// Sets whether the car records when it starts again.
    pub(super) fn set_resume(&self, on: bool) -> io::Result<()> {
        let mark = self.path.join(RESUME);
        if on {
            fs::write(&mark, b"")?;
        } else if mark.exists() {
            fs::remove_file(&mark)?;
        }
        self.sync()
    }

    fn sync(&self) -> io::Result<()> {
        File::open(&self.path)?.sync_all()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn folder() -> (tempfile::TempDir, RecordingFolder) {
        let temporary = tempfile::tempdir().expect("a folder");
        let car = "car-1".parse().expect("a name");
        let folder = RecordingFolder::open(&temporary.path().join("recordings"), &car).expect("made");
        (temporary, folder)
    }

    fn add(folder: &RecordingFolder, bytes: usize) -> u64 {
        let (name, _, mut file) = folder.create_next(Stamp(0)).expect("created");
        file.write_all(&vec![0; bytes]).expect("written");
        name.number
    }

    fn numbers(folder: &RecordingFolder) -> Vec<u64> {
        let files = folder.list().expect("listed");
        files.iter().map(|file| file.name.number).collect()
    }

    #[test]
    fn the_oldest_files_are_deleted_and_their_numbers_are_not_used_again() {
        let (_temporary, folder) = folder();
        for number in 1..=4 {
            assert_eq!(add(&folder, 100), number);
        }
        assert_eq!(folder.make_room(250, 0).expect("made"), 200);
        assert_eq!(numbers(&folder), [3, 4]);
        assert_eq!(add(&folder, 100), 5);
        assert_eq!(
            folder.make_room(0, 5).expect("made"),
            100,
            "the one being written stays"
        );
        assert_eq!(numbers(&folder), [5]);
    }

    #[test]
    fn other_files_and_links_are_left_alone() {
        let (temporary, folder) = folder();
        let secret = temporary.path().join("secret");
        fs::write(&secret, b"secret").expect("written");
        let other = folder.path().join("000007_19700101-000000_car-2.mcap");
        fs::write(&other, b"of another car").expect("written");
        let link = folder.path().join("000008_19700101-000000_car-1.mcap");
        std::os::unix::fs::symlink(&secret, link).expect("linked");
        assert!(numbers(&folder).is_empty());
        assert!(folder.open_file(8).expect("looked up").is_none());
        assert_eq!(add(&folder, 1), 1);
        folder.make_room(0, 0).expect("made");
        assert!(numbers(&folder).is_empty());
        assert!(secret.exists() && other.exists());
    }
}
