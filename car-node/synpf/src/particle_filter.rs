//! The particle filter: prediction, weighting and resampling of the particles (Probabilistic Robotics, table 4.3).

use maps::Pose;
use nalgebra::{Matrix3, Vector3};

use crate::estimate::{Estimate, rotation};
use crate::motion_model::Motion;
use crate::parameters::Parameters;
use crate::particle_estimate::ParticleEstimate;
use crate::particles::Particles;
use crate::preprocessed_scan::PreprocessedScan;
use crate::ranges::Ranges;
use crate::resampling::Proposal;
use crate::sensor_model::SensorModel;
use crate::track_map::TrackMap;

/// Particles with the model that weighs them.
#[derive(Debug, Clone)]
pub(crate) struct ParticleFilter {
    pub(crate) particles: Particles,
    sensor_model: SensorModel,
    /// The region of the map that the car is in, and what predicts ranges there.
    ranges: Option<(usize, Ranges)>,
}

/// What weighting came to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Weighted {
    /// The particles summed up, after weighting.
    pub(crate) particles: ParticleEstimate,
    /// Whether any particle explains the scan; if none does, all weigh the same.
    pub(crate) sound: bool,
}

impl ParticleFilter {
    pub(crate) fn new(seed: u64, capacity: usize, sensor_model: SensorModel) -> Self {
        Self {
            particles: Particles::new(seed, capacity),
            sensor_model,
            ranges: None,
        }
    }

    /// Another sensor model from now on; the particles stay.
    pub(crate) fn set_sensor_model(&mut self, sensor_model: SensorModel) {
        self.sensor_model = sensor_model;
        self.ranges = None;
    }

    /// `count` particles drawn from an estimate.
    pub(crate) fn scatter(&mut self, count: usize, estimate: &Estimate) {
        self.particles.scatter(count, estimate.pose, [0.0; 3]);
        let cloud = proposal(estimate.pose, &estimate.covariance, 1.0);
        self.particles.replace_at_random(cloud);
    }

    /// Moves every particle by its own draw from `motion`.
    pub(crate) fn predict(&mut self, motion: &Motion) {
        self.particles.advance(motion);
    }

    /// Weighs every particle by the scan, with the ranges of the region around `near`.
    pub(crate) fn reweight(
        &mut self,
        map: &TrackMap,
        scan: &PreprocessedScan,
        near: Pose,
        parameters: &Parameters,
    ) -> Weighted {
        let region = map.region_at(near);
        let known = self.ranges.as_ref().map(|(of, _)| *of);
        let index = region.unwrap_or_else(|| known.unwrap_or(usize::MAX));
        let interim = matches!(self.ranges, Some((_, Ranges::Interim)));
        if known != Some(index) || interim {
            self.ranges = Some((index, self.sensor_model.ranges(map, region, parameters)));
        }
        if let Some((_, ranges)) = &self.ranges {
            let mount = scan.base_link_from_laser;
            self.sensor_model
                .reweight(&mut self.particles, scan, map, ranges, mount);
        }
        let sound = self.particles.normalize();
        Weighted {
            particles: self.particles.estimate(),
            sound,
        }
    }

    /// Resamples when the weights have become uneven. Some of the new particles are then drawn anew: a share from the fitted
    /// estimate, and, when the fit has fallen (`w_ratio` below 1), a share around it with room along the track.
    pub(crate) fn resample(
        &mut self,
        ess_ratio: f64,
        estimate: &Estimate,
        w_ratio: f64,
        parameters: &Parameters,
    ) {
        if ess_ratio > parameters.particles.resample_ess_ratio {
            return;
        }
        let count = self.particles.kld_sample_size(&parameters.particles);
        self.particles.resample(count);
        let feedback = if parameters.refinement.refine {
            let covariance = estimate.covariance + least_spread();
            proposal(estimate.pose, &covariance, parameters.refinement.refine_feedback)
        } else {
            None
        };
        let recovery = &parameters.recovery;
        let injected = (recovery.injection && w_ratio < recovery.injection_ratio).then(|| Proposal {
            mean: estimate.pose,
            // Along the track the estimate is most often wrong: slip, and walls without features.
            root: rotation(estimate.pose.heading) * Matrix3::from_diagonal(&Vector3::new(1.0, 0.2, 0.1)),
            share: recovery.injection_share * (1.0 - w_ratio),
        });
        self.particles
            .replace_at_random(feedback.into_iter().chain(injected));
    }
}

/// Particles around the fit are never spread less than this: 1 cm, 0.2 deg.
fn least_spread() -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::new(1e-4, 1e-4, 1e-5))
}

/// A normal distribution for particles to be drawn from; None where the covariance is not positive.
fn proposal(mean: Pose, covariance: &Matrix3<f64>, share: f64) -> Option<Proposal> {
    let root = covariance.cholesky()?.l();
    Some(Proposal { mean, root, share })
}
