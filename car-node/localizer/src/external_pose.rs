//! A pose from another localizer.

use maps::Pose;
use nalgebra::Matrix3;

use crate::Stamp;

/// The frame whose pose is given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PoseOf {
    /// The car's.
    BaseLink,
    /// The laser's.
    Laser,
    /// Odometry's: the transform `map_from_odom`.
    Odometry,
}

/// A pose that another localizer has estimated, such as AMCL or Cartographer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExternalPose {
    /// When it is true.
    pub stamp: Stamp,
    /// Pose in `map` of the frame that `of` names.
    pub pose: Pose,
    /// What it is the pose of.
    pub of: PoseOf,
    /// Covariance of x, y [m^2], heading [rad^2] and between them, in `map`; None where the other localizer states none.
    pub covariance: Option<Matrix3<f64>>,
}
