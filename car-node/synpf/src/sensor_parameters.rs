//! Parameters of the sensor models.

use serde::{Deserialize, Serialize};

use crate::cddt::DIRECTIONS;
use crate::range_table::TableParameters;
use crate::validation::Check;

/// Which sensor model weighs the particles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SensorModelKind {
    /// The beam model (Probabilistic Robotics, table 6.1): measured against predicted range.
    Beam,
    /// The likelihood field (Probabilistic Robotics, table 6.3): distance of the end point to the nearest wall.
    LikelihoodField,
}

/// How the beam model predicts ranges; `ranges.rs` states how accurate each method is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RangeMethod {
    /// A table of all ranges: fastest, 512 bytes per cell that a car can be in.
    Lut,
    /// Ray marching on the distance field: no table.
    RayMarching,
    /// Compressed directional distance transform (Walsh and Karaman, ICRA 2018): a fraction of the table's memory.
    Cddt,
    /// Exact ranges, and the weights too, computed on a graphics card through Vulkan. For many particles. Needs a program
    /// that was built with the feature `gpu`, and an adapter.
    Gpu,
}

/// Parameters of the sensor models.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct SensorParameters {
    /// Which model.
    pub sensor_model: SensorModelKind,
    /// How ranges are predicted.
    pub range_method: RangeMethod,
    /// Weight of a beam that hits the wall on the map, in [0, 1] (Probabilistic Robotics, table 6.1). The four `z` add up to
    /// 1; sums within 0.1 of it are accepted and scaled to 1.
    pub z_hit: f64,
    /// Weight of a beam that hits something in front of the wall, in [0, 1] (table 6.1).
    pub z_short: f64,
    /// Weight of a beam without a return, in [0, 1] (table 6.1).
    pub z_max: f64,
    /// Weight of a beam of any range, in (0, 1] (table 6.1).
    pub z_rand: f64,
    /// Standard deviation of a hit \[m\] (table 6.1): noise of the laser, and the grain of the map and of the range table.
    pub sigma_hit: f64,
    /// Rate at which the density of short readings decays with range [1/m] (table 6.1).
    pub lambda_short: f64,
    /// The likelihood of the scan is taken to the power 1 / `squash_factor`, because the errors of neighbouring beams are
    /// correlated (Walsh and Karaman, ICRA 2018; 2.2 in the reference's file).
    pub squash_factor: f64,
    /// Ranges from here on count as no return \[m\].
    pub max_range: f64,
    /// Number of directions over a full turn in the range table, at most 256 (`theta_discretization` in the reference's file).
    pub theta_discretization: u16,
}

impl Default for SensorParameters {
    fn default() -> Self {
        Self {
            sensor_model: SensorModelKind::Beam,
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
        check.that(
            "range_method",
            cfg!(feature = "gpu") || self.range_method != RangeMethod::Gpu,
            || {
                "gpu needs a program built with the cargo feature gpu; choose lut, cddt or ray_marching"
                    .into()
            },
        );
        let sum = self.z_hit + self.z_short + self.z_max + self.z_rand;
        // The reference's family of files has shares that add up to 0.95.
        check.that("z_hit", (sum - 1.0).abs() < 0.1, || {
            format!("z_hit + z_short + z_max + z_rand is {sum}, not within 0.1 of 1")
        });
        check.that("z_rand", self.z_rand > 0.0, || {
            "is 0, so that a single unexpected beam would rule out a particle".into()
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

    /// `z_hit`, `z_short`, `z_max` and `z_rand`, scaled so that they add up to 1.
    pub(crate) fn mixture(&self) -> [f64; 4] {
        let shares = [self.z_hit, self.z_short, self.z_max, self.z_rand];
        let sum: f64 = shares.iter().sum();
        shares.map(|share| share / sum)
    }

    /// What the contents of a range table depend on.
    pub(crate) fn table_parameters(&self) -> TableParameters {
        TableParameters {
            directions: self.theta_discretization,
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::Parameters;

    /// Sums up to 1.5 used to be accepted and taken as they are.
    #[test]
    fn the_mixture_adds_up_to_one() {
        let mut parameters = Parameters::default();
        parameters.sensor.z_hit = 0.8;
        assert_eq!(parameters.validate(), Ok(()));
        assert!((parameters.sensor.mixture().iter().sum::<f64>() - 1.0).abs() < 1e-12);
        parameters.sensor.z_hit = 1.0;
        let faults = parameters.validate().expect_err("the sum is 1.15");
        assert_eq!(faults[0].key, "z_hit");
    }

    #[cfg(not(feature = "gpu"))]
    #[test]
    fn a_program_without_the_feature_refuses_gpu() {
        let mut parameters = Parameters::default();
        parameters.sensor.range_method = super::RangeMethod::Gpu;
        let faults = parameters.validate().expect_err("no GPU in this build");
        assert_eq!(faults[0].key, "range_method");
    }
}
