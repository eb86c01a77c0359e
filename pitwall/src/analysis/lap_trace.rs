//! One lap of one car over the track coordinate.

use std::sync::Arc;

use protocol::{CauseKind, State};
use serde::Serialize;

use super::{Channel, TrackLine};

/// One lap of one car: when it passed each place, and every channel there.
#[derive(Debug, Clone)]
pub struct LapTrace {
    /// Counts the laps of a car in a session, from 1. A car that restarts counts its laps anew, but not these numbers.
    pub id: u64,
    /// The car's own number of the lap; 0 before the first crossing of the start line.
    pub lap: u32,
    /// When it began, by the car's clock \[unix ns\].
    pub begun: i64,
    /// Lap time by the car; None while the car has not reported it \[s\].
    pub time_s: Option<f64>,
    /// The set in force at its end.
    pub set: Option<String>,
    /// Whether it counts.
    pub kind: LapKind,
    /// The line that it was driven along.
    pub line: Arc<TrackLine>,
    /// Time since `begun` at the begin of each cell and at the line \[s\]; NaN where the car was not.
    pub(super) edges: Vec<f32>,
    /// Values at the middle of each cell, channel by channel; NaN where they are not known.
    pub(super) values: Vec<f32>,
    /// The kinds of causes that were shown, in the order of their first appearance; at most 64.
    cause_kinds: Vec<CauseKind>,
    /// The causes shown in each cell, a bit for each of `cause_kinds`.
    pub(super) causes: Vec<u64>,
    /// State in each cell; None where it is not known.
    pub(super) states: Vec<Option<State>>,
}

/// What sort of lap it is. Only flying laps count for medians, best laps and sectors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case", tag = "kind", content = "reason")]
pub enum LapKind {
    /// A whole lap at speed.
    Flying,
    /// From where the car started to the start line.
    Out,
    /// Begun and not finished.
    In,
    /// A whole lap that does not count.
    Invalid(Invalid),
}

/// Why a whole lap does not count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Invalid {
    /// The car stood still for a second or more.
    Stopped,
    /// A pose was given on the way.
    PoseGiven,
    /// The pose was searched for and found on the way.
    PoseFound,
    /// The pose was wrong or unknown on the way.
    Lost,
    /// The pose jumped.
    Jumped,
    /// Part of the lap is missing.
    Gap,
}

impl Invalid {
    /// In words.
    pub fn words(self) -> &'static str {
        match self {
            Self::Stopped => "the car stood still",
            Self::PoseGiven => "a pose was given",
            Self::PoseFound => "the pose was searched for",
            Self::Lost => "localization was lost",
            Self::Jumped => "the pose jumped",
            Self::Gap => "part of the lap is missing",
        }
    }
}

impl LapTrace {
    pub(super) fn new(id: u64, lap: u32, begun: i64, kind: LapKind, line: Arc<TrackLine>) -> Self {
        let cells = line.cells;
        Self {
            id,
            lap,
            begun,
            time_s: None,
            set: None,
            kind,
            edges: vec![f32::NAN; cells + 1],
            values: vec![f32::NAN; cells * Channel::COUNT],
            cause_kinds: Vec::new(),
            causes: vec![0; cells],
            states: vec![None; cells],
            line,
        }
    }

    /// The car has reported the lap.
    pub(super) fn finish(&mut self, time_s: Option<f64>, set: &str) {
        self.time_s = time_s;
        self.set = Some(set.to_owned());
        // A whole lap of which the begin or the end was not seen.
        if time_s.is_some() && matches!(self.kind, LapKind::Out | LapKind::In) {
            self.kind = LapKind::Invalid(Invalid::Gap);
        }
    }

    /// A channel at the middle of each cell; NaN where it is not known.
    pub fn channel(&self, channel: Channel) -> &[f32] {
        let cells = self.line.cells;
        &self.values[channel as usize * cells..(channel as usize + 1) * cells]
    }

    pub(super) fn set_value(&mut self, channel: Channel, cell: usize, value: f32) {
        let cells = self.line.cells;
        self.values[channel as usize * cells + cell] = value;
    }

    /// The bits of these causes in this lap.
    pub(super) fn cause_bits(&mut self, kinds: &[CauseKind]) -> u64 {
        let mut bits = 0_u64;
        for kind in kinds {
            let known = self.cause_kinds.iter().position(|other| other == kind);
            let number = known.unwrap_or_else(|| {
                self.cause_kinds.push(*kind);
                self.cause_kinds.len() - 1
            });
            bits |= 1_u64.checked_shl(number as u32).unwrap_or(0);
        }
        bits
    }

    /// The causes that were shown in a cell.
    pub fn causes(&self, cell: usize) -> impl Iterator<Item = CauseKind> + '_ {
        let bits = self.causes.get(cell).copied().unwrap_or(0);
        let kinds = self.cause_kinds.iter().take(64).enumerate();
        kinds
            .filter(move |(number, _)| bits >> number & 1 == 1)
            .map(|(_, kind)| *kind)
    }

    /// Time since the begin of the lap at arc length `s` \[s\]; None where the car was not.
    pub fn time_at(&self, s: f64) -> Option<f64> {
        let at = (s / self.line.cell()).clamp(0.0, self.line.cells as f64);
        let cell = (at as usize).min(self.line.cells - 1);
        let (from, to) = (f64::from(self.edges[cell]), f64::from(self.edges[cell + 1]));
        let share = at - cell as f64;
        let time = if share <= 0.0 {
            from
        } else {
            from + share * (to - from)
        };
        time.is_finite().then_some(time)
    }

    /// Time from `from` to `to` \[s\], both arc lengths \[m\].
    pub fn time_between(&self, from: f64, to: f64) -> Option<f64> {
        Some(self.time_at(to)? - self.time_at(from)?)
    }

    /// By how much this lap is behind `reference` at arc length `s` \[s\].
    pub fn delta(&self, reference: &Self, s: f64) -> Option<f64> {
        Some(self.time_at(s)? - reference.time_at(s)?)
    }

    /// Share of the lap that was driven and recorded, in `[0, 1]`.
    pub fn covered(&self) -> f64 {
        let known = self
            .edges
            .windows(2)
            .filter(|pair| pair[0].is_finite() && pair[1].is_finite());
        known.count() as f64 / self.line.cells as f64
    }

    /// Mean of a channel between two arc lengths \[m\]; None without a value there.
    pub fn mean(&self, channel: Channel, from: f64, to: f64) -> Option<f64> {
        let (mut sum, mut count) = (0.0, 0_u32);
        for value in self.between(channel, from, to) {
            sum += value;
            count += 1;
        }
        (count > 0).then(|| sum / f64::from(count))
    }

    /// The known values of a channel between two arc lengths \[m\].
    pub fn between(&self, channel: Channel, from: f64, to: f64) -> impl Iterator<Item = f64> + '_ {
        let cell = self.line.cell();
        let inside = move |i: usize| (from..to).contains(&((i as f64 + 0.5) * cell));
        self.channel(channel)
            .iter()
            .enumerate()
            .filter(move |(i, value)| inside(*i) && value.is_finite())
            .map(|(_, value)| f64::from(*value))
    }

    /// Whether it counts.
    pub fn counts(&self) -> bool {
        self.kind == LapKind::Flying && self.time_s.is_some()
    }
}
