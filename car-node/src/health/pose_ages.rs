//! How old poses are when they are ready.

use std::collections::VecDeque;

use synpf::Stamp;

use crate::statistics::percentile;

/// Ages are summarized over this long \[s\].
const WINDOW: f64 = 1.0;

/// The ages of the poses of the last second.
#[derive(Debug, Default)]
pub(super) struct PoseAges {
    /// When each pose was ready, and its age then \[s\].
    ages: VecDeque<(Stamp, f64)>,
}

impl PoseAges {
    /// Adds a pose that is true at `stamp` and was ready at `now`.
    pub(super) fn add(&mut self, stamp: Stamp, now: Stamp) {
        self.ages.push_back((now, now.since(stamp)));
        self.ages.retain(|(ready, _)| now.since(*ready) <= WINDOW);
    }

    /// Median and 99th percentile \[s\]; 0 before the first pose.
    pub(super) fn percentiles(&self) -> [f64; 2] {
        let ages: Vec<f64> = self.ages.iter().map(|(_, age)| *age).collect();
        [0.5, 0.99].map(|share| percentile(&ages, share).unwrap_or_default())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_of_more_than_a_second_ago_do_not_count() {
        let mut ages = PoseAges::default();
        assert!(ages.percentiles().iter().all(|age| *age == 0.0));
        let start = Stamp(0);
        ages.add(start, start.plus(0.5));
        assert!(ages.percentiles().iter().all(|age| (age - 0.5).abs() < 1e-9));
        for scan in 0..40 {
            let stamp = start.plus(1.0 + 0.025 * f64::from(scan));
            ages.add(stamp, stamp.plus(0.02));
        }
        for age in ages.percentiles() {
            assert!((age - 0.02).abs() < 1e-6, "{age}");
        }
    }
}
