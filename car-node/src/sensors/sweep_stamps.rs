//! Scans whose stamps are of their last beam, and not of their first as ROS has it.
//!
//! A scan cannot arrive before its sweep has ended. One that is there before half of its sweep after its stamp was stamped at the end.

use synpf::Stamp;

use crate::statistics::percentile;

/// Sweeps that are looked at last this long \[s\].
const SWEEPS: std::ops::RangeInclusive<f64> = 1e-3..=0.25;
/// So many of the scans must have come so early.
const MOST: f64 = 0.9;
/// Ages in sweeps that no scan can have. Older in the other direction is another clock.
const TOO_YOUNG: std::ops::Range<f64> = -0.5..0.5;

/// How late scans arrive after their stamps, and how long they take.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct EndStamps {
    /// Nine of ten scans come so early \[s\].
    pub(crate) age: f64,
    /// \[s\].
    pub(crate) sweep: f64,
}

impl EndStamps {
    /// Judges scans by how late each came after its stamp \[s\] and how long its sweep took \[s\]. None if their stamps are of the first
    /// beam, or cannot be judged.
    pub(crate) fn find(scans: &[[f64; 2]]) -> Option<Self> {
        let [_, sweep] = *scans.first()?;
        let ages: Vec<f64> = scans
            .iter()
            .filter(|[_, sweep]| SWEEPS.contains(sweep))
            .map(|[age, sweep]| age / sweep)
            .collect();
        let latest = percentile(&ages, MOST)?;
        (ages.len() == scans.len() && TOO_YOUNG.contains(&latest)).then_some(Self {
            age: latest * sweep,
            sweep,
        })
    }

    /// The same for people.
    pub(crate) fn text(&self, topic: &str) -> String {
        format!(
            "{topic}: scans arrive {:.1} ms after their stamps, and a sweep takes {:.1} ms: the stamps are taken to be of the last beam",
            self.age * 1e3,
            self.sweep * 1e3
        )
    }
}

/// Scans of a live car are judged by so many.
const SCANS: usize = 20;
/// A shorter sweep is not judged on a live car \[s\]: another clock would look the same, and the turns of scans and odometry tell those apart.
const LEAST_SWEEP: f64 = 0.025;

/// Finds such stamps while the car runs.
#[derive(Debug, Default)]
pub(crate) struct LiveSweepStamps {
    scans: Vec<[f64; 2]>,
    at_end: bool,
}

impl LiveSweepStamps {
    /// Takes in a scan's age when it came \[s\], and its sweep \[s\]. Returns what was found, once.
    pub(crate) fn learn(&mut self, age: f64, sweep: f64) -> Option<EndStamps> {
        if self.at_end || sweep < LEAST_SWEEP {
            return None;
        }
        self.scans.push([age, sweep]);
        if self.scans.len() < SCANS {
            return None;
        }
        let found = EndStamps::find(&std::mem::take(&mut self.scans));
        self.at_end = found.is_some();
        found
    }

    /// The stamp of the first beam.
    pub(crate) fn first_beam(&self, stamp: Stamp, sweep: f64) -> Stamp {
        if self.at_end { stamp.plus(-sweep) } else { stamp }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_of_the_last_beam_are_found() {
        let found = |age: f64, sweep: f64| EndStamps::find(&[[age, sweep]; 30]).is_some();
        assert!(found(0.002, 0.01875) && found(0.002, 0.09) && !found(0.021, 0.01875) && !found(0.092, 0.09));
        // No sweep, and stamps of another clock.
        assert!(!found(0.002, 0.0) && !found(-3.0, 0.09));
        assert!(EndStamps::find(&[]).is_none());
    }

    #[test]
    fn a_busy_start_hides_nothing_for_good() {
        let mut live = LiveSweepStamps::default();
        let late = (0..20).filter_map(|_| live.learn(0.2, 0.09)).count();
        let found = (0..60).filter_map(|_| live.learn(0.003, 0.09)).count();
        assert_eq!((late, found), (0, 1));
        assert_eq!(live.first_beam(Stamp(1_000_000_000), 0.09), Stamp(910_000_000));
    }
}
