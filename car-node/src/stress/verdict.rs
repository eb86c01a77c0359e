//! How a parameter set did under a defect.

use std::fmt;

use maps::{Pose, wrap_angle};
use serde::Serialize;
use synpf::Stamp;

use crate::evaluate::SETTLING;
use crate::health::State;
use crate::statistics::ErrorSummary;

/// A pose is right within this distance of the truth \[m\].
pub(super) const RIGHT_POSITION: f64 = 0.3;
/// A pose is right within this angle of the truth \[rad\].
const RIGHT_HEADING: f64 = 5.0 * std::f64::consts::PI / 180.0;
/// A step of the error from one update to the next that is a jump \[m\].
const JUMP: f64 = 0.5;
/// A share of the updates that is allowed to be otherwise.
const ALLOWED: f64 = 0.005;
/// A car that is right is LOCALIZED for at least this share of the updates.
const LOCALIZED_SHARE: f64 = 0.9;
/// A car that was carried may be said to be LOCALIZED for this long \[s\].
const NOTICE: f64 = 1.0;

/// The verdict on a set under a defect, best first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// Right all the time, and LOCALIZED.
    Holds,
    /// Right all the time, but often not LOCALIZED.
    Doubts,
    /// Wrong at times, but not LOCALIZED then.
    Warns,
    /// Right, and gave that pose up: it was LOST, or jumped.
    GivesUp,
    /// Wrong while LOCALIZED.
    Misleads,
    /// No pose at all.
    NoPose,
}

impl Verdict {
    /// All of them, best first.
    pub const ALL: [Self; 6] = [
        Self::Holds,
        Self::Doubts,
        Self::Warns,
        Self::GivesUp,
        Self::Misleads,
        Self::NoPose,
    ];

    /// Its meaning, in a sentence.
    pub fn meaning(self) -> &'static str {
        match self {
            Self::Holds => "right all the time, and LOCALIZED",
            Self::Doubts => "right all the time, but LOCALIZED for less than 90 % of it",
            Self::Warns => "wrong at times, and not LOCALIZED then",
            Self::GivesUp => "left a pose that was right: it was LOST, or the pose jumped by 0.5 m",
            Self::Misleads => "wrong while LOCALIZED, for 0.5 % of the time or more",
            Self::NoPose => "gave no pose",
        }
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Holds => "holds",
            Self::Doubts => "doubts",
            Self::Warns => "warns",
            Self::GivesUp => "gives up",
            Self::Misleads => "misleads",
            Self::NoPose => "no pose",
        })
    }
}

/// What was measured in one run, without its first 2 s.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Measured {
    /// Root mean square of the position error \[m\].
    pub rmse_m: f64,
    /// Largest position error \[m\].
    pub max_m: f64,
    /// Root mean square of the heading error \[rad\].
    pub heading_rmse_rad: f64,
    /// Largest heading error \[rad\].
    pub heading_max_rad: f64,
    /// Share of the updates that are LOCALIZED.
    pub localized: f64,
    /// Of the LOCALIZED updates, the share within 0.3 m and 5 deg of the truth; None without any.
    pub precision: Option<f64>,
    /// Share of the updates within 0.3 m and 5 deg of the truth.
    pub right: f64,
    /// Share of the updates that are LOCALIZED and farther from the truth than that.
    pub misleading: f64,
    /// How often a right pose was given up.
    pub given_up: usize,
    /// The last update is right.
    pub right_at_end: bool,
    /// Updates that were compared with the truth.
    pub updates: usize,
    /// The verdict.
    pub verdict: Verdict,
}

/// Collects the updates of a run.
#[derive(Debug, Default)]
pub(super) struct Judge {
    first: Option<Stamp>,
    carried_at: Option<Stamp>,
    position: Vec<f64>,
    heading: Vec<f64>,
    localized: usize,
    localized_and_right: usize,
    right: usize,
    misleading: usize,
    given_up: usize,
    /// Error and state of the last update, where it was right.
    last_right: Option<(f64, State)>,
}

impl Judge {
    /// `carried_at` is the time at which the car was carried away, if it was.
    pub(super) fn new(carried_at: Option<Stamp>) -> Self {
        Self {
            carried_at,
            ..Self::default()
        }
    }

    pub(super) fn push(&mut self, stamp: Stamp, estimate: Pose, state: State, truth: Option<Pose>) {
        let first = *self.first.get_or_insert(stamp);
        let Some(truth) = truth.filter(|_| stamp.since(first) >= SETTLING) else {
            return;
        };
        let error = estimate.distance(truth);
        let turned = wrap_angle(estimate.heading - truth.heading).abs();
        // A NaN is not right.
        let right = error <= RIGHT_POSITION && turned <= RIGHT_HEADING;
        let localized = state == State::Localized;
        let unnoticed_yet = self
            .carried_at
            .is_some_and(|at| (0.0..NOTICE).contains(&stamp.since(at)));
        self.position.push(error);
        self.heading.push(turned);
        self.right += usize::from(right);
        self.localized += usize::from(localized);
        self.localized_and_right += usize::from(localized && right);
        self.misleading += usize::from(localized && !right && !unnoticed_yet);
        if let Some((before, state_before)) = self.last_right
            && self.carried_at.is_none()
        {
            let lost = right && state == State::Lost && state_before != State::Lost;
            self.given_up += usize::from(lost || error - before > JUMP);
        }
        self.last_right = right.then_some((error, state));
    }

    /// None without an update that could be compared with the truth.
    pub(super) fn measured(&self) -> Option<Measured> {
        let position = ErrorSummary::of(&self.position)?;
        let heading = ErrorSummary::of(&self.heading)?;
        let updates = self.position.len();
        let share = |count: usize| count as f64 / updates as f64;
        let (right, misleading, localized) =
            (share(self.right), share(self.misleading), share(self.localized));
        let right_at_end = self.last_right.is_some();
        // A car that was carried is wrong until it finds itself again.
        let wrong = match self.carried_at {
            None => right < 1.0 - ALLOWED,
            Some(_) => !right_at_end,
        };
        let verdict = if misleading >= ALLOWED {
            Verdict::Misleads
        } else if self.given_up > 0 {
            Verdict::GivesUp
        } else if wrong {
            Verdict::Warns
        } else if localized < LOCALIZED_SHARE && self.carried_at.is_none() {
            Verdict::Doubts
        } else {
            Verdict::Holds
        };
        Some(Measured {
            rmse_m: position.rmse,
            max_m: position.max,
            heading_rmse_rad: heading.rmse,
            heading_max_rad: heading.max,
            localized,
            precision: (self.localized > 0).then(|| self.localized_and_right as f64 / self.localized as f64),
            right,
            misleading,
            given_up: self.given_up,
            right_at_end,
            updates,
            verdict,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The verdict on a run of ten seconds at 100 Hz; `at` gives the error \[m\] and the state by time \[s\].
    fn verdict(carried_at: Option<f64>, at: impl Fn(f64) -> (f64, State)) -> Verdict {
        let mut judge = Judge::new(carried_at.map(|at| Stamp(0).plus(at)));
        for tick in 0..1000 {
            let seconds = f64::from(tick) / 100.0;
            let (error, state) = at(seconds);
            let stamp = Stamp(0).plus(seconds);
            judge.push(stamp, Pose::new(error, 0.0, 0.0), state, Some(Pose::IDENTITY));
        }
        judge.measured().expect("updates").verdict
    }

    #[test]
    fn a_verdict_is_about_errors_and_about_what_was_said() {
        use State::{Degraded, Localized, Lost};
        assert_eq!(verdict(None, |_| (0.1, Localized)), Verdict::Holds);
        // The first 2 s do not count.
        assert_eq!(
            verdict(None, |t| (if t < 1.9 { 3.0 } else { 0.1 }, Localized)),
            Verdict::Holds
        );
        assert_eq!(verdict(None, |_| (0.1, Degraded)), Verdict::Doubts);
        assert_eq!(
            verdict(None, |t| (0.1 * t, if t > 2.8 { Degraded } else { Localized })),
            Verdict::Warns
        );
        assert_eq!(verdict(None, |t| (0.1 * t, Localized)), Verdict::Misleads);
        let lost = |t: f64| (0.1, if t > 5.0 { Lost } else { Localized });
        assert_eq!(verdict(None, lost), Verdict::GivesUp);
        let jumps = |t: f64| if t > 5.0 { (4.0, Lost) } else { (0.1, Localized) };
        assert_eq!(verdict(None, jumps), Verdict::GivesUp);
        assert_eq!(
            verdict(None, |t| (f64::NAN, if t < 0.0 { Lost } else { Localized })),
            Verdict::Misleads
        );
    }

    #[test]
    fn a_carried_car_has_a_second_to_notice_and_must_be_right_in_the_end() {
        use State::{Localized, Lost};
        let run = |notices: f64, found: f64| {
            verdict(Some(4.0), |t| match t {
                t if t < 4.0 || t >= found => (0.1, Localized),
                t if t < notices => (3.0, Localized),
                _ => (3.0, Lost),
            })
        };
        assert_eq!(run(4.8, 6.0), Verdict::Holds);
        assert_eq!(run(6.0, 7.0), Verdict::Misleads);
        assert_eq!(run(4.8, 20.0), Verdict::Warns);
    }

    #[test]
    fn without_truth_there_is_no_verdict() {
        let mut judge = Judge::default();
        judge.push(Stamp(0), Pose::IDENTITY, State::Localized, None);
        assert_eq!(judge.measured(), None);
    }
}
