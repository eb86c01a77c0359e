//! Runs a localizer over a whole log as fast as it can, and compares its poses with the truth. The same inputs give the same
//! numbers, except for the times.

pub mod ablation;
mod consistency;
mod errors;
mod faults;
mod pose_file;
mod states;
mod truth;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use serde::Serialize;
use synpf::{Dropped, Localizer, PoseError, Stamp, Update};

pub use consistency::{Consistency, Nees};
pub(crate) use errors::SETTLING;
pub use errors::{PoseErrors, Summaries};
pub use faults::{Fault, FaultKind};
pub use pose_file::{PoseFileError, read_poses, read_trajectory};
pub use states::{FaultReport, StateChange, StateTruth, States};
pub use truth::Truth;

use consistency::ConsistencyCheck;

use crate::health::{Monitor, State, Thresholds};
use crate::localization::Start;
use crate::sensors::bag::{Arrival, SensorEvent};
use crate::statistics::{mean, percentile};

/// Mean and 5th percentile of the alignment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AlignmentSummary {
    /// Mean over all updates.
    pub mean: f64,
    /// 95 % of the updates are above this.
    pub p05: f64,
}

/// Times of whole updates \[us\].
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct UpdateTimes {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Maximum.
    pub max: f64,
}

/// Particles in use.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ParticleSummary {
    /// Mean over all updates.
    pub mean: f64,
}

/// The results of one run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Outcome {
    /// Scans in the log.
    pub scans: usize,
    /// Scans that led to a pose.
    pub updates: usize,
    /// Messages that were refused, by cause.
    pub dropped: BTreeMap<Dropped, usize>,
    /// Errors against the truth, where there is any.
    #[serde(flatten)]
    pub errors: Option<Summaries>,
    /// Consistency of the covariance, where there is truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nees: Option<Consistency>,
    /// Share of the updates in each health state.
    pub state_share: BTreeMap<State, f64>,
    /// Every change of the health state.
    pub state_changes: Vec<StateChange>,
    /// How often the states were right, where there is truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub state_truth: Option<StateTruth>,
    /// Scan alignment; None without an update.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub alignment: Option<AlignmentSummary>,
    /// Time of a whole update, scan in to estimate out; None without an update.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub update_us: Option<UpdateTimes>,
    /// Particles; None without an update.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub particles: Option<ParticleSummary>,
}

/// Why a run does not start.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// The run should start at the true pose, which is unknown.
    #[error("the true pose at the first scan is not known; give --initial-pose x,y,heading")]
    NoTruth,
    /// The initial pose is refused.
    #[error(transparent)]
    Start(#[from] PoseError),
}

/// Runs `localizer` over `arrivals`. `observe` gets every update, the health state after it, and the share of the log that is
/// done.
pub fn run(
    localizer: &mut dyn Localizer,
    arrivals: &[Arrival],
    truth: &Truth,
    start: Start,
    mut observe: impl FnMut(&Update, State, f64),
) -> Result<Outcome, EvaluateError> {
    let mut dropped = BTreeMap::new();
    let mut errors = PoseErrors::default();
    let (mut alignment, mut times_us, mut particles) = (Vec::new(), Vec::new(), Vec::new());
    let mut scans = 0;
    let mut latest_odometry = None;
    let begin_at = arrivals.first().map_or(Stamp(0), |arrival| arrival.log_time);
    let mut monitor = Monitor::new(Thresholds::default(), begin_at);
    let mut states = States::default();
    let mut consistency = ConsistencyCheck::default();

    for (index, arrival) in arrivals.iter().enumerate() {
        // A car checks its clock all the time. A log has a time only where a message arrives.
        if scans > 0 && monitor.tick(arrival.log_time).state == State::Stale {
            states.change(arrival.log_time, State::Stale, None);
        }
        let result = match &arrival.event {
            SensorEvent::Odometry(odometry) => {
                latest_odometry = Some(odometry.stamp);
                let result = localizer.on_odometry(odometry);
                if result.is_ok() {
                    monitor.on_odometry(arrival.log_time);
                }
                result
            }
            SensorEvent::YawRate(yaw_rate) => localizer.on_yaw_rate(yaw_rate),
            SensorEvent::Pose(pose) => localizer.on_external_pose(pose),
            SensorEvent::Scan(scan) => {
                if scans == 0 {
                    begin(localizer, truth, start, latest_odometry.unwrap_or(scan.stamp))?;
                    match start {
                        Start::Global => monitor.on_search(arrival.log_time),
                        Start::Pose(_) | Start::Truth => monitor.on_new_pose(arrival.log_time),
                    }
                }
                scans += 1;
                let before = Instant::now();
                let result = localizer.on_scan(scan);
                let taken = before.elapsed();
                if let Err(cause) = result {
                    monitor.on_refused_scan(arrival.log_time, cause);
                }
                result.map(|update| {
                    let true_pose = truth.at(update.stamp);
                    errors.push(update.stamp, update.pose, true_pose);
                    consistency.push(&update, true_pose);
                    monitor.on_sweep(scan.sweep());
                    let state = monitor.on_update(&update, arrival.log_time).state;
                    states.push(update.stamp, state, update.pose, true_pose);
                    alignment.push(update.alignment);
                    times_us.push(microseconds(taken));
                    particles.push(update.particles as f64);
                    observe(&update, state, (index + 1) as f64 / arrivals.len() as f64);
                })
            }
        };
        if let Err(cause) = result {
            *dropped.entry(cause).or_default() += 1;
        }
    }

    Ok(Outcome {
        scans,
        updates: times_us.len(),
        dropped,
        nees: consistency.summary(),
        state_share: states.shares(),
        state_changes: states.changes().to_vec(),
        state_truth: states.truth(),
        errors: (!truth.is_empty()).then(|| errors.summaries()).flatten(),
        alignment: mean(&alignment)
            .zip(percentile(&alignment, 0.05))
            .map(|(mean, p05)| AlignmentSummary { mean, p05 }),
        update_us: update_times(&times_us),
        particles: mean(&particles).map(|mean| ParticleSummary { mean }),
    })
}

/// Gives the localizer its initial pose, or starts the search; `now` is the latest odometry's stamp.
fn begin(
    localizer: &mut dyn Localizer,
    truth: &Truth,
    start: Start,
    now: Stamp,
) -> Result<(), EvaluateError> {
    match start {
        Start::Pose(pose) => localizer.initialize(pose)?,
        Start::Truth => localizer.initialize(truth.at(now).ok_or(EvaluateError::NoTruth)?)?,
        Start::Global => localizer.relocalize(),
    }
    Ok(())
}

fn update_times(times_us: &[f64]) -> Option<UpdateTimes> {
    Some(UpdateTimes {
        p50: percentile(times_us, 0.5)?,
        p99: percentile(times_us, 0.99)?,
        max: percentile(times_us, 1.0)?,
    })
}

fn microseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e6
}
