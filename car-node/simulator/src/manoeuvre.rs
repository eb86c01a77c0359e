//! Manoeuvres of a driver: racing, and turning round a car that points the wrong way or is stuck.

use std::time::Duration;

use crate::Controls;

/// What the driver is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Manoeuvre {
    /// Following the raceline.
    Racing,
    /// Coming to rest, because the car points the wrong way or does not move.
    Stopping,
    /// Going backwards with the wheel turned, until the given time.
    Reversing(Duration),
    /// Going forwards with the wheel turned, until the given time.
    Turning(Duration),
}

/// Beyond this heading error the car is turned round at walking speed \[rad\].
const LOST_HEADING: f64 = 1.4;
/// Below this heading error a turning manoeuvre ends \[rad\].
const FOUND_HEADING: f64 = 0.7;
/// Speed of manoeuvres \[m/s\].
const WALKING: f64 = 0.8;
/// Duration of one leg of a manoeuvre.
const LEG: Duration = Duration::from_millis(900);
/// A car that has not moved for this long is stuck.
const STUCK: Duration = Duration::from_millis(1500);

/// Chooses the manoeuvre, and gives the command of all but [`Manoeuvre::Racing`].
#[derive(Debug, Clone)]
pub(crate) struct ManoeuvrePlanner {
    manoeuvre: Manoeuvre,
    /// Since when the car has not moved although commanded to.
    stuck_since: Option<Duration>,
}

impl ManoeuvrePlanner {
    /// Racing.
    pub(crate) fn new() -> Self {
        Self {
            manoeuvre: Manoeuvre::Racing,
            stuck_since: None,
        }
    }

    /// What the driver is doing.
    pub(crate) fn manoeuvre(&self) -> Manoeuvre {
        self.manoeuvre
    }

    /// Chooses the manoeuvre for a car at `speed` \[m/s\] whose heading is `heading_error` off the line's \[rad\].
    pub(crate) fn update(&mut self, now: Duration, speed: f64, heading_error: f64) {
        let stuck = self.stuck_since.is_some_and(|since| now > since + STUCK);
        self.manoeuvre = match self.manoeuvre {
            Manoeuvre::Racing if heading_error.abs() > LOST_HEADING || stuck => Manoeuvre::Stopping,
            Manoeuvre::Stopping if speed.abs() < 0.2 => Manoeuvre::Reversing(now + LEG),
            Manoeuvre::Reversing(until) if now > until => Manoeuvre::Turning(now + LEG),
            Manoeuvre::Turning(until) if now > until || heading_error.abs() < FOUND_HEADING => {
                if heading_error.abs() < FOUND_HEADING {
                    Manoeuvre::Racing
                } else {
                    Manoeuvre::Reversing(now + LEG)
                }
            }
            same => same,
        };
        if self.manoeuvre != Manoeuvre::Racing {
            self.stuck_since = None;
        }
    }

    /// Notes whether the car moves, when it is commanded to drive at `commanded` \[m/s\].
    pub(crate) fn note_progress(&mut self, now: Duration, speed: f64, commanded: f64) {
        if commanded > 0.3 && speed.abs() < 0.1 {
            self.stuck_since.get_or_insert(now);
        } else {
            self.stuck_since = None;
        }
    }

    /// The command of a manoeuvre, or None while racing. Both legs turn the nose towards the line's heading.
    pub(crate) fn controls(&self, max_steering: f64, heading_error: f64) -> Option<Controls> {
        match self.manoeuvre {
            Manoeuvre::Racing => None,
            Manoeuvre::Stopping => Some(Controls::default()),
            Manoeuvre::Reversing(_) => Some(Controls {
                speed: -WALKING,
                steering: max_steering.copysign(heading_error),
            }),
            Manoeuvre::Turning(_) => Some(Controls {
                speed: WALKING,
                steering: -max_steering.copysign(heading_error),
            }),
        }
    }
}
