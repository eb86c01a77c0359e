//! The reference's particles: resampled in every tick, weighted mean, covariance.

use maps::{Pose, wrap_angle};
use nalgebra::{Matrix3, Vector3};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};

use super::motion::Motion;

/// Poses in the grid's frame with weights.
#[derive(Debug, Clone)]
pub(super) struct Particles {
    /// x, y \[m\], heading \[rad\].
    pub(super) poses: Vec<[f64; 3]>,
    /// Weights with sum 1.
    pub(super) weights: Vec<f64>,
    rng: SmallRng,
    spare: Vec<[f64; 3]>,
    /// Sums of the weights up to each.
    sums: Vec<f64>,
}

/// A heap of particles that lie together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cluster {
    /// Its weighted mean.
    pub(super) mean: Pose,
    /// Its share of the weight.
    pub(super) mass: f64,
}

/// Size of a cluster \[m\], [rad]: 0.5 m and 20 deg.
const CLUSTER: [f64; 2] = [0.5, 0.349_065_85];

impl Particles {
    pub(super) fn new(seed: u64) -> Self {
        Self {
            poses: Vec::new(),
            weights: Vec::new(),
            rng: SmallRng::seed_from_u64(seed),
            spare: Vec::new(),
            sums: Vec::new(),
        }
    }

    pub(super) fn len(&self) -> usize {
        self.poses.len()
    }

    /// `count` particles around a pose, by the lower triangular root of their covariance.
    pub(super) fn scatter(&mut self, count: usize, around: Pose, root: &Matrix3<f64>) {
        let rng = &mut self.rng;
        self.poses.clear();
        self.poses.extend((0..count).map(|_| {
            let normal = Vector3::from_fn(|_, _| StandardNormal.sample(rng));
            let off: Vector3<f64> = root * normal;
            [around.x + off[0], around.y + off[1], around.heading + off[2]]
        }));
        self.even_weights();
    }

    /// `count` particles with any heading, each in one of the places that `place` gives for numbers in [0, 1).
    pub(super) fn scatter_over(&mut self, count: usize, place: impl Fn(f64) -> [f64; 2]) {
        let rng = &mut self.rng;
        self.poses.clear();
        self.poses.extend((0..count).map(|_| {
            let [x, y] = place(rng.random());
            [x, y, wrap_angle(rng.random::<f64>() * std::f64::consts::TAU)]
        }));
        self.even_weights();
    }

    fn even_weights(&mut self) {
        let count = self.poses.len();
        self.weights.clear();
        self.weights.resize(count, 1.0 / count.max(1) as f64);
    }

    /// Multinomial resampling to `count` particles: each a copy of one drawn by its weight, independent of the others.
    pub(super) fn resample(&mut self, count: usize) {
        let Some(last) = self.poses.len().checked_sub(1) else {
            return;
        };
        self.sums.clear();
        let mut sum = 0.0;
        self.sums.extend(self.weights.iter().map(|weight| {
            sum += weight;
            sum
        }));
        let rng = &mut self.rng;
        self.spare.clear();
        self.spare.extend((0..count).map(|_| {
            let drawn = rng.random::<f64>() * sum;
            self.poses[self.sums.partition_point(|&sum| sum <= drawn).min(last)]
        }));
        std::mem::swap(&mut self.poses, &mut self.spare);
        self.even_weights();
    }

    /// Moves every particle by its own draw.
    pub(super) fn advance(&mut self, motion: &Motion) {
        if *motion == Motion::None {
            return;
        }
        for pose in &mut self.poses {
            let [x, y, heading] = motion.apply(*pose, &mut self.rng);
            *pose = [x, y, wrap_angle(heading)];
        }
    }

    /// Weights from log-likelihoods. If none is a number, all become equal.
    pub(super) fn set_weights(&mut self, log_likelihoods: &[f64]) {
        let most = log_likelihoods.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if !most.is_finite() {
            self.even_weights();
            return;
        }
        self.weights.clear();
        self.weights
            .extend(log_likelihoods.iter().map(|log| (log - most).exp()));
        let sum: f64 = self.weights.iter().sum();
        self.weights.iter_mut().for_each(|weight| *weight /= sum);
    }

    /// The weighted mean, the heading by sine and cosine.
    pub(super) fn mean(&self) -> Pose {
        mean(self.poses.iter().zip(&self.weights))
    }

    /// Weighted covariance of x, y, heading about a pose.
    pub(super) fn covariance(&self, about: Pose) -> Matrix3<f64> {
        let term = |([x, y, heading], weight): (&[f64; 3], &f64)| {
            let off = Vector3::new(x - about.x, y - about.y, wrap_angle(heading - about.heading));
            off * off.transpose() * *weight
        };
        self.poses.iter().zip(&self.weights).map(term).sum()
    }

    /// Effective sample size over the number of particles.
    pub(super) fn ess_ratio(&self) -> f64 {
        let squares: f64 = self.weights.iter().map(|weight| weight * weight).sum();
        (1.0 / (squares.max(1e-300) * self.len().max(1) as f64)).min(1.0)
    }

    /// At most `most` clusters, the heaviest first: the heaviest bin with those around it, then the heaviest of the rest.
    pub(super) fn clusters(&self, most: usize) -> Vec<Cluster> {
        let key = |[x, y, heading]: &[f64; 3]| {
            [x / CLUSTER[0], y / CLUSTER[0], heading / CLUSTER[1]].map(|v| v.floor() as i64)
        };
        let turn = (std::f64::consts::TAU / CLUSTER[1]).round() as i64;
        let near = |a: [i64; 3], b: [i64; 3]| {
            let turned = (a[2] - b[2]).rem_euclid(turn);
            (a[0] - b[0]).abs() <= 1 && (a[1] - b[1]).abs() <= 1 && (turned <= 1 || turned == turn - 1)
        };
        let mut left: Vec<usize> = (0..self.len()).collect();
        let mut found = Vec::new();
        while found.len() < most && !left.is_empty() {
            // Sorted, so that the same particles give the same clusters.
            let mut bins = std::collections::BTreeMap::<[i64; 3], f64>::new();
            for &i in &left {
                *bins.entry(key(&self.poses[i])).or_default() += self.weights[i];
            }
            let Some((&heaviest, _)) = bins.iter().max_by(|a, b| a.1.total_cmp(b.1)) else {
                break;
            };
            let (members, others): (Vec<usize>, Vec<usize>) = left
                .into_iter()
                .partition(|&i| near(key(&self.poses[i]), heaviest));
            found.push(Cluster {
                mean: mean(members.iter().map(|&i| (&self.poses[i], &self.weights[i]))),
                mass: members.iter().map(|&i| self.weights[i]).sum(),
            });
            left = others;
        }
        found
    }
}

fn mean<'a>(particles: impl Iterator<Item = (&'a [f64; 3], &'a f64)>) -> Pose {
    let [mut x, mut y, mut cos, mut sin, mut sum] = [0.0; 5];
    for ([px, py, heading], weight) in particles {
        x += weight * px;
        y += weight * py;
        cos += weight * heading.cos();
        sin += weight * heading.sin();
        sum += weight;
    }
    Pose::new(x / sum, y / sum, sin.atan2(cos))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn particles(poses: &[[f64; 3]], weights: &[f64]) -> Particles {
        let mut particles = Particles::new(1);
        particles.poses = poses.to_vec();
        particles.weights = weights.to_vec();
        particles
    }

    #[test]
    fn copies_are_drawn_by_weight() {
        let mut some = particles(&[[0.0; 3], [1.0; 3], [2.0; 3]], &[0.2, 0.0, 0.8]);
        some.resample(10_000);
        let count = |x: f64| some.poses.iter().filter(|pose| (pose[0] - x).abs() < 0.5).count();
        // Binomial with sigma 40: within five of them.
        assert!((1800..2200).contains(&count(0.0)), "{}", count(0.0));
        assert_eq!(count(1.0), 0);
        assert_eq!(some.len(), 10_000);
    }

    #[test]
    fn weights_follow_likelihoods_and_survive_none() {
        let mut some = particles(&[[0.0; 3]; 2], &[0.5, 0.5]);
        some.set_weights(&[-1000.0, -1000.0 + 3f64.ln()]);
        assert!((some.weights[1] - 0.75).abs() < 1e-12);
        some.set_weights(&[f64::NEG_INFINITY; 2]);
        assert!((some.weights[0] - 0.5).abs() < 1e-12);
    }

    #[test]
    fn headings_average_across_the_wrap() {
        let some = particles(&[[0.0, 0.0, 3.1], [0.0, 2.0, -3.1]], &[0.5, 0.5]);
        let mean = some.mean();
        assert!((mean.heading.abs() - std::f64::consts::PI).abs() < 1e-9);
        let covariance = some.covariance(mean);
        assert!((covariance[(1, 1)] - 1.0).abs() < 1e-9);
        assert!(covariance[(2, 2)] < 0.01);
    }

    #[test]
    fn two_heaps_are_two_clusters() {
        let poses: Vec<[f64; 3]> = (0..100)
            .map(|i| [if i < 70 { 0.2 } else { 5.2 }, f64::from(i % 10) * 0.01, 3.1])
            .collect();
        let some = particles(&poses, &[0.01; 100]);
        let clusters = some.clusters(5);
        assert_eq!(clusters.len(), 2);
        assert!((clusters[0].mass - 0.7).abs() < 1e-9 && (clusters[1].mean.x - 5.2).abs() < 1e-9);
    }
}
