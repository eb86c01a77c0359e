//! What is learned of the car and of the map while driving.
//!
//! Three things, each in a file of its own: how far odometry and the posterior disagree at present ([`Slip`]), the steady
//! part of that ([`SlipModel`]), and how the walls stand beside the map's ([`WallCalibration`]).

mod slip_model;
mod slip_window;
mod wall_calibration;

use localizer::Stamp;
use maps::{DistanceField, Pose};
use nalgebra::{Matrix3, Vector3};

pub(crate) use self::slip_model::{Drive, SlipModel};
pub(crate) use self::slip_window::Slip;
use self::slip_window::SlipWindow;
pub(crate) use self::wall_calibration::WallCalibration;
use crate::estimate::Estimate;

/// Everything that is learned while driving.
#[derive(Debug, Clone, Default)]
pub(crate) struct Calibration {
    /// Slip over the last moments.
    pub(crate) slip: Slip,
    /// The steady part of the slip, which is taken out of odometry.
    pub(crate) slip_model: SlipModel,
    /// How the walls stand beside the map's.
    pub(crate) walls: WallCalibration,
    window: SlipWindow,
}

impl Calibration {
    /// The pose has been set or found: what is known of slip stays, what goes with the old pose is dropped.
    pub(crate) fn forget_pose(&mut self) {
        self.window.clear();
        self.slip = Slip::default();
        self.slip_model.forget_pose();
    }

    /// Covariance of a pose for a scan whose beams were measured over `sweep` \[s\] and brought to one time: half of it at the
    /// velocity that calibrated odometry gets wrong. In the frame of `base_link`.
    pub(crate) fn sweep_error(&self, sweep: f64) -> Matrix3<f64> {
        let sigma = Vector3::from(self.slip.unforeseen) * (0.5 * sweep);
        Matrix3::from_diagonal(&sigma.component_mul(&sigma))
    }

    /// The car's own speed over the last moments [m/s]; zero before it is known.
    pub(crate) fn speed(&self) -> f64 {
        self.window.speed()
    }

    /// Compares one scan's motion by odometry with the posterior's, each in the frame of its own start.
    pub(crate) fn learn_slip(
        &mut self,
        stamp: Stamp,
        seconds: f64,
        wheel_distance: f64,
        odometry: Pose,
        posterior: Pose,
    ) {
        if seconds > 0.0 {
            self.window
                .push(stamp, seconds, wheel_distance, odometry, posterior);
            self.slip = self.window.slip();
        }
    }

    /// Learns from one scan's end points at the estimate how the walls stand, after `driven` \[m\]. With `distance` 0
    /// nothing is learned: walls stand where the map has them.
    pub(crate) fn learn_walls(
        &mut self,
        field: &DistanceField,
        points: &[[f32; 2]],
        estimate: &Estimate,
        driven: f64,
        distance: f64,
    ) {
        if distance <= 0.0 {
            self.walls = WallCalibration::default();
        } else if let Some(seen) = WallCalibration::seen(field, points, estimate.pose, self.walls) {
            self.walls.learn(seen, driven, distance);
        }
    }
}
