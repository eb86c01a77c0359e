//! Runs a localizer over a recorded drive that is damaged in many ways, and reports where it holds.
//!
//! The [`catalogue`] has the defects, each in up to three grades. [`Drive::damaged`] applies one to a log and its map.
//! [`DamageChain`] applies defects of the sensors message by message, so that races use them too.

pub mod catalogue;
mod damage_chain;
mod damaged_drive;
mod html;
pub mod map_damage;
mod report;
mod sensor_damage;
mod surroundings;
mod sweep;
mod verdict;

use std::sync::Arc;

use maps::Pose;
use synpf::{SetUpError, Stamp, TrackMap};

pub use catalogue::{Defect, DefectChoice, DefectKind, Grade, Part};
pub use damage_chain::DamageChain;
pub use damaged_drive::{DamagedDrive, Drive, NotApplicable};
pub use report::{Limit, Report, Row, SetReport, TruthFrom};
pub use sensor_damage::{ArrivalQueue, DamagedArrival, TruePose};
pub use verdict::{Measured, Verdict};

use crate::evaluate::{self, EvaluateError, Truth};
use crate::health::State;
use crate::localization::{LocalizerParameters, Start};
use verdict::Judge;

/// Poses of an undamaged run farther apart than this are not interpolated \[s\].
const LONGEST_GAP: f64 = 0.5;

/// Why a run does not start.
#[derive(Debug, thiserror::Error)]
pub enum StressError {
    /// The localizer cannot be built.
    #[error(transparent)]
    SetUp(#[from] SetUpError),
    /// The run cannot start.
    #[error(transparent)]
    Evaluate(#[from] EvaluateError),
    /// Without truth, the undamaged run is the truth, and it has none.
    #[error(
        "the bag has no truth, and the undamaged run is never LOCALIZED: give --initial-pose, or true poses with --truth"
    )]
    NeverLocalized,
}

impl Drive {
    /// The drive of a log without truth: the poses of an undamaged run, from where it is LOCALIZED for the first time.
    pub fn by_undamaged_run(
        &self,
        map: &Arc<TrackMap>,
        parameters: &LocalizerParameters,
        start: Start,
        seed: u64,
    ) -> Result<Self, StressError> {
        let mut localizer = parameters.build(map, self.base_link_from_laser, seed)?;
        let mut poses: Vec<(Stamp, Pose)> = Vec::new();
        let none = Truth::default();
        evaluate::run(
            localizer.as_mut(),
            &self.log.arrivals,
            &none,
            start,
            |update, state, _| {
                if state == State::Localized {
                    poses.push((update.stamp, update.pose));
                }
            },
        )?;
        let (Some((begin, _)), Some([first, _])) = (poses.first(), self.log.span()) else {
            return Err(StressError::NeverLocalized);
        };
        let mut log = self.log.clone();
        log.keep(begin.since(first), f64::INFINITY);
        Ok(Self {
            log,
            truth: poses,
            longest_gap: LONGEST_GAP,
            ..*self
        })
    }
}

/// Runs a set over a drive. It starts at the true pose. None for a run without an update that could be compared with the
/// truth.
pub fn run(
    drive: &DamagedDrive,
    base_link_from_laser: Pose,
    map: &Arc<TrackMap>,
    parameters: &LocalizerParameters,
    seed: u64,
) -> Result<Option<Measured>, StressError> {
    let map = drive.map.as_ref().unwrap_or(map);
    let start = drive.start().ok_or(EvaluateError::NoTruth)?;
    parameters.prepare_tables(map, Some(start));
    let mut localizer = parameters.build(map, base_link_from_laser, seed)?;
    let mut judge = Judge::new(drive.carried_at);
    let (arrivals, truth) = (&drive.arrivals, &drive.truth);
    evaluate::run(
        localizer.as_mut(),
        arrivals,
        truth,
        Start::Pose(start),
        |update, state, _| {
            judge.push(update.stamp, update.pose, state, truth.at(update.stamp));
        },
    )?;
    Ok(judge.measured())
}
