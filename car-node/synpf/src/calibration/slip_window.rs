//! Slip: what odometry says the car did against what the posterior says.

use std::collections::VecDeque;

use localizer::Stamp;
use maps::Pose;

/// Compares odometry with the posterior over a sliding window.
#[derive(Debug, Clone, Default)]
pub(crate) struct SlipWindow {
    steps: VecDeque<Step>,
}

#[derive(Debug, Clone, Copy)]
struct Step {
    stamp: Stamp,
    seconds: f64,
    /// By the wheels as they turned \[m\].
    wheel_distance: f64,
    /// The same, less the slip that was expected \[m\], and the turn \[rad\].
    odometry: [f64; 2],
    posterior: [f64; 2],
    /// Motion to the left by the posterior less that by odometry \[m\].
    aside: f64,
    /// By how much odometry was off, corrected as the steps before had taught: forwards and to the left [m/s], turning
    /// [rad/s].
    unforeseen: [f64; 3],
}

/// Slip over the window.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Slip {
    /// (odometry's distance - the posterior's) / odometry's; positive when wheels spin, negative when they lock.
    pub(crate) ratio: f64,
    /// The share of it that the slip learned so far does not explain.
    pub(crate) unexplained: f64,
    /// Odometry's yaw rate less the posterior's [rad/s].
    pub(crate) yaw_rate: f64,
    /// The share of odometry's turn by which it errs: a yaw rate told from the steering is off by more the faster the car
    /// turns, and changes its sign with the bend.
    turn_share: f64,
    /// What of odometry's yaw rate that does not explain, of late [rad/s].
    turn_rest: f64,
    /// Velocity to the left that odometry does not see, of late [m/s].
    side_speed: f64,
    /// Standard deviations of what is left when odometry is corrected by all this: forwards and to the left [m/s], turning
    /// [rad/s].
    pub(crate) unforeseen: [f64; 3],
}

impl Slip {
    /// What a motion by odometry, less the slip expected, over `seconds` was in truth, if the rest of the slip goes on as
    /// it was.
    pub(crate) fn corrected(self, motion: Pose, seconds: f64) -> Pose {
        // More than this is a pose that has jumped.
        let ratio = self.unexplained.clamp(-0.3, 0.3);
        let (share, rest) = (self.turn_share.clamp(-1.0, 1.0), self.turn_rest.clamp(-2.0, 2.0));
        Pose::new(
            motion.x * (1.0 - ratio),
            motion.y * (1.0 - ratio) + self.side_speed.clamp(-2.0, 2.0) * seconds,
            motion.heading * (1.0 - share) - rest * seconds,
        )
    }
}

/// Length of the window \[s\].
const WINDOW: f64 = 0.3;

/// Yaw rate and sideslip change within tenths of a second: what corrects a sweep must be as fresh as this \[s\].
const RECENT: f64 = 0.04;

/// A yaw rate of which its error is hardly a share [rad/s].
const HARDLY: f64 = 0.5;

/// Below this a share of the distance says nothing [m/s].
const WALKING: f64 = 1.0;

impl SlipWindow {
    /// Adds one scan's motion: by the wheels \[m\], by odometry less the slip expected, and by the posterior, each in the
    /// frame of its own start.
    pub(crate) fn push(
        &mut self,
        stamp: Stamp,
        seconds: f64,
        wheel_distance: f64,
        odometry: Pose,
        posterior: Pose,
    ) {
        let foreseen = self.slip().corrected(odometry, seconds);
        let off = posterior.since(foreseen);
        self.steps.push_back(Step {
            stamp,
            seconds,
            wheel_distance,
            odometry: [odometry.x, odometry.heading],
            posterior: [posterior.x, posterior.heading],
            aside: posterior.y - odometry.y,
            unforeseen: [off.x, off.y, maps::wrap_angle(off.heading)].map(|v| v / seconds),
        });
        while self
            .steps
            .front()
            .is_some_and(|step| stamp.since(step.stamp) > WINDOW)
        {
            self.steps.pop_front();
        }
    }

    /// The slip over the window; zero below walking speed and before the window is half full.
    pub(crate) fn slip(&self) -> Slip {
        let sum = |of: fn(&Step) -> f64| self.steps.iter().map(of).sum::<f64>();
        let seconds = sum(|step| step.seconds);
        if seconds < WINDOW / 2.0 {
            return Slip::default();
        }
        let posterior = sum(|step| step.posterior[0]);
        let driven = sum(|step| step.wheel_distance);
        let share = |odometry: f64| {
            if driven.abs() < WALKING * seconds {
                0.0
            } else {
                ((odometry - posterior) / driven).clamp(-2.0, 2.0)
            }
        };
        let turn = sum(|step| step.odometry[1]);
        let yaw_rate = (turn - sum(|step| step.posterior[1])) / seconds;
        // Least squares, shrunk by what a car that hardly turns could tell.
        let turn_share = sum(|step| step.odometry[1] * (step.odometry[1] - step.posterior[1]))
            / sum(|step| step.odometry[1].powi(2) + (HARDLY * step.seconds).powi(2)).max(1e-12);
        let recent = || {
            let latest = self.steps.back().map(|step| step.stamp);
            let fresh = move |step: &&Step| latest.is_some_and(|latest| latest.since(step.stamp) < RECENT);
            self.steps.iter().filter(fresh)
        };
        let recent_seconds = recent().map(|step| step.seconds).sum::<f64>().max(1e-9);
        let off_turn = |step: &Step| (1.0 - turn_share) * step.odometry[1] - step.posterior[1];
        let unforeseen = [0, 1, 2].map(|i| {
            let squares = self
                .steps
                .iter()
                .map(|step| step.unforeseen[i].powi(2))
                .sum::<f64>();
            (squares / self.steps.len() as f64).sqrt()
        });
        Slip {
            ratio: share(driven),
            unexplained: share(sum(|step| step.odometry[0])),
            yaw_rate,
            turn_share,
            turn_rest: recent().map(off_turn).sum::<f64>() / recent_seconds,
            side_speed: recent().map(|step| step.aside).sum::<f64>() / recent_seconds,
            unforeseen,
        }
    }

    /// The car's own speed over the window [m/s]; zero before there is one.
    pub(crate) fn speed(&self) -> f64 {
        let sum = |of: fn(&Step) -> f64| self.steps.iter().map(of).sum::<f64>();
        let seconds = sum(|step| step.seconds);
        if seconds > 0.0 {
            sum(|step| step.posterior[0]) / seconds
        } else {
            0.0
        }
    }

    /// Forgets, because the pose has jumped.
    pub(crate) fn clear(&mut self) {
        self.steps.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slip(wheel_distance: f64, odometry: Pose, posterior: Pose) -> Slip {
        let mut window = SlipWindow::default();
        for i in 0..20 {
            window.push(Stamp(i * 25_000_000), 0.025, wheel_distance, odometry, posterior);
        }
        window.slip()
    }

    #[test]
    fn spinning_wheels_are_positive_slip() {
        let slip = slip(0.11, Pose::new(0.105, 0.0, 0.02), Pose::new(0.1, 0.0, 0.01));
        assert!((slip.ratio - 0.01 / 0.11).abs() < 1e-9);
        assert!((slip.unexplained - 0.005 / 0.11).abs() < 1e-9);
        assert!((slip.yaw_rate - 0.4).abs() < 1e-9);
    }

    #[test]
    fn a_share_of_the_turn_changes_its_sign_with_the_bend() {
        // Odometry turns a quarter too far, as a yaw rate told from the steering does.
        let mut window = SlipWindow::default();
        for (i, turn) in (0..20i64).zip([0.05, 0.04, 0.03, 0.04].iter().cycle()) {
            let posterior = Pose::new(0.1, 0.0, 0.8 * turn);
            window.push(
                Stamp(i * 25_000_000),
                0.025,
                0.1,
                Pose::new(0.1, 0.0, *turn),
                posterior,
            );
        }
        let slip = window.slip();
        let off =
            |turn: f64, seconds: f64| slip.corrected(Pose::new(0.1, 0.0, turn), seconds).heading - 0.8 * turn;
        assert!(off(0.04, 0.025).abs() < 5e-4, "{slip:?}");
        // Into the bend the other way; by the yaw rate alone it would be off by 0.016.
        assert!(off(-0.04, 0.025).abs() < 5e-3, "{slip:?}");
    }

    #[test]
    fn at_a_standstill_there_is_none() {
        assert!(
            slip(0.001, Pose::new(0.001, 0.0, 0.0), Pose::new(-0.002, 0.0, 0.0))
                .ratio
                .abs()
                < 1e-12
        );
        assert_eq!(SlipWindow::default().slip(), Slip::default());
    }
}
