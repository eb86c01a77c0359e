//! Why a recording cannot be written or read.

/// Why a recording cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file exists: recordings are never overwritten.
    #[error("{0} exists already; recordings are never overwritten")]
    Exists(String),
    /// The file cannot be opened, written or read.
    #[error("{file}: {reason}")]
    Io {
        /// The file.
        file: String,
        /// The error of the system.
        reason: std::io::Error,
    },
    /// Writing the file failed.
    #[error("{file}: {reason}")]
    Mcap {
        /// The file.
        file: String,
        /// What is wrong.
        reason: mcap::McapError,
    },
    /// The file is not MCAP.
    #[error("{0} is not a recording: it does not start as an MCAP file does")]
    Foreign(String),
    /// The file was cut off, or is damaged.
    #[error("{file}: {reason}; `pitwall recover {file}` saves the intact part")]
    Broken {
        /// The file.
        file: String,
        /// What is wrong.
        reason: String,
    },
    /// No message is intact.
    #[error("{file}: nothing can be saved, {reason}")]
    Nothing {
        /// The file.
        file: String,
        /// Why.
        reason: String,
    },
    /// The recording has no event.
    #[error("{0} has no event of any car")]
    Empty(String),
}

impl RecordingError {
    pub(crate) fn io(file: &std::path::Path, reason: std::io::Error) -> Self {
        let file = file.display().to_string();
        if reason.kind() == std::io::ErrorKind::AlreadyExists {
            Self::Exists(file)
        } else {
            Self::Io { file, reason }
        }
    }

    /// What went wrong while writing.
    pub(super) fn mcap(file: &std::path::Path, reason: mcap::McapError) -> Self {
        match reason {
            mcap::McapError::Io(reason) => Self::io(file, reason),
            reason => Self::Mcap {
                file: file.display().to_string(),
                reason,
            },
        }
    }

    /// What went wrong while reading.
    pub(super) fn broken(file: &std::path::Path, reason: String) -> Self {
        Self::Broken {
            file: file.display().to_string(),
            reason,
        }
    }
}
