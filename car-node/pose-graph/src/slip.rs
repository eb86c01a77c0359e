//! Slip: odometry's way and turn against those by scan matching.

use std::collections::VecDeque;

use localizer::Stamp;
use maps::{Pose, wrap_angle};

/// Time over which slip is measured \[s\].
const OVER: f64 = 0.3;

/// Below this there is no telling [m/s].
const WALKING: f64 = 1.0;

/// Poses that are kept at most.
const KEPT: usize = 256;

/// The last poses by scan matching and by odometry.
#[derive(Debug, Clone, Default)]
pub(crate) struct SlipMeter {
    poses: VecDeque<(Stamp, Pose, Pose)>,
}

impl SlipMeter {
    /// Takes in a pose by scan matching and odometry's at the same time. Returns slip as a share of odometry's way, and odometry's
    /// yaw rate less that of the poses [rad/s]; see `Update::slip`.
    pub(crate) fn add(&mut self, stamp: Stamp, pose: Pose, odom: Pose) -> [f64; 2] {
        while self.poses.len() >= KEPT
            || self
                .poses
                .get(1)
                .is_some_and(|(next, ..)| stamp.since(*next) >= OVER)
        {
            self.poses.pop_front();
        }
        self.poses.push_back((stamp, pose, odom));
        let Some(&(from, pose_then, odom_then)) = self.poses.front() else {
            return [0.0; 2];
        };
        let seconds = stamp.since(from);
        if seconds < 0.5 * OVER {
            return [0.0; 2];
        }
        let (by_scans, by_odom) = (pose.since(pose_then), odom.since(odom_then));
        let [scans, odometry] = [by_scans.log()[0], by_odom.log()[0]];
        let slip = if odometry.abs() < WALKING * seconds {
            0.0
        } else {
            ((odometry - scans) / odometry).clamp(-1.0, 1.0)
        };
        [slip, wrap_angle(by_odom.heading - by_scans.heading) / seconds]
    }

    /// Begins anew, as after a pose was set.
    pub(crate) fn clear(&mut self) {
        self.poses.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wheels_that_turn_farther_than_the_car_goes_slip() {
        let mut meter = SlipMeter::default();
        let mut found = [0.0; 2];
        for k in 0..40 {
            let seconds = 0.025 * f64::from(k);
            let pose = Pose::exp([4.0 * seconds, 0.0, 0.5 * seconds]);
            let odom = Pose::exp([5.0 * seconds, 0.0, 0.8 * seconds]);
            found = meter.add(Stamp(0).plus(seconds), pose, odom);
        }
        assert!(
            (found[0] - 0.2).abs() < 0.01 && (found[1] - 0.3).abs() < 0.01,
            "{found:?}"
        );
    }
}
