//! The stages of an update one by one, for the benchmarks: what each costs on a localizer in mid-drive.

use maps::Pose;

use super::SynPf;
use crate::Scan;
use crate::motion_model::Motion;
use crate::particle_estimate::ParticleEstimate;
use crate::quality::Quality;
use crate::seed::seed;

/// A part of [`SynPf::on_scan`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// The scan checked, deskewed and its beams chosen.
    Deskew,
    /// The particles moved on by odometry, with noise.
    Move,
    /// The log-likelihood of the scan at every particle.
    Weigh,
    /// Weights from log-weights, mean and covariance of the particles.
    Belief,
    /// The whole scan fitted around the prediction.
    Refine,
    /// Alignment, residual, short and long beams at the estimate.
    Judge,
    /// Systematic resampling of all particles.
    Resample,
    /// A look at the whole map for where the scan may have been taken; part of a search, not of an update.
    Look,
}

impl Stage {
    /// Those of an update, in its order.
    pub const ALL: [Self; 7] = [
        Self::Deskew,
        Self::Move,
        Self::Weigh,
        Self::Belief,
        Self::Refine,
        Self::Judge,
        Self::Resample,
    ];
}

impl SynPf {
    /// Runs one stage on the state that the last update left. What it does to that state is no update: throw the
    /// localizer away.
    pub fn run_stage(&mut self, stage: Stage, scan: &Scan) {
        match stage {
            Stage::Deskew => {
                let loaded = self.scan.load(
                    scan,
                    &self.track,
                    self.slip,
                    self.base_link_from_laser,
                    self.parameters.sensor.max_range,
                    &self.parameters.beams,
                );
                debug_assert!(loaded.is_ok(), "{loaded:?}");
            }
            Stage::Move => self.particles.advance(&Motion::new(
                Pose::new(0.1, 0.0, 0.01),
                0.025,
                1.0,
                &self.parameters.motion,
                self.parameters.defects,
            )),
            Stage::Weigh => self.weigh(self.estimate.pose),
            Stage::Belief => {
                self.particles.normalize();
                std::hint::black_box(self.particles.estimate());
            }
            Stage::Refine => {
                let belief = ParticleEstimate {
                    mean: self.estimate.pose,
                    covariance: self.estimate.covariance,
                    ess_ratio: 1.0,
                };
                std::hint::black_box(self.refined(&self.estimate, &belief));
            }
            Stage::Judge => {
                std::hint::black_box(Quality::new(&self.map, &self.scan, self.estimate.pose));
            }
            Stage::Look => {
                std::hint::black_box(seed(&self.map, &self.scan.points, &self.parameters.search));
            }
            Stage::Resample => {
                let count = self.particles.len();
                self.particles.resample(count);
            }
        }
    }
}
