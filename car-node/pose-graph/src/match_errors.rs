//! How far the pose was off, as the matches with the map show: the covariance of what is published.
//!
//! The weights of the graph are no inverse variances, so its normal matrix says nothing on how good a pose is. A match says
//! by how much the pose of its node was off; the next one is off by about as much.

use maps::{Pose, wrap_angle};
use nalgebra::{Matrix3, Vector3};

/// Matches over which the errors are averaged.
const MEMORY: f64 = 10.0;

/// Standard deviations before any match, along, across \[m\] and of the heading \[rad\].
const START: [f64; 3] = [0.1, 0.1, 0.05];

/// A match itself is no better than this \[m\], \[m\], \[rad\].
const LEAST: [f64; 3] = [0.015, 0.015, 0.004];

/// Error of local scan matching per metre \[m\], \[m\], \[rad\].
const PER_METRE: [f64; 3] = [0.01, 0.01, 0.002];

/// Averaged errors of the pose.
#[derive(Debug, Clone)]
pub(crate) struct MatchErrors {
    /// Mean squares along, across and of the heading.
    squares: [f64; 3],
    matches: f64,
    /// Way since the last match \[m\].
    way: f64,
}

impl Default for MatchErrors {
    fn default() -> Self {
        Self::with(START)
    }
}

impl MatchErrors {
    /// Errors that are as large as these standard deviations, along, across and of the heading.
    pub(crate) fn with(sigma: [f64; 3]) -> Self {
        Self {
            squares: sigma.map(|sigma| sigma * sigma),
            matches: 0.0,
            way: 0.0,
        }
    }

    /// Takes in that the car has driven \[m\].
    pub(crate) fn drive(&mut self, way: f64) {
        self.way += way;
    }

    /// Takes in a match: where a node was thought to be, and where it is.
    pub(crate) fn add(&mut self, predicted: Pose, matched: Pose) {
        let off = matched.since(predicted);
        let share = 1.0 / (self.matches + 1.0).min(MEMORY);
        for (square, off) in self
            .squares
            .iter_mut()
            .zip([off.x, off.y, wrap_angle(off.heading)])
        {
            *square += share * (off * off - *square);
        }
        self.matches += 1.0;
        self.way = 0.0;
    }

    /// Covariance of x, y [m^2] and heading [rad^2] of a pose with this heading.
    pub(crate) fn covariance(&self, heading: f64) -> Matrix3<f64> {
        let variance = Vector3::from_fn(|k, _| {
            self.squares[k].max(LEAST[k] * LEAST[k]) + (PER_METRE[k] * self.way).powi(2)
        });
        let (sin, cos) = heading.sin_cos();
        let turn = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
        turn * Matrix3::from_diagonal(&variance) * turn.transpose()
    }

    /// Standard deviations along and across \[m\].
    pub(crate) fn along_and_across(&self) -> [f64; 2] {
        let own = self.covariance(0.0);
        [own[(0, 0)].sqrt(), own[(1, 1)].sqrt()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_covariance_is_that_of_the_errors() {
        let mut errors = MatchErrors::default();
        for k in 0..100 {
            let side = if k % 2 == 0 { 0.2 } else { -0.2 };
            errors.add(
                Pose::new(1.0, 2.0, 1.0),
                Pose::new(1.0, 2.0, 1.0) * Pose::new(0.05, side, 0.0),
            );
        }
        let [along, across] = errors.along_and_across();
        assert!((along - 0.05).abs() < 1e-9 && (across - 0.2).abs() < 1e-9);
        // Heading north, "along" is y.
        let north = errors.covariance(std::f64::consts::FRAC_PI_2);
        assert!((north[(1, 1)].sqrt() - 0.05).abs() < 1e-9);
        errors.drive(10.0);
        assert!(errors.along_and_across()[0] > 0.1);
    }
}
