//! A pose with its uncertainty.

use maps::Pose;
use nalgebra::Matrix3;

/// A pose with its uncertainty, in the grid's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Estimate {
    /// The pose of `base_link`.
    pub(crate) pose: Pose,
    /// Covariance of x, y [m^2] and heading [rad^2].
    pub(crate) covariance: Matrix3<f64>,
}

impl Estimate {
    /// The estimate carried on by a motion of `base_link`, whose uncertainty in its own frame is `noise`.
    pub(crate) fn moved(&self, motion: Pose, noise: &Matrix3<f64>) -> Self {
        let pose = self.pose * motion;
        let jacobian = carry(self.pose, pose);
        let turn = rotation(self.pose.heading);
        let covariance = jacobian * self.covariance * jacobian.transpose() + turn * noise * turn.transpose();
        Self { pose, covariance }
    }

    /// The estimate in the frame that `frame` is given in.
    pub(crate) fn transformed(&self, frame: Pose) -> Self {
        let turn = rotation(frame.heading);
        Self {
            pose: frame * self.pose,
            covariance: turn * self.covariance * turn.transpose(),
        }
    }

    /// Standard deviations along and across the heading \[m\].
    pub(crate) fn along_and_across(&self) -> [f64; 2] {
        let turn = rotation(self.pose.heading);
        let own = turn.transpose() * self.covariance * turn;
        [own[(0, 0)].max(0.0).sqrt(), own[(1, 1)].max(0.0).sqrt()]
    }
}

/// How an error of a pose is carried on by a motion: its Jacobian, in the frame of the poses.
pub(crate) fn carry(from: Pose, to: Pose) -> Matrix3<f64> {
    let (dx, dy) = (to.x - from.x, to.y - from.y);
    Matrix3::new(1.0, 0.0, -dy, 0.0, 1.0, dx, 0.0, 0.0, 1.0)
}

/// Whether two poses differ by less than so much \[m\], \[rad\].
pub(crate) fn are_near(a: Pose, b: Pose, within: [f64; 2]) -> bool {
    a.distance(b) < within[0] && maps::wrap_angle(a.heading - b.heading).abs() < within[1]
}

/// Turns the covariance of x, y and heading from a frame at `heading` \[rad\] into the frame around it.
pub(crate) fn rotation(heading: f64) -> Matrix3<f64> {
    let (sin, cos) = heading.sin_cos();
    Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn noise_along_the_heading_stays_along_it() {
        let start = Estimate {
            pose: Pose::new(1.0, 2.0, 0.7),
            covariance: Matrix3::zeros(),
        };
        let noise = Matrix3::from_diagonal(&Vector3::new(0.04, 0.01, 0.0));
        let moved = start.moved(Pose::new(0.5, 0.0, 0.0), &noise);
        let [along, across] = moved.along_and_across();
        assert!((along - 0.2).abs() < 1e-12 && (across - 0.1).abs() < 1e-12);
        let turned = moved.transformed(Pose::new(3.0, -1.0, 1.1));
        let [along, across] = turned.along_and_across();
        assert!((along - 0.2).abs() < 1e-12 && (across - 0.1).abs() < 1e-12);
    }

    #[test]
    fn an_uncertain_heading_becomes_uncertainty_across_the_way() {
        let start = Estimate {
            pose: Pose::IDENTITY,
            covariance: Matrix3::from_diagonal(&Vector3::new(0.0, 0.0, 1e-4)),
        };
        let moved = start.moved(Pose::new(5.0, 0.0, 0.0), &Matrix3::zeros());
        let [along, across] = moved.along_and_across();
        assert!(along < 1e-12 && (across - 0.05).abs() < 1e-12);
    }
}
