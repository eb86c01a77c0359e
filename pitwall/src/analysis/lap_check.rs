//! The one rule by which a lap is void, from one pose to the next.

use protocol::{EventKind, State};

use super::{Invalid, PoseSample};

/// From one pose to the next, forwards along a raceline.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Step {
    from: (i64, f64),
    /// `s` here may exceed a lap's length.
    to: (i64, f64),
    /// True when it crosses the start line.
    pub(crate) over_line: bool,
}

impl Step {
    /// A longer time between two poses is a gap \[ns\].
    pub(crate) const GAP: i64 = 1_000_000_000;

    /// None for a jump, a pause, and for driving backwards. `length` is that of a lap \[m\].
    pub(crate) fn between(before: &PoseSample, here: &PoseSample, length: f64) -> Option<Self> {
        let mut ahead = here.s - before.s;
        let over_line = ahead < -length / 2.0;
        if over_line {
            ahead += length;
        }
        let in_time = (1..=Self::GAP).contains(&(here.at - before.at));
        (in_time && ahead > 0.0 && ahead < length / 4.0).then_some(Self {
            from: (before.at, before.s),
            to: (here.at, before.s + ahead),
            over_line,
        })
    }

    /// When `s` was passed \[unix ns\]; None if it was not.
    pub(crate) fn when(&self, s: f64) -> Option<i64> {
        let (from, to) = (self.from, self.to);
        (from.1 < s && s <= to.1)
            .then(|| from.0 + ((s - from.1) / (to.1 - from.1) * (to.0 - from.0) as f64) as i64)
    }

    /// What it covers of the lap that it begins in, and of the next one \[m\].
    fn covers(&self, length: f64) -> [f64; 2] {
        let beyond = (self.to.1 - length).max(0.0);
        [self.to.1 - self.from.1 - beyond, beyond]
    }
}

/// Finds out whether a lap is void: one for each lap, live, in a replay and in a report alike.
#[derive(Debug, Clone, Default)]
pub(crate) struct LapCheck {
    invalid: Option<Invalid>,
    stands_since: Option<i64>,
    /// What was seen of the lap \[m\].
    covered: f64,
}

impl LapCheck {
    /// A car slower than this stands \[m/s\].
    const STANDS: f64 = 0.2;
    /// It may stand for so long \[ns\].
    const STANDS_FOR: i64 = 1_000_000_000;
    /// A lap of which less was seen is void.
    const KNOWN: f64 = 0.97;
    /// Two poses that are further apart than this speed allows are a jump \[m/s\]. No car of this class is that fast.
    const FASTEST: f64 = 25.0;
    /// How far a pose may move beyond that \[m\].
    const LOOSE: f64 = 0.5;

    /// Adds a pose and the one before it.
    pub(crate) fn on_pose(&mut self, before: Option<&PoseSample>, here: &PoseSample) {
        if here.speed < Self::STANDS {
            let since = *self.stands_since.get_or_insert(here.at);
            if here.at - since > Self::STANDS_FOR {
                self.note(Invalid::Stopped);
            }
        } else {
            self.stands_since = None;
        }
        let Some(before) = before else { return };
        let seconds = (here.at - before.at).max(0) as f64 * 1e-9;
        let [dx, dy] = [0, 1].map(|i| here.position[i] - before.position[i]);
        if here.at - before.at > Step::GAP {
            self.note(Invalid::Gap);
        } else if dx.hypot(dy) > Self::FASTEST * seconds + Self::LOOSE {
            self.note(Invalid::Jumped);
        }
    }

    /// The car has driven this step in the lap. Where it crosses the start line, it counts for the lap before and for
    /// the `next` one.
    pub(crate) fn on_step(&mut self, step: &Step, length: f64, next: bool) {
        self.covered += step.covers(length)[usize::from(next)];
    }

    /// Adds the state of a health message.
    pub(crate) fn on_state(&mut self, state: State) {
        if matches!(state, State::Lost | State::Relocalizing) {
            self.note(Invalid::Lost);
        }
    }

    /// Adds an event.
    pub(crate) fn on_event(&mut self, event: &EventKind) {
        match event {
            EventKind::PoseInitialized { .. } => self.note(Invalid::PoseGiven),
            EventKind::Relocalized { .. } => self.note(Invalid::PoseFound),
            _ => {}
        }
    }

    /// The first reason counts.
    fn note(&mut self, reason: Invalid) {
        self.invalid.get_or_insert(reason);
    }

    /// Why the lap is void so far, but for what is still to come; None while it is good.
    pub(crate) fn so_far(&self) -> Option<Invalid> {
        self.invalid
    }

    /// Why the lap, which has ended, is void; None for a good one. `length` is that of a lap \[m\].
    pub(crate) fn verdict(&self, length: f64) -> Option<Invalid> {
        self.invalid
            .or((self.covered < Self::KNOWN * length).then_some(Invalid::Gap))
    }
}
