//! What the engineer keeps with a track: its sectors and alarm limits. One small file for each track, beside the recordings.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use serde::{Deserialize, Serialize};

use crate::analysis::{Sectors, TrackLine};
use crate::fleet::Limits;

/// What is kept with a track.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TrackSettings {
    /// Its sectors; None for those of equal length.
    #[serde(default)]
    pub(crate) sectors: Option<Sectors>,
    /// The alarm limits of the engineer.
    #[serde(default)]
    pub(super) limits: Limits,
}

/// The settings of all tracks. Cheap to share.
#[derive(Debug, Clone)]
pub(crate) struct Tracks {
    folder: PathBuf,
    known: Arc<Mutex<BTreeMap<String, TrackSettings>>>,
}

impl Tracks {
    /// Most tracks that are kept in memory.
    const MOST: usize = 200;

    /// Settings in `tracks` beside the recordings in `folder`.
    pub(crate) fn new(folder: &Path) -> Self {
        Self {
            folder: folder.join("tracks"),
            known: Arc::default(),
        }
    }

    /// The settings of a track. A file that cannot be read is reported once, and the usual settings hold.
    pub(crate) fn of(&self, line: &TrackLine) -> TrackSettings {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(settings) = known.get(&line.key) {
            return settings.clone();
        }
        let settings = self.read(line).unwrap_or_else(|error| {
            tracing::warn!(error, "the usual settings hold for this track");
            TrackSettings::default()
        });
        if known.len() < Self::MOST {
            known.insert(line.key.clone(), settings.clone());
        }
        settings
    }

    fn read(&self, line: &TrackLine) -> Result<TrackSettings, String> {
        let path = self.path(line);
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(TrackSettings::default()),
            Err(error) => return Err(format!("{}: {error}", path.display())),
        };
        let fault = |error: String| format!("{}: {error}", path.display());
        let settings: TrackSettings = serde_json::from_str(&text).map_err(|e| fault(e.to_string()))?;
        if let Some(sectors) = &settings.sectors {
            Sectors::new(sectors.borders().to_vec(), line.length).map_err(fault)?;
        }
        Limits::new(settings.limits.to_map()).map_err(fault)?;
        Ok(settings)
    }

    /// Keeps the sectors of a track; the reason why not as `Err`.
    pub(super) fn keep_sectors(&self, line: &TrackLine, borders: Vec<f64>) -> Result<(), String> {
        let sectors = Some(Sectors::new(borders, line.length)?);
        self.keep(
            line,
            TrackSettings {
                sectors,
                ..self.of(line)
            },
        )
    }

    /// Keeps the alarm limits of a track; the reason why not as `Err`.
    pub(super) fn keep_limits(&self, line: &TrackLine, limits: Limits) -> Result<(), String> {
        self.keep(
            line,
            TrackSettings {
                limits,
                ..self.of(line)
            },
        )
    }

    fn keep(&self, line: &TrackLine, settings: TrackSettings) -> Result<(), String> {
        let path = self.path(line);
        let fault = |error: std::io::Error| format!("{}: {error}", path.display());
        std::fs::create_dir_all(&self.folder).map_err(fault)?;
        let text = serde_json::to_string_pretty(&settings).map_err(|e| e.to_string())?;
        // As a whole or not at all.
        let new = path.with_extension("new");
        std::fs::write(&new, text).map_err(fault)?;
        std::fs::rename(&new, &path).map_err(fault)?;
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        known.insert(line.key.clone(), settings);
        Ok(())
    }

    fn path(&self, line: &TrackLine) -> PathBuf {
        self.folder.join(format!("{}.json", line.key))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::analysis::test_line;

    #[test]
    fn sectors_are_kept_beside_the_recordings() {
        let folder = tempfile::tempdir().expect("a folder");
        let line = test_line();
        let tracks = Tracks::new(folder.path());
        assert_eq!(tracks.of(&line), TrackSettings::default());
        tracks.keep_sectors(&line, vec![9.0, 3.0]).expect("kept");
        for tracks in [tracks.clone(), Tracks::new(folder.path())] {
            let sectors = tracks.of(&line).sectors.expect("kept");
            assert_eq!(sectors.borders(), [3.0, 9.0]);
        }
        let error = tracks.keep_sectors(&line, vec![999.0]).expect_err("off the lap");
        assert!(error.contains("999"), "{error}");
    }

    #[test]
    fn a_damaged_file_is_named_and_the_usual_settings_hold() {
        let folder = tempfile::tempdir().expect("a folder");
        let line = test_line();
        let tracks = Tracks::new(folder.path());
        let path = tracks.path(&line);
        std::fs::create_dir_all(folder.path().join("tracks")).expect("a folder");
        for (text, fault) in [
            ("{", "EOF"),
            (r#"{"sectors": [1e9]}"#, "1000000000 m is not on a lap"),
            (r#"{"x": 1}"#, "unknown field"),
        ] {
            std::fs::write(&path, text).expect("written");
            let error = tracks.read(&line).expect_err("damaged");
            assert!(error.contains(fault) && error.contains(".json: "), "{error}");
        }
        assert_eq!(tracks.of(&line), TrackSettings::default());
    }
}
