//! What a localizer answers: the outcome of one scan.

use maps::Pose;
use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};

use crate::{ScanFit, SensorFindings, Stamp, Twist};

/// Why a message did not lead to an update. Each is counted by the caller.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, thiserror::Error,
)]
#[serde(rename_all = "snake_case")]
pub enum Dropped {
    /// A NaN or an infinity where a number must be, or a scan geometry that makes no sense.
    #[error("malformed message")]
    Malformed,
    /// Its stamp is not later than the last one of its kind.
    #[error("time went backwards")]
    TimeBackwards,
    /// A scan before the first odometry.
    #[error("no odometry yet")]
    NoOdometry,
    /// A scan so long after the last odometry that the motion in between is unknown.
    #[error("odometry is too old")]
    StaleOdometry,
    /// A scan without a single usable beam.
    #[error("no usable beam")]
    NoBeams,
    /// There is no pose to start from: neither given nor searched for.
    #[error("no initial pose")]
    NotInitialized,
    /// A scan with the readings of the one before, although the car has moved: the scanner or its driver hangs.
    #[error("the scan repeats the one before")]
    RepeatedScan,
}

/// What the localizer is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// Waiting for an initial pose.
    Uninitialized,
    /// Following one hypothesis.
    Tracking,
    /// Searching the whole map.
    Searching,
}

/// A particle, for drawing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WeightedPose {
    /// `map_from_base_link`.
    pub pose: Pose,
    /// Share of the whole weight, in [0, 1].
    pub weight: f64,
}

/// The outcome of one scan.
#[derive(Debug, Clone, PartialEq)]
pub struct Update {
    /// The time at which the pose is true: the scan's stamp.
    pub stamp: Stamp,
    /// Counts updates since the localizer was made, from 1.
    pub number: u64,
    /// `map_from_base_link`.
    pub pose: Pose,
    /// Velocity at that time.
    pub twist: Twist,
    /// Covariance of x, y [m^2], heading [rad^2] and between them, in `map`.
    pub covariance: Matrix3<f64>,
    /// What the localizer is doing.
    pub mode: Mode,
    /// Particles in use.
    pub particles: usize,
    /// Effective sample size over the number of particles, after weighing and before resampling, in (0, 1].
    pub ess_ratio: f64,
    /// Standard deviation of the particles along and across the car's heading \[m\].
    pub spread: [f64; 2],
    /// Mass of the second cluster of particles over that of the first, in [0, 1] (clusters of 0.5 m and 20 deg).
    pub second_mode: f64,
    /// Share of valid beams (about 60 over the full field) that end within 0.10 m of a wall (0.05 m and a cell where cells are larger), in [0, 1]. A beam is valid that
    /// has a return, and does not leave the mapped part of the world, as through a door that was shut when it was mapped.
    pub alignment: f64,
    /// Mean over the same beams of min(distance to the nearest wall, 1 m) \[m\].
    pub residual: f64,
    /// Share of the valid beams more than 0.3 m shorter than the map says: something stands in view.
    pub short_beams: f64,
    /// Share of the valid beams more than 0.3 m longer than the map says: wrong pose, or a wall has gone.
    pub long_beams: f64,
    /// Share of the beams without a return.
    pub no_return: f64,
    /// Short-term over long-term average of how well the scan fits the map at the estimate; 1 when all is as usual.
    ///
    /// The two averages are those of augmented MCL (Probabilistic Robotics, table 8.3), but taken over the alignment of the
    /// beams that end at no obstacle, where the table takes the mean likelihood of the particles.
    pub w_ratio: f64,
    /// The correction that this scan made to the predicted pose: distance \[m\] and angle \[rad\].
    pub innovation: [f64; 2],
    /// By how far odometry has jumped since the update before \[m\], \[rad\]; None when it has not.
    pub odometry_jump: Option<[f64; 2]>,
    /// Slip: (odometry's distance - the posterior's) / odometry's, over the last 0.3 s; positive when the wheels
    /// spin; 0 below walking speed.
    pub slip: f64,
    /// Odometry's yaw rate less the posterior's, over the last 0.3 s [rad/s].
    pub yaw_rate_residual: f64,
    /// What is wrong with the sensors, and what was done about it.
    pub sensors: SensorFindings,
    /// Why the pose may be wrong; None while nothing speaks against it.
    pub doubt: Option<Doubt>,
    /// Log of the odds that the pose is right, by how it was driven to and by its best rival, in [-25, 25]; None from a localizer that does
    /// not judge its pose.
    pub trust: Option<f64>,
}

/// A pose in doubt: a rival pose explains the scans as well or better, or the car seems to have been carried.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Doubt {
    /// Probability that the pose is wrong, in [0, 1].
    pub probability: f64,
    /// The rival, `map_from_base_link`; None before one is found.
    pub rival: Option<Pose>,
}

impl Update {
    /// How well the scan fits the map at the estimate.
    pub fn scan_fit(&self) -> ScanFit {
        ScanFit {
            alignment: self.alignment,
            residual: self.residual,
            short_beams: self.short_beams,
            long_beams: self.long_beams,
        }
    }
}

/// A pose that a search of the whole map has found, for the operator to choose from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// `map_from_base_link`.
    pub pose: Pose,
    /// How well the end points of the last scans lie on walls there, in [0, 1].
    pub fit: f64,
}
