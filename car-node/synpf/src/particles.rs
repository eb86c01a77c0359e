//! The set of particles: drawn, moved, weighed.
//!
//! `particle_estimate.rs` has its mean and covariance, `resampling.rs` how it is drawn anew.

use maps::Pose;
use rand::SeedableRng;
use rand::rngs::SmallRng;
use serde::{Deserialize, Serialize};
use wide::f32x8;

use crate::motion_model::Motion;
use crate::normal_pool::{NormalPool, POOL};
use crate::pose_array::{PoseArray, load, store};
use crate::pose_bins::PoseBins;
use crate::validation::Check;

/// How many particles there are, and when they are resampled.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ParticleParameters {
    /// Upper bound of the number of particles.
    pub max_particles: usize,
    /// Lower bound of the number of particles; equal to `max_particles`, the number is fixed.
    pub min_particles: usize,
    /// KLD-sampling: allowed Kullback-Leibler divergence between the sampled and the true posterior \[nat\] (epsilon in Fox,
    /// IJRR 2003; `kld_err` in AMCL).
    pub kld_error: f64,
    /// KLD-sampling: quantile of the standard normal for the probability that the divergence stays below `kld_error`; 2.33
    /// is 99 % (z of 1 - delta in Fox, IJRR 2003; `kld_z` in AMCL).
    pub kld_quantile: f64,
    /// Resample when the effective sample size is at most this share of the number of particles, in [0, 1]; 1 resamples at
    /// every scan, 0 never.
    pub resample_ess_ratio: f64,
    /// Standard deviation of a given initial pose along x \[m\].
    pub initial_std_x: f64,
    /// Standard deviation of a given initial pose along y \[m\].
    pub initial_std_y: f64,
    /// Standard deviation of a given initial heading \[rad\].
    pub initial_std_heading: f64,
}

impl Default for ParticleParameters {
    fn default() -> Self {
        Self {
            max_particles: 1500,
            min_particles: 600,
            kld_error: 0.05,
            kld_quantile: 2.33,
            resample_ess_ratio: 0.5,
            initial_std_x: 0.5,
            initial_std_y: 0.5,
            initial_std_heading: 0.4,
        }
    }
}

impl ParticleParameters {
    pub(crate) fn validate(&self, check: &mut Check) {
        check.range("max_particles", self.max_particles as f64, 10.0, 100_000.0);
        check.range("min_particles", self.min_particles as f64, 10.0, 100_000.0);
        check.that("min_particles", self.min_particles <= self.max_particles, || {
            format!(
                "{} is more than max_particles, {}",
                self.min_particles, self.max_particles
            )
        });
        check.range("kld_error", self.kld_error, 1e-4, 1.0);
        check.range("kld_quantile", self.kld_quantile, 0.0, 6.0);
        check.range("resample_ess_ratio", self.resample_ess_ratio, 0.0, 1.0);
        check.range("initial_std_x", self.initial_std_x, 0.0, 100.0);
        check.range("initial_std_y", self.initial_std_y, 0.0, 100.0);
        check.range("initial_std_heading", self.initial_std_heading, 0.0, 10.0);
    }
}

/// Poses with weights, in the grid's frame.
#[derive(Debug, Clone)]
pub(crate) struct Particles {
    pub(crate) poses: PoseArray,
    /// Log-weights; the sensor model adds to them.
    pub(crate) log_weight: Vec<f32>,
    /// Weights with sum 1, as of the last [`Particles::normalize`].
    pub(crate) weight: Vec<f32>,
    pub(crate) rng: SmallRng,
    pub(crate) pool: NormalPool,
    /// Buffers of the resampling: the poses to be, and indices of particles.
    pub(crate) spare: PoseArray,
    pub(crate) indices: Vec<u32>,
    pub(crate) bins: PoseBins,
}

impl Particles {
    /// No particles yet, but room for `capacity` of them.
    pub(crate) fn new(seed: u64, capacity: usize) -> Self {
        let mut rng = SmallRng::seed_from_u64(seed);
        let pool = NormalPool::new(&mut rng);
        Self {
            poses: PoseArray::with_capacity(capacity),
            log_weight: Vec::with_capacity(capacity),
            weight: Vec::with_capacity(capacity),
            rng,
            pool,
            spare: PoseArray::with_capacity(capacity),
            indices: Vec::with_capacity(capacity + 4),
            bins: PoseBins::new(),
        }
    }

    /// Number of particles.
    pub(crate) fn len(&self) -> usize {
        self.poses.len()
    }

    /// Draws `count` particles around a pose, with the given standard deviations of x, y \[m\] and heading \[rad\].
    pub(crate) fn scatter(&mut self, count: usize, pose: Pose, sigma: [f64; 3]) {
        self.poses.resize(count);
        for i in 0..count {
            let noise = self.pool.draw(&mut self.rng, 3);
            let [dx, dy, turn] = std::array::from_fn(|k| sigma[k] * f64::from(noise[k]));
            self.poses
                .set(i, Pose::new(pose.x + dx, pose.y + dy, pose.heading + turn));
        }
        self.even_weights();
    }

    /// Gives every particle the same weight.
    pub(crate) fn even_weights(&mut self) {
        let count = self.len();
        self.log_weight.clear();
        self.log_weight.resize(count, 0.0);
        self.weight.clear();
        self.weight.resize(count, 1.0 / count.max(1) as f32);
    }

    /// Moves every particle by its own draw from `motion`.
    pub(crate) fn advance(&mut self, motion: &Motion) {
        const LANES: usize = 8;
        let count = self.len();
        let (Motion::Polar { mean, sigma } | Motion::Body { mean, sigma }) = *motion;
        let polar = matches!(motion, Motion::Polar { .. });
        let mut begin = 0;
        while begin < count {
            // The pool holds enough for a part of the particles at a time.
            let part = (count - begin).min(POOL / 8);
            let draws = part.next_multiple_of(LANES);
            let noise = self.pool.draw(&mut self.rng, 3 * draws);
            for at in (0..part).step_by(LANES) {
                let lanes = LANES.min(part - at);
                let i = begin + at;
                let draw = |component: usize| {
                    let from = component * draws + at;
                    let numbers: [f32; LANES] = noise[from..from + LANES].try_into().expect("eight lanes");
                    f32x8::splat(mean[component]) + f32x8::splat(sigma[component]) * f32x8::from(numbers)
                };
                let (a, b, c) = (draw(0), draw(1), draw(2));
                let heading = load(&self.poses.heading()[i..], lanes);
                let (x, y) = (
                    load(&self.poses.x()[i..], lanes),
                    load(&self.poses.y()[i..], lanes),
                );
                let moved = if polar {
                    let (sin, cos) = (heading + a).sin_cos();
                    [x + b * cos, y + b * sin, heading + a + c]
                } else {
                    let (sin, cos) = heading.sin_cos();
                    [x + a * cos - b * sin, y + a * sin + b * cos, heading + c]
                };
                self.poses.store(i, lanes, moved);
            }
            begin += part;
        }
    }

    /// Computes the weights from the log-weights, with sum 1. If every weight is zero or not a number, all become equal and
    /// the result is false.
    pub(crate) fn normalize(&mut self) -> bool {
        let greatest = greatest(&self.log_weight);
        if !greatest.is_finite() {
            self.even_weights();
            return false;
        }
        let mut sum = f32x8::ZERO;
        let top = f32x8::splat(greatest);
        let count = self.len();
        for i in (0..count).step_by(8) {
            let lanes = 8.min(count - i);
            // A weight below e^-80 does not count; the bound also keeps infinities out.
            let log = (load(&self.log_weight[i..], lanes) - top).max(f32x8::splat(-80.0));
            // Kept relative to the greatest, so that a filter that never resamples stays in the range of f32.
            store(log, &mut self.log_weight[i..], lanes);
            let mut weight = log.exp();
            if lanes < 8 {
                let mut kept = weight.to_array();
                kept[lanes..].fill(0.0);
                weight = f32x8::from(kept);
            }
            sum += weight;
            store(weight, &mut self.weight[i..], lanes);
        }
        let scale = 1.0 / sum.reduce_add();
        self.weight.iter_mut().for_each(|weight| *weight *= scale);
        true
    }

    /// Mass of the second cluster over that of the first, among clusters of 0.5 m and 20 deg.
    pub(crate) fn second_mode(&mut self) -> f64 {
        self.bins.second_mode(&self.poses, &self.weight)
    }
}

/// The greatest of the values, NaN left out; minus infinity if there is none.
fn greatest(values: &[f32]) -> f32 {
    let (eights, rest) = values.as_chunks::<8>();
    let mut most = [f32::NEG_INFINITY; 8];
    for eight in eights {
        for (most, &value) in most.iter_mut().zip(eight) {
            // Unlike `f32::max` this compiles to one instruction for four values. It leaves NaN out as well.
            *most = if value > *most { value } else { *most };
        }
    }
    most.into_iter()
        .chain(rest.iter().copied())
        .fold(f32::NEG_INFINITY, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(count: usize, pose: Pose, sigma: [f64; 3]) -> Particles {
        let mut particles = Particles::new(7, count);
        particles.scatter(count, pose, sigma);
        particles
    }

    #[test]
    fn motion_has_the_mean_and_the_noise_asked_for() {
        let mut particles = cloud(20_001, Pose::new(5.0, 5.0, 1.0), [0.0; 3]);
        particles.advance(&Motion::Polar {
            mean: [0.1, 0.5, 0.2],
            sigma: [0.0, 0.05, 0.02],
        });
        let estimate = particles.estimate();
        let expected = Pose::new(5.0 + 0.5 * 1.1f64.cos(), 5.0 + 0.5 * 1.1f64.sin(), 1.3);
        assert!(estimate.mean.distance(expected) < 0.002, "{estimate:?}");
        let along = nalgebra::Vector3::new(1.1f64.cos(), 1.1f64.sin(), 0.0);
        let variance = (along.transpose() * estimate.covariance * along)[0];
        assert!((variance.sqrt() / 0.05 - 1.0).abs() < 0.04);
        assert!((estimate.covariance[(2, 2)].sqrt() / 0.02 - 1.0).abs() < 0.04);
    }

    #[test]
    fn weights_that_mean_nothing_become_even() {
        let mut particles = cloud(100, Pose::IDENTITY, [0.1; 3]);
        for nothing in [f32::NEG_INFINITY, f32::NAN] {
            particles.log_weight.fill(nothing);
            assert!(!particles.normalize());
            assert!(particles.weight.iter().all(|&w| (w - 0.01).abs() < 1e-6));
        }
        particles.log_weight.fill(-1e30);
        particles.log_weight[3] = 0.0;
        assert!(particles.normalize());
        assert!((particles.weight[3] - 1.0).abs() < 1e-3);
    }

    /// A set that never resamples used to add up log-weights until all were minus infinity.
    #[test]
    fn log_weights_stay_bounded_without_resampling() {
        let mut particles = cloud(10, Pose::IDENTITY, [0.1; 3]);
        for _ in 0..1000 {
            for (i, log_weight) in particles.log_weight.iter_mut().enumerate() {
                *log_weight -= 1e36 * (1.0 + i as f32);
            }
            assert!(particles.normalize());
        }
        assert!((particles.weight[0] - 1.0).abs() < 1e-6, "{:?}", particles.weight);
    }

    #[test]
    fn two_clusters_are_seen() {
        let mut particles = cloud(1000, Pose::new(3.0, 3.0, 0.0), [0.02; 3]);
        assert!(particles.second_mode() < 0.01);
        for i in 0..400 {
            particles.poses.set(i, Pose::new(8.3, 3.3, 0.1));
        }
        assert!((particles.second_mode() - 400.0 / 600.0).abs() < 0.05);
    }
}
