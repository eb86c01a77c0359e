//! Ground truth.

use maps::Pose;
use synpf::Stamp;

/// True poses over time.
#[derive(Debug, Default)]
pub struct Truth {
    /// `map_from_base_link` by stamp, strictly increasing.
    samples: Vec<(Stamp, Pose)>,
}

/// Across a longer gap the truth is too uncertain to compare an estimate with \[s\].
const LONGEST_GAP: f64 = 0.2;

/// Stamps in a text file may be rounded by this much \[s\].
const ROUNDING: f64 = 1e-6;

impl Truth {
    /// From samples in any order. Of two with the same stamp the first counts. Samples that are not finite are ignored.
    pub fn new(mut samples: Vec<(Stamp, Pose)>) -> Self {
        samples.retain(|(_, pose)| pose.is_finite());
        samples.sort_by_key(|(stamp, _)| *stamp);
        samples.dedup_by_key(|(stamp, _)| *stamp);
        Self { samples }
    }

    /// True without any sample.
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// The pose at `stamp`, interpolated; None outside the record and in its gaps.
    pub fn at(&self, stamp: Stamp) -> Option<Pose> {
        let next = self.samples.partition_point(|(sample, _)| *sample < stamp);
        let &(later, end) = self.samples.get(next)?;
        if later.since(stamp) < ROUNDING {
            return Some(end);
        }
        let (earlier, start) = *self.samples.get(next.checked_sub(1)?)?;
        let gap = later.since(earlier);
        (gap <= LONGEST_GAP).then(|| start.interpolate(end, stamp.since(earlier) / gap))
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
}
