//! Parameter sets of every kind of localizer, and localizers made from them.
//!
//! A set belongs to one kind of localizer; on disk and on the wire its key `localizer` says which. Everything else in this
//! crate knows sets as [`LocalizerParameters`] and localizers as [`Localizer`].

use std::sync::Arc;

use maps::Pose;
use pose_graph::{FrozenMap, PoseGraph, PoseGraphParameters, PoseGraphTuning};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use synpf::{
    Localizer, ParameterFault, ParameterValues, Parameters, PreparedParameters, RangeMethod, Reference,
    ReferenceParameters, ReferenceTuning, SensorModelKind, SetUpError, SynPf, TrackMap, Tuning,
    parameter_table,
};

use super::external::{External, ExternalParameters};

/// A parameter set for one kind of localizer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "ParameterValues", into = "ParameterValues")]
pub enum LocalizerParameters {
    /// For SynPF.
    SynPf(Box<Parameters>),
    /// For the reference emulation.
    Reference(Box<ReferenceParameters>),
    /// For following another localizer.
    External(ExternalParameters),
    /// For pose-graph localization.
    PoseGraph(Box<PoseGraphParameters>),
}

/// The key that says which kind of localizer a set is for.
pub const KIND_KEY: &str = "localizer";
const SYNPF: &str = "synpf";
const REFERENCE: &str = "reference";
/// The kind that follows another localizer, and its set.
pub const EXTERNAL: &str = "external";
const POSE_GRAPH: &str = "pose-graph";

/// A key from the time when the reference was a mode of SynPF. Only sets for that mode had it.
const FORMER_KEY: &str = "defect_update_per_odometry";

/// Names of the reference's parameters at that time, and today.
const FORMER_NAMES: [(&str, &str); 4] = [
    ("beams", "des_lidar_beams"),
    ("initial_std_x", "initial_var_x"),
    ("initial_std_y", "initial_var_y"),
    ("initial_std_heading", "initial_var_theta"),
];

impl Default for LocalizerParameters {
    fn default() -> Self {
        Self::SynPf(Box::default())
    }
}

impl From<Parameters> for LocalizerParameters {
    fn from(parameters: Parameters) -> Self {
        Self::SynPf(Box::new(parameters))
    }
}

impl From<ReferenceParameters> for LocalizerParameters {
    fn from(parameters: ReferenceParameters) -> Self {
        Self::Reference(Box::new(parameters))
    }
}

impl From<ExternalParameters> for LocalizerParameters {
    fn from(parameters: ExternalParameters) -> Self {
        Self::External(parameters)
    }
}

impl From<PoseGraphParameters> for LocalizerParameters {
    fn from(parameters: PoseGraphParameters) -> Self {
        Self::PoseGraph(Box::new(parameters))
    }
}

impl LocalizerParameters {
    /// The names of the sets that ship for every car. [`EXTERNAL`] is one for cars with another localizer.
    pub const NAMES: [&'static str; 6] = [
        "hq",
        "lq",
        "adaptive",
        "synpf-baseline",
        "pose-graph",
        "pose-graph-tuned",
    ];

    /// A set that ships, by name.
    pub fn named(name: &str) -> Option<Self> {
        if name == "synpf-baseline" {
            return Some(ReferenceParameters::default().into());
        }
        if name == EXTERNAL {
            return Some(ExternalParameters::default().into());
        }
        let synpf = Parameters::named(name).map(Into::into);
        synpf.or_else(|| PoseGraphParameters::named(name).map(Into::into))
    }

    /// Reads a flat YAML file. With `localizer: reference` it is a set for the reference emulation, under the names of
    /// `pf2_params.yaml`; with `localizer: pose-graph` one for pose-graph localization, under Cartographer's names; without,
    /// one for SynPF, which understands the reference's names too. Returns the set and the keys that are
    /// unknown, for a warning.
    pub fn from_yaml(text: &str) -> Result<(Self, Vec<String>), Vec<ParameterFault>> {
        let mut table = parameter_table(text)?;
        let kind = table.remove(KIND_KEY);
        match kind_of(kind.as_ref()).map_err(|fault| vec![fault])? {
            SYNPF => Parameters::from_table(&table).map(|(set, unknown)| (set.into(), unknown)),
            EXTERNAL => with(ExternalParameters::default().with_values(table)),
            POSE_GRAPH => with(PoseGraphParameters::default().with_values(table)),
            _ => ReferenceParameters::from_table(table).map(|(set, unknown)| (set.into(), unknown)),
        }
    }

    /// This set, or the default of the kind that a value of [`KIND_KEY`] names if that is another kind.
    pub fn of_kind(&self, kind: Option<&Value>) -> Result<Self, ParameterFault> {
        Ok(match kind {
            None => self.clone(),
            Some(_) => match kind_of(kind)? {
                kind if kind == self.kind() => self.clone(),
                kind => Self::default_of(kind),
            },
        })
    }

    /// The default of a kind of localizer.
    fn default_of(kind: &str) -> Self {
        match kind {
            SYNPF => Parameters::default().into(),
            EXTERNAL => ExternalParameters::default().into(),
            POSE_GRAPH => PoseGraphParameters::default().into(),
            _ => ReferenceParameters::default().into(),
        }
    }

    /// Which kind of localizer it is for: `synpf`, `reference`, `pose-graph` or `external`.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::SynPf(_) => SYNPF,
            Self::Reference(_) => REFERENCE,
            Self::External(_) => EXTERNAL,
            Self::PoseGraph(_) => POSE_GRAPH,
        }
    }

    /// The set as flat keys and values, its kind among them.
    pub fn to_values(&self) -> ParameterValues {
        let mut values = match self {
            Self::SynPf(parameters) => parameters.to_values(),
            Self::Reference(parameters) => parameters.to_values(),
            Self::External(parameters) => parameters.to_values(),
            Self::PoseGraph(parameters) => parameters.to_values(),
        };
        values.insert(KIND_KEY.into(), self.kind().into());
        values
    }

    /// This set with some values replaced, and the keys that are unknown. A value for another kind of localizer makes a set
    /// of that kind, with its defaults for what is not given. Every fault is listed.
    pub fn with_values(
        &self,
        given: impl IntoIterator<Item = (String, Value)>,
    ) -> Result<(Self, Vec<String>), Vec<ParameterFault>> {
        let mut given: ParameterValues = given.into_iter().collect();
        let kind = given.remove(KIND_KEY);
        match self.of_kind(kind.as_ref()).map_err(|fault| vec![fault])? {
            Self::SynPf(base) => with(base.with_values(given)),
            Self::Reference(base) => with(base.with_values(given)),
            Self::External(base) => with(base.with_values(given)),
            Self::PoseGraph(base) => with(base.with_values(given)),
        }
    }

    /// Every value that is out of its range, or contradicts another.
    pub fn validate(&self) -> Result<(), Vec<ParameterFault>> {
        match self {
            Self::SynPf(parameters) => parameters.validate(),
            Self::Reference(parameters) => parameters.validate(),
            Self::External(parameters) => parameters.validate(),
            Self::PoseGraph(parameters) => parameters.validate(),
        }
    }

    /// Builds the range tables that the set needs around a pose in `map`, or, without one, for all that look like tracks.
    pub fn prepare_tables(&self, map: &TrackMap, map_from_base_link: Option<Pose>) {
        match self {
            Self::SynPf(parameters) => map.prepare(map_from_base_link, parameters),
            Self::Reference(parameters) => Reference::prepare(map, map_from_base_link, parameters),
            // They cast few rays, or none.
            Self::External(_) | Self::PoseGraph(_) => {}
        }
    }

    /// A sentence on what the limit of memory has changed in the range tables of this set; None where nothing.
    pub fn table_note(&self, map: &TrackMap) -> Option<String> {
        match self {
            Self::SynPf(parameters)
                if parameters.sensor.sensor_model == SensorModelKind::Beam
                    && parameters.sensor.range_method == RangeMethod::Lut =>
            {
                map.table_note()
            }
            _ => None,
        }
    }

    /// Makes the set ready for a localizer of its kind, away from that localizer's thread. Every fault is listed.
    pub fn prepare(
        &self,
        map: &TrackMap,
        map_from_base_link: Option<Pose>,
    ) -> Result<PreparedParameters, Vec<ParameterFault>> {
        self.prepare_tables(map, map_from_base_link);
        Ok(match self {
            Self::SynPf(parameters) => PreparedParameters::new(Tuning::new(Parameters::clone(parameters))?),
            Self::Reference(parameters) => {
                PreparedParameters::new(ReferenceTuning::new(ReferenceParameters::clone(parameters), map)?)
            }
            Self::External(parameters) => {
                parameters.validate()?;
                PreparedParameters::new(*parameters)
            }
            Self::PoseGraph(parameters) => {
                PreparedParameters::new(PoseGraphTuning::new(PoseGraphParameters::clone(parameters))?)
            }
        })
    }

    /// A localizer under this set, without a pose.
    pub fn build(
        &self,
        map: &Arc<TrackMap>,
        base_link_from_laser: Pose,
        seed: u64,
    ) -> Result<Box<dyn Localizer>, SetUpError> {
        let map = Arc::clone(map);
        Ok(match self {
            Self::SynPf(parameters) => {
                let parameters = Parameters::clone(parameters);
                Box::new(SynPf::new(map, base_link_from_laser, parameters, seed)?)
            }
            Self::Reference(parameters) => {
                let parameters = ReferenceParameters::clone(parameters);
                Box::new(Reference::new(map, base_link_from_laser, parameters, seed)?)
            }
            // It throws no dice.
            Self::External(parameters) => Box::new(External::new(map, base_link_from_laser, *parameters)?),
            Self::PoseGraph(parameters) => {
                let (grid, field) = map.shared();
                let map = Arc::new(FrozenMap::new(grid, field));
                let parameters = PoseGraphParameters::clone(parameters);
                let localizer =
                    PoseGraph::new(map, base_link_from_laser, parameters).map_err(|error| match error {
                        pose_graph::SetUpError::Parameters(faults) => SetUpError::Parameters(faults),
                        pose_graph::SetUpError::Pose(error) => SetUpError::Pose(error),
                    })?;
                Box::new(localizer)
            }
        })
    }
}

fn with<T: Into<LocalizerParameters>>(
    set: Result<(T, Vec<String>), Vec<ParameterFault>>,
) -> Result<(LocalizerParameters, Vec<String>), Vec<ParameterFault>> {
    set.map(|(set, unknown)| (set.into(), unknown))
}

/// The kind that a value of [`KIND_KEY`] names; without one, SynPF.
fn kind_of(value: Option<&Value>) -> Result<&'static str, ParameterFault> {
    match value.map(Value::as_str) {
        None | Some(Some(SYNPF)) => Ok(SYNPF),
        Some(Some(REFERENCE)) => Ok(REFERENCE),
        Some(Some(POSE_GRAPH)) => Ok(POSE_GRAPH),
        Some(Some(EXTERNAL)) => Ok(EXTERNAL),
        Some(_) => Err(ParameterFault {
            key: KIND_KEY.into(),
            fault: format!(
                "{} is none of {SYNPF}, {REFERENCE}, {POSE_GRAPH}, {EXTERNAL}",
                value.unwrap_or(&Value::Null)
            ),
        }),
    }
}

impl From<LocalizerParameters> for ParameterValues {
    fn from(set: LocalizerParameters) -> Self {
        set.to_values()
    }
}

/// Reads a stored set. Keys that no longer exist are left out; new keys get their default. A set stored with the former
/// reference mode on is read as a set for the reference emulation.
impl TryFrom<ParameterValues> for LocalizerParameters {
    type Error = String;

    fn try_from(mut values: ParameterValues) -> Result<Self, Self::Error> {
        let kind = values.remove(KIND_KEY);
        let former = kind.is_none() && values.get(FORMER_KEY) == Some(&Value::Bool(true));
        if former {
            for (from, to) in FORMER_NAMES {
                if let Some(value) = values.remove(from) {
                    values.insert(to.into(), value);
                }
            }
        }
        let kind = kind_of(kind.as_ref()).map_err(|fault| fault.to_string())?;
        // What a kept set does not name has its kind's default.
        let default = if former {
            ReferenceParameters::default().into()
        } else {
            Self::default_of(kind)
        };
        let mut all = default.to_values();
        all.remove(KIND_KEY);
        all.extend(values);
        let values = Value::Object(all.into_iter().collect());
        if kind == POSE_GRAPH {
            let set: PoseGraphParameters =
                serde_json::from_value(values).map_err(|error| error.to_string())?;
            return Ok(set.into());
        }
        if kind == EXTERNAL {
            let set: ExternalParameters =
                serde_json::from_value(values).map_err(|error| error.to_string())?;
            Ok(set.into())
        } else if kind == REFERENCE || former {
            let set: ReferenceParameters =
                serde_json::from_value(values).map_err(|error| error.to_string())?;
            Ok(set.into())
        } else {
            let set: Parameters = serde_json::from_value(values).map_err(|error| error.to_string())?;
            Ok(set.into())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(name: &str) -> LocalizerParameters {
        LocalizerParameters::named(name).expect("ships")
    }

    fn given(values: &[(&str, Value)]) -> Vec<(String, Value)> {
        values
            .iter()
            .map(|(key, value)| ((*key).to_owned(), value.clone()))
            .collect()
    }

    #[test]
    fn the_sets_that_ship_are_valid_and_their_values_lead_back_to_them_from_any_other() {
        for name in LocalizerParameters::NAMES {
            let set = named(name);
            assert_eq!(set.validate(), Ok(()), "{name}");
            for other in LocalizerParameters::NAMES {
                let back = named(other).with_values(set.to_values());
                assert_eq!(back, Ok((set.clone(), Vec::new())), "{name} from {other}");
            }
            let kept = serde_json::to_string(&set).expect("writes");
            assert_eq!(
                serde_json::from_str::<LocalizerParameters>(&kept).expect("reads"),
                set
            );
        }
        assert_eq!(LocalizerParameters::named("wet"), None);
    }

    #[test]
    fn a_file_says_which_localizer_it_is_for() {
        let text = "des_lidar_beams: 33\nmax_particles: 700\n";
        let (synpf, unknown) = LocalizerParameters::from_yaml(text).expect("sound");
        assert_eq!((synpf.kind(), unknown.len()), ("synpf", 0));
        let text = format!("localizer: reference\n{text}");
        let (reference, unknown) = LocalizerParameters::from_yaml(&text).expect("sound");
        assert_eq!((reference.kind(), unknown.len()), ("reference", 0));
        assert_eq!(reference.to_values()["des_lidar_beams"], 33);
        let faults = LocalizerParameters::from_yaml("localizer: amcl\n").expect_err("no such kind");
        assert_eq!(faults[0].key, "localizer");
    }

    #[test]
    fn sets_kept_when_the_reference_was_a_mode_of_synpf_are_read() {
        let former = given(&[
            (FORMER_KEY, true.into()),
            ("beams", 31.into()),
            ("initial_std_heading", 0.2.into()),
            ("motion_model", "mit".into()),
            ("refine", false.into()),
        ]);
        let former: ParameterValues = former.into_iter().collect();
        let LocalizerParameters::Reference(set) = former.try_into().expect("read") else {
            panic!("a set for the reference");
        };
        assert_eq!(set.des_lidar_beams, 31);
        assert!((set.initial_var_theta - 0.2).abs() < 1e-12);
        // With the mode off it was a set for SynPF.
        let off: ParameterValues = given(&[(FORMER_KEY, false.into()), ("beams", 31.into())])
            .into_iter()
            .collect();
        let set = LocalizerParameters::try_from(off).expect("read");
        assert_eq!((set.kind(), &set.to_values()["beams"]), ("synpf", &31.into()));
    }

    #[test]
    fn another_kind_starts_from_its_own_defaults() {
        let values = given(&[("localizer", "reference".into()), ("max_particles", 500.into())]);
        let (set, unknown) = named("lq").with_values(values).expect("sound");
        assert!(unknown.is_empty());
        let expected = named("synpf-baseline")
            .with_values(given(&[("max_particles", 500.into())]))
            .expect("sound");
        assert_eq!(set, expected.0);
    }
}
