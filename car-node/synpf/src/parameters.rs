//! Parameter sets: what can be tuned, the sets that ship, and the reference's own file format.
//!
//! On disk and on the wire a set is flat: one key, one value. In the code each group of parameters belongs to
//! the model that is built from it.

mod reference;
mod sets;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use localizer::{ParameterFault, ParameterValues};

use crate::beam_layout::BeamParameters;
use crate::motion_model::MotionParameters;
use crate::particles::ParticleParameters;
use crate::recovery::RecoveryParameters;
use crate::scan_matcher::RefinementParameters;
use crate::search_parameters::SearchParameters;
use crate::sensor_parameters::SensorParameters;
use crate::validation::Check;

/// Everything that can be tuned.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Parameters {
    /// How many particles, and when they are resampled.
    #[serde(flatten)]
    pub particles: ParticleParameters,
    /// Which beams are weighed, and how a scan is brought to one time.
    #[serde(flatten)]
    pub beams: BeamParameters,
    /// How likely a range is.
    #[serde(flatten)]
    pub sensor: SensorParameters,
    /// How the car moves, and how far to trust odometry.
    #[serde(flatten)]
    pub motion: MotionParameters,
    /// The fit of the whole scan to the distance field.
    #[serde(flatten)]
    pub refinement: RefinementParameters,
    /// What is done when the filter doubts itself.
    #[serde(flatten)]
    pub recovery: RecoveryParameters,
    /// The search of the whole map.
    #[serde(flatten)]
    pub search: SearchParameters,
}

impl Parameters {
    /// The names of the sets that ship.
    pub const NAMES: [&'static str; 3] = ["hq", "lq", "adaptive"];

    /// A set that ships, by name.
    pub fn named(name: &str) -> Option<Self> {
        sets::named(name)
    }

    /// The set as flat keys and values, sorted by key.
    pub fn to_values(&self) -> ParameterValues {
        localizer::to_values(self)
    }

    /// This set with some values replaced, and the keys that are unknown. Every fault is listed.
    pub fn with_values(
        &self,
        given: impl IntoIterator<Item = (String, Value)>,
    ) -> Result<(Self, Vec<String>), Vec<ParameterFault>> {
        localizer::overlay(self, given, Self::validate)
    }

    /// Reads a flat YAML file; see [`parameter_table`] and [`Self::from_table`].
    pub fn from_yaml(text: &str) -> Result<(Self, Vec<String>), Vec<ParameterFault>> {
        Self::from_table(&parameter_table(text)?)
    }

    /// A set from a table of our own keys, or of those of the reference's `pf2_params.yaml`. Keys not given keep the value
    /// they have in `hq`; a table that gives only `max_particles` lowers `min_particles` with it. Returns the set and the
    /// keys that are unknown, for a warning. Faults are listed whole.
    pub fn from_table(given: &ParameterValues) -> Result<(Self, Vec<String>), Vec<ParameterFault>> {
        let mut base = Self::default();
        if let Some(most) = given.get("max_particles").and_then(Value::as_u64)
            && !given.contains_key("min_particles")
        {
            base.particles.min_particles = base.particles.min_particles.min(most as usize);
        }
        base.with_values(
            given
                .iter()
                .flat_map(|(key, value)| reference::translate(key, value)),
        )
    }

    /// Every value that is out of its range, or contradicts another.
    pub fn validate(&self) -> Result<(), Vec<ParameterFault>> {
        let mut check = Check::default();
        self.particles.validate(&mut check);
        self.beams.validate(&mut check);
        self.sensor.validate(&mut check);
        self.motion.validate(&mut check);
        self.refinement.validate(&mut check);
        self.recovery.validate(&mut check);
        self.search.validate(&mut check);
        if check.0.is_empty() { Ok(()) } else { Err(check.0) }
    }
}

/// The parameters in a flat YAML file: bare keys, or under `<node>: ros__parameters:`.
pub fn parameter_table(text: &str) -> Result<ParameterValues, Vec<ParameterFault>> {
    let fault = |fault: String| {
        vec![ParameterFault {
            key: "file".into(),
            fault,
        }]
    };
    let file: Value = serde_saphyr::from_str(text).map_err(|e| fault(e.without_snippet().to_string()))?;
    reference::parameter_table(&file)
        .map(|table| table.clone().into_iter().collect())
        .ok_or_else(|| fault("should be a table of keys and values".into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sets_that_ship_are_valid_and_differ() {
        let sets: Vec<_> = Parameters::NAMES
            .iter()
            .map(|name| Parameters::named(name).expect(name))
            .collect();
        for (i, set) in sets.iter().enumerate() {
            assert_eq!(set.validate(), Ok(()), "{}", Parameters::NAMES[i]);
            assert!(
                sets[..i].iter().all(|other| other != set),
                "{}",
                Parameters::NAMES[i]
            );
        }
        assert_eq!(Parameters::named("wet"), None);
    }

    #[test]
    fn values_there_and_back_are_the_same_set() {
        for name in Parameters::NAMES {
            let set = Parameters::named(name).expect(name);
            let (back, unknown) = Parameters::default().with_values(set.to_values()).expect("sound");
            assert_eq!((back, unknown), (set, Vec::new()));
        }
    }

    #[test]
    fn every_fault_is_listed_with_its_key() {
        let keys = |text: &str| -> Vec<String> {
            let faults = Parameters::from_yaml(text).expect_err("faulty");
            faults.into_iter().map(|fault| fault.key).collect()
        };
        // What is no value at all comes first: ranges can only be checked in a set of sound types.
        assert_eq!(
            keys("max_particles: many\nmotion_model: warp\nz_hit: 0.8\n"),
            ["max_particles", "motion_model"]
        );
        assert_eq!(keys("sigma_hit: 0\nmax_range: -3\n"), ["sigma_hit", "max_range"]);
        assert_eq!(keys("sigma_hit: .nan\n"), ["file"]);
    }

    #[test]
    fn unknown_keys_are_listed() {
        let (set, unknown) = Parameters::from_yaml("z_hit: 0.8\nspeed_of_light: 3\n").expect("sound");
        assert_eq!(unknown, ["speed_of_light"]);
        assert!((set.sensor.z_hit - 0.8).abs() < 1e-12);
    }
}
