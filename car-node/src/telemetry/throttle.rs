//! The throttle: lowers the rates while the link is slow, because what arrives late delays everything else. Pure: the caller
//! gives the time.

use std::collections::VecDeque;

use protocol::{LinkReport, Rates};
use synpf::Stamp;

/// The link is slow when poses arrive later than this \[s\].
const SLOW: f64 = 0.25;
/// Rates are lowered when the link was slow for this long \[s\].
const SLOW_FOR: f64 = 2.0;
/// When lower rates have not helped for this long, the full-rate streams for the recorder stay on the car, too \[s\]. The pit
/// wall requests them later, at the pace of the link.
const STILL_SLOW_FOR: f64 = 3.0;
/// The link is fast when poses arrive sooner than this \[s\].
const FAST: f64 = 0.1;
/// Rates are restored when the link was fast for this long \[s\].
const FAST_FOR: f64 = 5.0;
/// That time doubles, up to this, each time the link becomes slow again after the rates were restored \[s\].
const FAST_FOR_AT_MOST: f64 = 80.0;
/// Slow again within this time means that the full rates are what slows the link \[s\].
const AGAIN: f64 = 20.0;
/// A report is valid for this long \[s\].
const KEEP: f64 = 3.0;
/// The highest rates on a slow link.
const LOWERED: Rates = Rates {
    pose: 20.0,
    cloud: 2.0,
    scan: 1.0,
    health: 5.0,
    recorded: true,
};

/// A change of the rates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Change {
    /// The rates are lowered.
    Lowered {
        /// From publishing a pose to its arrival \[s\].
        transit: f64,
        /// The highest rates.
        rates: Rates,
    },
    /// The requested rates are in force again.
    Restored,
}

/// Judges the link by the reports of the pit walls.
#[derive(Debug, Default)]
pub struct Throttle {
    /// The last reports of all pit walls: time of the report, and how late poses arrive \[s\].
    reports: VecDeque<(Stamp, f64)>,
    slow_since: Option<Stamp>,
    fast_since: Option<Stamp>,
    /// The highest rates; None without a limit.
    lowered: Option<Rates>,
    /// When the rates were last restored, and how long the link had to be fast before \[s\].
    restored: Option<(Stamp, f64)>,
}

impl Throttle {
    /// Evaluates a report that came at `now`. Of several pit walls the one with the fastest link counts: if even that one is
    /// late, the car's own link is slow.
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

    /// The rates in force when `wanted` is requested.
    pub fn rates(&self, wanted: Rates) -> Rates {
        self.lowered.map_or(wanted, |most| Rates {
            pose: wanted.pose.min(most.pose),
            cloud: wanted.cloud.min(most.cloud),
            scan: wanted.scan.min(most.scan),
            health: wanted.health.min(most.health),
            recorded: wanted.recorded,
        })
    }

    /// True while the full-rate streams are kept on the car until they are requested.
    pub fn parked(&self) -> bool {
        self.lowered.is_some_and(|most| !most.recorded)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::shared_state::DEFAULT_RATES;

    /// Reports once a second for `seconds`, from pit walls with these transit times \[s\].
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
    fn a_slow_link_gets_lower_rates_until_it_recovers() {
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
        // A requested rate below the limit stays as it is.
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
    fn a_link_that_is_slow_at_full_rates_is_retried_at_growing_intervals() {
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
    fn one_late_report_and_a_distant_pit_wall_change_nothing() {
        let mut throttle = Throttle::default();
        report(&mut throttle, 0, 3, &[0.01]);
        assert_eq!(report(&mut throttle, 3, 1, &[2.0]), []);
        assert_eq!(report(&mut throttle, 4, 20, &[0.01, 1.5]), []);
    }
}
