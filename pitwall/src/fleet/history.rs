//! A car's health over the last minutes, and at each place of the track when the car was last there.

use std::collections::VecDeque;

use protocol::{Health, State};
use serde::Serialize;

/// The last two minutes, twice a second.
#[derive(Debug, Clone, Default)]
pub(crate) struct HealthHistory(VecDeque<HealthSample>);

/// A car's health at one sample.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct HealthSample {
    /// When it arrived, by the laptop's clock \[unix ns\].
    pub at: i64,
    /// The state.
    pub state: State,
    /// Alignment, in `[0, 1]`.
    pub alignment: f32,
    /// Slip.
    pub slip: f32,
    /// Standard deviation along the track \[m\].
    pub spread_along: f32,
    /// Standard deviation across the track \[m\].
    pub spread_across: f32,
}

impl HealthSample {
    fn new(at: i64, health: &Health) -> Option<Self> {
        let metrics = health.metrics?;
        Some(Self {
            at,
            state: health.state,
            alignment: metrics.alignment,
            slip: metrics.slip,
            spread_along: metrics.spread_along,
            spread_across: metrics.spread_across,
        })
    }
}

impl HealthHistory {
    /// Sample period \[ns\].
    const EVERY: i64 = 500_000_000;
    /// Maximum number of samples.
    const MAX: usize = 240;

    pub(crate) fn add(&mut self, at: i64, health: &Health) {
        if self.0.back().is_some_and(|last| at - last.at < Self::EVERY) {
            return;
        }
        if let Some(sample) = HealthSample::new(at, health) {
            if self.0.len() == Self::MAX {
                self.0.pop_front();
            }
            self.0.push_back(sample);
        }
    }

    /// The oldest first.
    pub(crate) fn samples(&self) -> impl Iterator<Item = &HealthSample> {
        self.0.iter()
    }
}

/// The health at each place of a lap, the last time that the car was there.
#[derive(Debug, Clone, Default)]
pub(crate) struct HealthProfile {
    cells: Vec<Option<ProfileCell>>,
    last: Option<usize>,
}

/// Health at one place.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ProfileCell {
    /// The state.
    pub state: State,
    /// Alignment, in `[0, 1]`.
    pub alignment: f32,
    /// Slip.
    pub slip: f32,
}

impl HealthProfile {
    /// Number of places of a lap, of equal length.
    const PLACES: usize = 120;

    /// Adds the health of a car at arc length `s` of `length` \[m\].
    pub(crate) fn add(&mut self, s: f64, length: f64, health: &Health) {
        let Some(metrics) = health.metrics else {
            return;
        };
        self.cells.resize(Self::PLACES, None);
        let share = s / length;
        if !(0.0..=1.0).contains(&share) {
            return;
        }
        let here = ((share * Self::PLACES as f64) as usize).min(Self::PLACES - 1);
        let place = ProfileCell {
            state: health.state,
            alignment: metrics.alignment,
            slip: metrics.slip,
        };
        // Places passed since the last message get the same health, unless the car jumped.
        let driven = self
            .last
            .map_or(0, |last| (here + Self::PLACES - last) % Self::PLACES);
        let driven = if driven > Self::PLACES / 8 {
            0
        } else {
            driven.saturating_sub(1)
        };
        for back in 0..=driven {
            self.cells[(here + Self::PLACES - back) % Self::PLACES] = Some(place);
        }
        self.last = Some(here);
    }

    /// From the start line on; empty before the first sample.
    pub(crate) fn cells(&self) -> &[Option<ProfileCell>] {
        &self.cells
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::Metrics;

    fn health(alignment: f32) -> Health {
        Health {
            state: State::Localized,
            since: 0,
            causes: Vec::new(),
            update: 1,
            metrics: Some(Metrics {
                alignment,
                ..Metrics::default()
            }),
            proposal: None,
            auto: false,
        }
    }

    #[test]
    fn two_minutes_are_kept() {
        let mut history = HealthHistory::default();
        for i in 0..3000 {
            history.add(i * 100_000_000, &health(0.9));
        }
        let samples: Vec<_> = history.samples().collect();
        assert_eq!(samples.len(), HealthHistory::MAX);
        assert!(
            samples
                .windows(2)
                .all(|pair| pair[1].at - pair[0].at == HealthHistory::EVERY)
        );
    }

    #[test]
    fn the_places_that_were_passed_have_a_health_and_no_others() {
        let mut health_profile = HealthProfile::default();
        let length = 60.0;
        // Two cells a message, over the start line.
        for s in [58.0, 59.0, 0.0, 1.0] {
            health_profile.add(s, length, &health(0.5));
        }
        let filled: Vec<usize> = (0..HealthProfile::PLACES)
            .filter(|&i| health_profile.cells()[i].is_some())
            .collect();
        assert_eq!(filled, [0, 1, 2, 116, 117, 118, 119]);
        health_profile.add(30.0, length, &health(0.7));
        assert_eq!(
            health_profile.cells().iter().flatten().count(),
            8,
            "a jump fills only its end"
        );
        for s in [f64::NAN, -1.0, 61.0] {
            health_profile.add(s, length, &health(0.1));
        }
        assert_eq!(
            health_profile.cells().iter().flatten().count(),
            8,
            "outside the lap nothing is filled"
        );
    }
}
