//! How a car is set up for a race.

use crate::{DriverParams, LidarParams, OdometryParams, VehicleParams};

/// A car, its sensors, its driver and its start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CarSetup {
    /// The vehicle.
    pub vehicle: VehicleParams,
    /// Its laser.
    pub lidar: LidarParams,
    /// Its odometry.
    pub odometry: OdometryParams,
    /// Its driver.
    pub driver: DriverParams,
    /// The pose that the driver uses.
    pub guidance: Guidance,
    /// Start position along the raceline \[m\]; may be negative.
    pub start: f64,
}

impl Default for CarSetup {
    fn default() -> Self {
        Self {
            vehicle: VehicleParams {
                steering_offset: 0.01,
                ..VehicleParams::default()
            },
            lidar: LidarParams::default(),
            odometry: OdometryParams::default(),
            driver: DriverParams::default(),
            guidance: Guidance::Estimate,
            // Before the start line, so that the first lap begins at speed.
            start: -8.0,
        }
    }
}

/// The pose that a driver uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Guidance {
    /// The estimates that the caller passes on with [`World::guide`](crate::World::guide).
    Estimate,
    /// The true pose: for opponents, and for a driver with a perfect localizer. Such cars have no sensors.
    Truth,
}
