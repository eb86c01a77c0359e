//! Ground truth.

use std::collections::BTreeMap;

use maps::Pose;
use synpf::Stamp;

/// True poses over time.
#[derive(Debug, Default)]
pub struct Truth {
    /// `map_from_base_link` by stamp, strictly increasing.
    samples: Vec<(Stamp, Pose)>,
    /// Gaps up to this length are interpolated \[s\].
    longest_gap: f64,
    /// When scans were measured whose stamps are wrong, by those stamps.
    measured: BTreeMap<Stamp, Stamp>,
}

/// Across a longer gap the truth is too uncertain to compare an estimate with \[s\].
const LONGEST_GAP: f64 = 0.2;

/// Stamps in a text file may be rounded by this much \[s\].
const ROUNDING: f64 = 1e-6;

impl Truth {
    /// From samples in any order. Of two with the same stamp the first counts. Samples that are not finite are ignored.
    pub fn new(samples: Vec<(Stamp, Pose)>) -> Self {
        Self::with_gaps(samples, LONGEST_GAP)
    }

    /// The same, with gaps up to `longest_gap` \[s\] that are interpolated.
    pub fn with_gaps(mut samples: Vec<(Stamp, Pose)>, longest_gap: f64) -> Self {
        samples.retain(|(_, pose)| pose.is_finite());
        samples.sort_by_key(|(stamp, _)| *stamp);
        samples.dedup_by_key(|(stamp, _)| *stamp);
        Self {
            samples,
            longest_gap,
            measured: BTreeMap::new(),
        }
    }

    /// The same, where some scans have wrong stamps: `measured` is when they were measured, by those stamps.
    #[must_use]
    pub fn with_measured(self, measured: BTreeMap<Stamp, Stamp>) -> Self {
        Self { measured, ..self }
    }

    /// The first pose.
    pub fn first(&self) -> Option<Pose> {
        self.samples.first().map(|(_, pose)| *pose)
    }

    /// True without any sample.
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// The pose at `stamp`, interpolated; None outside the record and in its gaps.
    pub fn at(&self, stamp: Stamp) -> Option<Pose> {
        let stamp = self.measured.get(&stamp).copied().unwrap_or(stamp);
        let next = self.samples.partition_point(|(sample, _)| *sample < stamp);
        let &(later, end) = self.samples.get(next)?;
        if later.since(stamp) < ROUNDING {
            return Some(end);
        }
        let (earlier, start) = *self.samples.get(next.checked_sub(1)?)?;
        let gap = later.since(earlier);
        (gap <= self.longest_gap).then(|| start.interpolate(end, stamp.since(earlier) / gap))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interpolates_between_samples_and_nowhere_else() {
        let second = Stamp(1_000_000_000);
        let truth = Truth::new(vec![
            (second.plus(0.1), Pose::new(1.0, 0.0, 0.2)),
            (second, Pose::new(0.0, 0.0, 0.2)),
            (second.plus(5.0), Pose::new(9.0, 0.0, 0.2)),
            (second.plus(0.05), Pose::new(f64::NAN, 0.0, 0.2)),
        ]);
        let half = truth.at(second.plus(0.05)).expect("between samples");
        assert!(half.distance(Pose::new(0.5, 0.0, 0.2)) < 1e-9);
        assert_eq!(truth.at(second), Some(Pose::new(0.0, 0.0, 0.2)));
        assert_eq!(truth.at(second.plus(5.0)), Some(Pose::new(9.0, 0.0, 0.2)));
        assert_eq!(truth.at(second.plus(-0.01)), None);
        assert_eq!(truth.at(second.plus(1.0)), None, "in the gap");
        assert_eq!(truth.at(second.plus(5.01)), None);
    }

    #[test]
    fn a_scan_with_a_wrong_stamp_is_compared_with_when_it_was_measured() {
        let second = Stamp(1_000_000_000);
        let samples = vec![
            (second, Pose::IDENTITY),
            (second.plus(0.4), Pose::new(4.0, 0.0, 0.0)),
        ];
        let late = second.plus(0.3);
        let truth = Truth::with_gaps(samples, 0.5).with_measured([(late, second.plus(0.1))].into());
        let x = |stamp| truth.at(stamp).expect("known").x;
        assert!((x(late) - 1.0).abs() < 1e-9);
        assert!((x(second.plus(0.2)) - 2.0).abs() < 1e-9);
    }
}
