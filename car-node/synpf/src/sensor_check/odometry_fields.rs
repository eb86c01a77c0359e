//! Odometry of which one half is missing or coarse: a twist of zeros beside a pose that moves, a pose of zeros or in steps beside a
//! twist; and messages that repeat the last one, from a driver that hangs.

use std::collections::VecDeque;

use localizer::{Odometry, SensorFinding, SensorFindings, Stamp, Twist};
use maps::Pose;

use super::{FASTEST, FASTEST_TURN};

/// Completes odometry by what the other half says.
#[derive(Debug, Clone, Default)]
pub(crate) struct OdometryFields {
    /// The last message as it came.
    last: Option<Odometry>,
    /// Where the pose that is passed on is.
    pose: Pose,
    /// Distance by the pose and by the twist, the older stretches forgotten \[m\].
    by_pose: f64,
    by_twist: f64,
    /// The pose does not move, or has no orientation.
    no_pose: bool,
    /// Distance by the twist while the pose stood still \[m\].
    still: f64,
    /// The twist is zero, or does not fit the pose: what it says of the distance.
    wrong_twist: Option<f64>,
    /// Some twist was not zero.
    twist_seen: bool,
    /// Distance by the twist, the older stretches forgotten; how much of it while the position stood still; and that by the
    /// position \[m\].
    twist_distance: f64,
    twist_distance_standing: f64,
    steps_distance: f64,
    /// The position moves in steps of several messages.
    coarse: bool,
    /// Messages on end that repeat one; None if the twist of that one was not new.
    repeats: Option<u32>,
    /// Recent poses.
    poses: VecDeque<(Stamp, Pose)>,
}

/// A pose that stands still while the twist goes so far is missing [m]: at the origin, where a publisher that never sets it
/// leaves it, and elsewhere, where it may be coarse.
const STILL: [f64; 2] = [0.05, 0.6];

/// A position is coarse when it stands still on more than the second share of the way by the twist, and fine below the first.
const COARSE: [f64; 2] = [0.1, 0.3];

/// Its steps, along both axes of a grid, make a way of so many times that by the twist.
const STEPS: std::ops::Range<f64> = 0.6..1.6;

/// So many messages on end that repeat a measured twist and pose are none.
const REPEATS: u32 = 3;

/// How far the pose must go to judge the twist \[m\].
const MOVED: f64 = 0.2;

/// Distances are compared over this \[m\].
const MEMORY: f64 = 2.0;

/// A twist that says more or less than this many times the pose's distance is wrong: both come from the same wheels.
const FITS: std::ops::Range<f64> = 0.6..1.6;

/// A twist is derived from poses so far apart [s]: shorter is noise, longer is late.
const SPAN: f64 = 0.045;

/// No message for so long: what the twist was in between is unknown \[s\].
const GAP: f64 = 0.5;

impl OdometryFields {
    /// The message with a pose and a twist. The heading may come as NaN: no orientation.
    pub(crate) fn completed(&mut self, message: &Odometry) -> Odometry {
        let received = *message;
        let Some(last) = self.last.replace(received) else {
            let mut pose = message.pose;
            if !pose.heading.is_finite() {
                self.no_pose = true;
                pose.heading = 0.0;
            }
            self.pose = pose;
            self.poses.push_back((message.stamp, pose));
            return Odometry { pose, ..received };
        };
        let dt = message.stamp.since(last.stamp);
        let Twist {
            linear_x,
            linear_y,
            angular,
        } = message.twist;
        let mean = [
            f64::midpoint(last.twist.linear_x, linear_x),
            f64::midpoint(last.twist.linear_y, linear_y),
            f64::midpoint(last.twist.angular, angular),
        ];
        self.twist_seen |= linear_x != 0.0 || linear_y != 0.0 || angular != 0.0;
        let by_twist = mean[0].hypot(mean[1]) * dt.min(GAP);
        let same = |a: f64, b: f64| (a - b).abs() <= 0.0;
        let position_stood = same(message.pose.x, last.pose.x) && same(message.pose.y, last.pose.y);
        let stood = position_stood && same(message.pose.heading, last.pose.heading);
        let origin = message.pose.x == 0.0 && message.pose.y == 0.0;
        let hung = self.repeats.is_some_and(|repeats| repeats >= REPEATS);
        if self.hangs(stood && !origin, message.twist == last.twist && by_twist > 0.0) {
            return Odometry {
                pose: self.pose,
                twist: Twist::default(),
                ..received
            };
        }
        self.judge_position(message.pose.distance(last.pose), by_twist, &message.twist);
        let oriented = message.pose.heading.is_finite() && last.pose.heading.is_finite();
        if stood || !oriented {
            self.still += by_twist;
            self.no_pose |= !oriented || self.still > STILL[usize::from(!origin)];
        } else {
            self.no_pose = false;
            self.still = 0.0;
        }
        if self.no_pose {
            self.pose = self.pose * Pose::exp(mean.map(|v| v * dt.min(GAP)));
            self.wrong_twist = None;
            return Odometry {
                pose: self.pose,
                ..received
            };
        }
        let step = message.pose.since(last.pose);
        self.pose = if self.coarse {
            // The way by the twist, the turn by the heading.
            self.pose * Pose::exp([mean[0] * dt.min(GAP), mean[1] * dt.min(GAP), step.heading])
        } else {
            message.pose
        };
        let distance = step.x.hypot(step.y);
        if self.coarse {
            // Its steps say little of the way.
            (self.by_pose, self.by_twist, self.wrong_twist) = (0.0, 0.0, None);
        } else if distance < FASTEST * dt && dt < GAP && !hung {
            self.judge_twist(distance * step.x.signum(), mean[0] * dt);
        }
        self.poses.push_back((message.stamp, message.pose));
        while self
            .poses
            .get(1)
            .is_some_and(|(stamp, _)| message.stamp.since(*stamp) >= SPAN)
        {
            self.poses.pop_front();
        }
        if self.wrong_twist.is_none() {
            return Odometry {
                pose: self.pose,
                ..received
            };
        }
        let (then, before) = self.poses[0];
        let seconds = message.stamp.since(then);
        let arc = message.pose.since(before).log();
        let possible = seconds < GAP && arc[0].hypot(arc[1]) < FASTEST * seconds;
        let [linear_x, linear_y, angular] = if possible {
            arc.map(|v| v / seconds)
        } else {
            [0.0; 3]
        };
        Odometry {
            twist: Twist {
                linear_x,
                linear_y,
                angular,
            },
            ..received
        }
    }

    /// Whether a message repeats the last one because its driver hangs; `pose` and `twist`: these are the same as before. A twist
    /// that is the same while the pose moves is commanded and not measured: then it may well repeat.
    fn hangs(&mut self, pose: bool, twist: bool) -> bool {
        self.repeats = if pose && twist {
            self.repeats.map(|repeats| repeats.saturating_add(1))
        } else {
            (!twist).then_some(0)
        };
        self.repeats.is_some_and(|repeats| repeats >= REPEATS)
    }

    /// Judges whether the position is coarse, by one step \[m\] in which the car went so far by the twist \[m\].
    fn judge_position(&mut self, step: f64, by_twist: f64, twist: &Twist) {
        if twist.linear_x.abs() > FASTEST || twist.angular.abs() > FASTEST_TURN {
            // Poses of two frames, one among the other.
            (self.twist_distance, self.twist_distance_standing) = (0.0, 0.0);
            (self.steps_distance, self.coarse) = (0.0, false);
            return;
        }
        let keep = (-by_twist / MEMORY).exp();
        self.twist_distance = self.twist_distance * keep + by_twist;
        self.steps_distance = self.steps_distance * keep + step;
        let standing = if step > 0.0 { 0.0 } else { by_twist };
        self.twist_distance_standing = self.twist_distance_standing * keep + standing;
        if self.twist_distance > 0.5 * MEMORY {
            let limit = COARSE[usize::from(!self.coarse)];
            self.coarse = self.twist_distance_standing > limit * self.twist_distance
                && STEPS.contains(&(self.steps_distance / self.twist_distance));
        }
    }

    /// Compares the distances of one step \[m\].
    fn judge_twist(&mut self, by_pose: f64, by_twist: f64) {
        let keep = (-by_pose.abs() / MEMORY).exp();
        // Forwards as the pose goes.
        self.by_pose = self.by_pose * keep + by_pose.abs();
        self.by_twist = self.by_twist * keep + by_twist * by_pose.signum();
        if self.by_pose > MOVED {
            let ratio = self.by_twist / self.by_pose;
            // A twist that has never been anything but zero is none; one that differs is judged over a longer way.
            let judged = !self.twist_seen || self.by_pose > 0.5 * MEMORY;
            if judged {
                self.wrong_twist = (!FITS.contains(&ratio)).then_some(ratio);
            }
        }
    }

    pub(crate) fn report(&self, findings: &mut SensorFindings) {
        if let Some(ratio) = self.wrong_twist {
            findings.insert(SensorFinding::TwistFromPose, ratio);
        }
        if self.no_pose || self.coarse {
            findings.insert(
                SensorFinding::PoseFromTwist,
                self.still.max(self.twist_distance_standing),
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two seconds of a circle of 2 m at 4 m/s, 50 Hz, each message changed; the last as it was and as it is completed.
    fn circle(change: impl Fn(&mut Odometry)) -> (Odometry, Odometry, OdometryFields) {
        let mut fields = OdometryFields::default();
        let twist = Twist {
            linear_x: 4.0,
            linear_y: 0.0,
            angular: 2.0,
        };
        let sound = |i: i64| Odometry {
            stamp: Stamp(i * 20_000_000),
            pose: Pose::exp([0.08 * i as f64, 0.0, 0.04 * i as f64]),
            twist,
        };
        let mut completed = sound(0);
        for i in 0..=100 {
            let mut message = sound(i);
            change(&mut message);
            completed = fields.completed(&message);
        }
        (sound(100), completed, fields)
    }

    #[test]
    fn what_is_whole_is_passed_on() {
        let (sound, completed, fields) = circle(|_| ());
        assert_eq!(sound, completed);
        let mut findings = SensorFindings::default();
        fields.report(&mut findings);
        assert_eq!(findings.iter().count(), 0);
    }

    #[test]
    fn a_twist_is_derived_from_the_pose() {
        for factor in [0.0, -1.0, 3.6] {
            let (sound, completed, fields) = circle(|message| {
                message.twist.linear_x *= factor;
                message.twist.angular *= factor;
            });
            assert!((completed.twist.linear_x - sound.twist.linear_x).abs() < 1e-6);
            assert!((completed.twist.angular - sound.twist.angular).abs() < 1e-6);
            let mut findings = SensorFindings::default();
            fields.report(&mut findings);
            let ratio = findings.get(SensorFinding::TwistFromPose).expect("found");
            assert!((ratio - factor).abs() < 0.01, "{ratio}");
        }
    }

    #[test]
    fn a_pose_is_integrated_from_the_twist() {
        for pose in [
            Pose::IDENTITY,
            Pose {
                heading: f64::NAN,
                ..Pose::IDENTITY
            },
        ] {
            let (sound, completed, fields) = circle(|message| message.pose = pose);
            // What the twist said before the pose was known to be missing is gone.
            let off = completed.pose.distance(sound.pose);
            assert!(off < 0.2, "{off}");
            let mut findings = SensorFindings::default();
            fields.report(&mut findings);
            assert!(findings.get(SensorFinding::PoseFromTwist).is_some());
        }
    }

    /// Scans between two steps of the position were up to 20 cm off.
    #[test]
    fn a_coarse_position_is_integrated_from_the_twist() {
        let coarse = |message: &mut Odometry| {
            message.pose.x = (message.pose.x / 0.2).round() * 0.2;
            message.pose.y = (message.pose.y / 0.2).round() * 0.2;
        };
        let (mut fields, mut steps) = (OdometryFields::default(), Vec::new());
        let twist = Twist {
            linear_x: 4.0,
            linear_y: 0.0,
            angular: 2.0,
        };
        let mut last: Option<Odometry> = None;
        for i in 0..=100 {
            let mut message = Odometry {
                stamp: Stamp(i * 20_000_000),
                pose: Pose::exp([0.08 * i as f64, 0.0, 0.04 * i as f64]),
                twist,
            };
            coarse(&mut message);
            let completed = fields.completed(&message);
            steps.extend(last.map(|last| completed.pose.since(last.pose)));
            last = Some(completed);
        }
        assert!(!fields.no_pose && fields.coarse);
        for step in &steps[40..] {
            assert!(
                (step.x - 0.08).abs() < 2e-3 && (step.heading - 0.04).abs() < 1e-9,
                "{step:?}"
            );
        }
        // Without a twist the pose is all there is.
        let (_, _, fields) = circle(|message| {
            coarse(message);
            message.twist = Twist::default();
        });
        assert!(!fields.no_pose && !fields.coarse);
    }

    #[test]
    fn a_driver_that_hangs_says_nothing() {
        let mut fields = OdometryFields::default();
        let measured = |i: i64| Odometry {
            stamp: Stamp(i * 20_000_000),
            pose: Pose::new(1.0 + 0.08 * i as f64, 0.0, 0.0),
            twist: Twist {
                linear_x: 4.0 + 1e-3 * i as f64,
                ..Twist::default()
            },
        };
        let mut passed = measured(0);
        for i in 0..100 {
            passed = fields.completed(&Odometry {
                stamp: measured(i).stamp,
                ..measured(i.min(50))
            });
        }
        assert_eq!((passed.pose, passed.twist), (measured(50).pose, Twist::default()));
        assert!(!fields.no_pose);
        // It goes on.
        let next = measured(120);
        assert_eq!(fields.completed(&next), next);
    }

    #[test]
    fn a_car_at_standstill_lacks_nothing() {
        let mut fields = OdometryFields::default();
        for i in 0..100 {
            fields.completed(&Odometry {
                stamp: Stamp(i * 20_000_000),
                pose: Pose::IDENTITY,
                twist: Twist::default(),
            });
        }
        assert!(!fields.no_pose && fields.wrong_twist.is_none());
    }
}
