//! What one localizer leaves to the next.

use maps::Pose;
use nalgebra::Matrix3;

use crate::{Odometry, Stamp, YawRate};

/// State that outlives a change from one kind of localizer to another on a running car.
///
/// Everything here is as the sensors sent it or in `map`: no localizer's own corrections, such as learned slip, are in it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct HandOver {
    /// The posterior at the latest update; None if there is no pose to go on from, and a search has to begin.
    pub estimate: Option<HandedEstimate>,
    /// Recent odometry as it was received, oldest first.
    pub odometry: Vec<Odometry>,
    /// Recent yaw rates as they were received, oldest first.
    pub yaw_rates: Vec<YawRate>,
    /// The stamp of the latest scan that led to an update.
    pub last_scan: Option<Stamp>,
    /// Number of the latest update; the next localizer counts on from it.
    pub updates: u64,
}

/// The posterior that is handed over.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandedEstimate {
    /// The time at which it is true.
    pub stamp: Stamp,
    /// `map_from_base_link`.
    pub pose: Pose,
    /// Covariance of x, y [m^2], heading [rad^2] and between them, in `map`.
    pub covariance: Matrix3<f64>,
}
