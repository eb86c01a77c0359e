//! Resampling: how many particles there are next, which ones are copied, and which are drawn elsewhere.

use maps::Pose;
use nalgebra::{Matrix3, Vector3};
use rand::RngExt;

use crate::particles::{ParticleParameters, Particles};

/// A normal distribution that particles are drawn from in place of resampled ones.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Proposal {
    /// Its mean, in the grid's frame.
    pub(crate) mean: Pose,
    /// Lower triangular root of its covariance of x, y \[m\] and heading \[rad\].
    pub(crate) root: Matrix3<f64>,
    /// Share of the particles that are drawn from it, in [0, 1].
    pub(crate) share: f64,
}

impl Particles {
    /// Number of particles that the spread asks for (KLD-sampling; Fox, IJRR 2003, equation 7), from the bins of 0.25 m
    /// and 10 deg that they fill.
    pub(crate) fn kld_sample_size(&mut self, parameters: &ParticleParameters) -> usize {
        let ParticleParameters {
            min_particles: fewest,
            max_particles: most,
            ..
        } = *parameters;
        if fewest == most {
            return most;
        }
        let filled = self.bins.filled(&self.poses, &self.weight);
        if filled < 2 {
            return fewest;
        }
        let freedom = (filled - 1) as f64;
        let a = 2.0 / (9.0 * freedom);
        let root = 1.0 - a + a.sqrt() * parameters.kld_quantile;
        let size = (freedom / (2.0 * parameters.kld_error) * root.powi(3)).ceil() as usize;
        size.clamp(fewest, most)
    }

    /// Systematic resampling (Probabilistic Robotics, table 4.4) to `count` particles of equal weight. The copies are in
    /// the order of the particles that they are copied from.
    pub(crate) fn resample(&mut self, count: usize) {
        // Particle i gets the copies up to where its share of the sum ends. Each index is written four at a time and the
        // surplus overwritten by the next: most particles get fewer copies, and a loop's branch would be mispredicted.
        const AT_ONCE: usize = 4;
        let copies = &mut self.indices;
        copies.clear();
        copies.resize(count + AT_ONCE, 0);
        let offset = self.rng.random::<f64>();
        let (mut sum, mut begin) = (0.0, 0);
        for (i, &weight) in self.weight.iter().enumerate() {
            sum += f64::from(weight);
            let end = ((sum * count as f64 - offset + 1.0) as usize).min(count);
            let some: &mut [u32; AT_ONCE] = (&mut copies[begin..begin + AT_ONCE])
                .try_into()
                .expect("a slice of this length");
            *some = [i as u32; AT_ONCE];
            if end > begin + AT_ONCE {
                copies[begin + AT_ONCE..end].fill(i as u32);
            }
            begin = end.max(begin);
        }
        // Rounding may leave the last copies over.
        let last = self.poses.len() as u32 - 1;
        copies[begin..].fill(last);
        self.spare.gather(&self.poses, &copies[..count]);
        std::mem::swap(&mut self.poses, &mut self.spare);
        self.even_weights();
    }

    /// Draws a share of the particles anew from each proposal, in place of particles chosen at random.
    ///
    /// For use after [`Particles::resample`]: every particle then has the weight 1/N, and the drawn ones keep it. Each
    /// copy is as likely to be replaced as any other, so with shares that sum to s the particles represent the mixture
    /// (1 - s) posterior + sum of share * proposal. No importance weight p / q corrects this: a proposal pulls the
    /// particles towards itself by its share, until the next scan weighs them.
    pub(crate) fn replace_at_random(&mut self, proposals: impl IntoIterator<Item = Proposal>) {
        let count = self.len();
        self.indices.clear();
        self.indices.extend(0..count as u32);
        let mut taken = 0;
        for proposal in proposals {
            let share = (proposal.share * count as f64) as usize;
            for _ in 0..share.min(count - taken) {
                // One step of a Fisher-Yates shuffle: any index that is not taken yet.
                let chosen = self.rng.random_range(taken..count);
                self.indices.swap(taken, chosen);
                let pose = self.draw(&proposal);
                self.poses.set(self.indices[taken] as usize, pose);
                taken += 1;
            }
        }
    }

    /// Draws a pose from a proposal.
    fn draw(&mut self, proposal: &Proposal) -> Pose {
        let noise = self.pool.draw(&mut self.rng, 3);
        let off = proposal.root * Vector3::new(noise[0].into(), noise[1].into(), noise[2].into());
        let mean = proposal.mean;
        Pose::new(mean.x + off[0], mean.y + off[1], mean.heading + off[2])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Particles at x = 0, 1, 2 ..., with the given weights.
    fn in_a_row(weight: &[f32]) -> Particles {
        let mut particles = Particles::new(7, weight.len());
        particles.scatter(weight.len(), Pose::IDENTITY, [0.0; 3]);
        for i in 0..weight.len() {
            particles.poses.set(i, Pose::new(i as f64, 0.0, 0.0));
        }
        particles.weight.copy_from_slice(weight);
        particles
    }

    /// Number of particles at (x, 0).
    fn count_at(particles: &Particles, x: f32) -> usize {
        let at = |&other: &&f32| (other - x).abs() < 1e-6;
        particles.poses.x().iter().filter(at).count()
    }

    #[test]
    fn systematic_resampling_keeps_shares_to_within_one() {
        let mut particles = in_a_row(&[0.1, 0.2, 0.3, 0.4]);
        particles.resample(1000);
        for (i, share) in [100.0, 200.0, 300.0, 400.0].into_iter().enumerate() {
            let count = count_at(&particles, i as f32) as f64;
            assert!((count - share).abs() <= 1.0, "{i}: {count}");
        }
    }

    /// The first indices used to be replaced, which hold the copies of the first particles: with a share of one half, the
    /// first four of eight equal particles died out in one resampling and the others lost nothing.
    ///
    /// 500 of the 1000 copies are replaced; a particle keeps 62.5 of its 125 on average, with a standard deviation of 5.2
    /// (hypergeometric). The tolerance is four times that.
    #[test]
    fn every_particle_loses_the_same_share_to_replacement() {
        let mut particles = in_a_row(&[0.125; 8]);
        particles.resample(1000);
        let proposal = |x: f64, share| Proposal {
            mean: Pose::new(x, 0.0, 0.0),
            root: Matrix3::zeros(),
            share,
        };
        particles.replace_at_random([proposal(100.0, 0.3), proposal(200.0, 0.2)]);
        for i in 0..8 {
            let left = count_at(&particles, i as f32) as f64;
            assert!((left - 62.5).abs() < 21.0, "particle {i}: {left} copies left");
        }
        assert_eq!(count_at(&particles, 100.0), 300);
        assert_eq!(count_at(&particles, 200.0), 200);
        assert!(
            particles
                .weight
                .iter()
                .all(|&weight| (weight - 1e-3).abs() < 1e-9)
        );
    }

    #[test]
    fn replacement_takes_no_more_than_all() {
        let mut particles = in_a_row(&[0.5; 2]);
        let proposal = Proposal {
            mean: Pose::new(9.0, 0.0, 0.0),
            root: Matrix3::zeros(),
            share: 1.0,
        };
        particles.replace_at_random([proposal, proposal]);
        assert_eq!(count_at(&particles, 9.0), 2);
    }

    #[test]
    fn a_wide_cloud_asks_for_more_particles() {
        let parameters = ParticleParameters {
            max_particles: 3000,
            ..ParticleParameters::default()
        };
        let size = |sigma| {
            let mut particles = Particles::new(7, 3000);
            particles.scatter(3000, Pose::IDENTITY, sigma);
            particles.kld_sample_size(&parameters)
        };
        assert_eq!(size([0.02, 0.02, 0.01]), parameters.min_particles);
        assert_eq!(size([1.0, 1.0, 0.5]), 3000);
    }
}
