//! Mean, covariance and effective sample size of the particles.

use maps::Pose;
use nalgebra::Matrix3;
use wide::f32x8;

use crate::particles::Particles;
use crate::pose_array::{PoseArray, load};

/// The posterior as the particles have it, in the grid's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ParticleEstimate {
    /// Weighted mean.
    pub(crate) mean: Pose,
    /// Weighted covariance of x, y [m^2] and heading [rad^2].
    pub(crate) covariance: Matrix3<f64>,
    /// Effective sample size over the number of particles, in [0, 1].
    pub(crate) ess_ratio: f64,
}

impl Particles {
    /// Their mean, covariance and effective sample size.
    pub(crate) fn estimate(&self) -> ParticleEstimate {
        ParticleEstimate::new(&self.poses, &self.weight)
    }
}

impl ParticleEstimate {
    /// Of at least one pose. Headings are averaged by sine and cosine.
    pub(crate) fn new(poses: &PoseArray, weight: &[f32]) -> Self {
        let (xs, ys, cosines, sines) = (poses.x(), poses.y(), poses.cos(), poses.sin());
        // Sums relative to the first particle, so that f32 is precise enough on a track of kilometres.
        let [x0, y0] = [xs[0], ys[0]];
        let mut sums = [f32x8::ZERO; 9];
        let count = poses.len();
        for i in (0..count).step_by(8) {
            let lanes = 8.min(count - i);
            let w = load(&weight[i..], lanes);
            let (x, y) = (
                load(&xs[i..], lanes) - f32x8::splat(x0),
                load(&ys[i..], lanes) - f32x8::splat(y0),
            );
            let (c, s) = (load(&cosines[i..], lanes), load(&sines[i..], lanes));
            let (wx, wy) = (w * x, w * y);
            for (sum, term) in sums
                .iter_mut()
                .zip([w, wx, wy, w * c, w * s, wx * x, wy * y, wx * y, w * w])
            {
                *sum += term;
            }
        }
        let [w, x, y, c, s, xx, yy, xy, ww] = sums.map(|sum| f64::from(sum.reduce_add()));
        let w = w.max(1e-12);
        let (mx, my) = (x / w, y / w);
        let mean = Pose::new(mx + f64::from(x0), my + f64::from(y0), s.atan2(c));
        // Deviations of the heading as their sines: on a localized car they are small.
        let (sin, cos) = (
            f32x8::splat(mean.heading.sin() as f32),
            f32x8::splat(mean.heading.cos() as f32),
        );
        let (fx, fy) = (f32x8::splat(mean.x as f32), f32x8::splat(mean.y as f32));
        let mut about = [f32x8::ZERO; 3];
        for i in (0..count).step_by(8) {
            let lanes = 8.min(count - i);
            let off = load(&sines[i..], lanes) * cos - load(&cosines[i..], lanes) * sin;
            let weighed = off * load(&weight[i..], lanes);
            about[0] += weighed * (load(&xs[i..], lanes) - fx);
            about[1] += weighed * (load(&ys[i..], lanes) - fy);
            about[2] += weighed * off;
        }
        let [xh, yh, hh] = about.map(|sum| f64::from(sum.reduce_add()) / w);
        // The circular variance where headings spread widely.
        let resultant = (c.hypot(s) / w).max(1e-6);
        let heading_variance = if resultant > 0.98 {
            hh
        } else {
            -2.0 * resultant.ln()
        };
        let (xx, yy, xy) = (
            (xx / w - mx * mx).max(0.0),
            (yy / w - my * my).max(0.0),
            xy / w - mx * my,
        );
        let covariance = Matrix3::new(xx, xy, xh, xy, yy, yh, xh, yh, heading_variance);
        Self {
            mean,
            covariance,
            ess_ratio: (w * w / (ww.max(1e-12) * count as f64)).clamp(0.0, 1.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 20000 draws: the mean is known to sigma / 141, the variance to 1 %; tolerances are four times that.
    #[test]
    fn the_estimate_is_what_was_drawn() {
        let pose = Pose::new(120.0, 40.0, 3.1);
        let mut particles = Particles::new(7, 20_000);
        particles.scatter(20_000, pose, [0.3, 0.2, 0.1]);
        let estimate = particles.estimate();
        assert!(estimate.mean.distance(pose) < 0.01);
        assert!(maps::wrap_angle(estimate.mean.heading - pose.heading).abs() < 0.003);
        for (got, sigma) in estimate.covariance.diagonal().iter().zip([0.3f64, 0.2, 0.1]) {
            assert!((got / (sigma * sigma) - 1.0).abs() < 0.04, "{got} {sigma}");
        }
        assert!((estimate.ess_ratio - 1.0).abs() < 1e-3);
    }
}
