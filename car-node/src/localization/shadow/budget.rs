//! Decides when there is not enough CPU for a shadow set. The shadow is dropped first; telemetry and the set in force stay.

use std::collections::VecDeque;

use synpf::Stamp;

/// The CPU is judged over this long \[s\].
const WINDOW: f64 = 2.0;
/// The filter is behind when more messages than this wait for it: about 0.1 s of a car's sensors.
const BEHIND: usize = 10;
/// An update that takes longer than this share of the time between scans is slow.
const SLOW: f64 = 0.6;
/// There is not enough CPU when the filter is behind or slow, or the shadow skips scans, at this share of the scans.
const TOO_MANY: f64 = 0.2;

/// The cost of a scan.
#[derive(Debug, Clone, Copy)]
pub(super) struct ScanCost {
    /// The scan's stamp.
    pub(super) stamp: Stamp,
    /// Time of the update in force \[s\].
    pub(super) taken: f64,
    /// Messages that waited for the filter.
    pub(super) queued: usize,
    /// Scans that the shadow skipped before this one.
    pub(super) skipped: u64,
}

/// The scans of the last seconds.
#[derive(Debug, Default)]
pub(super) struct Budget(VecDeque<ScanCost>);

impl Budget {
    /// Adds a scan. Returns a reason when there was not enough CPU for the whole window.
    pub(super) fn on_scan(&mut self, spent: &ScanCost) -> Option<String> {
        self.0.push_back(*spent);
        let first = self.0.front()?.stamp;
        let seconds = spent.stamp.since(first);
        if seconds < WINDOW {
            return None;
        }
        self.0.pop_front();
        let skipped: u64 = self.0.iter().map(|spent| spent.skipped).sum();
        let scans = self.0.len() as f64 + skipped as f64;
        let period = seconds / scans;
        let share = |count: usize| count as f64 / self.0.len() as f64;
        let slow = share(self.0.iter().filter(|spent| spent.taken > SLOW * period).count());
        let behind = share(self.0.iter().filter(|spent| spent.queued > BEHIND).count());
        let left_out = skipped as f64 / scans;
        let percent = |share: f64| share * 100.0;
        if behind > TOO_MANY {
            Some(format!(
                "not enough CPU: more than {BEHIND} messages waited for the filter at {:.0} % of the scans",
                percent(behind)
            ))
        } else if slow > TOO_MANY {
            Some(format!(
                "not enough CPU: {:.0} % of the updates took longer than {:.0} of the {:.0} ms between scans",
                percent(slow),
                SLOW * period * 1e3,
                period * 1e3
            ))
        } else if left_out > TOO_MANY {
            Some(format!(
                "not enough CPU: the shadow skipped {:.0} % of the scans",
                percent(left_out)
            ))
        } else {
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs ten seconds at 40 scans a second. Returns when the shadow ends, and the reason.
    fn drive(change: impl Fn(usize, &mut ScanCost)) -> Option<(f64, String)> {
        let mut budget = Budget::default();
        (0..400).find_map(|scan| {
            let t = scan as f64 / 40.0;
            let mut spent = ScanCost {
                stamp: Stamp(0).plus(t),
                taken: 0.002,
                queued: 1,
                skipped: 0,
            };
            change(scan, &mut spent);
            budget.on_scan(&spent).map(|evidence| (t, evidence))
        })
    }

    #[test]
    fn a_car_with_time_to_spare_keeps_its_shadow() {
        assert_eq!(drive(|_, _| ()), None);
        // One slow scan every second does not end it.
        let hiccup = drive(|scan, spent| {
            if scan % 40 < 3 {
                (spent.taken, spent.queued, spent.skipped) = (0.03, 20, 1);
            }
        });
        assert_eq!(hiccup, None);
    }

    #[test]
    fn a_short_cpu_ends_it_within_seconds_with_the_reason() {
        let reasons = [
            drive(|scan, spent| spent.queued = if scan > 100 { 20 } else { 0 }),
            drive(|scan, spent| spent.taken = if scan > 100 { 0.02 } else { 0.002 }),
            drive(|scan, spent| spent.skipped = u64::from(scan > 100)),
        ];
        for (ended, word) in reasons.iter().zip(["waited", "took longer", "skipped"]) {
            let (when, evidence) = ended.as_ref().expect("ends");
            assert!((2.5..4.6).contains(when), "{when} s: {evidence}");
            assert!(evidence.contains(word), "{evidence}");
        }
    }
}
