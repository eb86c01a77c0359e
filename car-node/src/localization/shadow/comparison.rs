//! Compares two sets over the same scans.

use std::collections::VecDeque;

use maps::{Pose, wrap_angle};
use protocol::{Comparison, Fitness, SetRef};
use synpf::{Stamp, Update};

use crate::telemetry::counters::Spread;
use crate::wire;

/// Length of the window that is compared \[s\]: about a lap of a small track.
const LENGTH: f64 = 10.0;

/// The results of one set for a scan.
#[derive(Debug, Clone, Copy)]
pub(super) struct ScanOutcome {
    stamp: Stamp,
    pose: Pose,
    alignment: f64,
    residual: f64,
    innovation: f64,
    spread: [f64; 2],
    /// Time taken \[s\].
    taken: f64,
}

impl ScanOutcome {
    pub(super) fn new(update: &Update, taken: f64) -> Self {
        Self {
            stamp: update.stamp,
            pose: update.pose,
            alignment: update.alignment,
            residual: update.residual,
            innovation: update.innovation[0],
            spread: update.spread,
            taken,
        }
    }
}

/// The scans of the last seconds.
#[derive(Debug, Default)]
pub(super) struct ComparisonWindow {
    set: Option<SetRef>,
    /// The results of the set in force, and those of the shadow set.
    scans: VecDeque<[ScanOutcome; 2]>,
    skipped: VecDeque<(Stamp, u64)>,
}

impl ComparisonWindow {
    /// Adds a scan. The window is cleared when the set in force changes.
    pub(super) fn push(&mut self, set: &SetRef, force: ScanOutcome, shadow: ScanOutcome) {
        if self.set.as_ref() != Some(set) {
            self.set = Some(set.clone());
            self.scans.clear();
        }
        let now = force.stamp;
        self.scans.push_back([force, shadow]);
        let old = |stamp: Stamp| now.since(stamp) > LENGTH;
        while self.scans.front().is_some_and(|[force, _]| old(force.stamp)) {
            self.scans.pop_front();
        }
        while self.skipped.front().is_some_and(|(stamp, _)| old(*stamp)) {
            self.skipped.pop_front();
        }
    }

    /// Counts scans that the shadow skipped before `stamp`.
    pub(super) fn skip(&mut self, stamp: Stamp, count: u64) {
        if count > 0 {
            self.skipped.push_back((stamp, count));
        }
    }

    /// The comparison; None before the first scan.
    pub(super) fn comparison(&self) -> Option<Comparison> {
        let (first, last) = (self.scans.front()?[0].stamp, self.scans.back()?[0].stamp);
        let all = |of: fn(&[ScanOutcome; 2]) -> f64| self.scans.iter().map(of);
        let count = self.scans.len() as f64;
        let mean = |of: fn(&[ScanOutcome; 2]) -> f64| all(of).sum::<f64>() / count;
        let share = |of: fn(&[ScanOutcome; 2]) -> bool| {
            self.scans.iter().filter(|pair| of(pair)).count() as f64 / count
        };
        let distance: fn(&[ScanOutcome; 2]) -> f64 = |[force, shadow]| force.pose.distance(shadow.pose);
        Some(Comparison {
            in_force: self.set.clone()?,
            window: wire::finite(last.since(first)),
            scans: u32::try_from(self.scans.len()).unwrap_or(u32::MAX),
            skipped: self
                .skipped
                .iter()
                .filter(|(stamp, _)| *stamp > first)
                .map(|(_, count)| u32::try_from(*count).unwrap_or(u32::MAX))
                .fold(0, u32::saturating_add),
            force: fitness(&self.scans, 0),
            shadow: fitness(&self.scans, 1),
            distance: wire::finite(mean(distance)),
            distance_max: wire::finite(all(distance).fold(0.0, f64::max)),
            angle: wire::finite(mean(|[force, shadow]| {
                wrap_angle(force.pose.heading - shadow.pose.heading).abs()
            })),
            force_better: wire::share(share(|[force, shadow]| {
                shadow.residual - force.residual > Comparison::MARGIN
            })),
            shadow_better: wire::share(share(|[force, shadow]| {
                force.residual - shadow.residual > Comparison::MARGIN
            })),
        })
    }
}

/// The results of the set in force (0) or of the shadow set (1).
fn fitness(scans: &VecDeque<[ScanOutcome; 2]>, which: usize) -> Fitness {
    let count = scans.len().max(1) as f64;
    let mean = |of: fn(&ScanOutcome) -> f64| scans.iter().map(|pair| of(&pair[which])).sum::<f64>() / count;
    let times: Vec<f64> = scans.iter().map(|pair| pair[which].taken).collect();
    Fitness {
        alignment: wire::share(mean(|judged| judged.alignment)),
        residual: wire::finite(mean(|judged| judged.residual)),
        innovation: wire::finite(mean(|judged| judged.innovation)),
        spread_along: wire::finite(mean(|judged| judged.spread[0])),
        spread_across: wire::finite(mean(|judged| judged.spread[1])),
        update_us: wire::latency(Spread::of(&times)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::tests_support::good_update;

    fn set(revision: u64) -> SetRef {
        SetRef {
            name: "hq".into(),
            revision,
        }
    }

    /// A scan at `t` with these residuals in force and in the shadow, whose poses are 0.1 m apart.
    fn scan(t: f64, residuals: [f64; 2]) -> [ScanOutcome; 2] {
        [0, 1].map(|which| {
            let mut update = good_update(Stamp(0).plus(t), 1);
            update.residual = residuals[which];
            update.pose = Pose::new(0.1 * which as f64, 0.0, 0.02 * which as f64);
            ScanOutcome::new(&update, 0.001 * (1 + which) as f64)
        })
    }

    #[test]
    fn the_better_set_is_told_by_its_share_of_the_scans() {
        let mut window = ComparisonWindow::default();
        assert_eq!(window.comparison(), None);
        for i in 0..40 {
            // In force: better on every fourth, equal on every fourth, worse on half.
            let residuals = match i % 4 {
                0 => [0.03, 0.05],
                1 => [0.05, 0.051],
                _ => [0.06, 0.05],
            };
            let [force, shadow] = scan(f64::from(i) / 40.0, residuals);
            window.push(&set(1), force, shadow);
        }
        let told = window.comparison().expect("scans");
        assert_eq!((told.scans, told.skipped), (40, 0));
        assert!((told.force_better - 0.25).abs() < 1e-6 && (told.shadow_better - 0.5).abs() < 1e-6);
        assert!((told.distance - 0.1).abs() < 1e-6 && (told.angle - 0.02).abs() < 1e-6);
        assert!((told.shadow.update_us.p50 - 2000.0).abs() < 0.1);
        assert!((told.force.residual - 0.05).abs() < 1e-6, "{told:?}");
    }

    #[test]
    fn old_scans_and_another_set_are_forgotten() {
        let mut window = ComparisonWindow::default();
        for i in 0..600 {
            let [force, shadow] = scan(f64::from(i) / 40.0, [0.05; 2]);
            window.skip(force.stamp, u64::from(i % 40 == 20));
            window.push(&set(1), force, shadow);
        }
        let told = window.comparison().expect("scans");
        assert_eq!((told.scans, told.skipped), (401, 10));
        let [force, shadow] = scan(15.0, [0.05; 2]);
        window.push(&set(2), force, shadow);
        let told = window.comparison().expect("scans");
        assert_eq!((told.scans, told.in_force.revision, told.skipped), (1, 2, 0));
    }
}
