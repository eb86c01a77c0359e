//! The interface between localizers and all that uses them.
//!
//! A localizer takes in scans, odometry and yaw rates and answers each scan with an [`Update`]. Health, publishing,
//! evaluation and racing know this crate only, and not which localizer runs.
//!
//! Localizers are deterministic: no clock, no file, no network, no hidden randomness. The same seed and the same log
//! give the same bytes.
//!
//! ```
//! use localizer::{Dropped, Localizer, Odometry, Scan, Update};
//!
//! /// Whichever localizer it is: odometry first, then the scan that was taken meanwhile.
//! fn follow(localizer: &mut dyn Localizer, odometry: &[Odometry], scan: &Scan) -> Result<Update, Dropped> {
//!     for message in odometry {
//!         localizer.on_odometry(message)?;
//!     }
//!     localizer.on_scan(scan)
//! }
//! ```

mod external_pose;
mod hand_over;
mod parameters;
pub mod received;
mod scan_fit;
mod sensor_finding;
mod sensors;
mod stamp;
mod update;

use std::any::Any;
use std::fmt;

use maps::Pose;

pub use external_pose::{ExternalPose, PoseOf};
pub use hand_over::{HandOver, HandedEstimate};
pub use parameters::{ParameterFault, ParameterValues, PreparedParameters, overlay, to_values};
pub use scan_fit::{ScanFit, leaves_map};
pub use sensor_finding::{SensorFinding, SensorFindings};
pub use sensors::{Odometry, Scan, Twist, YawRate};
pub use stamp::Stamp;
pub use update::{Doubt, Dropped, Hypothesis, Mode, Update, WeightedPose};

/// Why a pose cannot be started from.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PoseError {
    /// A pose with a NaN or an infinity.
    #[error("pose {0:?} is not finite")]
    NotFinite(Pose),
    /// A pose that is nowhere on the map.
    #[error("pose ({:.2}, {:.2}) is off the map", .0.x, .0.y)]
    OffMap(Pose),
    /// The pose comes from another localizer.
    #[error("the pose comes from another localizer, which has to be given it itself")]
    Elsewhere,
}

/// Work that takes longer than an update, to be run on another thread.
pub type Job = Box<dyn FnOnce() -> JobOutcome + Send>;

/// What a [`Job`] came to, for the localizer that it is from.
pub type JobOutcome = Box<dyn Any + Send>;

/// Sensors in, poses out. One thread owns a localizer.
///
/// All poses are `map_from_base_link`.
pub trait Localizer: fmt::Debug + Send {
    /// Starts from a pose that is true at the latest odometry, or, before there is any, at the first scan. On `Err`
    /// nothing has changed.
    fn initialize(&mut self, pose: Pose) -> Result<(), PoseError>;

    /// Forgets the pose and searches the whole map with the next scans.
    fn relocalize(&mut self);

    /// Takes in odometry. Takes microseconds.
    fn on_odometry(&mut self, odometry: &Odometry) -> Result<(), Dropped>;

    /// Takes in a gyroscope's reading. Takes microseconds.
    fn on_yaw_rate(&mut self, yaw_rate: &YawRate) -> Result<(), Dropped>;

    /// Takes in a pose from another localizer. Only a localizer that follows another one needs it.
    fn on_external_pose(&mut self, _pose: &ExternalPose) -> Result<(), Dropped> {
        Ok(())
    }

    /// Takes in a scan and updates the pose.
    fn on_scan(&mut self, scan: &Scan) -> Result<Update, Dropped>;

    /// The latest posterior carried on to `stamp` by the odometry since; None before the first update.
    fn predict(&self, stamp: Stamp) -> Option<Pose>;

    /// At most `most` particles, a fair sample, at the latest update's stamp; empty for a localizer without particles.
    fn particles(&self, most: usize) -> Vec<WeightedPose>;

    /// What a search under way has found, best first; empty when none is.
    fn hypotheses(&self) -> Vec<Hypothesis>;

    /// Work that the latest scan has asked for. Whoever takes it runs it on another thread and hands the outcome in with
    /// [`Localizer::finish_job`]; the localizer goes on meanwhile. What nobody takes is done within the next scan.
    fn take_job(&mut self) -> Option<Job> {
        None
    }

    /// Takes in what a job came to. An outcome that is no longer asked for is ignored.
    fn finish_job(&mut self, _outcome: JobOutcome) {}

    /// The laser is mounted here on `base_link`, other than was known. Holds from the next scan on.
    fn set_laser(&mut self, base_link_from_laser: Pose);

    /// The parameter set in force.
    fn parameters(&self) -> ParameterValues;

    /// Swaps the parameter set between two updates and keeps the state. Takes no time. A set for another kind of
    /// localizer comes back as `Err`; [`Localizer::hand_over`] and [`Localizer::take_over`] are for that.
    fn set_parameters(&mut self, prepared: PreparedParameters) -> Result<(), PreparedParameters>;

    /// What another kind of localizer needs to go on from here.
    fn hand_over(&self) -> HandOver;

    /// Goes on from where another localizer was; called once, on a new localizer.
    fn take_over(&mut self, from: HandOver);
}
