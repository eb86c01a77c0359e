//! The likelihood field (Probabilistic Robotics, table 6.3): distance of an end point to the nearest wall.

use maps::DistanceField;

use crate::beam_layout::MOST_BEAMS;
use crate::particles::Particles;
use crate::preprocessed_scan::PreprocessedScan;
use crate::sensor_parameters::SensorParameters;

/// Log-likelihoods by distance to the nearest wall, in steps of 1 cm.
#[derive(Debug, Clone)]
pub(crate) struct LikelihoodField {
    by_distance: Vec<f32>,
    /// The log-likelihood of an end point outside the map.
    off_track: f32,
}

/// Step of the table \[m\].
const FIELD_STEP: f32 = 0.01;

/// All distances from here on are equally likely \[m\].
const FIELD_LIMIT: f32 = 2.0;

/// A particle inside a wall loses as much as by so many end points outside the map.
const OFF_TRACK: f32 = 5.0;

impl LikelihoodField {
    /// Computes the table.
    pub(crate) fn new(parameters: &SensorParameters) -> Self {
        let [z_hit, _, _, z_rand] = parameters.mixture();
        let squash = 1.0 / parameters.squash_factor;
        let log = |distance: f64| {
            let deviation = distance / parameters.sigma_hit;
            let hit = z_hit * (-0.5 * deviation * deviation).exp()
                / (parameters.sigma_hit * std::f64::consts::TAU.sqrt());
            ((hit + z_rand / parameters.max_range).ln() * squash) as f32
        };
        let steps = (FIELD_LIMIT / FIELD_STEP) as usize;
        let by_distance: Vec<f32> = (0..=steps)
            .map(|k| log(k as f64 * f64::from(FIELD_STEP)))
            .collect();
        let off_track = by_distance[steps];
        Self {
            by_distance,
            off_track,
        }
    }

    /// Adds the log-likelihood of the beams to weigh to every particle's log-weight.
    pub(crate) fn reweight(&self, particles: &mut Particles, scan: &PreprocessedScan, field: &DistanceField) {
        let cells = 1.0 / field.resolution() as f32;
        let mut points = [[0.0f32; 2]; MOST_BEAMS];
        let mut count = 0;
        for point in scan.weighed_points().take(MOST_BEAMS) {
            points[count] = point.map(|v| v * cells);
            count += 1;
        }
        let poses = &particles.poses;
        for (i, log_weight) in particles.log_weight.iter_mut().enumerate() {
            let (c, s) = (poses.cos()[i], poses.sin()[i]);
            let (x, y) = (poses.x()[i] * cells, poses.y()[i] * cells);
            let inside = field.nearest(x, y).is_some_and(|distance| distance > 0.0);
            let mut sum = if inside { 0.0 } else { self.off_track * OFF_TRACK };
            for [px, py] in &points[..count] {
                sum += self.at(field, x + c * px - s * py, y + s * px + c * py);
            }
            *log_weight += sum;
        }
    }

    /// The log-likelihood of an end point in grid coordinates \[cells\].
    #[inline]
    fn at(&self, field: &DistanceField, u: f32, v: f32) -> f32 {
        field.nearest(u, v).map_or(self.off_track, |distance| {
            let step = (distance.abs() * (1.0 / FIELD_STEP)) as usize;
            self.by_distance[step.min(self.by_distance.len() - 1)]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_likelihood_field_falls_with_distance() {
        let model = LikelihoodField::new(&SensorParameters::default());
        assert!(model.by_distance.windows(2).all(|pair| pair[0] >= pair[1]));
    }
}
