//! Limits what one car may send, so that a car that floods takes nothing from the others. Pure: the caller passes the time.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use protocol::CarName;

/// Most messages a second. A car at full telemetry sends 300.
const MESSAGES: f64 = 3000.0;
/// Most bytes a second. A car at full telemetry sends 150 000.
const BYTES: f64 = 20e6;
/// What may come at once, as a time at the limit \[s\]: what waited in the queues of a link that was down.
const BURST: f64 = 4.0;
/// How long a car is muted that sends more.
const MUTED: Duration = Duration::from_secs(5);
/// Most cars that are counted one by one.
const MOST: usize = 400;

/// What every car may still send.
#[derive(Debug, Default)]
pub(super) struct FloodLimit {
    cars: BTreeMap<CarName, Allowance>,
    reports: Vec<Flood>,
}

#[derive(Debug)]
struct Allowance {
    messages: f64,
    bytes: f64,
    at: Instant,
    muted_until: Option<Instant>,
    dropped: u64,
}

/// A car that is muted because it floods, or that is heard again.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Flood {
    /// The car.
    pub(crate) car: CarName,
    /// What happened, for the operator.
    pub(crate) text: String,
}

impl FloodLimit {
    /// Counts a message of `bytes` that arrived at `now`. False when it is to be dropped.
    pub(super) fn admit(&mut self, car: &CarName, bytes: usize, now: Instant) -> bool {
        if !self.cars.contains_key(car) && self.cars.len() >= MOST {
            // Whoever was silent for long has the full allowance again, and need not be remembered.
            let idle = Duration::from_secs_f64(BURST).max(MUTED);
            self.cars.retain(|_, car| now - car.at < idle);
            if self.cars.len() >= MOST {
                return false;
            }
        }
        let allowance = self.cars.entry(car.clone()).or_insert(Allowance {
            messages: MESSAGES * BURST,
            bytes: BYTES * BURST,
            at: now,
            muted_until: None,
            dropped: 0,
        });
        let passed = (now - allowance.at).as_secs_f64();
        allowance.at = now;
        allowance.messages = (allowance.messages + MESSAGES * passed).min(MESSAGES * BURST);
        allowance.bytes = (allowance.bytes + BYTES * passed).min(BYTES * BURST);
        if let Some(until) = allowance.muted_until {
            if now < until {
                allowance.dropped += 1;
                return false;
            }
            allowance.muted_until = None;
            self.reports.push(Flood {
                car: car.clone(),
                text: format!("heard again; {} messages were ignored", allowance.dropped),
            });
        }
        allowance.messages -= 1.0;
        allowance.bytes -= bytes as f64;
        if allowance.messages >= 0.0 && allowance.bytes >= 0.0 {
            return true;
        }
        let what = if allowance.messages < 0.0 {
            format!("more than {MESSAGES} messages a second")
        } else {
            format!("more than {:.0} MB a second", BYTES / 1e6)
        };
        allowance.muted_until = Some(now + MUTED);
        allowance.dropped = 1;
        self.reports.push(Flood {
            car: car.clone(),
            text: format!("floods: {what}; muted for {} s", MUTED.as_secs()),
        });
        false
    }

    /// What has happened since the last call.
    pub(super) fn reports(&mut self) -> Vec<Flood> {
        std::mem::take(&mut self.reports)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> CarName {
        text.parse().expect("a name")
    }

    #[test]
    fn a_flood_is_muted_and_named_and_others_lose_nothing() {
        let mut limit = FloodLimit::default();
        let start = Instant::now();
        let (mut flooding, mut good) = (0, 0);
        // Ten seconds: 20 000 messages a second of one car, 300 of the other.
        for n in 0..200_000_u32 {
            let now = start + Duration::from_micros(u64::from(n) * 50);
            flooding += usize::from(limit.admit(&name("mallory"), 200, now));
            if n % 67 == 0 {
                good += 1;
                assert!(limit.admit(&name("car-1"), 500, now));
            }
        }
        assert!(good > 2900);
        assert!(flooding < 50_000, "{flooding}");
        let reports = limit.reports();
        assert!(reports.iter().all(|flood| flood.car == name("mallory")));
        assert!(
            reports[0].text.contains("more than 3000 messages a second"),
            "{reports:?}"
        );
        // Once quiet, the car is heard again.
        assert!(limit.admit(&name("mallory"), 200, start + Duration::from_secs(30)));
    }

    #[test]
    fn large_messages_count_by_their_size() {
        let mut limit = FloodLimit::default();
        let now = Instant::now();
        let admitted = (0..100)
            .filter(|_| limit.admit(&name("mallory"), 16_000_000, now))
            .count();
        assert_eq!(admitted, 5);
        assert!(limit.reports()[0].text.contains("20 MB a second"));
    }

    #[test]
    fn what_waited_on_a_dead_link_is_no_flood() {
        let mut limit = FloodLimit::default();
        let now = Instant::now();
        assert!((0..10_000).all(|_| limit.admit(&name("car-1"), 500, now)));
    }

    #[test]
    fn invented_names_take_no_memory() {
        let mut limit = FloodLimit::default();
        let now = Instant::now();
        let admitted = (0..10_000)
            .filter(|n| limit.admit(&name(&format!("m{n}")), 100, now))
            .count();
        assert_eq!((admitted, limit.cars.len()), (MOST, MOST));
    }
}
