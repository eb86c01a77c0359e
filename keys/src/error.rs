//! What is wrong with keys.

use std::path::{Path, PathBuf};

/// Keys that cannot be made, read or used. No message holds a secret.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The system refuses to read or write a file.
    #[error("{file}: {reason}", file = file.display())]
    File {
        /// The file.
        file: PathBuf,
        /// The system's message.
        reason: std::io::Error,
    },
    /// A file holds something else.
    #[error("{file}: {fault}", file = file.display())]
    Format {
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        fault: String,
    },
    /// A certificate cannot be made.
    #[error("the certificate of {subject}: {reason}")]
    Certificate {
        /// Whose.
        subject: String,
        /// Why.
        reason: String,
    },
    /// There is a certificate of this role and name already.
    #[error("{0} has keys already; renew or revoke them")]
    Exists(String),
    /// There is no certificate of this role and name.
    #[error("{0} has no keys here")]
    Unknown(String),
    /// A passphrase that can be guessed.
    #[error("the passphrase has {got} characters; it needs {least} or more")]
    ShortPassphrase {
        /// Its length.
        got: usize,
        /// The least length.
        least: usize,
    },
    /// The keys belong to another role.
    #[error("these are the keys of {got}, but {wanted} needs its own")]
    WrongRole {
        /// Whose they are.
        got: String,
        /// Who asked for them.
        wanted: String,
    },
}

impl KeyError {
    pub(crate) fn file(file: &Path, reason: std::io::Error) -> Self {
        Self::File {
            file: file.to_owned(),
            reason,
        }
    }

    pub(crate) fn format(file: &Path, fault: impl std::fmt::Display) -> Self {
        Self::Format {
            file: file.to_owned(),
            fault: fault.to_string(),
        }
    }
}
