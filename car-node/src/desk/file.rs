//! What survives a restart, in a file.

use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use crate::keeper::Memory;

/// Why the file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// It cannot be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It does not hold what it should.
    #[error("{path}: {source}; move it away to start afresh")]
    Content {
        /// The file.
        path: PathBuf,
        /// Why.
        source: serde_json::Error,
    },
}

/// `parameters.json` in the car's state folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StateFile {
    path: PathBuf,
}

impl StateFile {
    /// The file in `folder`, which is made when it is not there.
    pub fn in_folder(folder: &Path) -> Result<Self, FileError> {
        fs::create_dir_all(folder).map_err(|source| FileError::Io {
            path: folder.into(),
            source,
        })?;
        Ok(Self {
            path: folder.join("parameters.json"),
        })
    }

    /// Reads it; what was never written is empty.
    pub fn read(&self) -> Result<Memory, FileError> {
        let text = match fs::read_to_string(&self.path) {
            Ok(text) => text,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Memory::default()),
            Err(source) => {
                return Err(FileError::Io {
                    path: self.path.clone(),
                    source,
                });
            }
        };
        serde_json::from_str(&text).map_err(|source| FileError::Content {
            path: self.path.clone(),
            source,
        })
    }

    /// Writes it whole or not at all: a power cut leaves the old one or the new one.
    pub fn write(&self, memory: &Memory) -> Result<(), FileError> {
        let failed = |source| FileError::Io {
            path: self.path.clone(),
            source,
        };
        let text = serde_json::to_vec_pretty(memory).map_err(|source| FileError::Content {
            path: self.path.clone(),
            source,
        })?;
        let beside = self.path.with_extension("json.new");
        let mut file = File::create(&beside).map_err(failed)?;
        file.write_all(&text)
            .and_then(|()| file.sync_all())
            .and_then(|()| fs::rename(&beside, &self.path))
            .map_err(failed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::keeper::Stored;
    use synpf::Parameters;

    #[test]
    fn what_was_written_is_read_again() {
        let folder = tempfile::tempdir().expect("folder");
        let file = StateFile::in_folder(&folder.path().join("car-1")).expect("made");
        assert_eq!(file.read().expect("nothing yet"), Memory::default());
        let mut memory = Memory {
            revision: 7,
            settled: Some("mine".into()),
            ..Memory::default()
        };
        memory.sets.insert(
            "mine".into(),
            Stored {
                parameters: Parameters::default(),
                who: "anna".into(),
            },
        );
        file.write(&memory).expect("writes");
        assert_eq!(file.read().expect("reads"), memory);
    }

    #[test]
    fn a_broken_file_is_named() {
        let folder = tempfile::tempdir().expect("folder");
        let file = StateFile::in_folder(folder.path()).expect("made");
        fs::write(folder.path().join("parameters.json"), "{\"revision\": ").expect("writes");
        let message = file.read().expect_err("broken").to_string();
        assert!(message.contains("parameters.json"), "{message}");
    }
}
