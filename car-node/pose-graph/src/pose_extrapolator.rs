//! The pose extrapolator: where the car is between scans, by odometry.
//!
//! Cartographer's extrapolates with one velocity, from the odometry around the last scan. Ours goes by odometry's own poses,
//! interpolated: the same at 40 scans a second, and right at 5 in a bend.

use std::collections::VecDeque;

use localizer::received::{CARRY, FASTEST_TURN, KEPT, is_possible, keep_yaw_rate};
use localizer::{Dropped, Odometry, Stamp, Twist, YawRate};
use maps::Pose;

use crate::parameters::PoseGraphParameters;
use crate::sampler::FixedRatioSampler;

/// Odometry that moves faster than this [m/s] between two messages, and by more than this \[m\], has been set anew.
const JUMP: [f64; 2] = [30.0, 0.3];

/// Odometry as it is kept.
#[derive(Debug, Clone, Copy)]
struct Kept {
    /// As it was received.
    raw: Odometry,
    /// Its pose, without the jumps of odometry that was set anew.
    continuous: Pose,
    /// Whether the extrapolation uses it.
    sampled: bool,
}

/// Odometry and yaw rates, and the last pose by scan matching.
#[derive(Debug, Clone, Default)]
pub(crate) struct PoseExtrapolator {
    odometry: VecDeque<Kept>,
    yaw_rates: VecDeque<YawRate>,
    sampler: FixedRatioSampler,
    /// A pose, when it was true, and where odometry was.
    last: Option<(Stamp, Pose)>,
    /// A jump since it was last taken: distance \[m\] and angle \[rad\].
    jump: Option<[f64; 2]>,
}

impl PoseExtrapolator {
    /// Takes in odometry.
    pub(crate) fn add_odometry(
        &mut self,
        odometry: &Odometry,
        parameters: &PoseGraphParameters,
    ) -> Result<(), Dropped> {
        let pose = odometry.pose;
        if !(pose.heading.is_finite() && is_possible(odometry, FASTEST_TURN)) {
            return Err(Dropped::Malformed);
        }
        let mut continuous = pose;
        if let Some(last) = self.odometry.back() {
            let seconds = odometry.stamp.since(last.raw.stamp);
            if seconds <= 0.0 {
                return Err(Dropped::TimeBackwards);
            }
            let step = pose.since(last.raw.pose);
            if step.x.hypot(step.y) > JUMP[0] * seconds + JUMP[1] {
                self.jump = Some([step.x.hypot(step.y), step.heading.abs()]);
                continuous = last.continuous;
            } else {
                continuous = last.continuous * step;
            }
        }
        let sampled = self.sampler.pulse(parameters.odometry_sampling_ratio);
        self.odometry.push_back(Kept {
            raw: *odometry,
            continuous,
            sampled,
        });
        if self.odometry.len() > KEPT {
            self.odometry.pop_front();
        }
        Ok(())
    }

    /// Takes in a gyroscope's reading.
    pub(crate) fn add_yaw_rate(&mut self, yaw_rate: &YawRate) -> Result<(), Dropped> {
        keep_yaw_rate(&mut self.yaw_rates, yaw_rate, FASTEST_TURN)
    }

    /// The stamp of the latest odometry.
    pub(crate) fn latest(&self) -> Option<Stamp> {
        self.odometry.back().map(|kept| kept.raw.stamp)
    }

    /// The velocity at a stamp: that of the last message before it.
    pub(crate) fn twist(&self, stamp: Stamp) -> Twist {
        let after = self.odometry.partition_point(|kept| kept.raw.stamp <= stamp);
        self.odometry
            .get(after.saturating_sub(1))
            .map_or_else(Twist::default, |kept| kept.raw.twist)
    }

    /// Odometry's pose at a stamp: between two messages that are used, or carried on by the last two for at most `carry` \[s\].
    pub(crate) fn odometry_at(&self, stamp: Stamp, carry: f64) -> Option<Pose> {
        let used = || self.odometry.iter().filter(|kept| kept.sampled);
        // From the latest on: what is asked for is recent.
        let mut later: Option<&Kept> = None;
        for kept in used().rev() {
            if kept.raw.stamp <= stamp {
                let seconds = stamp.since(kept.raw.stamp);
                if let Some(later) = later {
                    let share = seconds / later.raw.stamp.since(kept.raw.stamp);
                    return Some(kept.continuous.interpolate(later.continuous, share));
                }
                if seconds > carry {
                    return None;
                }
                let before = used()
                    .rev()
                    .nth(1)
                    .filter(|before| before.raw.stamp < kept.raw.stamp);
                let Some(before) = before else {
                    let twist = kept.raw.twist;
                    let moved = [twist.linear_x, twist.linear_y, twist.angular].map(|v| v * seconds);
                    return Some(kept.continuous * Pose::exp(moved));
                };
                let share = 1.0 + seconds / kept.raw.stamp.since(before.raw.stamp);
                return Some(before.continuous.interpolate(kept.continuous, share));
            }
            later = Some(kept);
        }
        // Before the first message: back by its velocity.
        let first = later?;
        let seconds = stamp.since(first.raw.stamp);
        let twist = first.raw.twist;
        let moved = [twist.linear_x, twist.linear_y, twist.angular].map(|v| v * seconds);
        (-seconds <= carry).then(|| first.continuous * Pose::exp(moved))
    }

    /// Sets the pose by scan matching.
    pub(crate) fn add_pose(&mut self, stamp: Stamp, pose: Pose) {
        self.last = Some((stamp, pose));
    }

    /// The last pose by scan matching, and when it was true.
    pub(crate) fn last_pose(&self) -> Option<(Stamp, Pose)> {
        self.last
    }

    /// The last pose carried on to `stamp`, at most `carry` \[s\] beyond the latest odometry.
    pub(crate) fn extrapolate(&self, stamp: Stamp, carry: f64, use_imu_data: bool) -> Option<Pose> {
        let (at, pose) = self.last?;
        let mut motion = self
            .odometry_at(stamp, carry)?
            .since(self.odometry_at(at, carry)?);
        if use_imu_data && let Some(turn) = self.turn(at, stamp) {
            // The same way along the arc, with the gyroscope's turn.
            let [along, across, _] = motion.log();
            motion = Pose::exp([along, across, turn]);
        }
        Some(pose * motion)
    }

    /// The turn between two stamps by the gyroscope; None where it was silent.
    fn turn(&self, from: Stamp, to: Stamp) -> Option<f64> {
        let last = self.yaw_rates.back()?;
        let first = self.yaw_rates.front()?;
        if first.stamp > from.min(to) || from.max(to).since(last.stamp) > CARRY {
            return None;
        }
        let seconds = to.since(from);
        let after = self.yaw_rates.partition_point(|rate| rate.stamp <= from.min(to));
        let until = self.yaw_rates.partition_point(|rate| rate.stamp <= from.max(to));
        let used = self.yaw_rates.range(after.saturating_sub(1)..until);
        let (count, sum) = used.fold((0, 0.0), |(count, sum), rate| (count + 1, sum + rate.rate));
        (count > 0).then(|| sum / f64::from(count) * seconds)
    }

    /// The jump of odometry since this was last asked.
    pub(crate) fn take_jump(&mut self) -> Option<[f64; 2]> {
        self.jump.take()
    }

    /// Odometry as it was received, oldest first.
    pub(crate) fn received(&self) -> Vec<Odometry> {
        self.odometry.iter().map(|kept| kept.raw).collect()
    }

    /// Yaw rates as they were received, oldest first.
    pub(crate) fn yaw_rates(&self) -> Vec<YawRate> {
        self.yaw_rates.iter().copied().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A car on a circle of 2 m at 4 m/s, odometry at 50 Hz.
    fn circling(until: usize, ratio: f64) -> PoseExtrapolator {
        let parameters = PoseGraphParameters {
            odometry_sampling_ratio: ratio,
            ..PoseGraphParameters::default()
        };
        let mut extrapolator = PoseExtrapolator::default();
        for k in 0..until {
            let odometry = Odometry {
                stamp: stamp(0.02 * k as f64),
                pose: at(0.02 * k as f64),
                twist: Twist {
                    linear_x: 4.0,
                    linear_y: 0.0,
                    angular: 2.0,
                },
            };
            assert_eq!(extrapolator.add_odometry(&odometry, &parameters), Ok(()));
        }
        extrapolator
    }

    fn stamp(seconds: f64) -> Stamp {
        Stamp(1_000_000_000).plus(seconds)
    }

    fn at(seconds: f64) -> Pose {
        Pose::exp([4.0 * seconds, 0.0, 2.0 * seconds])
    }

    #[test]
    fn poses_between_and_after_messages_are_on_the_circle() {
        for ratio in [1.0, 0.5] {
            let mut extrapolator = circling(50, ratio);
            extrapolator.add_pose(stamp(0.5), Pose::new(7.0, 8.0, 1.0));
            for seconds in [0.45, 0.5, 0.513, 0.77, 1.01] {
                let found = extrapolator
                    .extrapolate(stamp(seconds), CARRY, false)
                    .expect("near the odometry");
                let expected = Pose::new(7.0, 8.0, 1.0) * at(seconds).since(at(0.5));
                assert!(
                    found.distance(expected) < 1e-6,
                    "{seconds}: {found:?} {expected:?}"
                );
            }
            assert_eq!(extrapolator.extrapolate(stamp(2.0), CARRY, false), None);
        }
    }

    #[test]
    fn a_gyroscope_replaces_odometrys_turn_if_it_is_used() {
        let mut extrapolator = circling(50, 1.0);
        extrapolator.add_pose(stamp(0.5), Pose::IDENTITY);
        for k in 0..50 {
            let reading = YawRate {
                stamp: stamp(0.02 * f64::from(k)),
                rate: 1.0,
            };
            assert_eq!(extrapolator.add_yaw_rate(&reading), Ok(()));
        }
        let turn = |used| {
            extrapolator
                .extrapolate(stamp(0.6), CARRY, used)
                .expect("near")
                .heading
        };
        assert!((turn(false) - 0.2).abs() < 1e-9);
        assert!((turn(true) - 0.1).abs() < 1e-9);
    }

    #[test]
    fn odometry_that_is_set_anew_moves_nothing() {
        let parameters = PoseGraphParameters::default();
        let mut extrapolator = circling(50, 1.0);
        extrapolator.add_pose(stamp(0.98), Pose::IDENTITY);
        let anew = Odometry {
            stamp: stamp(1.0),
            pose: Pose::new(50.0, 3.0, 0.0),
            twist: Twist::default(),
        };
        assert_eq!(extrapolator.add_odometry(&anew, &parameters), Ok(()));
        let pose = extrapolator.extrapolate(stamp(1.0), CARRY, false).expect("near");
        assert!(pose.distance(Pose::IDENTITY) < 1e-9);
        assert!(
            extrapolator
                .take_jump()
                .is_some_and(|[distance, _]| distance > 40.0)
        );
        assert_eq!(extrapolator.take_jump(), None);
        let backwards = extrapolator.add_odometry(&anew, &parameters);
        assert_eq!(backwards, Err(Dropped::TimeBackwards));
    }
}
