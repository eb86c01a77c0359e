//! What a car's health was over the last minutes, and what it was last time at each place of the track.

use std::collections::VecDeque;

use protocol::{Health, State};
use serde::Serialize;

/// The last two minutes, twice a second.
#[derive(Debug, Clone, Default)]
pub(crate) struct HealthHistory(VecDeque<HealthSample>);

/// A car's health at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct HealthSample {
    /// When it arrived, by the laptop's clock [unix ns].
    pub at: i64,
    /// The state.
    pub state: State,
    /// Alignment, in `[0, 1]`.
    pub alignment: f32,
    /// Slip.
    pub slip: f32,
    /// Standard deviation along the track [m].
    pub spread_along: f32,
    /// Standard deviation across the track [m].
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
    /// From one moment to the next [ns].
    const EVERY: i64 = 500_000_000;
    /// Moments kept.
    const MAX: usize = 240;

    pub(crate) fn take(&mut self, at: i64, health: &Health) {
        if self.0.back().is_some_and(|last| at - last.at < Self::EVERY) {
            return;
        }
        if let Some(moment) = HealthSample::new(at, health) {
            if self.0.len() == Self::MAX {
                self.0.pop_front();
            }
            self.0.push_back(moment);
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

/// What was measured at a place.
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
    /// Places of a lap, of equal length.
    const PLACES: usize = 120;

    /// Takes in the health of a car that is at `s` of `length` [m].
    pub(crate) fn take(&mut self, s: f64, length: f64, health: &Health) {
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
        // Places driven over since the last message get this one too; further apart it was a jump.
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

    /// From the start line onwards; empty before the first.
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
            history.take(i * 100_000_000, &health(0.9));
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
    fn what_was_driven_over_is_painted_and_nothing_else() {
        let mut health_profile = HealthProfile::default();
        let length = 60.0;
        // Two cells a message, over the start line.
        for s in [58.0, 59.0, 0.0, 1.0] {
            health_profile.take(s, length, &health(0.5));
        }
        let painted: Vec<usize> = (0..HealthProfile::PLACES)
            .filter(|&i| health_profile.cells()[i].is_some())
            .collect();
        assert_eq!(painted, [0, 1, 2, 116, 117, 118, 119]);
        health_profile.take(30.0, length, &health(0.7));
        assert_eq!(
            health_profile.cells().iter().flatten().count(),
            8,
            "a jump paints only where it ends"
        );
        for s in [f64::NAN, -1.0, 61.0] {
            health_profile.take(s, length, &health(0.1));
        }
        assert_eq!(
            health_profile.cells().iter().flatten().count(),
            8,
            "off the line paints nothing"
        );
    }
}
