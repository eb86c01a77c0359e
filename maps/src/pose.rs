//! Rigid transforms of the plane.

use std::f64::consts::{PI, TAU};
use std::ops::Mul;

use serde::{Deserialize, Serialize};

/// Wraps an angle to `[-pi, pi)` \[rad\].
pub fn wrap_angle(angle: f64) -> f64 {
    if (-PI..PI).contains(&angle) {
        angle
    } else {
        (angle + PI).rem_euclid(TAU) - PI
    }
}

/// A pose in the plane, or equally the rigid transform of SE(2) to its frame.
///
/// Named target-from-source so that transforms chain:
///
/// ```
/// use maps::Pose;
/// let map_from_base_link = Pose::new(1.0, 2.0, std::f64::consts::FRAC_PI_2);
/// let base_link_from_laser = Pose::new(0.27, 0.0, 0.0);
/// let map_from_laser = map_from_base_link * base_link_from_laser;
/// assert!((map_from_laser.y - 2.27).abs() < 1e-12);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Pose {
    /// Position along the target frame's x axis \[m\].
    pub x: f64,
    /// Position along the target frame's y axis \[m\].
    pub y: f64,
    /// Direction of the source's x axis in the target frame, in `[-pi, pi)` \[rad\].
    pub heading: f64,
}

impl Pose {
    /// The identity.
    pub const IDENTITY: Self = Self {
        x: 0.0,
        y: 0.0,
        heading: 0.0,
    };

    /// A pose at (`x`, `y`) \[m\] heading `heading` \[rad\], which is wrapped.
    pub fn new(x: f64, y: f64, heading: f64) -> Self {
        Self {
            x,
            y,
            heading: wrap_angle(heading),
        }
    }

    /// The inverse transform.
    #[must_use]
    pub fn inverse(self) -> Self {
        let (sin, cos) = self.heading.sin_cos();
        Self::new(
            -cos * self.x - sin * self.y,
            sin * self.x - cos * self.y,
            -self.heading,
        )
    }

    /// A point of the source frame, in the target frame \[m\].
    pub fn transform(self, point: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.heading.sin_cos();
        [
            self.x + cos * point[0] - sin * point[1],
            self.y + sin * point[0] + cos * point[1],
        ]
    }

    /// The motion from `earlier` to `self`, in the frame of `earlier`.
    #[must_use]
    pub fn since(self, earlier: Self) -> Self {
        earlier.inverse() * self
    }

    /// Distance between the two positions \[m\].
    pub fn distance(self, other: Self) -> f64 {
        (self.x - other.x).hypot(self.y - other.y)
    }

    /// The point of the geodesic of SE(2) from `self` (`fraction` 0) to `other` (`fraction` 1): motion of
    /// constant twist. Fractions outside `[0, 1]` extrapolate.
    #[must_use]
    pub fn interpolate(self, other: Self, fraction: f64) -> Self {
        self * Self::exp(other.since(self).log().map(|v| v * fraction))
    }

    /// The pose reached from the identity by the constant twist `[v_x, v_y, omega]` in unit time
    /// \[m, m, rad\]: the exponential map of SE(2).
    pub fn exp([vx, vy, omega]: [f64; 3]) -> Self {
        let (s, c) = if omega.abs() < 1e-6 {
            (1.0 - omega * omega / 6.0, omega / 2.0)
        } else {
            (omega.sin() / omega, (1.0 - omega.cos()) / omega)
        };
        Self::new(s * vx - c * vy, c * vx + s * vy, omega)
    }

    /// The twist `[v_x, v_y, omega]` that reaches this pose in unit time \[m, m, rad\]: the inverse of
    /// [`Pose::exp`].
    pub fn log(self) -> [f64; 3] {
        let omega = self.heading;
        let half = omega / 2.0;
        let cot = if omega.abs() < 1e-6 {
            1.0 - omega * omega / 12.0
        } else {
            half / half.tan()
        };
        [cot * self.x + half * self.y, cot * self.y - half * self.x, omega]
    }

    /// True when no component is NaN or infinite.
    pub fn is_finite(self) -> bool {
        self.x.is_finite() && self.y.is_finite() && self.heading.is_finite()
    }
}

impl Mul for Pose {
    type Output = Self;

    #[allow(
        clippy::suspicious_arithmetic_impl,
        reason = "headings of chained transforms add up"
    )]
    fn mul(self, source: Self) -> Self {
        let [x, y] = self.transform([source.x, source.y]);
        Self::new(x, y, self.heading + source.heading)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn pose() -> impl Strategy<Value = Pose> {
        (-50.0..50.0, -50.0..50.0, -3.1..3.1).prop_map(|(x, y, heading)| Pose::new(x, y, heading))
    }

    fn close(a: Pose, b: Pose) -> bool {
        a.distance(b) < 1e-9 && wrap_angle(a.heading - b.heading).abs() < 1e-9
    }

    proptest! {
        #[test]
        fn inverse_undoes(p in pose()) {
            prop_assert!(close(p * p.inverse(), Pose::IDENTITY));
        }

        #[test]
        fn exp_undoes_log(p in pose()) {
            prop_assert!(close(Pose::exp(p.log()), p));
        }

        #[test]
        fn interpolation_ends_at_its_ends(p in pose(), q in pose()) {
            prop_assert!(close(p.interpolate(q, 0.0), p));
            prop_assert!(close(p.interpolate(q, 1.0), q));
        }

        #[test]
        fn wrapped_angles_stay_in_range(angle in -1e4..1e4) {
            prop_assert!((-PI..PI).contains(&wrap_angle(angle)));
        }
    }

    #[test]
    fn constant_twist_follows_a_circle() {
        let quarter = Pose::exp([std::f64::consts::FRAC_PI_2, 0.0, std::f64::consts::FRAC_PI_2]);
        assert!(close(quarter, Pose::new(1.0, 1.0, std::f64::consts::FRAC_PI_2)));
    }
}
