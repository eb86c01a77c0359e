//! Parameter sets.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::{Invalid, Message, Schema};

/// The set in force, and the names of all sets on the car.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Params {
    /// The set in force.
    pub set: ParameterSet,
    /// Counts the changes of the set in force since the car was first set up.
    pub revision: u64,
    /// Who put it in force: an operator's name, `start` or `auto`.
    pub who: String,
    /// When \[unix ns\].
    pub when: i64,
    /// The first filter update under it.
    pub since_update: u64,
    /// Set while the car waits for a confirmation, without which it falls back.
    pub pending_revert: Option<PendingRevert>,
    /// Names of all sets on the car.
    pub available: Vec<String>,
}

/// The car falls back to another set unless the set in force is confirmed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PendingRevert {
    /// The set that it falls back to.
    pub to: String,
    /// When \[unix ns, the car's clock\].
    pub at: i64,
}

/// A named set of parameter values. The car decides which parameters exist, and refuses unknown ones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterSet {
    /// The set's name: 1 to [`ParameterSet::MAX_NAME`] characters of `[a-z0-9-]`.
    pub name: String,
    /// Values by name, at most [`ParameterSet::MAX_VALUES`].
    pub values: Vec<(String, Value)>,
}

impl ParameterSet {
    /// Longest name of a set \[bytes\].
    pub const MAX_NAME: usize = 64;
    /// Most values in a set.
    pub const MAX_VALUES: usize = 256;

    pub(crate) fn validate(&self) -> Result<(), Invalid> {
        set_name("name", &self.name)?;
        Invalid::unless_at_most("values", self.values.len(), Self::MAX_VALUES)?;
        let mut names: Vec<_> = self.values.iter().map(|(name, _)| name).collect();
        names.sort_unstable();
        match names.windows(2).find(|pair| pair[0] == pair[1]) {
            Some(pair) => Err(Invalid::new("values", format!("{:?} is given twice", pair[0]))),
            None => Ok(()),
        }
    }
}

/// Refuses a name that cannot be used as a file name.
pub(crate) fn set_name(field: &'static str, name: &str) -> Result<(), Invalid> {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    if (1..=ParameterSet::MAX_NAME).contains(&name.len()) && name.chars().all(allowed) {
        Ok(())
    } else {
        let max = ParameterSet::MAX_NAME;
        Err(Invalid::new(
            field,
            format!("{name:?} is not 1 to {max} characters of a-z, 0-9 and -"),
        ))
    }
}

/// A parameter's value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Value {
    /// On or off.
    Bool(bool),
    /// A count.
    Int(i64),
    /// A quantity, in the unit that the parameter's documentation gives.
    Float(f64),
    /// A choice among several words.
    Text(String),
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bool(value) => value.fmt(f),
            Self::Int(value) => value.fmt(f),
            Self::Float(value) => value.fmt(f),
            Self::Text(value) => value.fmt(f),
        }
    }
}

impl Message for Params {
    const SCHEMA: Schema = Schema::Params;

    fn validate(&self) -> Result<(), Invalid> {
        self.set.validate()
    }
}
