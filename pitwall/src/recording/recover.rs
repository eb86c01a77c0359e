//! Repairs a recording that was cut off, by a power cut or a kill.

use std::fs::{self, OpenOptions};
use std::io::{BufReader, BufWriter};
use std::path::Path;

use mcap::Writer;
use mcap::io::MessageReader;
use mcap::sans_io::LinearReaderOptions;
use serde::Serialize;

use super::reader::open;
use super::writer::RecordingError;

/// What could be saved.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Recovered {
    /// Messages saved.
    pub messages: u64,
    /// Time that they span [s].
    pub duration_s: f64,
    /// Why reading ended before the end of a whole file; None for a file that was whole.
    pub damage: Option<String>,
}

/// Copies what can be read of `from` into the new file `to`, which ends as it should. Where nothing can be read, there
/// is no new file.
pub fn recover(from: &Path, to: &Path) -> Result<Recovered, RecordingError> {
    let input = open(from)?;
    let output = OpenOptions::new()
        .write(true)
        .create_new(true)
        .open(to)
        .map_err(|e| RecordingError::io(to, e))?;
    let written = |e| RecordingError::mcap(to, e);
    let mut writer = Writer::new(BufWriter::new(output)).map_err(written)?;
    let options = LinearReaderOptions::default().with_skip_end_magic(true);
    let mut messages = 0;
    let mut span: Option<(u64, u64)> = None;
    let mut damage = None;
    for message in MessageReader::new_with_options(BufReader::new(input), options) {
        match message {
            Ok(message) => {
                writer.write(&message).map_err(written)?;
                messages += 1;
                let time = message.log_time;
                span = Some(span.map_or((time, time), |(a, b)| (a.min(time), b.max(time))));
            }
            Err(error) => {
                damage = Some(error.to_string());
                break;
            }
        }
    }
    writer.finish().map_err(written)?;
    if messages == 0 {
        fs::remove_file(to).map_err(|e| RecordingError::io(to, e))?;
        return Err(RecordingError::Nothing {
            file: from.display().to_string(),
            reason: damage.unwrap_or_else(|| "it holds no message".to_owned()),
        });
    }
    Ok(Recovered {
        messages,
        duration_s: span.map_or(0.0, |(a, b)| (b - a) as f64 * 1e-9),
        damage,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::read_events;

    /// The message of an error, which names the file as `FILE`.
    fn fault<T>(result: Result<T, RecordingError>, file: &Path) -> String {
        let error = result.err().expect("a fault");
        error.to_string().replace(&file.display().to_string(), "FILE")
    }

    #[test]
    fn what_is_no_recording_is_told_so_and_leaves_nothing_behind() {
        let folder = tempfile::tempdir().expect("a folder");
        let [file, to] = ["file", "to"].map(|name| folder.path().join(name));
        let told = fault(recover(&file, &to), &file);
        assert!(told.starts_with("FILE: No such file"), "{told}");
        for content in ["", "hello", "a text that is longer than the magic bytes"] {
            fs::write(&file, content).expect("written");
            let foreign = "FILE is no recording: it does not begin as an MCAP file does";
            assert_eq!(fault(recover(&file, &to), &file), foreign);
            assert_eq!(fault(read_events(&file), &file), foreign);
        }
        assert!(!to.exists());
    }

    #[test]
    fn a_file_that_was_cut_off_at_once_names_the_way_out_and_has_nothing_to_save() {
        let folder = tempfile::tempdir().expect("a folder");
        let [file, to] = ["file", "to"].map(|name| folder.path().join(name));
        fs::write(&file, mcap::MAGIC).expect("written");
        let first = read_events(&file).expect("a begin").next().expect("a fault");
        let told = fault(first, &file);
        assert!(
            told.ends_with("`pitwall recover FILE` saves what can be read"),
            "{told}"
        );
        let told = fault(recover(&file, &to), &file);
        assert!(told.starts_with("FILE: nothing can be saved"), "{told}");
        assert!(!to.exists());
    }
}
