//! What the filter gives to the car's own nodes, and when.

use maps::Pose;
use nalgebra::Matrix3;
use protocol::Severity;
use synpf::{Localizer, Mode, Odometry, Stamp, Update};

use super::pace::Pace;
use crate::health::{CauseKind, State};
use crate::ros2::output::{PoseOutput, RosOutput, RosSink};
use crate::sensors::PoseEstimate;
use crate::telemetry::queue::HealthReport;

/// Particles at this rate \[Hz\].
const PARTICLES_RATE: f32 = 10.0;
/// At most so many particles.
const PARTICLES: usize = 500;
/// Health at least at this rate \[Hz\], and at once when it changes.
const HEALTH_RATE: f32 = 1.0;

/// Feeds the publisher for the car's own nodes. Without one, every call does nothing.
#[derive(Debug, Default)]
pub(super) struct RosFeed {
    sink: Option<RosSink>,
    /// Stamp of the last pose.
    last: Option<Stamp>,
    particles: Pace,
    health: Pace,
    /// What the last health said.
    said: Option<(State, Vec<CauseKind>)>,
}

impl RosFeed {
    pub(super) fn new(sink: Option<RosSink>) -> Self {
        Self {
            sink,
            ..Self::default()
        }
    }

    /// Sends; a publisher that is behind misses this one and gets the next.
    fn send(&self, output: RosOutput) {
        if let Some(sink) = &self.sink {
            sink.try_send(output).ok();
        }
    }

    /// A pose, if it is newer than every one before it: a controller must not see time run backwards.
    fn pose(&mut self, estimate: PoseEstimate, covariance: Matrix3<f64>, odometry: Option<Pose>) {
        if self.last.is_some_and(|last| estimate.stamp <= last) {
            return;
        }
        self.last = Some(estimate.stamp);
        self.send(RosOutput::Pose(Box::new(PoseOutput {
            estimate,
            covariance,
            odometry,
        })));
    }

    /// Odometry came in: the pose of the last update, carried on to it.
    pub(super) fn on_odometry(&mut self, odometry: &Odometry, pose: Pose, update: &Update) {
        if self.sink.is_some() && update.mode == Mode::Tracking {
            let estimate = PoseEstimate {
                stamp: odometry.stamp,
                pose,
                twist: odometry.twist,
            };
            self.pose(estimate, update.covariance, Some(odometry.pose));
        }
    }

    /// A scan led to an update. Its pose goes out if the scan is newer than all odometry; else the next odometry carries it.
    pub(super) fn on_update(&mut self, update: &Update, localizer: &dyn Localizer) {
        if self.sink.is_none() || update.mode != Mode::Tracking {
            return;
        }
        let estimate = PoseEstimate {
            stamp: update.stamp,
            pose: update.pose,
            twist: update.twist,
        };
        self.pose(estimate, update.covariance, None);
        if self.particles.due(update.stamp, PARTICLES_RATE) {
            let particles = localizer.particles(PARTICLES);
            self.send(RosOutput::Particles {
                stamp: update.stamp,
                poses: particles.into_iter().map(|particle| particle.pose).collect(),
            });
        }
    }

    /// True when a health report is due: once a second, and when the state or the kinds of its causes change.
    pub(super) fn wants_health(
        &mut self,
        now: Stamp,
        state: State,
        causes: impl Iterator<Item = CauseKind>,
    ) -> bool {
        if self.sink.is_none() {
            return false;
        }
        let says = (state, causes.collect());
        let changed = self.said.as_ref() != Some(&says);
        let due = self.health.due(now, HEALTH_RATE);
        self.said = Some(says);
        changed || due
    }

    pub(super) fn health(&self, report: HealthReport) {
        self.send(RosOutput::Health(Box::new(report)));
    }

    pub(super) fn log(&self, stamp: Stamp, severity: Severity, text: impl Into<String>) {
        self.send(RosOutput::Log {
            stamp,
            severity,
            text: text.into(),
        });
    }
}
