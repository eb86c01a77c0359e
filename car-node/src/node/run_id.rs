//! Identifies a run of the node, whatever the car's clock shows.
//!
//! Many cars have no battery for their clock. After a power cut it may be behind. The number of the last run is therefore kept
//! in the state folder, and the next run has a higher one.

use std::fs::{self, File};
use std::io::Write;
use std::path::Path;

use synpf::Stamp;

/// Name of the file in the state folder.
const FILE: &str = "run";

/// The number of a run that starts at `now`: its time \[unix ns\], or one more than the last run's. Without a state folder, or
/// where that cannot be written, it is the time.
pub(super) fn next(folder: Option<&Path>, now: Stamp) -> u64 {
    let time = now.0.unsigned_abs().max(1);
    let Some(folder) = folder else {
        return time;
    };
    let last = last(folder);
    let run_id = last.map_or(time, |last| time.max(last.saturating_add(1)));
    if let Err(error) = write(folder, run_id) {
        let file = folder.join(FILE);
        tracing::warn!(file = %file.display(), %error, "the number of this run is not kept");
    }
    run_id
}

/// The number of the last run; None before the first, and where the file is damaged.
fn last(folder: &Path) -> Option<u64> {
    let text = fs::read_to_string(folder.join(FILE)).ok()?;
    let last = text.trim().parse();
    if last.is_err() {
        tracing::warn!(file = %folder.join(FILE).display(), "no number of a run; it is replaced");
    }
    last.ok()
}

/// Replaces the file atomically: a power cut leaves the old number or the new one.
fn write(folder: &Path, run_id: u64) -> std::io::Result<()> {
    let new = folder.join(format!("{FILE}.new"));
    let mut file = File::create(&new)?;
    file.write_all(run_id.to_string().as_bytes())?;
    file.sync_all()?;
    fs::rename(&new, folder.join(FILE))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_is_behind_does_not_lower_the_number() {
        let folder = tempfile::tempdir().expect("a folder");
        let next = |now| next(Some(folder.path()), Stamp(now));
        assert_eq!(
            [next(1000), next(2000), next(5), next(6)],
            [1000, 2000, 2001, 2002]
        );
        fs::write(folder.path().join(FILE), "damaged").expect("written");
        assert_eq!([next(30), next(30)], [30, 31]);
    }

    #[test]
    fn without_a_folder_it_is_the_time() {
        assert_eq!(next(None, Stamp(7)), 7);
        assert_eq!(next(Some(Path::new("/no/such/folder")), Stamp(7)), 7);
    }
}
