//! SynPF: Monte-Carlo localization made for racing.
//!
//! Sensor data goes in ([`Localizer::on_odometry`], [`Localizer::on_scan`]), poses come out. The crate reads
//! no file, no clock and no network, and every random number comes from the seed: the same seed and the
//! same log give the same bytes.
mod input;
mod localizer;
mod parameters;

pub use input::{Odometry, Scan, Stamp, Twist, YawRate};
pub use localizer::{Dropped, Localizer, Mode, SetUpError, TrackMap, Update, WeightedPose};
pub use parameters::{ParameterFault, Parameters};
