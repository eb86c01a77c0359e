//! Errors of the estimates against the truth.

use maps::{Pose, wrap_angle};
use serde::Serialize;
use synpf::Stamp;

use crate::statistics::ErrorSummary;

/// Errors in the first seconds are those of the start, and do not count \[s\].
pub(crate) const SETTLING: f64 = 2.0;
/// A position error above this is an excursion \[m\].
const EXCURSION_DISTANCE: f64 = 1.0;
/// An excursion counts when it lasts this long \[s\].
const EXCURSION_TIME: f64 = 1.0;

/// Collects the errors, estimate by estimate.
#[derive(Debug, Default)]
pub struct PoseErrors {
    first: Option<Stamp>,
    position: Vec<f64>,
    lateral: Vec<f64>,
    longitudinal: Vec<f64>,
    heading: Vec<f64>,
    /// Since when the estimate has been that wrong.
    off_since: Option<Stamp>,
    /// The present excursion has been counted.
    counted: bool,
    excursions: usize,
}

/// Errors of a whole run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Summaries {
    /// Distance from the true position \[m\].
    pub position_error_m: ErrorSummary,
    /// Across the true heading \[m\].
    pub lateral_error_m: ErrorSummary,
    /// Along the true heading \[m\].
    pub longitudinal_error_m: ErrorSummary,
    /// Heading \[rad\].
    pub heading_error_rad: ErrorSummary,
    /// Number of times that the position was wrong by more than 1 m for 1 s or more.
    pub excursions: usize,
}

impl PoseErrors {
    /// Adds the estimate for `stamp`. Without truth at that time it does not count.
    pub fn push(&mut self, stamp: Stamp, estimate: Pose, truth: Option<Pose>) {
        let first = *self.first.get_or_insert(stamp);
        let Some(truth) = truth else { return };
        if stamp.since(first) < SETTLING {
            return;
        }
        let error = estimate.since(truth);
        let distance = error.x.hypot(error.y);
        self.position.push(distance);
        self.longitudinal.push(error.x);
        self.lateral.push(error.y);
        self.heading.push(wrap_angle(error.heading));

        // A NaN counts as an infinite error.
        if distance <= EXCURSION_DISTANCE {
            self.off_since = None;
            self.counted = false;
        } else if stamp.since(*self.off_since.get_or_insert(stamp)) >= EXCURSION_TIME && !self.counted {
            self.excursions += 1;
            self.counted = true;
        }
    }

    /// The summaries; None without an error.
    pub fn summaries(&self) -> Option<Summaries> {
        Some(Summaries {
            position_error_m: ErrorSummary::of(&self.position)?,
            lateral_error_m: ErrorSummary::of(&self.lateral)?,
            longitudinal_error_m: ErrorSummary::of(&self.longitudinal)?,
            heading_error_rad: ErrorSummary::of(&self.heading)?,
            excursions: self.excursions,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_2;

    #[test]
    fn errors_are_taken_along_and_across_the_true_heading() {
        let mut errors = PoseErrors::default();
        errors.push(Stamp(0), Pose::IDENTITY, Some(Pose::new(50.0, 0.0, 0.0)));
        assert!(errors.summaries().is_none(), "the first 2 s do not count");
        // Facing north, 0.3 m ahead and 0.4 m to the left, turned by 0.1 across the wrap.
        errors.push(
            Stamp(2_000_000_000),
            Pose::new(-0.4, 0.3, FRAC_PI_2 + 0.1),
            Some(Pose::new(0.0, 0.0, FRAC_PI_2)),
        );
        errors.push(Stamp(3_000_000_000), Pose::IDENTITY, None);
        let summaries = errors.summaries().expect("one error");
        assert!((summaries.position_error_m.max - 0.5).abs() < 1e-12);
        assert!((summaries.longitudinal_error_m.max - 0.3).abs() < 1e-12);
        assert!((summaries.lateral_error_m.rmse - 0.4).abs() < 1e-12);
        assert!((summaries.heading_error_rad.p95 - 0.1).abs() < 1e-12);
        assert_eq!(summaries.excursions, 0);
    }

    #[test]
    fn an_excursion_lasts_a_second() {
        let excursions = |off: std::ops::Range<usize>| {
            let mut errors = PoseErrors::default();
            for tenth in 0..100_usize {
                let x = if off.contains(&tenth) { 1.5 } else { 0.0 };
                let stamp = Stamp(tenth as i64 * 100_000_000);
                errors.push(stamp, Pose::new(x, 0.0, 0.0), Some(Pose::IDENTITY));
            }
            errors.summaries().expect("errors").excursions
        };
        assert_eq!(excursions(30..40), 0, "0.9 s");
        assert_eq!(excursions(30..41), 1);
        assert_eq!(excursions(30..90), 1, "a long one is one");
        assert_eq!(excursions(0..22), 0, "most of it within the first 2 s");
    }
}
