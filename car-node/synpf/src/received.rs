//! Odometry and yaw rates as they arrive: what is possible, and how much is kept.

use std::collections::VecDeque;

use localizer::{Dropped, Odometry, YawRate};

/// Longest that odometry is carried on beyond its last message \[s\]; a scan later than that is dropped.
pub(crate) const CARRY: f64 = 0.25;

/// Messages that are kept, as many as a late scan or a localizer that takes over can need: 2 s at 200 Hz.
pub(crate) const KEPT: usize = 400;

/// Farther from the origin no car drives \[m\].
const FARTHEST: f64 = 1e7;

/// Faster [m/s] is no car of this kind: a broken driver, and of no use to a filter.
const FASTEST: f64 = 30.0;

/// A faster turn [rad/s] is none. In deg/s a turn has up to 57 times its number.
const FASTEST_TURN: f64 = 1000.0;

/// Whether a car can have this position and twist. The heading is not judged: some drivers never set an orientation.
pub(crate) fn is_possible(odometry: &Odometry) -> bool {
    let sane = |v: f64, limit: f64| v.is_finite() && v.abs() < limit;
    let (pose, twist) = (odometry.pose, odometry.twist);
    [pose.x, pose.y].iter().all(|&v| sane(v, FARTHEST))
        && [twist.linear_x, twist.linear_y].iter().all(|&v| sane(v, FASTEST))
        && sane(twist.angular, FASTEST_TURN)
}

/// Adds a reading to those that are kept, and forgets the oldest.
pub(crate) fn keep_yaw_rate(kept: &mut VecDeque<YawRate>, yaw_rate: &YawRate) -> Result<(), Dropped> {
    if !(yaw_rate.rate.is_finite() && yaw_rate.rate.abs() < FASTEST_TURN) {
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
