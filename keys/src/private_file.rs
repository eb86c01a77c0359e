//! Files that only their owner may read.

use std::io::{self, Write};
use std::path::Path;

use crate::error::KeyError;

/// Replaces a file as a whole; only its owner can read it.
pub fn write_private(file: &Path, text: &str) -> Result<(), KeyError> {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty());
    let write = || -> io::Result<()> {
        // Temporary files are made with mode 0600.
        let mut new = tempfile::NamedTempFile::new_in(folder.unwrap_or(Path::new(".")))?;
        new.write_all(text.as_bytes())?;
        new.as_file().sync_all()?;
        new.persist(file).map_err(|error| error.error)?;
        Ok(())
    };
    write().map_err(|reason| KeyError::file(file, reason))
}

/// True when others than the owner may read a file.
#[cfg(unix)]
pub fn open_to_others(file: &Path) -> bool {
    use std::os::unix::fs::PermissionsExt;
    std::fs::metadata(file).is_ok_and(|data| data.permissions().mode() & 0o077 != 0)
}

/// True when others than the owner may read a file.
#[cfg(not(unix))]
pub fn open_to_others(_: &Path) -> bool {
    false
}

/// Reads a text file of at most `most` bytes.
pub(crate) fn read_text(file: &Path, most: u64) -> Result<String, KeyError> {
    use std::io::Read;
    let read = || -> io::Result<String> {
        let mut text = String::new();
        std::fs::File::open(file)?
            .take(most + 1)
            .read_to_string(&mut text)?;
        Ok(text)
    };
    let text = read().map_err(|reason| KeyError::file(file, reason))?;
    if text.len() as u64 > most {
        return Err(KeyError::format(file, format!("it is longer than {most} bytes")));
    }
    Ok(text)
}
