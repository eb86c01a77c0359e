//! What a car's health was over the last minutes, and what it was last time at each place of the track.

use std::collections::VecDeque;

use protocol::{Health, State};
use serde::Serialize;

/// The last two minutes, twice a second.
#[derive(Debug, Clone, Default)]
pub(crate) struct History(VecDeque<Moment>);

/// A car's health at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Moment {
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

impl Moment {
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

impl History {
    /// From one moment to the next [ns].
    const EVERY: i64 = 500_000_000;
    /// Moments kept.
    const MAX: usize = 240;

    pub(crate) fn take(&mut self, at: i64, health: &Health) {
        if self.0.back().is_some_and(|last| at - last.at < Self::EVERY) {
            return;
        }
        if let Some(moment) = Moment::new(at, health) {
            if self.0.len() == Self::MAX {
                self.0.pop_front();
            }
            self.0.push_back(moment);
        }
    }

    /// The oldest first.
    pub(crate) fn moments(&self) -> impl Iterator<Item = &Moment> {
        self.0.iter()
    }
}

/// The health at each place of a lap, the last time that the car was there.
#[derive(Debug, Clone, Default)]
pub(crate) struct Strip {
    places: Vec<Option<Place>>,
    last: Option<usize>,
}

/// What was measured at a place.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Place {
    /// The state.
    pub state: State,
    /// Alignment, in `[0, 1]`.
    pub alignment: f32,
    /// Slip.
    pub slip: f32,
}

impl Strip {
    /// Places of a lap, of equal length.
    const PLACES: usize = 120;

    /// Takes in the health of a car that is at `s` of `length` [m].
    pub(crate) fn take(&mut self, s: f64, length: f64, health: &Health) {
        let Some(metrics) = health.metrics else {
            return;
        };
        self.places.resize(Self::PLACES, None);
        let share = s / length;
        if !(0.0..=1.0).contains(&share) {
            return;
        }
        let here = ((share * Self::PLACES as f64) as usize).min(Self::PLACES - 1);
        let place = Place {
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
            self.places[(here + Self::PLACES - back) % Self::PLACES] = Some(place);
        }
        self.last = Some(here);
    }

    /// From the start line onwards; empty before the first.
    pub(crate) fn places(&self) -> &[Option<Place>] {
        &self.places
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
        let mut history = History::default();
        for i in 0..3000 {
            history.take(i * 100_000_000, &health(0.9));
        }
        let moments: Vec<_> = history.moments().collect();
        assert_eq!(moments.len(), History::MAX);
        assert!(
            moments
                .windows(2)
                .all(|pair| pair[1].at - pair[0].at == History::EVERY)
        );
    }

    #[test]
    fn what_was_driven_over_is_painted_and_nothing_else() {
        let mut strip = Strip::default();
        let length = 60.0;
        // Two places a message, over the start line.
        for s in [58.0, 59.0, 0.0, 1.0] {
            strip.take(s, length, &health(0.5));
        }
        let painted: Vec<usize> = (0..Strip::PLACES)
            .filter(|&i| strip.places()[i].is_some())
            .collect();
        assert_eq!(painted, [0, 1, 2, 116, 117, 118, 119]);
        strip.take(30.0, length, &health(0.7));
        assert_eq!(
            strip.places().iter().flatten().count(),
            8,
            "a jump paints only where it ends"
        );
        for s in [f64::NAN, -1.0, 61.0] {
            strip.take(s, length, &health(0.1));
        }
        assert_eq!(
            strip.places().iter().flatten().count(),
            8,
            "off the line paints nothing"
        );
    }
}
