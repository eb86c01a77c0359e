//! The car's pose.

use serde::{Deserialize, Serialize};

use crate::{Covariance, Message, Pose2, Schema, Twist2};

/// The pose of `base_link` in `map` at the header's sensor time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// `map_from_base_link`.
    pub pose: Pose2,
    /// Velocity at that time.
    pub twist: Twist2,
    /// Uncertainty of the pose, in `map`.
    pub covariance: Covariance,
    /// Position relative to the raceline; None where the car has no raceline.
    pub track: Option<TrackPoint>,
    /// Laps begun since the node started; 0 before the first crossing of the start line.
    pub lap: u32,
    /// The filter update that this pose comes from; counts from 1.
    pub update: u64,
    /// From a scan, or predicted.
    pub kind: PoseKind,
}

/// A position relative to a raceline.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TrackPoint {
    /// Arc length of the nearest point of the line \[m\].
    pub s: f64,
    /// Signed distance from the line, left positive \[m\].
    pub d: f64,
}

/// What a pose was computed from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseKind {
    /// The posterior of a scan.
    Updated,
    /// The last posterior, composed with the odometry since.
    Predicted,
}

impl Message for Pose {
    const SCHEMA: Schema = Schema::Pose;
    const MAX_LEN: usize = 1024;
}
