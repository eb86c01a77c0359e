//! SynPF: Monte-Carlo localization made for racing.
//!
//! Sensor data goes in ([`Localizer::on_odometry`], [`Localizer::on_scan`]), poses come out. The crate reads
//! no file, no clock and no network, and every random number comes from the seed: the same seed and the
//! same log give the same bytes.
mod beams;
mod cddt;
mod defects;
mod input;
mod localizer;
mod motion;
mod odometry_track;
mod parameters;
mod particles;
mod quality;
mod range_table;
mod recovery;
mod refine;
mod search;
mod seed;
mod sensor;
mod slip;
mod slip_model;
mod surprise;
mod track_map;
mod walls;
mod weigh;

pub use beams::{BeamLayout, BeamParameters};
pub use defects::Defects;
pub use input::{Odometry, Scan, Stamp, Twist, YawRate};
#[doc(hidden)]
pub use localizer::Stage;
pub use localizer::{Dropped, Hypothesis, Localizer, Mode, SetUpError, Tuning, Update, WeightedPose};
pub use motion::{MotionModel, MotionParameters};
pub use parameters::{ParameterFault, Parameters};
pub use particles::ParticleParameters;
pub use recovery::RecoveryParameters;
pub use refine::RefinementParameters;
pub use search::SearchParameters;
pub use sensor::{RangeMethod, SensorModel, SensorParameters};
pub use track_map::TrackMap;
