//! SynPF: Monte-Carlo localization made for racing.
//!
//! Sensor data goes in ([`SynPf::on_odometry`], [`SynPf::on_scan`]), poses come out. The crate reads
//! no file, no clock and no network, and every random number comes from the seed: the same seed and the
//! same log give the same bytes.
mod beam_layout;
mod beam_model;
mod calibration;
mod cddt;
mod error;
mod estimate;
mod likelihood_field;
mod loss_detector;
mod motion_model;
mod normal_pool;
mod odometry_track;
mod parameters;
mod particle_estimate;
mod particle_filter;
mod particles;
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
mod search;
mod seed;
mod sensor_model;
mod sensor_parameters;
mod surprise;
mod synpf;
mod table_store;
mod track_map;
mod tracker;
mod tuning;
mod validation;

pub use beam_layout::{BeamLayout, BeamParameters};
pub use error::SetUpError;
pub use localizer::{
    Dropped, HandOver, HandedEstimate, Hypothesis, Localizer, Mode, Odometry, ParameterFault,
    ParameterValues, PoseError, PreparedParameters, Scan, Stamp, Twist, Update, WeightedPose, YawRate,
};
pub use loss_detector::RecoveryParameters;
pub use motion_model::{MotionModel, MotionParameters};
pub use parameters::{Parameters, parameter_table};
pub use particles::ParticleParameters;
pub use reference::{
    Reference, ReferenceDefects, ReferenceMotionModel, ReferenceParameters, ReferenceTuning,
};
pub use scan_matcher::RefinementParameters;
pub use search::SearchParameters;
pub use sensor_parameters::{RangeMethod, SensorModelKind, SensorParameters};
#[doc(hidden)]
pub use synpf::Stage;
pub use synpf::SynPf;
pub use table_store::{TableJob, TablePolicy};
pub use track_map::TrackMap;
pub use tuning::Tuning;
