//! When the wheels slip, and when they grip again.

use synpf::{Stamp, Update};

use super::Thresholds;

/// The wheels grip again when the slip was below this share of the threshold...
const GRIP_SHARE: f64 = 0.6;
/// ...for this long [s].
const GRIP_TIME: f64 = 0.5;

/// What happened to the grip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SlipEvent {
    /// The wheels began to slip.
    Started {
        /// Share of odometry's distance that was not driven.
        slip: f64,
    },
    /// They grip again.
    Ended {
        /// The slip of the largest magnitude in between.
        worst: f64,
        /// How long it lasted [s].
        duration: f64,
    },
}

/// A stretch of slipping.
#[derive(Debug, Clone, Copy)]
struct Slipping {
    since: Stamp,
    last: Stamp,
    worst: f64,
}

/// Turns a noisy slip into events: it takes three scans to begin, and half a second of grip to end.
#[derive(Debug, Default)]
pub struct SlipTracker {
    scans_over: u32,
    slipping: Option<Slipping>,
}

impl SlipTracker {
    /// Takes in an update.
    pub fn on_update(&mut self, update: &Update, thresholds: &Thresholds) -> Option<SlipEvent> {
        let (slip, stamp) = (update.slip, update.stamp);
        self.scans_over = if slip.abs() > thresholds.slip {
            self.scans_over.saturating_add(1)
        } else {
            0
        };
        match &mut self.slipping {
            None if self.scans_over >= thresholds.bad_scans => {
                self.slipping = Some(Slipping {
                    since: stamp,
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
