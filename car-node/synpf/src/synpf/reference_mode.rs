//! The reference's cycle, for the set `synpf-baseline`: one update per odometry message, with the latest scan and the motion
//! before the last.

use localizer::{Dropped, Mode, Odometry, Update};
use maps::Pose;

use super::{Step, SynPf};
use crate::estimate::Estimate;
use crate::motion_model::Motion;
use crate::odometry_track::CARRY;
use crate::tracker::Fit;

/// What the cycle keeps: odometry is applied one message late.
#[derive(Debug, Clone, Default)]
pub(super) struct PerOdometry {
    last: Option<Odometry>,
    delayed: Pose,
    have_scan: bool,
}

impl SynPf {
    /// One update, with the latest scan however old.
    pub(super) fn update_per_odometry(&mut self, odometry: &Odometry) {
        let last = self.per_odometry.last.replace(*odometry);
        let Some(last) = last else { return };
        let motion = std::mem::replace(&mut self.per_odometry.delayed, odometry.pose.since(last.pose));
        if self.mode != Mode::Tracking || !self.per_odometry.have_scan {
            return;
        }
        let parameters = &self.parameters;
        let seconds = odometry.stamp.since(last.stamp);
        let still = parameters.defects.defect_deadband && motion.x.hypot(motion.y) < 0.01;
        if !still {
            let motion = Motion::new(motion, seconds, 1.0, &parameters.motion, parameters.defects);
            self.filter.predict(&motion);
        }
        self.filter.particles.log_weight.fill(0.0);
        let near = self.tracker.estimate.pose;
        let weighted = self.filter.reweight(&self.map, &self.scan, near, parameters);
        self.tracker.estimate = Estimate {
            pose: weighted.particles.mean,
            covariance: weighted.particles.covariance,
        };
        let count = parameters.particles.max_particles;
        self.filter.particles.resample(count);
        self.tracker.at = self
            .odometry
            .at(odometry.stamp, CARRY)
            .map(|(odom, _)| (odometry.stamp, odom));
    }

    /// What the reference would publish at a scan: the result of the latest odometry.
    pub(super) fn latest_of_odometry(&mut self, step: &Step) -> Result<Update, Dropped> {
        self.per_odometry.have_scan = true;
        let last = self.per_odometry.last.ok_or(Dropped::NoOdometry)?;
        let step = Step {
            stamp: last.stamp,
            twist: last.twist,
            ..*step
        };
        let quality = self.assess();
        let fit = Fit {
            estimate: self.tracker.estimate,
            from_prediction: true,
        };
        Ok(self.update(&step, &fit.estimate, None, &quality))
    }
}
