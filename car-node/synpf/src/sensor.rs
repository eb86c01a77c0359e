//! Sensor models: how likely a measured range is where the map says another.

use maps::DistanceField;
use serde::{Deserialize, Serialize};

use crate::defects::Defects;
use crate::parameters::Check;
use crate::range_table::{DIRECTIONS, TableParameters, UNIT};

/// Which sensor model weighs the particles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SensorModel {
    /// The beam model (Probabilistic Robotics, table 6.1): measured against predicted range.
    Beam,
    /// The likelihood field (Probabilistic Robotics, table 6.3): distance of the end point to the nearest wall.
    LikelihoodField,
}

/// How the beam model finds the predicted range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RangeMethod {
    /// A table of all ranges: fastest, 512 bytes per cell.
    Lut,
    /// Sphere tracing on the distance field: no table.
    RayMarching,
    /// Compressed directional distance transform (Walsh and Karaman, ICRA 2018): a fraction of the table's memory.
    Cddt,
}

/// Parameters of the sensor models.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct SensorParameters {
    /// Which model.
    pub sensor_model: SensorModel,
    /// How ranges are predicted.
    pub range_method: RangeMethod,
    /// Share of beams that hit the wall which the map says.
    pub z_hit: f64,
    /// Share of beams that hit something in front of it.
    pub z_short: f64,
    /// Share of beams that come back without a return.
    pub z_max: f64,
    /// Share of beams with any range at all.
    pub z_rand: f64,
    /// Standard deviation of a hit [m]: the laser's noise, the map's and the table's cells.
    pub sigma_hit: f64,
    /// Decay of the ranges that are too short [1/m].
    pub lambda_short: f64,
    /// The product over the beams is taken to the power 1/this, because neighbouring beams err together.
    pub squash_factor: f64,
    /// Ranges from here on are "nothing in range" [m].
    pub max_range: f64,
    /// Directions that the range table distinguishes, at most 256.
    pub theta_discretization: u16,
}

impl Default for SensorParameters {
    fn default() -> Self {
        Self {
            sensor_model: SensorModel::Beam,
            range_method: RangeMethod::Lut,
            z_hit: 0.85,
            z_short: 0.10,
            z_max: 0.025,
            z_rand: 0.025,
            sigma_hit: 0.1,
            lambda_short: 0.25,
            squash_factor: 2.2,
            max_range: 20.0,
            theta_discretization: DIRECTIONS as u16,
        }
    }
}

impl SensorParameters {
    pub(crate) fn validate(&self, check: &mut Check) {
        for (key, value) in [
            ("z_hit", self.z_hit),
            ("z_short", self.z_short),
            ("z_max", self.z_max),
            ("z_rand", self.z_rand),
        ] {
            check.range(key, value, 0.0, 1.0);
        }
        let sum = self.z_hit + self.z_short + self.z_max + self.z_rand;
        check.that("z_hit", (sum - 1.0).abs() < 0.5, || {
            format!("z_hit + z_short + z_max + z_rand is {sum}, which is far from 1")
        });
        check.that("z_rand", self.z_rand > 0.0, || {
            "0 makes a single odd beam veto a particle".into()
        });
        check.range("sigma_hit", self.sigma_hit, 0.005, 5.0);
        check.range("lambda_short", self.lambda_short, 1e-3, 100.0);
        check.range("squash_factor", self.squash_factor, 0.1, 1000.0);
        check.range("max_range", self.max_range, 1.0, 100.0);
        check.range(
            "theta_discretization",
            f64::from(self.theta_discretization),
            16.0,
            DIRECTIONS as f64,
        );
    }

    pub(crate) fn table_parameters(&self, defects: Defects) -> TableParameters {
        TableParameters {
            directions: self.theta_discretization,
            long_ranges: defects.defect_long_ranges,
        }
    }
}

/// Predicted ranges fall into steps of this many table units: 2 cm.
pub(crate) const STEP_SHIFT: u32 = 3;
const STEP: f64 = UNIT as f64 * (1 << STEP_SHIFT) as f64;

/// Rows come in lengths that the kernel knows when it is compiled, so that no look-up has to be checked: up to
/// 20 m, 41 m, and what 16 bits hold.
pub(crate) const ROW_LENGTHS: [usize; 3] = [1024, 2048, 1 << (16 - STEP_SHIFT)];

/// The beam model as a table of log-likelihoods, `[measured][predicted]` in steps of 2 cm.
#[derive(Debug, Clone)]
pub(crate) struct BeamModel {
    /// Steps up to the greatest range, which is the last.
    steps: usize,
    /// Length of a row: one of [`ROW_LENGTHS`], the rest filled with the last step's value.
    length: usize,
    rows: Vec<f32>,
    /// The log-likelihood per beam of a particle that is nowhere: a random range, and unlikely.
    pub(crate) off_track: f32,
}

impl BeamModel {
    pub(crate) fn new(parameters: &SensorParameters, resolution: f64, defects: Defects) -> Self {
        let steps = (parameters.max_range / STEP).round() as usize + 1;
        let SensorParameters {
            z_hit,
            z_short,
            z_max,
            z_rand,
            sigma_hit,
            ..
        } = *parameters;
        let lambda = if defects.defect_lambda_short {
            // Per cell, but divided by the cell's size where multiplying was meant; back in metres.
            parameters.lambda_short / resolution / resolution
        } else {
            parameters.lambda_short
        };
        let squash = 1.0 / parameters.squash_factor;
        // Densities are per step, so that the modes' shares can be added to probabilities.
        let gauss: Vec<f64> = (0..steps)
            .map(|k| {
                let deviation = k as f64 * STEP / sigma_hit;
                (-0.5 * deviation * deviation).exp() * STEP / (sigma_hit * std::f64::consts::TAU.sqrt())
            })
            .collect();
        let short: Vec<f64> = (0..steps)
            .map(|k| lambda * STEP * (-lambda * k as f64 * STEP).exp())
            .collect();
        // Normalisers per predicted range: a hit is somewhere in [0, max], a short reading in [0, predicted].
        let mut below = vec![0.0; steps + 1];
        for (k, value) in gauss.iter().enumerate() {
            below[k + 1] = below[k] + value;
        }
        let hit_scale: Vec<f64> = (0..steps)
            .map(|predicted| z_hit / (below[predicted + 1] + below[steps - predicted] - gauss[0]).max(1e-9))
            .collect();
        let mut nearer = 0.0;
        let short_scale: Vec<f64> = short
            .iter()
            .map(|value| {
                nearer += value;
                z_short / nearer
            })
            .collect();
        let uniform = z_rand / steps as f64;
        let length = ROW_LENGTHS.into_iter().find(|length| steps <= *length);
        let length = length.unwrap_or(ROW_LENGTHS[2]);
        let mut rows = vec![0.0f32; steps * length];
        for (measured, row) in rows.chunks_exact_mut(length).enumerate() {
            let none = if measured + 1 == steps { z_max } else { 0.0 };
            for (predicted, value) in row[..steps].iter_mut().enumerate() {
                let mut p = uniform + none + hit_scale[predicted] * gauss[measured.abs_diff(predicted)];
                if measured <= predicted {
                    p += short_scale[predicted] * short[measured];
                }
                *value = (p as f32).ln() * squash as f32;
            }
            let last = row[steps - 1];
            row[steps..].fill(last);
        }
        let off_track = (uniform * 0.1).ln() * squash;
        Self {
            steps,
            length,
            rows,
            off_track: off_track as f32,
        }
    }

    /// The row for a measured range [m]; infinite for no return. `N` is [`BeamModel::row_length`].
    pub(crate) fn fixed_row<const N: usize>(&self, measured: f32) -> &[f32; N] {
        self.row(measured)
            .try_into()
            .expect("the length that was asked for")
    }

    /// The row for a measured range [m]; infinite for no return.
    pub(crate) fn row(&self, measured: f32) -> &[f32] {
        let step = ((f64::from(measured) / STEP).round() as usize).min(self.steps - 1);
        &self.rows[step * self.length..(step + 1) * self.length]
    }

    /// The length of a row.
    pub(crate) fn row_length(&self) -> usize {
        self.length
    }

    /// The greatest range that differs from no return [m].
    pub(crate) fn reach(&self) -> f32 {
        ((self.steps - 1) as f64 * STEP) as f32
    }

    /// The step of a predicted range in cells of `resolution` [m].
    pub(crate) fn step_of(&self, cells: f32, resolution: f32) -> usize {
        ((cells * resolution / STEP as f32) as usize).min(self.steps - 1)
    }
}

/// The likelihood field as log-likelihoods of a distance to the nearest wall, in millimetres' steps.
#[derive(Debug, Clone)]
pub(crate) struct LikelihoodField {
    by_distance: Vec<f32>,
    /// The log-likelihood of an end point that is nowhere.
    pub(crate) off_track: f32,
}

/// Steps of the likelihood field [m], and where it ends.
const FIELD_STEP: f32 = 0.01;
const FIELD_LIMIT: f32 = 2.0;

impl LikelihoodField {
    pub(crate) fn new(parameters: &SensorParameters) -> Self {
        let squash = 1.0 / parameters.squash_factor;
        let log = |distance: f64| {
            let deviation = distance / parameters.sigma_hit;
            let hit = parameters.z_hit * (-0.5 * deviation * deviation).exp()
                / (parameters.sigma_hit * std::f64::consts::TAU.sqrt());
            ((hit + parameters.z_rand / parameters.max_range).ln() * squash) as f32
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

    /// The log-likelihood of an end point in grid coordinates [cells].
    #[inline]
    pub(crate) fn at(&self, field: &DistanceField, u: f32, v: f32) -> f32 {
        field.nearest(u, v).map_or(self.off_track, |distance| {
            let step = (distance.abs() * (1.0 / FIELD_STEP)) as usize;
            self.by_distance[step.min(self.by_distance.len() - 1)]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> BeamModel {
        let parameters = SensorParameters {
            squash_factor: 1.0,
            ..SensorParameters::default()
        };
        BeamModel::new(&parameters, 0.05, Defects::default())
    }

    #[test]
    fn every_column_is_a_distribution() {
        let model = model();
        for predicted in [0, 5, 100, 500, model.steps - 1] {
            let sum: f32 = (0..model.steps)
                .map(|measured| model.rows[measured * model.length + predicted].exp())
                .sum();
            assert!((sum - 1.0).abs() < 0.01, "{predicted}: {sum}");
        }
    }

    #[test]
    fn the_wall_is_likelier_than_before_it_and_that_than_behind_it() {
        let model = model();
        let at = |measured: f32| model.row(measured)[model.step_of(100.0, 0.05)];
        assert!(at(5.0) > at(3.0) && at(3.0) > at(7.0));
        assert!(at(f32::INFINITY) > at(7.0), "no return has a share of its own");
    }

    #[test]
    fn dividing_lambda_puts_short_readings_at_zero() {
        let parameters = SensorParameters {
            squash_factor: 1.0,
            ..SensorParameters::default()
        };
        let defects = Defects {
            defect_lambda_short: true,
            ..Defects::default()
        };
        let model = BeamModel::new(&parameters, 0.05, defects);
        let at = |measured: f32| model.row(measured)[model.step_of(100.0, 0.05)];
        assert!(at(0.0) > at(1.0) + 3.0);
    }

    #[test]
    fn the_likelihood_field_falls_with_distance() {
        let model = LikelihoodField::new(&SensorParameters::default());
        assert!(model.by_distance.windows(2).all(|pair| pair[0] >= pair[1]));
    }
}
