//! Reasons for a state.

use serde::Serialize;

/// One reason for a state.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Cause {
    /// What is wrong.
    pub kind: CauseKind,
    /// How much it counts.
    pub severity: Severity,
    /// What was measured, in the metric's unit.
    pub value: Option<f64>,
    /// The threshold that it crossed.
    pub limit: Option<f64>,
}

/// How much something counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Good to know; the state does not depend on it.
    Info,
    /// Makes the state DEGRADED where it concerns the pose.
    Warning,
    /// Evidence that the pose is wrong, or that there is none.
    Critical,
}

/// What can be wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CauseKind {
    /// Nobody has given a pose to start from.
    NoInitialPose,
    /// A new pose is not yet confirmed by motion.
    NewPose,
    /// Too few end points lie on walls.
    Alignment,
    /// End points lie far from walls [m].
    Residual,
    /// Beams are longer than the map says.
    LongBeams,
    /// Beams are shorter than the map says: something stands in view.
    Occluded,
    /// Many beams come back with nothing.
    NoReturn,
    /// Few particles carry the weight.
    EffectiveSampleSize,
    /// Scans fit worse than they used to.
    Likelihood,
    /// Unsure along the track [m].
    SpreadAlong,
    /// Unsure across the track [m].
    SpreadAcross,
    /// A second place fits nearly as well.
    SecondMode,
    /// The wheels spin or lock.
    Slip,
    /// Odometry's yaw rate is wrong [rad/s].
    YawRate,
    /// A scan moved the pose far [m].
    Innovation,
    /// Poses come late [s].
    Age,
    /// No scans come in [s].
    NoScan,
    /// No odometry comes in [s].
    NoOdometry,
    /// Sensor data comes in and is refused.
    BadSensorData,
    /// A search of the whole map is under way.
    Searching,
}
