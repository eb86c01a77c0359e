//! Parameter sets by name or from a file.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use maps::MapError;
use pose_graph::LuaConfiguration;
use protocol::ValueChange;
use serde_json::Value;
use synpf::ParameterFault;

use crate::localization::{KIND_KEY, LocalizerParameters};
use crate::wire;

/// A set with its name, from those that ship or from a file.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedSet {
    /// The set's name: the shipped one's, or the file's without its extension.
    pub name: String,
    /// The values.
    pub parameters: LocalizerParameters,
    /// Keys in the file that the localizer does not know.
    pub unknown_keys: Vec<String>,
}

/// Why a set cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum SetError {
    /// Neither a shipped set nor a file.
    #[error("no parameter set {0:?}: neither a file nor one of {names}", names = LocalizerParameters::NAMES.join(", "))]
    Unknown(String),
    /// The file cannot be read.
    #[error(transparent)]
    Read(#[from] MapError),
    /// Values in the file are refused; lists every fault.
    #[error("{path}: {}", .faults.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))]
    Faults {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        faults: Vec<ParameterFault>,
    },
}

/// The shipped set of that name, or else the file at that path: YAML, or a team's Lua configuration of Cartographer (`.lua`).
pub fn load(name_or_path: &str) -> Result<NamedSet, SetError> {
    if let Some(parameters) = LocalizerParameters::named(name_or_path) {
        return Ok(NamedSet {
            name: name_or_path.into(),
            parameters,
            unknown_keys: Vec::new(),
        });
    }
    let path = Path::new(name_or_path);
    if !path.exists() {
        return Err(SetError::Unknown(name_or_path.into()));
    }
    let text = maps::read_text(path)?;
    let faulty = |faults| SetError::Faults {
        path: path.into(),
        faults,
    };
    let lua = path
        .extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("lua"));
    let (parameters, unknown_keys) = if lua {
        let read = LuaConfiguration::parse(&text).map_err(faulty)?;
        (read.parameters.into(), read.ignored)
    } else {
        LocalizerParameters::from_yaml(&text).map_err(faulty)?
    };
    parameters.validate().map_err(faulty)?;
    Ok(NamedSet {
        name: path
            .file_stem()
            .map_or_else(|| name_or_path.into(), |stem| stem.to_string_lossy().into_owned()),
        parameters,
        unknown_keys,
    })
}

/// The values in which two sets differ.
pub fn changes(before: &LocalizerParameters, after: &LocalizerParameters) -> Vec<ValueChange> {
    let was = values(before);
    values(after)
        .into_iter()
        .filter(|(key, value)| was.get(key) != Some(value))
        .filter_map(|(key, value)| {
            let before = wire::value(was.get(&key)?)?;
            let after = wire::value(&value)?;
            Some(ValueChange { key, before, after })
        })
        .collect()
}

/// A set as flat keys and values.
pub fn values(parameters: &LocalizerParameters) -> BTreeMap<String, Value> {
    parameters.to_values()
}

/// `base` with some values replaced. One fault refuses the whole change; an unknown key is a fault. Every fault is listed.
pub fn with_values(
    base: &LocalizerParameters,
    given: impl IntoIterator<Item = (String, Value)>,
) -> Result<LocalizerParameters, Vec<ParameterFault>> {
    let given: BTreeMap<String, Value> = given.into_iter().collect();
    let base = base.of_kind(given.get(KIND_KEY)).map_err(|fault| vec![fault])?;
    let known = values(&base);
    let unknown = given.keys().filter(|key| !known.contains_key(*key));
    let mut faults: Vec<ParameterFault> = unknown
        .map(|key| ParameterFault {
            key: key.clone(),
            fault: "there is no such parameter".into(),
        })
        .collect();
    match base.with_values(given) {
        Ok((set, _)) if faults.is_empty() => Ok(set),
        Ok(_) => Err(faults),
        Err(more) => {
            faults.extend(more);
            Err(faults)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shipped_sets_are_found_by_name_and_others_named_in_the_error() {
        for name in LocalizerParameters::NAMES {
            assert_eq!(load(name).expect("ships").name, name);
        }
        let message = load("no-such-set").expect_err("does not exist").to_string();
        assert!(
            message.contains("no-such-set") && message.contains("hq"),
            "{message}"
        );
    }
}
