//! The steps of an update one by one, for the benchmarks: what each costs on a localizer in mid-drive.

use localizer::Scan;
use maps::Pose;

use super::SynPf;
use crate::correlative_match::seed;
use crate::motion_model::Motion;
use crate::particle_estimate::ParticleEstimate;
use crate::particle_filter::Weighted;

/// A step of [`SynPf::on_scan`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// The scan checked, deskewed and its beams chosen.
    Preprocess,
    /// The particles moved on by odometry, with noise.
    Predict,
    /// The log-likelihood of the scan at every particle, the weights, and the particles summed up.
    Reweight,
    /// The whole scan fitted around the prediction.
    Fit,
    /// Alignment, residual, short and long beams at the estimate.
    Assess,
    /// Systematic resampling of all particles.
    Resample,
    /// A look at the whole map for where the scan may have been taken; part of a search, not of an update.
    Search,
}

impl Stage {
    /// Those of an update, in its order.
    pub const ALL: [Self; 6] = [
        Self::Preprocess,
        Self::Predict,
        Self::Reweight,
        Self::Fit,
        Self::Assess,
        Self::Resample,
    ];
}

impl SynPf {
    /// Runs one step on the state that the last update left. What it does to that state is no update: throw the
    /// localizer away.
    pub fn run_stage(&mut self, stage: Stage, scan: &Scan) {
        let parameters = &self.parameters;
        let estimate = &self.tracker.estimate;
        match stage {
            Stage::Preprocess => {
                let geometry = self.sensors.geometry(scan);
                let loaded = self.scan.load(
                    (scan, &geometry),
                    &self.odometry,
                    self.calibration.slip,
                    self.base_link_from_laser,
                    parameters.sensor.max_range,
                    &parameters.beams,
                );
                debug_assert!(loaded.is_ok(), "{loaded:?}");
            }
            Stage::Predict => self.filter.predict(&Motion::new(
                Pose::new(0.1, 0.0, 0.01),
                0.025,
                1.0,
                &parameters.motion,
            )),
            Stage::Reweight => {
                let near = estimate.pose;
                std::hint::black_box(self.filter.reweight(&self.map, &self.scan, near, parameters));
            }
            Stage::Fit => {
                let weighted = Weighted {
                    particles: ParticleEstimate {
                        mean: estimate.pose,
                        covariance: estimate.covariance,
                        ess_ratio: 1.0,
                    },
                    sound: true,
                };
                std::hint::black_box(self.tracker.fit_scan(
                    self.map.field(),
                    &self.scan.points,
                    estimate,
                    &weighted,
                    self.calibration.walls,
                    &parameters.refinement,
                ));
            }
            Stage::Assess => {
                std::hint::black_box(self.assess());
            }
            Stage::Resample => {
                self.filter.resample(0.0, estimate, 1.0, parameters);
            }
            Stage::Search => {
                std::hint::black_box(seed(&self.map, &self.scan.points, &parameters.search));
            }
        }
    }
}
