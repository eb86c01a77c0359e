//! The localizer: sensors in, poses out.

use std::collections::VecDeque;
use std::sync::Arc;

use maps::{OccupancyGrid, Pose};
use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};

use crate::{Odometry, ParameterFault, Parameters, Scan, Stamp, Twist, YawRate};

/// A map made ready for localization: the grid, its distance field and its range table. Built once, shared
/// between threads and between localizers.
#[derive(Debug)]
pub struct TrackMap {
    grid: OccupancyGrid,
}

impl TrackMap {
    /// Builds what the filter needs. Fails on a map without a free cell.
    pub fn new(grid: OccupancyGrid) -> Result<Self, SetUpError> {
        Ok(Self { grid })
    }

    /// The grid it was built from.
    pub fn grid(&self) -> &OccupancyGrid {
        &self.grid
    }

    /// Distance from a point of `map` to the nearest wall's face [m]; positive in free space.
    pub fn distance(&self, point: [f64; 2]) -> f64 {
        let _ = point;
        0.0
    }

    /// Exact range that a laser at `map_from_laser` measures along its x axis [m], at most `max_range`.
    pub fn range(&self, map_from_laser: Pose, max_range: f64) -> f64 {
        let _ = map_from_laser;
        max_range
    }

    /// Memory that the range table takes [bytes].
    pub fn table_bytes(&self) -> usize {
        0
    }
}

/// Why a localizer could not be set up.
#[derive(Debug, thiserror::Error)]
pub enum SetUpError {
    /// The map has no free cell, so there is nowhere to be.
    #[error("the map has no free cell ({width} x {height} cells)")]
    NoFreeSpace {
        /// Cells along x.
        width: usize,
        /// Cells along y.
        height: usize,
    },
    /// A parameter set with faults, all of them.
    #[error("parameter set refused: {}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))]
    Parameters(Vec<ParameterFault>),
    /// A pose with a NaN or an infinity.
    #[error("pose {0:?} is not finite")]
    Pose(Pose),
}

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
    /// Standard deviation of the particles along and across the car's heading [m].
    pub spread: [f64; 2],
    /// Mass of the second cluster of particles over that of the first, in [0, 1] (clusters of 0.5 m and 20 deg).
    pub second_mode: f64,
    /// Share of valid beams (about 60 over the full field) that end within 0.10 m of a wall, in [0, 1].
    pub alignment: f64,
    /// Mean over the same beams of min(distance to the nearest wall, 1 m) [m].
    pub residual: f64,
    /// Share of the valid beams more than 0.3 m shorter than the map says: something stands in view.
    pub short_beams: f64,
    /// Share of the valid beams more than 0.3 m longer than the map says: wrong pose, or a wall has gone.
    pub long_beams: f64,
    /// Share of the beams without a return.
    pub no_return: f64,
    /// w_fast / w_slow of augmented MCL (Probabilistic Robotics, table 8.3); 1 when all is as usual.
    pub w_ratio: f64,
    /// The correction that this scan made to the predicted pose: distance [m] and angle [rad].
    pub innovation: [f64; 2],
    /// Slip: (odometry's distance - the posterior's) / odometry's, over the last 0.3 s; positive when the wheels
    /// spin; 0 below walking speed.
    pub slip: f64,
    /// Odometry's yaw rate less the posterior's, over the last 0.3 s [rad/s].
    pub yaw_rate_residual: f64,
}

/// SynPF. Not thread-safe by design: one thread owns it; the map is shared.
#[derive(Debug)]
pub struct Localizer {
    map: Arc<TrackMap>,
    parameters: Parameters,
    pose: Option<Pose>,
    odometry: VecDeque<Odometry>,
    number: u64,
}

impl Localizer {
    /// A localizer on `map` for a laser mounted at `base_link_from_laser`. It has no pose yet.
    pub fn new(
        map: Arc<TrackMap>,
        base_link_from_laser: Pose,
        parameters: Parameters,
        seed: u64,
    ) -> Result<Self, SetUpError> {
        let _ = (base_link_from_laser, seed);
        parameters.validate().map_err(SetUpError::Parameters)?;
        Ok(Self {
            map,
            parameters,
            pose: None,
            odometry: VecDeque::new(),
            number: 0,
        })
    }

    /// Starts from a pose of `base_link` in `map`, true now (at the latest odometry), with the set's initial spread.
    pub fn initialize(&mut self, pose: Pose) -> Result<(), SetUpError> {
        if !pose.is_finite() {
            return Err(SetUpError::Pose(pose));
        }
        self.pose = Some(pose);
        Ok(())
    }

    /// Forgets the pose and searches the whole map with the next scans.
    pub fn relocalize(&mut self) {
        self.pose = None;
    }

    /// Swaps the parameter set between two updates; the particles stay. On `Err` nothing has changed.
    pub fn set_parameters(&mut self, parameters: Parameters) -> Result<(), Vec<ParameterFault>> {
        parameters.validate()?;
        self.parameters = parameters;
        Ok(())
    }

    /// The set in force.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// The map it localizes on.
    pub fn map(&self) -> &Arc<TrackMap> {
        &self.map
    }

    /// Takes in odometry. Cheap.
    pub fn on_odometry(&mut self, odometry: &Odometry) -> Result<(), Dropped> {
        if !odometry.pose.is_finite() {
            return Err(Dropped::Malformed);
        }
        if let Some(last) = self.odometry.back() {
            if odometry.stamp <= last.stamp {
                return Err(Dropped::TimeBackwards);
            }
            self.pose = self.pose.map(|pose| pose * odometry.pose.since(last.pose));
        }
        self.odometry.clear();
        self.odometry.push_back(*odometry);
        Ok(())
    }

    /// Takes in a gyroscope's reading; used in place of odometry's yaw rate where the set says so. Cheap.
    pub fn on_yaw_rate(&mut self, yaw_rate: &YawRate) -> Result<(), Dropped> {
        if yaw_rate.rate.is_finite() {
            Ok(())
        } else {
            Err(Dropped::Malformed)
        }
    }

    /// The whole update: move, weigh, resample, estimate.
    pub fn on_scan(&mut self, scan: &Scan) -> Result<Update, Dropped> {
        let odometry = self.odometry.back().ok_or(Dropped::NoOdometry)?;
        let pose = self.pose.ok_or(Dropped::NotInitialized)?;
        self.number += 1;
        Ok(Update {
            stamp: scan.stamp,
            number: self.number,
            pose,
            twist: odometry.twist,
            covariance: Matrix3::identity() * 0.01,
            mode: Mode::Tracking,
            particles: self.parameters.max_particles,
            ess_ratio: 1.0,
            spread: [0.0; 2],
            second_mode: 0.0,
            alignment: 1.0,
            residual: 0.0,
            short_beams: 0.0,
            long_beams: 0.0,
            no_return: 0.0,
            w_ratio: 1.0,
            innovation: [0.0; 2],
            slip: 0.0,
            yaw_rate_residual: 0.0,
        })
    }

    /// The latest posterior carried forward to `stamp` by the odometry since, for publishing at odometry rate.
    /// None before the first pose.
    pub fn predict(&self, stamp: Stamp) -> Option<Pose> {
        let _ = stamp;
        self.pose
    }

    /// The particles with their weights, at the latest update's stamp.
    pub fn particles(&self) -> impl Iterator<Item = WeightedPose> + '_ {
        self.pose.iter().map(|&pose| WeightedPose { pose, weight: 1.0 })
    }
}
