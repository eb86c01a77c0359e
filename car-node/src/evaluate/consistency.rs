//! Consistency of the covariance: normalised estimation error squared (NEES; Bar-Shalom, Li and Kirubarajan,
//! *Estimation with Applications to Tracking and Navigation*, section 5.4).
//!
//! For an honest covariance, the NEES follows a chi-square distribution: its mean is the dimension, and 5 % exceed the 95 %
//! bound. A larger mean means a covariance that is too small.

use maps::{Pose, wrap_angle};
use nalgebra::Matrix3;
use serde::Serialize;
use synpf::{Mode, Stamp, Update};

use super::errors::SETTLING;
use crate::statistics::mean;

/// The 95 % bounds of the chi-square distribution with one and with two degrees of freedom.
const BOUND_1: f64 = 3.841;
const BOUND_2: f64 = 5.991;

/// NEES over a run, without the first 2 s and without updates during a search.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Consistency {
    /// Of the position; its dimension is 2.
    pub position: Nees,
    /// Of the heading; its dimension is 1.
    pub heading: Nees,
    /// Updates whose covariance is not positive definite; they are not in the means.
    pub degenerate: usize,
}

/// NEES of one part of the pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Nees {
    /// Mean; the dimension for an honest covariance.
    pub mean: f64,
    /// Share above the 95 % bound of the chi-square distribution, in [0, 1]; 0.05 for an honest covariance.
    pub above_95: f64,
}

impl Nees {
    fn of(values: &[f64], bound: f64) -> Option<Self> {
        let above = values.iter().filter(|value| **value > bound).count();
        Some(Self {
            mean: mean(values)?,
            above_95: above as f64 / values.len() as f64,
        })
    }
}

/// Collects the NEES, update by update.
#[derive(Debug, Default)]
pub(super) struct ConsistencyCheck {
    first: Option<Stamp>,
    position: Vec<f64>,
    heading: Vec<f64>,
    degenerate: usize,
}

impl ConsistencyCheck {
    /// Adds an update. Without truth at its stamp it does not count.
    pub(super) fn push(&mut self, update: &Update, truth: Option<Pose>) {
        let first = *self.first.get_or_insert(update.stamp);
        let Some(truth) = truth else { return };
        if update.mode != Mode::Tracking || update.stamp.since(first) < SETTLING {
            return;
        }
        let error = [
            update.pose.x - truth.x,
            update.pose.y - truth.y,
            wrap_angle(update.pose.heading - truth.heading),
        ];
        match nees(error, &update.covariance) {
            Some([position, heading]) => {
                self.position.push(position);
                self.heading.push(heading);
            }
            None => self.degenerate += 1,
        }
    }

    /// The summary; None without an update that counts.
    pub(super) fn summary(&self) -> Option<Consistency> {
        Some(Consistency {
            position: Nees::of(&self.position, BOUND_2)?,
            heading: Nees::of(&self.heading, BOUND_1)?,
            degenerate: self.degenerate,
        })
    }
}

/// NEES of position and heading; None when the covariance is not positive definite.
fn nees([x, y, heading]: [f64; 3], covariance: &Matrix3<f64>) -> Option<[f64; 2]> {
    let (xx, xy, yy, hh) = (
        covariance[(0, 0)],
        covariance[(0, 1)],
        covariance[(1, 1)],
        covariance[(2, 2)],
    );
    let determinant = xx * yy - xy * xy;
    if !(xx > 0.0 && determinant > 0.0 && hh > 0.0) {
        return None;
    }
    let position = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant;
    Some([position, heading * heading / hh])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::tests_support::good_update;
    use rand::{RngExt, SeedableRng, rngs::StdRng};

    #[test]
    fn errors_along_the_axes_of_the_covariance_count_their_sigmas() {
        let covariance = Matrix3::new(0.04, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0001);
        let [position, heading] = nees([0.4, 0.1, 0.03], &covariance).expect("positive definite");
        assert!((position - 5.0).abs() < 1e-9, "2 and 1 sigma: {position}");
        assert!((heading - 9.0).abs() < 1e-9, "3 sigma: {heading}");
        assert_eq!(nees([0.1, 0.0, 0.0], &Matrix3::zeros()), None);
        assert_eq!(nees([0.1, 0.0, 0.0], &Matrix3::repeat(f64::NAN)), None);
    }

    #[test]
    fn an_honest_covariance_has_its_dimension_as_mean_and_a_proud_one_four_times_that() {
        // Sum of 12 uniform numbers less 6: normal enough, and its variance is 1.
        let mut rng = StdRng::seed_from_u64(1);
        let mut normal = || (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
        let (mut honest, mut proud) = (ConsistencyCheck::default(), ConsistencyCheck::default());
        for number in 0..20_000_u64 {
            let (a, b, c) = (normal(), normal(), normal());
            let mut update = good_update(Stamp(0).plus(number as f64 / 40.0), number + 1);
            // Correlated errors: x = 0.1 a, y = 0.05 a + 0.05 b, heading = 0.01 c.
            update.pose = Pose::new(0.1 * a, 0.05 * a + 0.05 * b, 0.01 * c);
            update.covariance = Matrix3::new(0.01, 0.005, 0.0, 0.005, 0.005, 0.0, 0.0, 0.0, 0.0001);
            honest.push(&update, Some(Pose::IDENTITY));
            update.covariance /= 4.0;
            proud.push(&update, Some(Pose::IDENTITY));
        }
        let honest = honest.summary().expect("updates");
        // The mean of n chi-square numbers of dimension d has the standard deviation sqrt(2 d / n): 0.014 and 0.010.
        assert!((honest.position.mean - 2.0).abs() < 0.06, "{honest:?}");
        assert!((honest.heading.mean - 1.0).abs() < 0.04, "{honest:?}");
        assert!((honest.position.above_95 - 0.05).abs() < 0.008, "{honest:?}");
        assert!((honest.heading.above_95 - 0.05).abs() < 0.008, "{honest:?}");
        let proud = proud.summary().expect("updates");
        assert!((proud.position.mean - 8.0).abs() < 0.24, "{proud:?}");
    }

    #[test]
    fn searching_settling_and_missing_truth_do_not_count() {
        let mut check = ConsistencyCheck::default();
        check.push(&good_update(Stamp(0), 1), Some(Pose::IDENTITY));
        let mut update = good_update(Stamp(0).plus(3.0), 2);
        check.push(&update, None);
        update.mode = Mode::Searching;
        check.push(&update, Some(Pose::IDENTITY));
        assert_eq!(check.summary(), None);
    }
}
