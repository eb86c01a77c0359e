//! Reads and writes the persisted state.

use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use super::persisted_state::PersistedState;

/// Why the state file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum StateFileError {
    /// It cannot be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// Its content is not a valid state.
    #[error("{path}: {source}; move it away to start again without it")]
    Content {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: serde_json::Error,
    },
}

/// `parameters.json` in the car's state folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StateFile {
    path: PathBuf,
}

impl StateFile {
    /// The state file in `folder`; creates the folder.
    pub fn in_folder(folder: &Path) -> Result<Self, StateFileError> {
        fs::create_dir_all(folder).map_err(|source| StateFileError::Io {
            path: folder.into(),
            source,
        })?;
        Ok(Self {
            path: folder.join("parameters.json"),
        })
    }

    /// Reads the state; empty if no file was ever written.
    pub fn read(&self) -> Result<PersistedState, StateFileError> {
        let text = match fs::read_to_string(&self.path) {
            Ok(text) => text,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(PersistedState::default()),
            Err(source) => {
                return Err(StateFileError::Io {
                    path: self.path.clone(),
                    source,
                });
            }
        };
        serde_json::from_str(&text).map_err(|source| StateFileError::Content {
            path: self.path.clone(),
            source,
        })
    }

    /// Replaces the file atomically: a power cut leaves the old file or the new one.
    pub fn write(&self, state: &PersistedState) -> Result<(), StateFileError> {
        let failed = |source| StateFileError::Io {
            path: self.path.clone(),
            source,
        };
        let text = serde_json::to_vec_pretty(state).map_err(|source| StateFileError::Content {
            path: self.path.clone(),
            source,
        })?;
        let new = self.path.with_extension("json.new");
        let mut file = File::create(&new).map_err(failed)?;
        file.write_all(&text)
            .and_then(|()| file.sync_all())
            .and_then(|()| fs::rename(&new, &self.path))
            .map_err(failed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::persisted_state::SavedSet;
    use crate::localization::LocalizerParameters;

    #[test]
    fn what_was_written_is_read_again() {
        let folder = tempfile::tempdir().expect("folder");
        let file = StateFile::in_folder(&folder.path().join("car-1")).expect("made");
        assert_eq!(file.read().expect("nothing yet"), PersistedState::default());
        let mut state = PersistedState {
            revision: 7,
            settled: Some("mine".into()),
            ..PersistedState::default()
        };
        state.sets.insert(
            "mine".into(),
            SavedSet {
                parameters: LocalizerParameters::default(),
                who: "anna".into(),
            },
        );
        file.write(&state).expect("writes");
        assert_eq!(file.read().expect("reads"), state);
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
