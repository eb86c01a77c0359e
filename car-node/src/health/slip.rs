//! Events for slipping wheels: when a slip starts, and when it ends.

use synpf::{Stamp, Update};

use super::Thresholds;

/// A slip is reported after this long \[s\]. A start from standstill is over sooner.
const SLIP_TIME: f64 = 0.3;
/// The wheels grip when the slip is below this share of the threshold.
const GRIP_SHARE: f64 = 0.6;
/// A slip has ended when the wheels grip for this long \[s\].
const GRIP_TIME: f64 = 1.0;
/// Slip is not judged below this speed [m/s]: it is a share of a distance that is too short.
const SLOWEST: f64 = 1.0;

/// A slip starts or ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SlipEvent {
    /// The wheels slip.
    Started {
        /// Share of odometry's distance that the car did not drive.
        slip: f64,
    },
    /// They grip again.
    Ended {
        /// The slip of the largest magnitude.
        worst: f64,
        /// How long it lasted \[s\].
        duration: f64,
    },
}

/// A slip that has not ended.
#[derive(Debug, Clone, Copy)]
struct Slipping {
    since: Stamp,
    last: Stamp,
    worst: f64,
}

/// Makes events of the slip of each update.
#[derive(Debug, Default)]
pub struct SlipTracker {
    over_since: Option<Stamp>,
    slipping: Option<Slipping>,
}

impl SlipTracker {
    /// Judges an update.
    pub fn on_update(&mut self, update: &Update, thresholds: &Thresholds) -> Option<SlipEvent> {
        let (slip, stamp) = (update.slip, update.stamp);
        if slip.abs() > thresholds.slip && update.twist.linear_x.abs() > SLOWEST {
            self.over_since.get_or_insert(stamp);
        } else {
            self.over_since = None;
        }
        let lasting = self.over_since.filter(|since| stamp.since(*since) >= SLIP_TIME);
        match &mut self.slipping {
            None if lasting.is_some() => {
                self.slipping = Some(Slipping {
                    since: lasting.unwrap_or(stamp),
                    last: stamp,
                    worst: slip,
                });
                Some(SlipEvent::Started { slip })
            }
            None => None,
            Some(slipping) => {
                if slip.abs() > GRIP_SHARE * thresholds.slip {
                    slipping.last = stamp;
                }
                if slip.abs() > slipping.worst.abs() {
                    slipping.worst = slip;
                }
                let ended = (stamp.since(slipping.last) >= GRIP_TIME).then_some(SlipEvent::Ended {
                    worst: slipping.worst,
                    duration: slipping.last.since(slipping.since),
                });
                if ended.is_some() {
                    self.slipping = None;
                }
                ended
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::tests_support::good_update;

    /// Drives at 3 m/s, 40 scans a second, with this slip over time.
    fn drive(slip: impl Fn(f64) -> f64) -> Vec<SlipEvent> {
        let (mut tracker, thresholds) = (SlipTracker::default(), Thresholds::default());
        (0..400_u32)
            .filter_map(|scan| {
                let t = f64::from(scan) / 40.0;
                let mut update = good_update(Stamp(0).plus(t), u64::from(scan) + 1);
                update.twist.linear_x = 3.0;
                update.slip = slip(t);
                tracker.on_update(&update, &thresholds)
            })
            .collect()
    }

    #[test]
    fn a_slip_is_two_events_the_second_with_its_worst_value_and_its_length() {
        let events = drive(|t| {
            if (2.0..4.0).contains(&t) {
                -0.1 - 0.01 * t
            } else {
                0.02
            }
        });
        let [SlipEvent::Started { slip }, SlipEvent::Ended { worst, duration }] = events[..] else {
            panic!("{events:?}");
        };
        assert!(slip < -0.1);
        assert!((worst + 0.14).abs() < 0.001, "{worst}");
        assert!((duration - 1.975).abs() < 0.001, "{duration}");
    }

    #[test]
    fn a_short_slip_is_no_event_and_an_intermittent_one_is_one() {
        assert_eq!(drive(|t| if (2.0..2.25).contains(&t) { 0.3 } else { 0.0 }), []);
        let intermittent = drive(|t| if (t * 2.0).fract() < 0.7 { 0.2 } else { 0.0 });
        assert_eq!(
            intermittent.len(),
            1,
            "it starts once and has not ended: {intermittent:?}"
        );
    }
}
