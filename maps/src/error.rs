//! Faults of map and raceline files.

use std::path::Path;
use std::{fs, io};

/// Why a map or a raceline could not be read. `file` is a path, or the name that the caller gave the bytes.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// The file itself cannot be read.
    #[error("{file}: {source}")]
    Read {
        /// The file.
        file: String,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The file has the wrong format.
    #[error("{file}: {fault}")]
    Format {
        /// The file.
        file: String,
        /// What is wrong with it.
        fault: String,
    },
    /// A key has no value or an invalid one.
    #[error("{file}: {key}: {fault}")]
    Key {
        /// The file.
        file: String,
        /// The key, as the file spells it.
        key: String,
        /// What is wrong with its value.
        fault: String,
    },
    /// A line is invalid.
    #[error("{file}, line {line}: {fault}")]
    Line {
        /// The file.
        file: String,
        /// Counted from 1.
        line: u64,
        /// What is wrong with it.
        fault: String,
    },
}

/// Reads a text file. The error names it.
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
