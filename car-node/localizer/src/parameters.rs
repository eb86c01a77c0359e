//! Parameter sets as every localizer takes them: flat keys and values.

use std::any::Any;
use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;
use serde::de::DeserializeOwned;
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

/// A parameter set as flat keys and values. The set must be a struct of numbers, names and flags; another has none.
pub fn to_values<T: Serialize>(set: &T) -> ParameterValues {
    match serde_json::to_value(set) {
        Ok(Value::Object(values)) => values.into_iter().collect(),
        _ => ParameterValues::new(),
    }
}

/// `base` with some values replaced, and the keys that are unknown to it, for the caller to warn of or to refuse. Every
/// fault is listed: of each value alone, and what `validate` finds in the set of all sound values.
pub fn overlay<T: Serialize + DeserializeOwned>(
    base: &T,
    given: impl IntoIterator<Item = (String, Value)>,
    validate: impl FnOnce(&T) -> Result<(), Vec<ParameterFault>>,
) -> Result<(T, Vec<String>), Vec<ParameterFault>> {
    let read =
        |values: ParameterValues| serde_json::from_value::<T>(Value::Object(values.into_iter().collect()));
    let known = to_values(base);
    let (mut values, mut unknown, mut faults) = (known.clone(), Vec::new(), Vec::new());
    for (key, value) in given {
        if !known.contains_key(&key) {
            unknown.push(key);
            continue;
        }
        // Each value alone on top of a sound set, so that a fault names its key.
        let mut alone = known.clone();
        alone.insert(key.clone(), value.clone());
        match read(alone) {
            Ok(_) => {
                values.insert(key, value);
            }
            Err(error) => faults.push(ParameterFault {
                fault: format!("{value}: {error}"),
                key,
            }),
        }
    }
    let set = read(values).map_err(|error| {
        vec![ParameterFault {
            key: "set".into(),
            fault: error.to_string(),
        }]
    })?;
    faults.extend(validate(&set).err().into_iter().flatten());
    if faults.is_empty() {
        Ok((set, unknown))
    } else {
        Err(faults)
    }
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
