//! Parameter sets as every localizer takes them: flat keys and values.

use std::any::Any;
use std::collections::BTreeMap;
use std::fmt;

use serde_json::Value;

/// A parameter set as flat keys and values, sorted by key; this is its form on disk and on the wire.
pub type ParameterValues = BTreeMap<String, Value>;

/// What is wrong with one parameter.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{key}: {fault}")]
pub struct ParameterFault {
    /// The parameter's name.
    pub key: String,
    /// What is wrong with it, with the value and what is allowed.
    pub fault: String,
}

/// A parameter set with the tables that it needs, made ready on another thread for one kind of localizer.
///
/// Each localizer defines what is inside; [`crate::Localizer::set_parameters`] gives back what belongs to another kind.
pub struct PreparedParameters(Box<dyn Any + Send>);

impl PreparedParameters {
    /// Wraps a localizer's own prepared set.
    pub fn new<T: Any + Send>(prepared: T) -> Self {
        Self(Box::new(prepared))
    }

    /// The prepared set if it is a `T`; else it comes back unchanged.
    pub fn downcast<T: Any + Send>(self) -> Result<Box<T>, Self> {
        self.0.downcast().map_err(Self)
    }
}

impl fmt::Debug for PreparedParameters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("PreparedParameters")
    }
}
