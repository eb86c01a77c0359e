//! What the filter gives to the thread that publishes to the car's own nodes.

use crossbeam_channel::Sender;
use maps::Pose;
use nalgebra::Matrix3;
use protocol::Severity;
use synpf::Stamp;

use crate::sensors::PoseEstimate;
use crate::telemetry::queue::HealthReport;

/// One message. Stamps are on the sensors' clock as the filter has it.
#[derive(Debug, Clone)]
pub enum RosOutput {
    /// The newest pose. Stamps strictly increase.
    Pose(Box<PoseOutput>),
    /// A fair sample of the particles.
    Particles {
        /// When they are true.
        stamp: Stamp,
        /// `map_from_base_link` of each.
        poses: Vec<Pose>,
    },
    /// Health, once a second and when it changes.
    Health(Box<HealthReport>),
    /// Something to read, such as the answer to an initial pose.
    Log {
        /// When.
        stamp: Stamp,
        /// How severe it is.
        severity: Severity,
        /// The text.
        text: String,
    },
}

/// A pose with what belongs to it.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseOutput {
    /// The pose, carried to the newest odometry.
    pub estimate: PoseEstimate,
    /// Covariance of x, y [m^2] and heading [rad^2].
    pub covariance: Matrix3<f64>,
    /// `odom_from_base_link` at the same stamp, as odometry sent it; None when the pose is newer than odometry.
    pub odometry: Option<Pose>,
}

/// Takes what the filter gives. A full one drops it: the filter does not wait.
pub type RosSink = Sender<RosOutput>;
