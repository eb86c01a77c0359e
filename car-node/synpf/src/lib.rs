//! SynPF: Monte-Carlo localization made for racing.
//!
//! Scans and odometry go in ([`SynPf::on_odometry`], [`SynPf::on_scan`]), poses with a covariance come out. The pose comes
//! from a fit of the whole scan to the map around odometry's prediction; the particles guard that fit, and a search of the
//! whole map finds the car when both are lost.
//!
//! The crate reads no file, no clock and no network. Every random number comes from the seed: the same seed and the same
//! log give the same bytes.
//!
//! ```
//! use std::sync::Arc;
//!
//! use maps::{Cell, OccupancyGrid, Pose};
//! use synpf::{Odometry, Parameters, Scan, Stamp, SynPf, TrackMap, Twist};
//!
//! // A room of 6 x 4 m in cells of 5 cm.
//! let grid = OccupancyGrid::from_fn(120, 80, 0.05, Pose::IDENTITY, |column, row| match (column, row) {
//!     (0 | 119, _) | (_, 0 | 79) => Cell::Occupied,
//!     _ => Cell::Free,
//! });
//! let map = Arc::new(TrackMap::new(grid)?);
//! let base_link_from_laser = Pose::new(0.27, 0.0, 0.0);
//! let mut localizer = SynPf::new(Arc::clone(&map), base_link_from_laser, Parameters::default(), 1)?;
//!
//! let stamp = Stamp(0);
//! localizer.on_odometry(&Odometry { stamp, pose: Pose::IDENTITY, twist: Twist::default() })?;
//! // The initial pose is 14 cm and 6 deg off.
//! localizer.initialize(Pose::new(2.0, 1.6, 0.1))?;
//!
//! let truth = Pose::new(2.1, 1.5, 0.0);
//! let range = |i: i32| {
//!     let beam = Pose::new(0.0, 0.0, -2.3 + 0.01 * f64::from(i));
//!     map.range(truth * base_link_from_laser * beam, 10.0) as f32
//! };
//! let update = localizer.on_scan(&Scan {
//!     stamp,
//!     angle_min: -2.3,
//!     angle_max: None,
//!     angle_increment: 0.01,
//!     time_increment: 0.0,
//!     scan_time: None,
//!     range_min: 0.05,
//!     range_max: 10.0,
//!     ranges: (0..461).map(range).collect(),
//! })?;
//! assert!(update.pose.distance(truth) < 0.02);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Where to find what: [`SynPf::on_scan`] is the algorithm. `motion_model` moves the particles, `sensor_model` weighs them,
//! `resampling` draws the next ones, `tracker` and `scan_matcher` predict and fit the pose, `recovery` notices a wrong pose
//! and finds the right one, `calibration` learns slip and how the walls stand.

mod beam_layout;
mod beam_model;
mod calibration;
mod cddt;
mod correlative_match;
mod error;
mod estimate;
mod global_search;
#[cfg(feature = "gpu")]
mod gpu;
mod innovation_gate;
mod likelihood_field;
mod motion_model;
mod motion_noise;
mod normal_pool;
mod odometry_drift;
mod odometry_track;
mod parameters;
mod particle_estimate;
mod particle_filter;
mod particles;
pub mod parts;
mod pose_array;
mod pose_bins;
mod preprocessed_scan;
mod quality;
mod range_table;
mod ranges;
mod recovery;
mod reference;
mod regions;
mod resampling;
mod scan_matcher;
mod score_pyramid;
mod search_parameters;
mod sensor_check;
mod sensor_model;
mod sensor_parameters;
mod synpf;
mod table_store;
mod track_map;
mod tracker;
mod tuning;
mod validation;

pub use beam_layout::{BeamLayout, BeamParameters};
pub use error::SetUpError;
pub use global_search::{GlobalCheck, GlobalCheckOutcome};
#[cfg(feature = "gpu")]
pub use gpu::GpuError;
pub use localizer::{
    Doubt, Dropped, ExternalPose, HandOver, HandedEstimate, Hypothesis, Job, JobOutcome, Localizer, Mode,
    Odometry, ParameterFault, ParameterValues, PoseError, PoseOf, PreparedParameters, Scan, SensorFinding,
    SensorFindings, Stamp, Twist, Update, WeightedPose, YawRate,
};
pub use motion_model::{MotionModel, MotionParameters};
pub use motion_noise::MotionNoise;
pub use parameters::{Parameters, parameter_table};
pub use particles::ParticleParameters;
pub use recovery::RecoveryParameters;
pub use reference::{
    Reference, ReferenceDefects, ReferenceMotionModel, ReferenceParameters, ReferenceTuning,
};
pub use scan_matcher::RefinementParameters;
pub use search_parameters::SearchParameters;
pub use sensor_parameters::{RangeMethod, SensorModelKind, SensorParameters};
pub use synpf::SynPf;
#[doc(hidden)]
pub use synpf::stages::Stage;
pub use table_store::{TableJob, TablePolicy};
pub use track_map::{TABLE_BUDGET, TrackMap};
pub use tuning::Tuning;
