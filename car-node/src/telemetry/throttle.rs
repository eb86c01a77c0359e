//! Sends less while the link is slow: what cannot get through in time only delays the rest. Pure: the caller brings the
//! time.

use std::collections::VecDeque;

use protocol::{LinkReport, Rates};
use synpf::Stamp;

/// Poses that arrive later than this mean a slow link [s]...
const SLOW: f64 = 0.25;
/// ...once that has lasted [s].
const SLOW_FOR: f64 = 2.0;
/// Where sending less has not helped for so long, the full-rate streams for the recorder stay on the car, too [s]: over a
/// link that cannot take them, they only keep what is live from coming through. The pit wall asks for them as it can.
const STILL_SLOW_FOR: f64 = 3.0;
/// Poses that arrive sooner than this mean that the link has recovered [s]...
const FAST: f64 = 0.1;
/// ...once that has lasted [s]...
const FAST_FOR: f64 = 5.0;
/// ...or longer, up to this, where the link was slow again as soon as everything was sent [s].
const FAST_FOR_AT_MOST: f64 = 80.0;
/// Slow again so soon means that it is sending everything that makes the link slow [s].
const AGAIN: f64 = 20.0;
/// A report counts for this long [s].
const KEEP: f64 = 3.0;
/// What is sent at most over a slow link.
const LOWERED: Rates = Rates {
    pose: 20.0,
    cloud: 2.0,
    scan: 1.0,
    health: 5.0,
    recorded: true,
};

/// What has changed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Change {
    /// The car sends less from now on.
    Lowered {
        /// From publishing a pose to its arrival [s].
        transit: f64,
        /// What is sent at most.
        rates: Rates,
    },
    /// The car sends what it was asked for.
    Restored,
}

/// Follows what pit walls say of the link.
#[derive(Debug, Default)]
pub struct Throttle {
    /// The last reports of all pit walls: when, and how late poses arrive [s].
    reports: VecDeque<(Stamp, f64)>,
    slow_since: Option<Stamp>,
    fast_since: Option<Stamp>,
    /// What is sent at most; None for all that was asked for.
    lowered: Option<Rates>,
    /// When everything was last sent again, and how long the link had to be fast for it [s].
    restored: Option<(Stamp, f64)>,
}

impl Throttle {
    /// Takes in a report that came at `now`. Of several pit walls the one that is reached best counts: if even that one
    /// is late, it is the car's own link that is slow.
    pub fn on_report(&mut self, now: Stamp, report: &LinkReport) -> Option<Change> {
        self.reports
            .push_back((now, f64::from(report.transit - report.uncertainty)));
        self.reports.retain(|(at, _)| now.since(*at) < KEEP);
        let best = self
            .reports
            .iter()
            .map(|(_, transit)| *transit)
            .fold(f64::INFINITY, f64::min);
        let lasts = |since: &mut Option<Stamp>, holds: bool, time: f64| {
            if !holds {
                *since = None;
                return false;
            }
            now.since(*since.get_or_insert(now)) >= time
        };
        let slow_for = if self.lowered.is_none() {
            SLOW_FOR
        } else {
            STILL_SLOW_FOR
        };
        let fast_for = self.restored.map_or(FAST_FOR, |(_, fast_for)| fast_for);
        let slow = lasts(&mut self.slow_since, best > SLOW, slow_for);
        let fast = lasts(&mut self.fast_since, best < FAST, fast_for);
        let lowered = match self.lowered {
            None if slow => LOWERED,
            Some(rates) if slow && rates.recorded => Rates {
                recorded: false,
                ..LOWERED
            },
            Some(_) if fast => {
                self.lowered = None;
                self.restored = Some((now, fast_for));
                return Some(Change::Restored);
            }
            _ => return None,
        };
        if self.lowered.is_none() {
            let again = self.restored.filter(|(at, _)| now.since(*at) < AGAIN);
            let fast_for = again.map_or(FAST_FOR, |(_, fast_for)| (2.0 * fast_for).min(FAST_FOR_AT_MOST));
            self.restored = Some((now, fast_for));
        }
        self.lowered = Some(lowered);
        self.slow_since = None;
        Some(Change::Lowered {
            transit: best,
            rates: lowered,
        })
    }

    /// What is sent when `wanted` was asked for.
    pub fn rates(&self, wanted: Rates) -> Rates {
        self.lowered.map_or(wanted, |most| Rates {
            pose: wanted.pose.min(most.pose),
            cloud: wanted.cloud.min(most.cloud),
            scan: wanted.scan.min(most.scan),
            health: wanted.health.min(most.health),
            recorded: wanted.recorded,
        })
    }

    /// True while the full-rate streams are kept and not sent, until somebody asks for them.
    pub fn parked(&self) -> bool {
        self.lowered.is_some_and(|most| !most.recorded)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::shared_state::DEFAULT_RATES;

    /// A report a second for so long, from pit walls that are reached after these times [s].
    fn report(throttle: &mut Throttle, from: u32, seconds: u32, transits: &[f32]) -> Vec<Change> {
        (from..from + seconds)
            .flat_map(|second| transits.iter().map(move |transit| (second, *transit)))
            .filter_map(|(second, transit)| {
                let report = LinkReport {
                    transit,
                    uncertainty: 0.01,
                    poses: 40,
                };
                throttle.on_report(Stamp(0).plus(f64::from(second)), &report)
            })
            .collect()
    }

    #[test]
    fn a_slow_link_gets_less_until_it_has_recovered() {
        let mut throttle = Throttle::default();
        assert_eq!(report(&mut throttle, 0, 10, &[0.01]), []);
        assert_eq!(throttle.rates(DEFAULT_RATES), DEFAULT_RATES);
        let changes = report(&mut throttle, 10, 10, &[0.8]);
        assert!(
            matches!(changes[..], [Change::Lowered { rates: first, .. }, Change::Lowered { rates: second, .. }]
                if first.recorded && !second.recorded),
            "{changes:?}"
        );
        let lowered = throttle.rates(DEFAULT_RATES);
        assert_eq!(
            (lowered.pose, lowered.cloud, lowered.recorded, throttle.parked()),
            (20.0, 2.0, true, true)
        );
        // What was asked to be less stays less.
        let quiet = Rates {
            pose: 5.0,
            ..DEFAULT_RATES
        };
        assert_eq!(throttle.rates(quiet), Rates { pose: 5.0, ..lowered });
        assert_eq!(report(&mut throttle, 20, 4, &[0.15]), [], "neither slow nor fast");
        assert_eq!(report(&mut throttle, 24, 12, &[0.02]), [Change::Restored]);
        assert_eq!(throttle.rates(DEFAULT_RATES), DEFAULT_RATES);
        assert!(!throttle.parked());
    }

    #[test]
    fn a_link_that_cannot_take_everything_is_tried_less_and_less_often() {
        let mut throttle = Throttle::default();
        let (mut now, mut tries) = (0, Vec::new());
        while now < 400 {
            // Slow while everything is sent, fast while it is not.
            let transit = if throttle.lowered.is_some() { 0.02 } else { 0.6 };
            if report(&mut throttle, now, 1, &[transit]) == [Change::Restored] {
                tries.push(now);
            }
            now += 1;
        }
        let pauses: Vec<_> = tries.windows(2).map(|pair| pair[1] - pair[0]).collect();
        assert!(pauses.is_sorted() && pauses.last() > Some(&60), "{tries:?}");
    }

    #[test]
    fn a_hiccup_and_a_far_viewer_change_nothing() {
        let mut throttle = Throttle::default();
        report(&mut throttle, 0, 3, &[0.01]);
        assert_eq!(report(&mut throttle, 3, 1, &[2.0]), []);
        assert_eq!(report(&mut throttle, 4, 20, &[0.01, 1.5]), []);
    }
}
