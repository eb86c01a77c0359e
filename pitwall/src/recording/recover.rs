//! Repairs a recording that was cut off, by a power cut or a kill.

use std::fs::{File, OpenOptions};
use std::io::{BufReader, BufWriter};
use std::path::Path;

use mcap::Writer;
use mcap::io::MessageReader;
use mcap::sans_io::LinearReaderOptions;
use serde::Serialize;

use super::file::RecordingError;

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

/// Copies what can be read of `from` into the new file `to`, which ends as it should.
pub fn recover(from: &Path, to: &Path) -> Result<Recovered, RecordingError> {
    let input = File::open(from).map_err(|e| RecordingError::io(from, e))?;
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
    Ok(Recovered {
        messages,
        duration_s: span.map_or(0.0, |(a, b)| (b - a) as f64 * 1e-9),
        damage,
    })
}
