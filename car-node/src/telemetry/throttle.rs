//! The throttle: lowers the rates while the link is slow, because what arrives late delays everything else. Pure: the caller
//! gives the time.

use std::collections::VecDeque;

use protocol::{LinkReport, Rates};
use synpf::Stamp;

/// The link is slow when poses arrive later than this \[s\].
const SLOW: f64 = 0.25;
/// Rates are lowered when the link was slow for this long \[s\].
const SLOW_FOR: f64 = 0.5;
/// Poses that arrive later than this take two steps at once \[s\].
const VERY_SLOW: f64 = 2.0 * SLOW;
/// The link is fast when poses arrive sooner than this \[s\].
const FAST: f64 = 0.12;
/// Rates are raised by one step when the link was fast for this long \[s\].
const FAST_FOR: f64 = 5.0;
/// That time doubles, up to this, each time the link becomes slow again after the rates were raised \[s\].
const FAST_FOR_AT_MOST: f64 = 80.0;
/// Slow again within this time means that the higher rates are what slows the link \[s\].
const AGAIN: f64 = 20.0;
/// A report is valid for this long \[s\]. Pit walls report every second, and four times as often while poses are late.
const KEEP: f64 = 1.25;

/// The highest rates on a slow link, step by step. The full-rate streams for the recorder stay on the car meanwhile. The pit wall
/// requests them later, at the pace of the link. Poses, health, events and answers always get through.
const STEPS: [Rates; 3] = [
    Rates {
        pose: 20.0,
        cloud: 2.0,
        scan: 1.0,
        health: 5.0,
        recorded: false,
    },
    Rates {
        pose: 15.0,
        cloud: 0.5,
        scan: 0.25,
        health: 4.0,
        recorded: false,
    },
    Rates {
        pose: 10.0,
        cloud: 0.0,
        scan: 0.0,
        health: 2.0,
        recorded: false,
    },
];

/// A change of the rates that an operator should know.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Change {
    /// The rates are lowered by one step.
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
#[derive(Debug)]
pub struct Throttle {
    /// The last reports of all pit walls: time of the report, and how late poses arrive \[s\].
    reports: VecDeque<(Stamp, f64)>,
    slow_since: Option<Stamp>,
    fast_since: Option<Stamp>,
    /// Steps of [`STEPS`] that were taken; 0 without a limit.
    step: usize,
    /// How late poses were when the last step was taken \[s\].
    late: f64,
    /// When the rates were last raised, unless they were lowered since.
    raised: Option<Stamp>,
    /// How long the link must be fast before the rates are raised \[s\].
    fast_for: f64,
}

impl Default for Throttle {
    fn default() -> Self {
        Self {
            reports: VecDeque::new(),
            slow_since: None,
            fast_since: None,
            step: 0,
            late: 0.0,
            raised: None,
            fast_for: FAST_FOR,
        }
    }
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
        // What waits already must arrive before a step has an effect.
        let slow = best > SLOW && (self.step == 0 || best >= self.late);
        let slow = lasts(&mut self.slow_since, slow, SLOW_FOR);
        let fast = lasts(&mut self.fast_since, best < FAST, self.fast_for);
        let change = if slow && self.step < STEPS.len() {
            let raised = self.raised.take();
            if raised.is_some_and(|at| now.since(at) < AGAIN) {
                self.fast_for = (2.0 * self.fast_for).min(FAST_FOR_AT_MOST);
            } else if raised.is_some() {
                self.fast_for = FAST_FOR;
            }
            let steps = if best > VERY_SLOW { 2 } else { 1 };
            self.step = (self.step + steps).min(STEPS.len());
            Some(Change::Lowered {
                transit: best,
                rates: STEPS[self.step - 1],
            })
        } else if fast && self.step > 0 {
            self.raised = Some(now);
            self.step -= 1;
            (self.step == 0).then_some(Change::Restored)
        } else {
            return None;
        };
        (self.slow_since, self.fast_since) = (None, None);
        self.late = best;
        change
    }

    fn limit(&self) -> Option<&'static Rates> {
        self.step.checked_sub(1).and_then(|step| STEPS.get(step))
    }

    /// The rates in force when `wanted` is requested.
    pub fn rates(&self, wanted: Rates) -> Rates {
        self.limit().map_or(wanted, |most| Rates {
            pose: wanted.pose.min(most.pose),
            cloud: wanted.cloud.min(most.cloud),
            scan: wanted.scan.min(most.scan),
            health: wanted.health.min(most.health),
            recorded: wanted.recorded,
        })
    }

    /// True while the full-rate streams are kept on the car until they are requested.
    pub fn parked(&self) -> bool {
        self.limit().is_some_and(|most| !most.recorded)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::shared_state::DEFAULT_RATES;

    #[test]
    fn while_poses_become_less_late_no_further_step_is_taken() {
        let mut throttle = Throttle::default();
        assert_eq!(report(&mut throttle, 0, 2, &[0.45]).len(), 1);
        for (second, transit) in [(2, 0.44), (3, 0.42), (4, 0.4), (5, 0.3)] {
            assert_eq!(report(&mut throttle, second, 1, &[transit]), []);
        }
    }

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
        let changes = report(&mut throttle, 10, 4, &[0.4]);
        assert!(
            matches!(changes[..], [Change::Lowered { rates, .. }] if !rates.recorded),
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
        assert_eq!(report(&mut throttle, 14, 4, &[0.15]), [], "neither slow nor fast");
        assert_eq!(report(&mut throttle, 18, 10, &[0.02]), [Change::Restored]);
        assert_eq!(throttle.rates(DEFAULT_RATES), DEFAULT_RATES);
        assert!(!throttle.parked());
    }

    #[test]
    fn on_the_slowest_link_only_poses_and_health_are_sent() {
        let mut throttle = Throttle::default();
        assert_eq!(
            report(&mut throttle, 0, 60, &[3.0]).len(),
            2,
            "two steps at once, then one"
        );
        let rates = throttle.rates(DEFAULT_RATES);
        assert_eq!(
            (rates.pose, rates.cloud, rates.scan, rates.health),
            (10.0, 0.0, 0.0, 2.0)
        );
        // It is raised step by step, and each step must hold.
        assert_eq!(report(&mut throttle, 60, 7, &[0.02]), []);
        assert!((throttle.rates(DEFAULT_RATES).pose - 15.0).abs() < 1e-6);
    }

    #[test]
    fn a_link_that_is_slow_at_full_rates_is_retried_at_growing_intervals() {
        let mut throttle = Throttle::default();
        let (mut now, mut tries) = (0, Vec::new());
        while now < 400 {
            // Slow while everything is sent, fast while it is not.
            let transit = if throttle.step > 0 { 0.02 } else { 0.6 };
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
