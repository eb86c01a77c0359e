//! Odometry as a continuous motion: interpolated between messages, carried on a little beyond the last.

use std::collections::VecDeque;

use localizer::received::{KEPT, is_possible, keep_yaw_rate};
use localizer::{Dropped, Odometry, SensorFindings, Stamp, Twist, YawRate};
use maps::Pose;

use crate::calibration::{Drive, SlipModel};
use crate::estimate::are_near;
use crate::sensor_check::{Corrections, DrivenSums, OdometryFields, STANDS, WheelGrip};

/// The recent odometry. Jumps and known slip are taken out and gyroscope turns put in as messages arrive, so that
/// whoever reads it sees one smooth motion in a frame of its own. Whether a jump was one of the car, which was carried or
/// of which messages are missing, or only one of its odometry, which began anew, the next scan can tell.
#[derive(Debug, Clone, Default)]
pub(crate) struct OdometryTrack {
    /// Poses in the smooth frame.
    points: VecDeque<Odometry>,
    /// The same messages as they were received.
    received: VecDeque<Odometry>,
    /// What the sensors have said until then, without corrections.
    driven: VecDeque<DrivenSums>,
    /// The last message, completed.
    last: Option<Odometry>,
    /// How the pose went on in the last step that was no jump [m/s], [m/s], [rad/s].
    pace: [f64; 3],
    fields: OdometryFields,
    grip: WheelGrip,
    /// Messages on end that stood still, but for those in which the wheels braked.
    silent: u32,
    /// While odometry is silent: the car's twist by the scans [m/s], [m/s], [rad/s].
    carried: Option<[f64; 3]>,
    /// What the checks of the sensors have found.
    pub(crate) corrections: Corrections,
    yaw_rates: VecDeque<YawRate>,
    /// The wheels' speed as it came [m/s], over the last [`ACCELERATING`].
    speeds: VecDeque<(Stamp, f64)>,
    /// What the car was doing at the last message.
    drive: Drive,
    /// What would bring the poses that follow the last jumps, in the smooth frame, to where they are if the car jumped.
    discontinuity: Option<Pose>,
}

/// A step is a jump if it differs by more than this from what the twist says, and from the step before \[m\], \[rad\]...
const JUMP: [f64; 2] = [0.3, 0.3];
/// ...plus as far as a car comes with the acceleration of [`TWIST_RATE`], but no more than this per second [m/s], [rad/s].
const JUMP_RATE: [f64; 2] = [3.0, 3.0];

/// A twist changes by no more than this from one message to the next [m/s], [rad/s]...
const TWIST_STEP: [f64; 2] = [1.0, 3.0];
/// ...and by this per second [m/s^2], [rad/s^2]: tyres with a coefficient of friction of 1.2; a car that spins.
const TWIST_RATE: [f64; 2] = [12.0, 100.0];

/// After a gap of so long \[s\] the pose says where the car has gone, and not the twist, if it can have gone so far.
const GAP: f64 = 0.5;

/// Wheels that stand for longer while the car moves do not brake it: odometry is silent \[s\].
const BRAKING: f64 = 1.0;

/// A twist by the scans that differs by more is none: the pose was found elsewhere [m/s], [rad/s].
const PLAUSIBLE: [f64; 3] = [3.0, 3.0, 5.0];

/// Share of it that is believed.
const GAIN: f64 = 0.5;

/// A faster turn [rad/s] is none, in whatever unit: in deg/s a turn has up to 57 times its number, which [`crate::sensor_check`]
/// finds out.
const FASTEST_READING: f64 = 1000.0;

/// A gyroscope is silent when its last reading is older than this \[s\].
const GYRO_SILENT: f64 = 0.1;

/// Acceleration is taken over this long [s]: shorter is noise, longer is late.
const ACCELERATING: f64 = 0.08;

impl OdometryTrack {
    /// The track that these messages lead to, whatever slip was taken out of another one. Messages that are refused are left
    /// out; discontinuities among them lie in the past and are forgotten.
    pub(crate) fn replayed(
        odometry: &[Odometry],
        yaw_rates: &[YawRate],
        use_imu: bool,
        slip: &SlipModel,
    ) -> Self {
        let mut track = Self::default();
        let mut gyro = yaw_rates.iter().peekable();
        for message in odometry {
            while let Some(reading) = gyro.next_if(|reading| reading.stamp <= message.stamp) {
                track.push_yaw_rate(reading).ok();
            }
            track.push(message, use_imu, slip).ok();
        }
        for reading in gyro {
            track.push_yaw_rate(reading).ok();
        }
        track.discontinuity = None;
        track
    }

    /// Recent odometry as it was received, oldest first.
    pub(crate) fn received(&self) -> impl Iterator<Item = &Odometry> {
        self.received.iter()
    }

    /// Recent yaw rates, oldest first.
    pub(crate) fn yaw_rates(&self) -> impl Iterator<Item = &YawRate> {
        self.yaw_rates.iter()
    }

    pub(crate) fn push(
        &mut self,
        odometry: &Odometry,
        use_imu: bool,
        slip: &SlipModel,
    ) -> Result<(), Dropped> {
        if !is_possible(odometry, FASTEST_READING) {
            return Err(Dropped::Malformed);
        }
        if self
            .received
            .back()
            .is_some_and(|last| odometry.stamp <= last.stamp)
        {
            return Err(Dropped::TimeBackwards);
        }
        let received = *odometry;
        let mut odometry = self.fields.completed(odometry);
        let speaks = odometry.twist.linear_x.abs() >= STANDS;
        let Some(mut last) = self.last else {
            self.last = Some(odometry);
            self.received.push_back(received);
            self.points.push_back(odometry);
            self.driven.push_back(DrivenSums::default());
            return Ok(());
        };
        if let Some([linear_x, linear_y, angular]) = self.carried.filter(|_| speaks) {
            last.twist = Twist {
                linear_x,
                linear_y,
                angular,
            };
        }
        let dt = odometry.stamp.since(last.stamp);
        odometry.twist.angular = towards(last.twist.angular, odometry.twist.angular, dt, 1);
        self.last = Some(odometry);
        let mut step = odometry.pose.since(last.pose);
        // A car does not change its speed so fast, even where its wheels do.
        let reachable = Twist {
            linear_x: towards(last.twist.linear_x, odometry.twist.linear_x, dt, 0),
            linear_y: towards(last.twist.linear_y, odometry.twist.linear_y, dt, 0),
            ..odometry.twist
        };
        let by_twist = mean_twist(&last.twist, &reachable);
        let margin = jump_margin(dt);
        let goes_on = [by_twist, self.pace]
            .iter()
            .any(|pace| are_near(step, Pose::exp(pace.map(|v| v * dt.min(1.0))), margin));
        let speed = last.twist.linear_x.hypot(last.twist.linear_y);
        let gone_on = dt > GAP && step.x.hypot(step.y) < speed * dt + margin[0];
        let before = self.points.back().expect("a last message has a point").pose;
        if !goes_on && !gone_on {
            // A twist that came with a jump may be told from it.
            odometry.twist = last.twist;
            self.last = Some(odometry);
            let expected = Pose::exp(mean_twist(&last.twist, &last.twist).map(|v| v * dt.min(1.0)));
            let jump = before * step * (before * expected).inverse();
            self.discontinuity = Some(self.discontinuity.map_or(jump, |earlier| earlier * jump));
            step = expected;
        } else {
            self.pace = step.log().map(|v| v / dt);
        }
        let gyro = self.turn_by_gyro(last.stamp, odometry.stamp);
        let (arc, twist) = self.corrected(&odometry, step.log(), gyro.filter(|_| use_imu), dt);
        self.note_driven(step.log(), gyro, dt);
        self.drive = Drive {
            acceleration: self.acceleration(odometry.stamp, twist[0]),
            lateral: twist[0] * arc[2] / dt,
        };
        let step = Pose::exp(slip.corrected(arc, self.drive));
        let [linear_x, linear_y, angular] = slip.corrected(twist, self.drive);
        self.received.push_back(received);
        self.points.push_back(Odometry {
            pose: before * step,
            twist: Twist {
                linear_x,
                linear_y,
                angular,
            },
            ..odometry
        });
        if self.points.len() > KEPT {
            self.points.pop_front();
            self.received.pop_front();
            self.driven.pop_front();
        }
        Ok(())
    }

    /// A step of odometry, as an arc, and its twist, corrected by what is known of the sensors. `gyro` is the gyroscope's turn.
    fn corrected(
        &mut self,
        odometry: &Odometry,
        mut arc: [f64; 3],
        gyro: Option<f64>,
        dt: f64,
    ) -> ([f64; 3], [f64; 3]) {
        let Corrections {
            gyro: gyro_correction,
            turn,
            wheel_scale,
            standing,
        } = self.corrections;
        let Twist {
            linear_x,
            linear_y,
            angular,
        } = odometry.twist;
        let mut twist = [linear_x * wheel_scale, linear_y * wheel_scale, angular];
        twist[2] = turn.corrected(angular, 1.0);
        arc = [
            arc[0] * wheel_scale,
            arc[1] * wheel_scale,
            turn.corrected(arc[2], dt),
        ];
        if let Some(reading) = gyro
            && let Some(correction) = gyro_correction
        {
            // The same arc, turned by the gyroscope.
            arc[2] = correction.corrected(reading, dt);
        }
        let stands = linear_x.abs() < STANDS && arc[0].abs() < STANDS * dt.max(1e-3);
        self.carried = self.carried.filter(|_| stands);
        let wheels = self.carried.map_or(twist[0], |carried| carried[0]);
        let speed = self.grip.speed(odometry.stamp, wheels);
        if self.grip.is_sliding() {
            arc[0] = speed * dt;
            twist[0] = speed;
        }
        let brakes = self.grip.sliding_for().is_some_and(|seconds| seconds < BRAKING);
        self.silent = if stands && !brakes {
            self.silent.saturating_add(1)
        } else {
            0
        };
        if let Some(carried) = self.carried {
            // A gyroscope knows the turn better.
            let turn = gyro.and(gyro_correction).map(|_| arc[2]);
            (arc, twist) = (carried.map(|v| v * dt), carried);
            arc[2] = turn.unwrap_or(arc[2]);
        } else if standing && linear_x.abs() < STANDS {
            (arc, twist) = ([0.0; 3], [0.0; 3]);
        }
        (arc, twist)
    }

    /// Adds a step, as an arc, to what the sensors have said.
    fn note_driven(&mut self, [x, _, turn]: [f64; 3], gyro: Option<f64>, dt: f64) {
        let sums = self.driven_sums();
        self.driven.push_back(DrivenSums {
            distance: sums.distance + x,
            turn: sums.turn + turn,
            gyro_turn: sums.gyro_turn + gyro.unwrap_or(0.0),
            gyro_time: sums.gyro_time + gyro.map_or(0.0, |_| dt),
            sliding: sums.sliding
                + if self.wheels_slide() || self.is_carried() {
                    dt
                } else {
                    0.0
                },
        });
    }

    /// What the sensors have said until the last message.
    pub(crate) fn driven_sums(&self) -> DrivenSums {
        self.driven.back().copied().unwrap_or_default()
    }

    /// What the sensors have said until a stamp; None where odometry does not cover it.
    pub(crate) fn driven_until(&self, stamp: Stamp) -> Option<DrivenSums> {
        let after = self.points.partition_point(|point| point.stamp <= stamp);
        let before = after.checked_sub(1)?;
        let (a, sums) = (self.points[before].stamp, &self.driven[before]);
        match self.points.get(after) {
            Some(b) => Some(sums.interpolate(&self.driven[after], stamp.since(a) / b.stamp.since(a))),
            None => (a == stamp).then_some(*sums),
        }
    }

    /// Speed of the car by the last message [m/s]: that of the wheels, unless they slide or are silent.
    pub(crate) fn speed(&self) -> f64 {
        let wheels = self.last.map_or(0.0, |last| last.twist.linear_x);
        let carried = self.carried.map(|twist| twist[0]);
        carried.or(self.grip.sliding_speed()).unwrap_or(wheels)
    }

    /// How many messages on end stood still.
    pub(crate) fn silent_messages(&self) -> u32 {
        self.silent
    }

    /// Odometry stands still and the car moves: from the last message on it is carried on at this twist [m/s], [m/s], [rad/s].
    pub(crate) fn carry_on(&mut self, twist: [f64; 3]) {
        self.carried = Some(twist);
        self.grip.release();
        if let Some(point) = self.points.back_mut() {
            let [linear_x, linear_y, angular] = twist;
            point.twist = Twist {
                linear_x,
                linear_y,
                angular,
            };
        }
    }

    /// Whether the car is carried on at its twist by the scans.
    pub(crate) fn is_carried(&self) -> bool {
        self.carried.is_some()
    }

    /// Whether the wheels slide, so that the car's own speed is carried on.
    pub(crate) fn wheels_slide(&self) -> bool {
        self.grip.is_sliding()
    }

    /// The scans say that the car moves at `twist` [m/s], [m/s], [rad/s]; `share` of its speed is to be believed, in [0, 1].
    /// Counts while the wheels slide or are silent.
    pub(crate) fn correct_twist(&mut self, twist: [f64; 3], share: f64) {
        self.grip.correct(twist[0], share);
        if let Some(carried) = &mut self.carried {
            let shares = [share.clamp(0.0, 1.0), 1.0, 1.0];
            for i in 0..3 {
                let off = twist[i] - carried[i];
                if off.abs() < PLAUSIBLE[i] {
                    carried[i] += GAIN * shares[i] * off;
                }
            }
        }
    }

    /// Adds what is wrong with odometry.
    pub(crate) fn report(&self, findings: &mut SensorFindings) {
        self.fields.report(findings);
        self.grip.report(findings);
    }

    pub(crate) fn push_yaw_rate(&mut self, yaw_rate: &YawRate) -> Result<(), Dropped> {
        keep_yaw_rate(&mut self.yaw_rates, yaw_rate, FASTEST_READING)
    }

    /// The jumps since this was last asked, as a motion of the smooth frame: with it in front, later poses are where they
    /// would be if the car itself had jumped. None when there was none.
    pub(crate) fn take_discontinuity(&mut self) -> Option<Pose> {
        self.discontinuity.take()
    }

    /// What the car was doing at the last message.
    pub(crate) fn drive(&self) -> Drive {
        self.drive
    }

    /// Notes the wheels' speed [m/s] and returns their acceleration [m/s^2].
    fn acceleration(&mut self, now: Stamp, speed: f64) -> f64 {
        self.speeds.push_back((now, speed));
        while self
            .speeds
            .get(1)
            .is_some_and(|(stamp, _)| now.since(*stamp) >= ACCELERATING)
        {
            self.speeds.pop_front();
        }
        let (then, before) = self.speeds[0];
        let seconds = now.since(then);
        // Neither from a single reading, nor over a gap.
        if (ACCELERATING / 2.0..2.0 * ACCELERATING).contains(&seconds) {
            // More than any tyre of this kind can do is a fault of the reading.
            ((speed - before) / seconds).clamp(-15.0, 15.0)
        } else {
            0.0
        }
    }

    /// The turn from one stamp to another by the gyroscope \[rad\], held between readings; None if it was silent.
    fn turn_by_gyro(&self, from: Stamp, to: Stamp) -> Option<f64> {
        let first = self
            .yaw_rates
            .partition_point(|reading| reading.stamp <= from)
            .checked_sub(1)?;
        let last = self.yaw_rates.back()?;
        if to.since(last.stamp) > GYRO_SILENT {
            return None;
        }
        let (mut turn, mut at) = (0.0, from);
        let mut rate = self.yaw_rates[first].rate;
        for reading in self
            .yaw_rates
            .range(first + 1..)
            .take_while(|reading| reading.stamp < to)
        {
            turn += rate * reading.stamp.since(at);
            (at, rate) = (reading.stamp, reading.rate);
        }
        Some(turn + rate * to.since(at))
    }

    /// The stamp of the latest message.
    pub(crate) fn latest(&self) -> Option<Stamp> {
        self.points.back().map(|point| point.stamp)
    }

    /// The pose in the smooth frame at a stamp: interpolated on SE(2), carried on by the last twist for at most
    /// `carry` \[s\] beyond the last message. None before the first message.
    pub(crate) fn at(&self, stamp: Stamp, carry: f64) -> Option<(Pose, Twist)> {
        let after = self.points.partition_point(|point| point.stamp <= stamp);
        let Some(before) = after.checked_sub(1) else {
            // A scan may be a little older than the first odometry.
            let first = self.points.front()?;
            let dt = stamp.since(first.stamp);
            return (dt >= -carry).then(|| (first.pose * moved(&first.twist, dt), first.twist));
        };
        let a = &self.points[before];
        if let Some(b) = self.points.get(after) {
            let fraction = stamp.since(a.stamp) / b.stamp.since(a.stamp);
            let mix = |from: f64, to: f64| from + (to - from) * fraction;
            let twist = Twist {
                linear_x: mix(a.twist.linear_x, b.twist.linear_x),
                linear_y: mix(a.twist.linear_y, b.twist.linear_y),
                angular: mix(a.twist.angular, b.twist.angular),
            };
            Some((a.pose.interpolate(b.pose, fraction), twist))
        } else {
            let dt = stamp.since(a.stamp).min(carry);
            Some((a.pose * moved(&a.twist, dt), a.twist))
        }
    }
}

/// The motion of a constant twist over `dt` \[s\].
fn moved(twist: &Twist, dt: f64) -> Pose {
    Pose::exp([twist.linear_x * dt, twist.linear_y * dt, twist.angular * dt])
}

fn mean_twist(a: &Twist, b: &Twist) -> [f64; 3] {
    [
        f64::midpoint(a.linear_x, b.linear_x),
        f64::midpoint(a.linear_y, b.linear_y),
        f64::midpoint(a.angular, b.angular),
    ]
}

/// By how much a step over `dt` \[s\] may differ from what was to be expected \[m\], \[rad\].
fn jump_margin(dt: f64) -> [f64; 2] {
    [0, 1].map(|kind| JUMP[kind] + (0.5 * TWIST_RATE[kind] * dt * dt).min(JUMP_RATE[kind] * dt))
}

/// A component of a twist on its way from one value to another, as far as a car can come in `dt` \[s\]. `kind` is 0 for a speed, 1
/// for a yaw rate.
fn towards(from: f64, to: f64, dt: f64, kind: usize) -> f64 {
    let most = TWIST_STEP[kind] + TWIST_RATE[kind] * dt;
    from + (to - from).clamp(-most, most)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A car on a circle of 2 m at 4 m/s, 50 Hz.
    fn circle(i: i64) -> Odometry {
        let t = i as f64 * 0.02;
        let twist = Twist {
            linear_x: 4.0,
            linear_y: 0.0,
            angular: 2.0,
        };
        Odometry {
            stamp: Stamp(i * 20_000_000),
            pose: moved(&twist, t),
            twist,
        }
    }

    fn track(messages: impl IntoIterator<Item = Odometry>) -> OdometryTrack {
        let mut track = OdometryTrack::default();
        for message in messages {
            track.push(&message, true, &SlipModel::default()).expect("sound");
        }
        track
    }

    #[test]
    fn a_circle_is_interpolated_and_carried_on_exactly() {
        let track = track((0..10).map(circle));
        for t in [0.0, 0.013, 0.1, 0.177, 0.19] {
            let (pose, _) = track.at(Stamp(0).plus(t), 0.05).expect("covered");
            let truth = moved(&circle(0).twist, t);
            assert!(pose.distance(truth) < 1e-9, "at {t}: {pose:?} {truth:?}");
        }
    }

    #[test]
    fn a_jump_of_the_pose_is_no_motion() {
        let mut messages: Vec<_> = (0..10).map(circle).collect();
        for message in &mut messages[5..] {
            message.pose.x += 7.0;
        }
        let mut track = track(messages);
        let jump = track.take_discontinuity().expect("a jump");
        let (pose, _) = track.at(Stamp(9 * 20_000_000), 0.0).expect("covered");
        assert!(pose.distance(circle(9).pose) < 1e-2);
        assert!((jump * pose).distance(Pose::new(7.0, 0.0, 0.0) * circle(9).pose) < 1e-2);
        assert_eq!(track.take_discontinuity(), None, "asked once");
    }

    /// Two programs that publish on one topic: a twist told from both their poses drove the car 1 m aside and turned it by 90 deg.
    #[test]
    fn a_message_of_another_frame_among_the_others_is_no_motion() {
        let mut messages: Vec<_> = (0..10).map(circle).collect();
        messages[5].pose = Pose::new(-0.9, -0.3, -1.8);
        messages[5].twist = Twist {
            linear_x: -25.0,
            linear_y: 0.0,
            angular: -90.0,
        };
        let track = track(messages);
        let (pose, twist) = track.at(Stamp(9 * 20_000_000), 0.0).expect("covered");
        assert!(pose.distance(circle(9).pose) < 0.05, "{pose:?}");
        assert!((pose.heading - circle(9).pose.heading).abs() < 0.1, "{pose:?}");
        assert!((twist.angular - circle(9).twist.angular).abs() < 1e-6);
    }

    /// A robot that stands, and after a pause of 0.2 s a message of another frame, with a twist told from the poses of both.
    #[test]
    fn a_twist_told_from_a_jump_does_not_make_it_a_motion() {
        let standing = |stamp: f64| Odometry {
            stamp: Stamp(0).plus(stamp),
            pose: Pose::IDENTITY,
            twist: Twist::default(),
        };
        let mut jumped = standing(0.71);
        jumped.pose = Pose::new(0.03, -0.95, -1.83);
        jumped.twist = Twist {
            linear_x: 4.5,
            linear_y: 0.0,
            angular: -8.6,
        };
        let mut track = track([standing(0.24), standing(0.48), jumped]);
        let (pose, _) = track.at(jumped.stamp, 0.0).expect("covered");
        assert!(pose.distance(Pose::IDENTITY) < 0.01, "{pose:?}");
        assert!(track.take_discontinuity().is_some());
        // A car that goes off as hard as it can does move.
        let hardest = |i: i32| {
            let t = 0.1 * f64::from(i);
            let mut message = standing(t);
            message.pose.x = 0.5 * 10.0 * t * t;
            message.twist.linear_x = 10.0 * t;
            message
        };
        let (pose, _) = self::track((0..8).map(hardest))
            .at(hardest(7).stamp, 0.0)
            .expect("covered");
        assert!((pose.x - hardest(7).pose.x).abs() < 1e-6, "{pose:?}");
    }

    #[test]
    fn the_gyroscope_turns_the_car_where_odometry_does_not() {
        let mut track = OdometryTrack::default();
        // It is known to be sound.
        track.corrections.gyro = Some(crate::sensor_check::TurnCorrection::default());
        for i in 0..=50 {
            track
                .push_yaw_rate(&YawRate {
                    stamp: Stamp(i * 20_000_000),
                    rate: 0.5,
                })
                .expect("sound");
            let twist = Twist {
                linear_x: 1.0,
                ..Twist::default()
            };
            let odometry = Odometry {
                stamp: Stamp(i * 20_000_000),
                pose: moved(&twist, i as f64 * 0.02),
                twist,
            };
            track.push(&odometry, true, &SlipModel::default()).expect("sound");
        }
        let (pose, _) = track.at(Stamp(1_000_000_000), 0.0).expect("covered");
        assert!((pose.heading - 0.5).abs() < 0.02, "{pose:?}");
    }

    #[test]
    fn what_cannot_be_is_refused() {
        let mut track = track((0..3).map(circle));
        assert_eq!(
            track.push(&circle(2), true, &SlipModel::default()),
            Err(Dropped::TimeBackwards)
        );
        let mut nan = circle(3);
        nan.pose.x = f64::NAN;
        assert_eq!(
            track.push(&nan, true, &SlipModel::default()),
            Err(Dropped::Malformed)
        );
        let mut absurd = circle(3);
        absurd.twist.linear_x = 1e9;
        assert_eq!(
            track.push(&absurd, true, &SlipModel::default()),
            Err(Dropped::Malformed)
        );
        assert_eq!(track.push(&circle(3), true, &SlipModel::default()), Ok(()));
    }
}
