//! Sectors of a track and the ideal lap.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::LapTrace;

/// The borders between the sectors of a track, besides the start line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Sectors(Vec<f64>);

impl Sectors {
    /// Most sectors.
    pub const MAX: usize = 20;
    /// Shortest sector \[m\].
    pub const SHORTEST: f64 = 0.5;

    /// `count` sectors of equal length on a lap of `length` \[m\].
    pub fn equal(count: usize, length: f64) -> Self {
        Self((1..count).map(|i| length * i as f64 / count as f64).collect())
    }

    /// Sectors with borders at these arc lengths of a lap of `length` \[m\], or what is wrong with them.
    pub fn new(mut borders: Vec<f64>, length: f64) -> Result<Self, String> {
        if let Some(bad) = borders.iter().find(|s| !(0.0..=length).contains(*s)) {
            return Err(format!("border {bad} m is not on a lap of {length:.2} m"));
        }
        if borders.len() >= Self::MAX {
            return Err(format!("{} sectors exceed {}", borders.len() + 1, Self::MAX));
        }
        borders.sort_by(f64::total_cmp);
        let sectors = Self(borders);
        let short = sectors
            .spans(length)
            .find(|[from, to]| to - from < Self::SHORTEST);
        match short {
            Some([from, to]) => {
                let least = Self::SHORTEST;
                Err(format!(
                    "the sector from {from:.2} to {to:.2} m is shorter than {least} m"
                ))
            }
            None => Ok(sectors),
        }
    }

    /// The borders \[m\].
    pub fn borders(&self) -> &[f64] {
        &self.0
    }

    /// Begin and end of each sector of a lap of `length` \[m\].
    pub fn spans(&self, length: f64) -> impl Iterator<Item = [f64; 2]> + '_ {
        let begins = std::iter::once(0.0).chain(self.0.iter().copied());
        let ends = self.0.iter().copied().chain([length]);
        begins.zip(ends).map(|(from, to)| [from, to])
    }

    /// Time of each sector of a lap \[s\]; None where the lap was not driven.
    pub fn times(&self, lap: &LapTrace) -> Vec<Option<f64>> {
        self.spans(lap.line.length)
            .map(|[from, to]| lap.time_between(from, to))
            .collect()
    }
}

/// The best time of each sector among the laps that count, and their sum \[s\]. None when no lap counts.
pub fn ideal_lap<'a>(
    sectors: &Sectors,
    laps: impl IntoIterator<Item = &'a Arc<LapTrace>>,
) -> Option<(Vec<f64>, f64)> {
    let mut best: Option<Vec<f64>> = None;
    for lap in laps.into_iter().filter(|lap| lap.counts()) {
        let Some(times) = sectors.times(lap).into_iter().collect::<Option<Vec<f64>>>() else {
            continue;
        };
        best = Some(match best {
            Some(best) => best.iter().zip(&times).map(|(a, b)| a.min(*b)).collect(),
            None => times,
        });
    }
    best.map(|best| {
        let sum = best.iter().sum();
        (best, sum)
    })
}

#[cfg(test)]
mod tests {
    use super::super::lap_book::tests::drive;
    use super::*;
    use std::f64::consts::TAU;

    const LENGTH: f64 = 3.0 * TAU;

    #[test]
    fn the_ideal_lap_has_the_best_of_every_sector() {
        // One lap is slow in its first half, the other in its second.
        let book = drive(2, |lap, s| {
            if (lap == 1) == (s < LENGTH / 2.0) {
                3.0
            } else {
                4.0
            }
        });
        let sectors = Sectors::equal(2, LENGTH);
        let laps: Vec<_> = book.laps().cloned().collect();
        let (best, sum) = ideal_lap(&sectors, &laps).expect("laps");
        assert!((sum - LENGTH / 4.0).abs() < 0.02, "{best:?}");
        for lap in laps.iter().filter(|lap| lap.counts()) {
            let times: f64 = sectors.times(lap).into_iter().flatten().sum();
            assert!((times - lap.time_s.expect("known")).abs() < 0.02);
            assert!(sum < times);
        }
        assert!(ideal_lap(&sectors, &[]).is_none());
    }

    #[test]
    fn borders_lie_on_the_lap_and_apart() {
        assert_eq!(Sectors::new(vec![6.0, 3.0], 9.0).map(|s| s.0), Ok(vec![3.0, 6.0]));
        for (borders, fault) in [
            (vec![10.0], "border 10 m is not on a lap of 9.00 m"),
            (vec![f64::NAN], "border NaN m is not on a lap"),
            (vec![3.0, 3.1], "from 3.00 to 3.10 m is shorter"),
            (vec![0.1], "from 0.00 to 0.10 m is shorter"),
            ((0..25).map(f64::from).collect(), "not on a lap"),
        ] {
            let error = Sectors::new(borders, 9.0).expect_err("a fault");
            assert!(error.contains(fault), "{error}");
        }
    }
}
