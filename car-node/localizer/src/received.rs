//! Odometry and yaw rates as they arrive: what is possible, and how much of them is kept. The same for every localizer.

use std::collections::VecDeque;

use crate::{Dropped, Odometry, YawRate};

/// Longest that odometry is carried on beyond its last message \[s\]; a scan later than that is dropped.
pub const CARRY: f64 = 0.25;

/// Messages that are kept, as many as a late scan or a localizer that takes over can need: 2 s at 200 Hz.
pub const KEPT: usize = 400;

/// A faster turn [rad/s] is no car's.
pub const FASTEST_TURN: f64 = 100.0;

/// Farther from the origin no car drives \[m\].
const FARTHEST: f64 = 1e7;

/// Faster [m/s] is no car of this kind: a broken driver, and of no use to a localizer.
const FASTEST: f64 = 30.0;

/// Whether a car can have this position and twist, which turns by less than `fastest_turn` [rad/s]. The heading is not judged:
/// some drivers never set an orientation.
pub fn is_possible(odometry: &Odometry, fastest_turn: f64) -> bool {
    let sane = |v: f64, limit: f64| v.is_finite() && v.abs() < limit;
    let (pose, twist) = (odometry.pose, odometry.twist);
    [pose.x, pose.y].iter().all(|&v| sane(v, FARTHEST))
        && [twist.linear_x, twist.linear_y].iter().all(|&v| sane(v, FASTEST))
        && sane(twist.angular, fastest_turn)
}

/// Adds a reading to the [`KEPT`] latest. Refuses one that is not finite or not below `fastest_turn` [rad/s] as
/// [`Dropped::Malformed`], and one that is no later than the last as [`Dropped::TimeBackwards`].
pub fn keep_yaw_rate(
    kept: &mut VecDeque<YawRate>,
    yaw_rate: &YawRate,
    fastest_turn: f64,
) -> Result<(), Dropped> {
    if !(yaw_rate.rate.is_finite() && yaw_rate.rate.abs() < fastest_turn) {
        return Err(Dropped::Malformed);
    }
    if kept.back().is_some_and(|last| yaw_rate.stamp <= last.stamp) {
        return Err(Dropped::TimeBackwards);
    }
    kept.push_back(*yaw_rate);
    if kept.len() > KEPT {
        kept.pop_front();
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Stamp, Twist};
    use maps::Pose;

    fn odometry(x: f64, speed: f64, turn: f64) -> Odometry {
        Odometry {
            stamp: Stamp(0),
            pose: Pose::new(x, 0.0, f64::NAN),
            twist: Twist {
                linear_x: speed,
                linear_y: 0.0,
                angular: turn,
            },
        }
    }

    /// A driver that told its twist from two poses of different frames gave 95 m/s, which was believed.
    #[test]
    fn what_no_car_can_do_is_not_possible() {
        assert!(is_possible(&odometry(1e3, -20.0, 5.0), FASTEST_TURN));
        for impossible in [
            odometry(1e8, 1.0, 0.0),
            odometry(0.0, 95.0, 0.0),
            odometry(0.0, 1.0, 186.0),
            odometry(0.0, f64::NAN, 0.0),
        ] {
            assert!(!is_possible(&impossible, FASTEST_TURN), "{impossible:?}");
        }
        assert!(is_possible(&odometry(0.0, 1.0, 186.0), 1000.0));
    }

    #[test]
    fn yaw_rates_are_kept_in_order_and_not_without_end() {
        let mut kept = VecDeque::new();
        let reading = |at: i64, rate: f64| YawRate {
            stamp: Stamp(at),
            rate,
        };
        for at in 1..=KEPT as i64 + 5 {
            keep_yaw_rate(&mut kept, &reading(at, 0.1), FASTEST_TURN).expect("sound");
        }
        assert_eq!((kept.len(), kept[0].stamp), (KEPT, Stamp(6)));
        let mut keep = |reading| keep_yaw_rate(&mut kept, &reading, FASTEST_TURN);
        assert_eq!(keep(reading(3, 0.1)), Err(Dropped::TimeBackwards));
        assert_eq!(keep(reading(999, f64::NAN)), Err(Dropped::Malformed));
        assert_eq!(keep(reading(999, 100.0)), Err(Dropped::Malformed));
    }
}
