//! `car-node health`, and the file that it looks at.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context, bail};
use synpf::Stamp;

/// The file in the state folder that a running car touches.
const FILE: &str = "running";
/// How often it is touched.
const PERIOD: Duration = Duration::from_secs(1);
/// A car that has not touched it for this long does not run.
const OLD: Duration = Duration::from_secs(10);

/// Fails when the car with this state folder does not run.
pub(crate) fn run(state: &Path) -> anyhow::Result<()> {
    let file = state.join(FILE);
    let touched = fs::metadata(&file)
        .and_then(|data| data.modified())
        .with_context(|| format!("{}: no car has run with this folder", file.display()))?;
    // A clock that was set back makes the file look new: a later check shows it.
    let age = SystemTime::now().duration_since(touched).unwrap_or_default();
    if age > OLD {
        bail!("{}: the car has not run for {} s", file.display(), age.as_secs());
    }
    Ok(())
}

/// Touches the file while the filter works.
pub(crate) struct Heartbeat {
    file: Option<PathBuf>,
    due: Instant,
    estimate: Option<Stamp>,
}

impl Heartbeat {
    /// Without a folder there is nothing to touch.
    pub(crate) fn new(state: Option<&Path>) -> Self {
        Self {
            file: state.map(|folder| folder.join(FILE)),
            due: Instant::now(),
            estimate: None,
        }
    }

    /// Call it often, with the stamp of the latest estimate. A filter whose estimate stays the same does not work, unless its
    /// source has `ended`.
    pub(crate) fn beat(&mut self, estimate: Option<Stamp>, ended: bool) {
        if Instant::now() < self.due {
            return;
        }
        self.due = Instant::now() + PERIOD;
        let works = ended || estimate.is_none() || estimate != self.estimate;
        self.estimate = estimate;
        if let Some(file) = self.file.as_ref().filter(|_| works)
            && let Err(error) = File::create(file)
        {
            tracing::debug!(%error, file = %file.display(), "the heartbeat");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_car_that_runs_is_healthy() {
        let folder = tempfile::tempdir().expect("a folder");
        let error = run(folder.path()).expect_err("none runs").to_string();
        assert!(error.contains("no car has run"), "{error}");
        let mut heartbeat = Heartbeat::new(Some(folder.path()));
        heartbeat.beat(None, false);
        run(folder.path()).expect("it runs");
        let grow_old = || {
            let file = File::options().write(true).open(folder.path().join(FILE));
            let past = SystemTime::now() - 2 * OLD;
            file.and_then(|file| file.set_modified(past)).expect("set");
        };
        grow_old();
        assert!(run(folder.path()).is_err());
        // A filter that hangs does not touch the file.
        heartbeat.due = Instant::now();
        heartbeat.estimate = Some(Stamp(5));
        heartbeat.beat(Some(Stamp(5)), false);
        assert!(run(folder.path()).is_err());
        heartbeat.due = Instant::now();
        heartbeat.beat(Some(Stamp(6)), false);
        run(folder.path()).expect("it works again");
    }
}
