//! The laps of a whole recording.

use std::collections::BTreeMap;
use std::path::Path;

use protocol::CarName;

use super::{CarLaps, LapBook, MapCheck};
use crate::fleet::Fleet;
use crate::recording::RecordingError;

/// The laps of all cars in one session.
#[derive(Debug, Clone, Default)]
pub(crate) struct SessionLaps {
    /// The session's name.
    pub(crate) name: String,
    cars: BTreeMap<CarName, (LapBook, Option<MapCheck>)>,
}

impl SessionLaps {
    /// The laps that a fleet has seen in the recording at `path`. Laps under way end here.
    pub(crate) fn new(path: &Path, fleet: &Fleet) -> Self {
        let mut session = Self::now(&path.file_stem().unwrap_or_default().to_string_lossy(), fleet);
        for (book, _) in session.cars.values_mut() {
            book.end();
        }
        session
    }

    /// The laps that a fleet has seen so far.
    pub(crate) fn now(name: &str, fleet: &Fleet) -> Self {
        let laps =
            |car: &crate::fleet::Car| (car.name.clone(), (car.book().clone(), car.map_check().cloned()));
        Self {
            name: name.to_owned(),
            cars: fleet.cars().map(laps).collect(),
        }
    }

    /// Reads a whole recording: every pose that was recorded, also those that the link had lost.
    pub(crate) fn of(path: &Path) -> Result<Self, RecordingError> {
        let mut fleet = Fleet::default();
        let events = crate::report::read(path)?;
        events.prepare(&mut fleet);
        for event in events {
            fleet.apply(&event?);
        }
        Ok(Self::new(path, &fleet))
    }

    /// Each car with its laps.
    pub(crate) fn cars(&self) -> impl Iterator<Item = CarLaps<'_>> {
        self.cars.iter().map(|(car, (book, check))| CarLaps {
            session: &self.name,
            car,
            book,
            check: check.as_ref(),
        })
    }
}
