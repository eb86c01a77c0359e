//! Limits how many commands one sender may give.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// Commands a second. An operator who holds a key down sends fewer.
const RATE: f64 = 20.0;
/// Commands at once.
const BURST: f64 = 60.0;
/// Most senders that are counted one by one.
const MOST: usize = 64;
/// A flood is reported again after this time.
const REPORT: Duration = Duration::from_secs(10);

/// What every sender may still send.
#[derive(Debug, Default)]
pub(super) struct CommandLimit {
    senders: BTreeMap<String, Sender>,
}

#[derive(Debug)]
struct Sender {
    allowed: f64,
    at: Instant,
    reported: Option<Instant>,
}

/// A command beyond the limit.
#[derive(Debug, PartialEq)]
pub(super) struct TooMany {
    /// The limit \[1/s\].
    pub(super) rate: f64,
    /// True when it is time to report the flood.
    pub(super) first: bool,
}

impl CommandLimit {
    /// Counts a command of `who` at `now`.
    pub(super) fn take(&mut self, who: &str, now: Instant) -> Result<(), TooMany> {
        if !self.senders.contains_key(who) && self.senders.len() >= MOST {
            // Whoever has been silent for long has the full burst again, and need not be remembered.
            self.senders.retain(|_, sender| {
                sender.allowed_at(now) < BURST || sender.reported.is_some_and(|at| now - at < REPORT)
            });
        }
        // Names are free to invent: the ones beyond the limit share one count.
        let who = if self.senders.contains_key(who) || self.senders.len() < MOST {
            who
        } else {
            ""
        };
        let sender = self.senders.entry(who.to_owned()).or_insert(Sender {
            allowed: BURST,
            at: now,
            reported: None,
        });
        sender.allowed = sender.allowed_at(now);
        sender.at = now;
        if sender.allowed >= 1.0 {
            sender.allowed -= 1.0;
            return Ok(());
        }
        let first = sender.reported.is_none_or(|at| now - at >= REPORT);
        if first {
            sender.reported = Some(now);
        }
        Err(TooMany { rate: RATE, first })
    }
}

impl Sender {
    fn allowed_at(&self, now: Instant) -> f64 {
        (self.allowed + RATE * (now - self.at).as_secs_f64()).min(BURST)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_reported_once_and_others_are_served() {
        let mut limit = CommandLimit::default();
        let start = Instant::now();
        let mut served = 0;
        let mut reports = 0;
        for n in 0..2000 {
            match limit.take("mallory", start + Duration::from_millis(n)) {
                Ok(()) => served += 1,
                Err(too_many) => reports += usize::from(too_many.first),
            }
            if n % 100 == 0 {
                assert_eq!(limit.take("ana", start + Duration::from_millis(n)), Ok(()));
            }
        }
        assert!((95..=105).contains(&served), "{served}");
        assert_eq!(reports, 1);
    }

    #[test]
    fn invented_names_take_no_memory() {
        let mut limit = CommandLimit::default();
        let now = Instant::now();
        let served = (0..10_000)
            .filter(|n| limit.take(&format!("m{n}"), now).is_ok())
            .count();
        assert!(limit.senders.len() <= MOST + 1);
        assert!(served < 200, "{served}");
    }
}
