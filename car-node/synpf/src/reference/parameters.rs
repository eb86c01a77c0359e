//! The reference's parameters, under its own names (`pf2_params.yaml`).

use localizer::{ParameterFault, ParameterValues, overlay, to_values};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::motion_noise::MotionNoise;
use crate::validation::Check;

/// Which motion model moves the particles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ReferenceMotionModel {
    /// Rotate, drive, rotate, with a rotation noise that shrinks with speed (Stahl et al., IV 2019).
    Tum,
    /// Rotate, drive, rotate; the noise is a sum of standard deviations, unlike in AMCL.
    Amcl,
    /// Drive along an arc, then slip sideways.
    Arc,
    /// The motion in the car's frame, with constant noise along the map's axes (MIT's particle filter).
    #[serde(alias = "mit")]
    Default,
}

/// The reference's parameters; the default is what it ships.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReferenceParameters {
    /// Particles.
    pub max_particles: usize,
    /// Beams that are weighed, about: the choice of beams may give two more.
    pub des_lidar_beams: usize,
    /// Length over width of the corridor that beams are chosen by.
    pub lidar_aspect_ratio: f64,
    /// The product over the beams is taken to the power 1/this.
    pub squash_factor: f64,
    /// Ranges from here on are "nothing in range" \[m\].
    pub max_range: f64,
    /// Directions that the range table distinguishes.
    pub theta_discretization: u16,
    /// Standard deviation of a given initial pose along x \[m\]; a variance by name only.
    pub initial_var_x: f64,
    /// Standard deviation of a given initial pose along y \[m\]; a variance by name only.
    pub initial_var_y: f64,
    /// Standard deviation of a given initial heading \[rad\]; a variance by name only.
    pub initial_var_theta: f64,
    /// Share of beams that hit the wall which the map says.
    pub z_hit: f64,
    /// Share of beams that hit something in front of it.
    pub z_short: f64,
    /// Share of beams that come back without a return.
    pub z_max: f64,
    /// Share of beams with any range at all.
    pub z_rand: f64,
    /// Standard deviation of a hit \[m\].
    pub sigma_hit: f64,
    /// Decay of the ranges that are too short [1/m]; see [`ReferenceDefects::defect_lambda_short`].
    pub lambda_short: f64,
    /// Which motion model moves the particles.
    pub motion_model: ReferenceMotionModel,
    /// The noise of each motion model.
    #[serde(flatten)]
    pub noise: MotionNoise,
    /// Its defects, all on as shipped.
    #[serde(flatten)]
    pub defects: ReferenceDefects,
}

/// What `synPF.py` does wrong, each a switch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "independent switches, flipped one at a time"
)]
pub struct ReferenceDefects {
    /// The two rotations of a motion lose their sign before they are used as means: right turns predict left. Models
    /// `tum` and `amcl`.
    pub defect_unsigned_rotation: bool,
    /// The noise on a translation has mean `s_trans / 2`: with `alpha_3_tum` 1 the mean step is 1.5 times odometry.
    /// Models `tum` and `amcl`.
    pub defect_biased_translation: bool,
    /// Motion under 1 cm per odometry message is thrown away, and its noise with it. Models `tum` and `amcl`.
    pub defect_deadband: bool,
    /// The motion before the last is applied. Models `arc` and `default`.
    pub defect_late_odometry: bool,
    /// The centre of the arc lies on the wrong side in right turns and in reverse. Model `arc`.
    pub defect_mirrored_arc: bool,
    /// `lambda_short` is divided by the cell's size in place of multiplied: nearly all of `z_short` sits at 0 m.
    pub defect_lambda_short: bool,
    /// One update per odometry message with the latest scan, however old, in place of one per scan at its own time.
    pub defect_update_per_odometry: bool,
    /// Noise per message in place of per time, so that a tuning depends on odometry's rate.
    pub defect_noise_per_message: bool,
    /// Ranges come out half a cell long.
    pub defect_long_ranges: bool,
    /// The covariance is taken about the mean of the update before.
    pub defect_covariance_about_previous: bool,
}

impl Default for ReferenceDefects {
    fn default() -> Self {
        Self {
            defect_unsigned_rotation: true,
            defect_biased_translation: true,
            defect_deadband: true,
            defect_late_odometry: true,
            defect_mirrored_arc: true,
            defect_lambda_short: true,
            defect_update_per_odometry: true,
            defect_noise_per_message: true,
            defect_long_ranges: true,
            defect_covariance_about_previous: true,
        }
    }
}

impl Default for ReferenceParameters {
    fn default() -> Self {
        Self {
            max_particles: 3000,
            des_lidar_beams: 21,
            lidar_aspect_ratio: 3.5,
            squash_factor: 2.2,
            max_range: 20.0,
            theta_discretization: 150,
            initial_var_x: 0.5,
            initial_var_y: 0.5,
            initial_var_theta: 0.4,
            z_hit: 0.85,
            z_short: 0.10,
            z_max: 0.025,
            z_rand: 0.025,
            sigma_hit: 0.1,
            lambda_short: 0.25,
            motion_model: ReferenceMotionModel::Tum,
            noise: MotionNoise::REFERENCE,
            defects: ReferenceDefects::default(),
        }
    }
}

impl ReferenceParameters {
    /// The set as flat keys and values, sorted by key.
    pub fn to_values(&self) -> ParameterValues {
        to_values(self)
    }

    /// This set with some values replaced, and the keys that are unknown. Every fault is listed.
    pub fn with_values(
        &self,
        given: impl IntoIterator<Item = (String, Value)>,
    ) -> Result<(Self, Vec<String>), Vec<ParameterFault>> {
        overlay(self, given, Self::validate)
    }

    /// A set from a table of the reference's own keys, on top of what it ships; and the keys that are unknown.
    pub fn from_table(given: ParameterValues) -> Result<(Self, Vec<String>), Vec<ParameterFault>> {
        Self::default().with_values(given)
    }

    /// Every value that is out of its range, or contradicts another.
    pub fn validate(&self) -> Result<(), Vec<ParameterFault>> {
        let mut check = Check::default();
        check.range("max_particles", self.max_particles as f64, 10.0, 100_000.0);
        check.range("des_lidar_beams", self.des_lidar_beams as f64, 3.0, 1000.0);
        check.range("lidar_aspect_ratio", self.lidar_aspect_ratio, 0.1, 100.0);
        check.range("squash_factor", self.squash_factor, 0.1, 1000.0);
        check.range("max_range", self.max_range, 1.0, 100.0);
        check.range(
            "theta_discretization",
            f64::from(self.theta_discretization),
            16.0,
            1024.0,
        );
        check.range("initial_var_x", self.initial_var_x, 0.0, 100.0);
        check.range("initial_var_y", self.initial_var_y, 0.0, 100.0);
        check.range("initial_var_theta", self.initial_var_theta, 0.0, 10.0);
        for (key, value) in [
            ("z_hit", self.z_hit),
            ("z_short", self.z_short),
            ("z_max", self.z_max),
        ] {
            check.range(key, value, 0.0, 1.0);
        }
        check.range("z_rand", self.z_rand, 1e-9, 1.0);
        check.range("sigma_hit", self.sigma_hit, 0.005, 5.0);
        check.range("lambda_short", self.lambda_short, 1e-3, 100.0);
        self.noise.validate(&mut check);
        if check.0.is_empty() { Ok(()) } else { Err(check.0) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_ships_is_valid_and_its_values_lead_back_to_it() {
        let shipped = ReferenceParameters::default();
        assert_eq!(shipped.validate(), Ok(()));
        let mut changed = shipped.clone();
        changed.max_particles = 500;
        changed.defects.defect_deadband = false;
        let back = shipped.with_values(changed.to_values());
        assert_eq!(back, Ok((changed, Vec::new())));
    }

    #[test]
    fn every_fault_is_listed_with_its_key() {
        let given = [("sigma_hit", Value::from(0)), ("max_range", Value::from(-3))];
        let given = given.map(|(key, value)| (key.to_owned(), value));
        let faults = ReferenceParameters::default()
            .with_values(given)
            .expect_err("faulty");
        let keys: Vec<_> = faults.iter().map(|fault| fault.key.as_str()).collect();
        assert_eq!(keys, ["max_range", "sigma_hit"]);
    }
}
