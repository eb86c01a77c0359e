//! What can be wrong with a map or a raceline that somebody else made.

use std::path::Path;
use std::{fs, io};

/// Why a map or a raceline could not be read. `file` is a path, or what the caller called the bytes.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// The file itself cannot be read.
    #[error("{file}: {source}")]
    Read {
        /// What was read.
        file: String,
        /// What the operating system said.
        source: io::Error,
    },
    /// Not the format it should be, as a whole.
    #[error("{file}: {fault}")]
    Format {
        /// What was read.
        file: String,
        /// What is wrong with it.
        fault: String,
    },
    /// One key has no value, or one that cannot be.
    #[error("{file}: {key}: {fault}")]
    Key {
        /// What was read.
        file: String,
        /// The key, as the file spells it.
        key: String,
        /// What is wrong with its value.
        fault: String,
    },
    /// One line cannot be understood.
    #[error("{file}, line {line}: {fault}")]
    Line {
        /// What was read.
        file: String,
        /// Counted from 1.
        line: u64,
        /// What is wrong with it.
        fault: String,
    },
}

/// Reads a text file, or says which one could not be read.
pub fn read_text(path: impl AsRef<Path>) -> Result<String, MapError> {
    let path = path.as_ref();
    let file = path.display().to_string();
    fs::read_to_string(path).map_err(|source| match source.kind() {
        io::ErrorKind::InvalidData => MapError::format(&file, "not a text file"),
        _ => MapError::Read { file, source },
    })
}

impl MapError {
    pub(crate) fn format(file: &str, fault: impl Into<String>) -> Self {
        Self::Format {
            file: file.to_owned(),
            fault: fault.into(),
        }
    }

    pub(crate) fn key(file: &str, key: &str, fault: impl Into<String>) -> Self {
        Self::Key {
            file: file.to_owned(),
            key: key.to_owned(),
            fault: fault.into(),
        }
    }

    pub(crate) fn line(file: &str, line: u64, fault: impl Into<String>) -> Self {
        Self::Line {
            file: file.to_owned(),
            line,
            fault: fault.into(),
        }
    }
}
