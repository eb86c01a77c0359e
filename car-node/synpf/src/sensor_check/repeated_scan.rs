//! Scans that repeat: the same readings under new stamps, from a scanner or a driver that hangs.

use localizer::Scan;

use super::DrivenSums;

/// Compares every scan with the last one that was new. The noise of a laser is a centimetre, its readings are in millimetres: a
/// live one repeats no scan of many beams.
#[derive(Debug, Clone, Default)]
pub(super) struct RepeatedScan {
    ranges: Vec<f32>,
    /// The sums when the scan came in first.
    driven: DrivenSums,
}

/// Fewer readings may repeat by chance.
const LEAST_READINGS: usize = 20;

/// A car that stands in front of a simulated laser without noise sees the same scan again. One that has moved by this does
/// not \[m\], \[rad\].
const MOVED: [f64; 2] = [0.02, 0.01];

impl RepeatedScan {
    /// Whether the scan repeats an earlier one although the car has moved since.
    pub(super) fn is_repeated(&mut self, scan: &Scan, driven: &DrivenSums) -> bool {
        let same = scan.ranges.len() == self.ranges.len()
            && scan
                .ranges
                .iter()
                .zip(&self.ranges)
                .all(|(new, old)| new.to_bits() == old.to_bits());
        if !same {
            self.ranges.clone_from(&scan.ranges);
            self.driven = *driven;
            return false;
        }
        let readings = scan
            .ranges
            .iter()
            .filter(|&&range| range.is_finite() && f64::from(range) < scan.range_max.max(0.1))
            .take(LEAST_READINGS);
        let moved = driven.since(&self.driven);
        readings.count() >= LEAST_READINGS && (moved.distance.abs() > MOVED[0] || moved.turn.abs() > MOVED[1])
    }
}
