//! Other localizers' parameter files: SynPF's, MIT's particle filter's, nav2's (and ROS 1's) AMCL's, and Cartographer's Lua.
//! Each value is taken, converted, or has no counterpart, and the reason is given.
//!
//! Their keys look alike and mean different things: MIT's `sigma_hit` is in cells, SynPF's in metres; AMCL's `alpha1` acts on
//! variances, SynPF's `alpha_1_amcl` on standard deviations.

use std::collections::BTreeMap;

use pose_graph::{LuaConfiguration, PoseGraphParameters};
use serde::Serialize;
use serde_json::{Map, Value};
use synpf::ParameterFault;

use crate::localization::LocalizerParameters;

/// Whose file it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Dialect {
    /// ForzaETH's particle filter, `pf2_params.yaml`.
    SynPf,
    /// MIT's particle filter and those made from it, such as `f1tenth/particle_filter`.
    Mit,
    /// AMCL of nav2, or of ROS 1.
    Amcl,
    /// Cartographer's Lua.
    Cartographer,
}

impl Dialect {
    /// The name for people.
    pub fn name(self) -> &'static str {
        match self {
            Self::SynPf => "SynPF",
            Self::Mit => "MIT's particle filter",
            Self::Amcl => "AMCL",
            Self::Cartographer => "Cartographer",
        }
    }
}

/// What became of a value.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "outcome", rename_all = "snake_case")]
pub enum Outcome {
    /// It means the same here.
    Taken {
        /// The keys and values of the set.
        to: BTreeMap<String, Value>,
    },
    /// It means something else there.
    Converted {
        /// The keys and values of the set.
        to: BTreeMap<String, Value>,
        /// How it was converted.
        why: String,
    },
    /// It belongs on the command line.
    Option {
        /// The option.
        option: String,
    },
    /// There is nothing like it here.
    NoCounterpart {
        /// What is done in its place.
        why: String,
    },
    /// No version of that localizer that we know has this key.
    Unknown,
}

/// A value of the file.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Imported {
    /// The key in the file.
    pub key: String,
    /// The value in the file.
    pub value: Value,
    /// What became of it.
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// What a file came to.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Import {
    /// Whose file it is.
    pub dialect: Dialect,
    /// What became of each value, by key.
    pub values: Vec<Imported>,
    /// The values of the set that differ from `hq`, or from Cartographer's defaults.
    pub set: BTreeMap<String, Value>,
}

impl Import {
    /// What a value has that is not in the set.
    pub fn base(&self) -> &'static str {
        match self.dialect {
            Dialect::Cartographer => "Cartographer's defaults",
            _ => "hq",
        }
    }
}

/// Why a file cannot be imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The file is no YAML.
    #[error("{0}")]
    Yaml(String),
    /// It has none of the keys of the localizers that are known.
    #[error("these are not the parameters of SynPF, MIT's particle filter or AMCL{}", keys(.0))]
    Foreign(Vec<String>),
    /// Lua that sets nothing of Cartographer's.
    #[error("this Lua sets no parameter of Cartographer's")]
    Lua,
    /// The values do not make a set.
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))]
    Faults(Vec<ParameterFault>),
}

fn keys(found: &[String]) -> String {
    const SHOWN: usize = 8;
    if found.is_empty() {
        return ": there is no key".into();
    }
    let more = if found.len() > SHOWN { ", ..." } else { "" };
    format!(": there is {}{more}", found[..found.len().min(SHOWN)].join(", "))
}

/// Keys that only one of them has, or that decide it.
const MARKS: [(Dialect, &[&str]); 3] = [
    (
        Dialect::Amcl,
        &[
            "alpha1",
            "odom_alpha1",
            "laser_model_type",
            "pf_err",
            "kld_err",
            "robot_model_type",
            "odom_model_type",
        ],
    ),
    (
        Dialect::SynPf,
        &[
            "des_lidar_beams",
            "lidar_aspect_ratio",
            "alpha_1_tum",
            "alpha_1_amcl",
            "motion_dispersion_arc_x",
            "lam_thresh",
        ],
    ),
    (
        Dialect::Mit,
        &["angle_step", "motion_dispersion_theta", "rangelib_variant"],
    ),
];

/// Beams of the scanner that most of these cars have, a Hokuyo UST-10LX.
const SCANNER_BEAMS: f64 = 1081.0;
/// Mean speed for which AMCL's motion between two updates is taken [m/s].
const SPEED: f64 = 2.5;
/// Most particles of a set.
const MOST_PARTICLES: f64 = 100_000.0;

/// Reads a file. `resolution` is the edge of a cell of the map that it was used with \[m\].
pub fn import(text: &str, resolution: f64) -> Result<Import, ImportError> {
    let file: Value = serde_saphyr::from_str(text)
        .map_err(|error| ImportError::Yaml(error.without_snippet().to_string()))?;
    let (dialect, table) = find(&file)?;
    let values: Vec<Imported> = table
        .iter()
        .map(|(key, value)| Imported {
            key: key.clone(),
            value: value.clone(),
            outcome: match dialect {
                Dialect::SynPf => of_synpf(key, value),
                Dialect::Mit => of_mit(key, value, resolution),
                Dialect::Amcl => of_amcl(key, value, table),
                Dialect::Cartographer => of_cartographer(key, value),
            },
        })
        .collect();
    let mut given = BTreeMap::new();
    for imported in &values {
        if let Outcome::Taken { to } | Outcome::Converted { to, .. } = &imported.outcome {
            given.extend(to.clone());
        }
    }
    match dialect {
        Dialect::SynPf | Dialect::Cartographer => {}
        Dialect::Mit => {
            given.insert("motion_model".into(), "mit".into());
            given.insert("beam_layout".into(), "uniform".into());
        }
        Dialect::Amcl => {
            given.insert("motion_model".into(), "amcl".into());
            given.insert("beam_layout".into(), "uniform".into());
        }
    }
    // A fixed number of particles, unless the file says otherwise.
    if let (Some(most), false) = (
        given.get("max_particles").cloned(),
        given.contains_key("min_particles"),
    ) {
        given.insert("min_particles".into(), most);
    }
    let hq = LocalizerParameters::default();
    let (set, _) = hq.with_values(given.clone()).map_err(ImportError::Faults)?;
    let plain = hq.to_values();
    let set = set.to_values();
    Ok(Import {
        dialect,
        values,
        set: set
            .into_iter()
            .filter(|(key, value)| given.contains_key(key) && plain.get(key) != Some(value))
            .collect(),
    })
}

/// Reads Cartographer's Lua. A fault names its line.
pub fn import_lua(text: &str) -> Result<Import, ImportError> {
    let read = LuaConfiguration::parse(text).map_err(ImportError::Faults)?;
    if read.ignored.len() == read.values.len() {
        return Err(ImportError::Lua);
    }
    let included = read.includes.iter().map(|file| Imported {
        key: "include".into(),
        value: file.as_str().into(),
        outcome: none("it is not read: what it sets has Cartographer's default here; add the values of a team's own file"),
    });
    let values = read.values.iter().map(|(path, value)| Imported {
        key: path.clone(),
        value: value.clone(),
        outcome: of_cartographer(path, value),
    });
    let defaults = PoseGraphParameters::default().to_values();
    let set = read.parameters.to_values().into_iter();
    Ok(Import {
        dialect: Dialect::Cartographer,
        values: included.chain(values).collect(),
        set: set
            .filter(|(key, value)| defaults.get(key) != Some(value))
            .collect(),
    })
}

/// A value of Cartographer's Lua, by its path.
fn of_cartographer(path: &str, value: &Value) -> Outcome {
    let key = path.strip_prefix("options.").unwrap_or(path);
    if PoseGraphParameters::default().to_values().contains_key(key) {
        return taken(key, value.clone());
    }
    let last = key.rsplit('.').next().unwrap_or(key);
    if key.starts_with("trajectory_builder_3d.") || last.ends_with("_3d") || key.contains("_3d.") {
        return none("it belongs to Cartographer in three dimensions");
    }
    if key.starts_with("map_builder.") {
        return match last {
            "num_background_threads" => none("the back end has one worker"),
            "use_trajectory_builder_2d" => none("there are two dimensions only"),
            _ => none("there is one kind of map builder"),
        };
    }
    match last {
        "map_frame"
        | "tracking_frame"
        | "published_frame"
        | "odom_frame"
        | "provide_odom_frame"
        | "publish_frame_projected_to_2d"
        | "publish_to_tf"
        | "publish_tracked_pose"
        | "use_pose_extrapolator" => {
            none("frames come from the messages and /tf_static; what is published is set on the command line")
        }
        "use_odometry" => none("odometry is always used"),
        "use_nav_sat" | "use_landmarks" | "collate_landmarks" | "collate_fixed_frame" => {
            none("only scans, odometry and a gyroscope are used")
        }
        "num_laser_scans" | "num_multi_echo_laser_scans" | "num_point_clouds" => {
            none("one scanner is used; --scan-topic names it")
        }
        "num_subdivisions_per_laser_scan" | "num_accumulated_range_data" => {
            none("each scan is matched as a whole, its beams brought to its stamp by odometry")
        }
        "lookup_transform_timeout_sec"
        | "submap_publish_period_sec"
        | "pose_publish_period_sec"
        | "trajectory_publish_period_sec" => none("what is published, and how often, is set at the pit wall"),
        "rangefinder_sampling_ratio" => none("every scan is used"),
        "fixed_frame_pose_sampling_ratio" | "imu_sampling_ratio" | "landmarks_sampling_ratio" => {
            none("every gyroscope reading is used; there are no landmarks")
        }
        "min_z" | "max_z" => none("a scan has no height"),
        "imu_gravity_time_constant" | "acceleration_weight" | "rotation_weight"
            if key.contains("optimization_problem") || last == "imu_gravity_time_constant" =>
        {
            none("gravity is not estimated in two dimensions")
        }
        "max_constraint_distance" => none("a node is matched where it lies on the map, whatever its submap"),
        "num_threads" | "use_nonmonotonic_steps" => none("the solver is another one, on one thread"),
        "log_matches" | "log_solver_summary" | "log_residual_histograms" => none("matches are not logged"),
        "max_num_final_iterations" => none("a drive on a known map has no final optimization"),
        "grid_type" | "range_data_inserter_type" => none("submaps are probability grids"),
        "fixed_frame_pose_translation_weight"
        | "fixed_frame_pose_rotation_weight"
        | "fixed_frame_pose_use_tolerant_loss"
        | "fixed_frame_pose_tolerant_loss_param_a"
        | "fixed_frame_pose_tolerant_loss_param_b" => none("there are no fixed-frame poses"),
        _ if key.contains("tsdf_range_data_inserter") => none("submaps are probability grids"),
        _ if key.contains("pose_extrapolator") => none("odometry's own poses are interpolated"),
        _ if key.contains("overlapping_submaps_trimmer") => none("all submaps but the last few are trimmed"),
        _ => Outcome::Unknown,
    }
}

/// The table of a localizer we know: the file, or what is below a node's name, a namespace and `ros__parameters`.
fn find(file: &Value) -> Result<(Dialect, &Map<String, Value>), ImportError> {
    const DEPTH: usize = 4;
    let mut level: Vec<&Map<String, Value>> = file.as_object().into_iter().collect();
    for _ in 0..DEPTH {
        for table in &level {
            for (dialect, marks) in MARKS {
                if marks.iter().any(|mark| table.contains_key(*mark)) {
                    return Ok((dialect, table));
                }
            }
        }
        level = level
            .into_iter()
            .flat_map(|table| table.values().filter_map(Value::as_object))
            .collect();
    }
    let names = file.as_object().map(|table| table.keys().cloned().collect());
    Err(ImportError::Foreign(names.unwrap_or_default()))
}

fn taken(key: &str, value: impl Into<Value>) -> Outcome {
    Outcome::Taken {
        to: BTreeMap::from([(key.to_owned(), value.into())]),
    }
}

fn converted(key: &str, value: impl Into<Value>, why: impl Into<String>) -> Outcome {
    Outcome::Converted {
        to: BTreeMap::from([(key.to_owned(), value.into())]),
        why: why.into(),
    }
}

fn none(why: &str) -> Outcome {
    Outcome::NoCounterpart { why: why.into() }
}

/// An option that names a topic, with the slash that ROS puts in front.
fn topic(option: &str, value: &Value) -> Outcome {
    let Some(name) = value.as_str() else {
        return none("the value is no topic");
    };
    Outcome::Option {
        option: format!("{option} /{}", name.trim_start_matches('/')),
    }
}

/// A number, or else an outcome that says that it is none.
fn number(value: &Value, then: impl FnOnce(f64) -> Outcome) -> Outcome {
    match value.as_f64() {
        Some(number) if number.is_finite() => then(number),
        _ => none("the value is no number"),
    }
}

/// Keys that mean the same in all of them.
fn common(key: &str, value: &Value) -> Option<Outcome> {
    Some(match key {
        "max_particles" | "min_particles" => number(value, |count| {
            taken(key, count.round().clamp(10.0, MOST_PARTICLES) as u64)
        }),
        "scan_topic" => topic("--scan-topic", value),
        "odometry_topic" | "odom_topic" => topic("--odom-topic", value),
        "range_method" => match value.as_str() {
            Some("glt" | "lut") => converted("range_method", "lut", "the table is called lut here"),
            Some("pcddt" | "cddt") => {
                converted("range_method", "cddt", "pruned or not, it is called cddt here")
            }
            Some("bl" | "rm" | "rmgpu") => converted(
                "range_method",
                "lut",
                "a table has the same ranges as casting each ray, and is faster without a GPU; ray_marching needs no memory",
            ),
            _ => none("no such method is known; lut is used"),
        },
        "max_viz_particles" | "viz" | "publish_odom" | "fine_timing" | "rate" | "publish_rate"
        | "save_pose_rate" => none("what is published, and how often, is set at the pit wall"),
        "rangelib_variant" => none("there is one implementation, for the CPU"),
        "use_sim_time" => none("the sensors' clock is followed, whichever it is"),
        "initialize_with_map_click" | "click_topic" => none("/initialpose and /clicked_point are obeyed"),
        _ => return None,
    })
}

/// `pf2_params.yaml`.
fn of_synpf(key: &str, value: &Value) -> Outcome {
    if let Some(outcome) = common(key, value) {
        return outcome;
    }
    match key {
        "des_lidar_beams" => number(value, |beams| taken("beams", beams.round().max(3.0) as u64)),
        "lidar_aspect_ratio"
        | "squash_factor"
        | "max_range"
        | "z_hit"
        | "z_short"
        | "z_max"
        | "z_rand"
        | "sigma_hit"
        | "lambda_short"
        | "lam_thresh"
        | "theta_discretization"
        | "alpha_1_tum"
        | "alpha_2_tum"
        | "alpha_3_tum"
        | "alpha_4_tum" => {
            if key == "theta_discretization" {
                number(value, |bins| taken(key, bins.round().clamp(8.0, 256.0) as u64))
            } else {
                number(value, |number| taken(key, number))
            }
        }
        "initial_var_x" => number(value, |std| taken("initial_std_x", std)),
        "initial_var_y" => number(value, |std| taken("initial_std_y", std)),
        "initial_var_theta" => number(value, |std| taken("initial_std_heading", std)),
        "alpha_1_amcl" | "alpha_2_amcl" | "alpha_3_amcl" | "alpha_4_amcl" => number(value, |alpha| {
            let why = "it adds standard deviations there and variances here, so it is squared";
            converted(key, alpha * alpha, why)
        }),
        "motion_model" => match value.as_str() {
            Some("default") => converted(key, "mit", "its default is MIT's"),
            Some("tum" | "amcl" | "arc" | "mit") => taken(key, value.clone()),
            _ => none("no such model is known; tum is used"),
        },
        _ if key.starts_with("motion_dispersion_") && known(key) => {
            number(value, |number| taken(key, number))
        }
        "lidar_frame" | "base_frame" | "map_frame" | "odom_frame" | "laser_frame" => {
            none("frames come from the messages and /tf_static")
        }
        _ if is_ours(key, value) => taken(key, value.clone()),
        _ => Outcome::Unknown,
    }
}

fn known(key: &str) -> bool {
    LocalizerParameters::default().to_values().contains_key(key)
}

/// A key of our own sets with a value that they take.
fn is_ours(key: &str, value: &Value) -> bool {
    known(key)
        && LocalizerParameters::default()
            .with_values([(key.to_owned(), value.clone())])
            .is_ok()
}

/// MIT's `localize.yaml`.
fn of_mit(key: &str, value: &Value, resolution: f64) -> Outcome {
    if let Some(outcome) = common(key, value) {
        return outcome;
    }
    match key {
        "angle_step" => number(value, |step| {
            let beams = (SCANNER_BEAMS / step.max(1.0)).ceil().max(3.0) as u64;
            converted("beams", beams, format!("every {step}th of {SCANNER_BEAMS} beams"))
        }),
        "sigma_hit" => number(value, |cells| {
            let metres = cells * resolution;
            let why = format!("{cells} cells of {resolution} m there, metres here");
            converted("sigma_hit", metres.clamp(0.005, 5.0), why)
        }),
        "z_hit" | "z_short" | "z_max" | "z_rand" | "squash_factor" | "max_range" => {
            number(value, |number| taken(key, number))
        }
        "theta_discretization" => number(value, |bins| taken(key, bins.round().clamp(8.0, 256.0) as u64)),
        "motion_dispersion_x" | "motion_dispersion_y" | "motion_dispersion_theta" => {
            number(value, |number| taken(key, number))
        }
        _ => Outcome::Unknown,
    }
}

#[expect(clippy::too_many_lines, reason = "one table of keys, from top to bottom")]
/// nav2's `amcl` section; ROS 1 puts `odom_` or `laser_` in front of some keys.
fn of_amcl(key: &str, value: &Value, table: &Map<String, Value>) -> Outcome {
    if let Some(outcome) = common(key, value) {
        return outcome;
    }
    let field = table
        .get("laser_model_type")
        .and_then(Value::as_str)
        .is_none_or(|model| model.starts_with("likelihood_field"));
    let bare = match key.strip_prefix("laser_") {
        Some(rest)
            if rest.starts_with("z_")
                || matches!(
                    rest,
                    "sigma_hit" | "lambda_short" | "max_beams" | "likelihood_max_dist"
                ) =>
        {
            rest
        }
        _ => key
            .strip_prefix("odom_")
            .filter(|rest| rest.starts_with("alpha"))
            .unwrap_or(key),
    };
    match bare {
        "alpha1" | "alpha2" | "alpha3" | "alpha4" => number(value, |alpha| {
            taken(&format!("alpha_{}_amcl", &bare[5..]), alpha.clamp(0.0, 10.0))
        }),
        "alpha5" => none("it belongs to omnidirectional robots; sideslip is learned here"),
        "update_min_d" => number(value, |metres| {
            let interval = (metres / SPEED).clamp(0.02, 1.0);
            let why =
                format!("AMCL adds noise once per update, every {metres} m: {interval:.3} s at {SPEED} m/s");
            converted("noise_interval", (interval * 1e3).round() / 1e3, why)
        }),
        "update_min_a" | "resample_interval" => {
            none("every scan updates; particles are resampled when they have degenerated")
        }
        "pf_err" | "kld_err" => number(value, |error| taken("kld_error", error)),
        "pf_z" | "kld_z" => number(value, |z| taken("kld_quantile", z)),
        "max_beams" => number(value, |beams| taken("beams", beams.round().max(3.0) as u64)),
        "sigma_hit" => number(value, |sigma| taken("sigma_hit", sigma)),
        "lambda_short" => number(value, |lambda| taken("lambda_short", lambda)),
        "z_hit" | "z_rand" => number(value, |weight| taken(bare, weight)),
        "z_short" | "z_max" if field => converted(
            bare,
            0.0,
            "AMCL's likelihood field has no such term, whatever the value",
        ),
        "z_short" | "z_max" => number(value, |weight| taken(bare, weight)),
        "laser_model_type" => match value.as_str() {
            Some("beam") => converted("sensor_model", "beam", "the same model"),
            Some("likelihood_field") => converted("sensor_model", "likelihood_field", "the same model"),
            Some("likelihood_field_prob") => converted(
                "sensor_model",
                "likelihood_field",
                "without skipping beams: the fit of the scan is robust against what is not on the map",
            ),
            _ => none("no such model is known; beam is used"),
        },
        "laser_max_range" => number(value, |range| {
            if range <= 0.0 {
                none("the scanner's own range is used")
            } else if range > 100.0 {
                converted("max_range", 100.0, "100 m are the most here")
            } else {
                taken("max_range", range.max(1.0))
            }
        }),
        "likelihood_max_dist" => none("distances count up to where z_rand takes over"),
        "laser_min_range" => none("the scanner's own least range is used"),
        "do_beamskip" | "beam_skip_distance" | "beam_skip_threshold" | "beam_skip_error_threshold" => {
            none("the fit of the scan is robust against what is not on the map")
        }
        "recovery_alpha_slow" | "recovery_alpha_fast" => {
            none("a lost pose is noticed and searched for on the whole map")
        }
        "robot_model_type" | "odom_model_type" => {
            none("a car drives as a differential robot does; its sideslip is learned")
        }
        "initial_pose" => match ["x", "y", "yaw"].map(|part| value.get(part).and_then(Value::as_f64)) {
            [Some(x), Some(y), yaw] => Outcome::Option {
                option: format!("--initial-pose {x},{y},{}", yaw.unwrap_or(0.0)),
            },
            _ => none("it has no x and y"),
        },
        "initial_pose_x" | "initial_pose_y" | "initial_pose_a" => none("give --initial-pose x,y,heading"),
        "initial_cov_xx" | "initial_cov_yy" | "initial_cov_aa" => number(value, |variance| {
            let to = match bare {
                "initial_cov_xx" => "initial_std_x",
                "initial_cov_yy" => "initial_std_y",
                _ => "initial_std_heading",
            };
            converted(
                to,
                variance.max(0.0).sqrt(),
                "a variance there, a standard deviation here",
            )
        }),
        "set_initial_pose"
        | "always_reset_initial_pose"
        | "first_map_only"
        | "use_map_topic"
        | "map_topic" => none("the map is given with --map, the pose with --initial-pose"),
        "global_frame_id" | "base_frame_id" | "odom_frame_id" => {
            none("frames come from the messages and /tf_static")
        }
        "tf_broadcast" => {
            none("the transform from map to odom is published to ROS unless it is switched off")
        }
        "transform_tolerance" => none("poses are carried to the newest odometry, and not dated ahead"),
        "gui_publish_rate"
        | "service_introspection_mode"
        | "bond_heartbeat_period"
        | "introspection_mode"
        | "selective_resampling"
        | "random_seed"
        | "freespace_downsampling" => none("nothing depends on it here"),
        _ => Outcome::Unknown,
    }
}

/// The set as a file that `--params` reads.
pub fn to_yaml(import: &Import, source: &str) -> String {
    let mut text = format!(
        "# Made by `car-node import` from {source}, parameters of {}.\n# What is not here is as in {}.\n",
        import.dialect.name(),
        import.base()
    );
    if import.dialect == Dialect::Cartographer {
        text += "localizer: pose-graph\n";
    }
    for (key, value) in &import.set {
        let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        text += &[key.as_str(), ": ", &value, "\n"].concat();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome<'a>(import: &'a Import, key: &str) -> &'a Outcome {
        let value = import.values.iter().find(|value| value.key == key);
        &value.unwrap_or_else(|| panic!("{key} in the file")).outcome
    }

    fn set_of(import: &Import) -> LocalizerParameters {
        let (set, unknown) = LocalizerParameters::from_yaml(&to_yaml(import, "a.yaml")).expect("a sound set");
        assert!(unknown.is_empty(), "{unknown:?}");
        set
    }

    fn value(import: &Import, key: &str) -> f64 {
        set_of(import).to_values()[key].as_f64().expect("a number")
    }

    #[test]
    fn mits_hits_are_in_cells() {
        let text = "particle_filter:\n  ros__parameters:\n    angle_step: 18\n    max_particles: 4000\n    sigma_hit: 8.0\n    \
                    z_hit: 0.75\n    z_short: 0.01\n    z_max: 0.07\n    z_rand: 0.12\n    range_method: rmgpu\n    \
                    motion_dispersion_theta: 0.25\n    scan_topic: scan\n    colour: red\n";
        let import = import(text, 0.05).expect("MIT's");
        assert_eq!(import.dialect, Dialect::Mit);
        assert!((value(&import, "sigma_hit") - 0.4).abs() < 1e-9);
        assert!((value(&import, "beams") - 61.0).abs() < 1e-9);
        assert_eq!(set_of(&import).to_values()["motion_model"], "mit");
        assert!(
            matches!(outcome(&import, "sigma_hit"), Outcome::Converted { why, .. } if why.contains("8 cells"))
        );
        assert_eq!(outcome(&import, "colour"), &Outcome::Unknown);
        let option = Outcome::Option {
            option: "--scan-topic /scan".into(),
        };
        assert_eq!(outcome(&import, "scan_topic"), &option);
    }

    #[test]
    fn amcl_is_found_among_the_nodes_of_a_whole_stack() {
        let text = "bt_navigator:\n  ros__parameters:\n    odom_topic: /odom\namcl:\n  ros__parameters:\n    alpha1: 0.2\n    \
                    alpha2: 0.3\n    laser_model_type: likelihood_field\n    z_hit: 0.5\n    z_max: 0.05\n    z_rand: 0.5\n    \
                    z_short: 0.05\n    sigma_hit: 0.2\n    pf_err: 0.05\n    pf_z: 0.99\n    update_min_d: 0.25\n    \
                    max_beams: 60\n    max_particles: 2000\n    min_particles: 500\n    transform_tolerance: 1.0\n    \
                    initial_pose: {x: 1.0, y: 2.0, z: 0.0, yaw: 0.5}\n";
        let import = import(text, 0.05).expect("AMCL's");
        assert_eq!(import.dialect, Dialect::Amcl);
        assert!(
            (value(&import, "alpha_2_amcl") - 0.3).abs() < 1e-9,
            "variances in both"
        );
        assert!(
            (value(&import, "z_max")).abs() < 1e-9,
            "the likelihood field has none"
        );
        assert!((value(&import, "noise_interval") - 0.1).abs() < 1e-9);
        assert!((value(&import, "kld_quantile") - 0.99).abs() < 1e-9);
        assert_eq!(set_of(&import).to_values()["sensor_model"], "likelihood_field");
        assert!(
            matches!(outcome(&import, "initial_pose"), Outcome::Option { option } if option.ends_with("1,2,0.5"))
        );
    }

    #[test]
    fn synpfs_alphas_of_amcl_are_squared_and_its_variances_are_none() {
        let text = "pf2:\n  ros__parameters:\n    des_lidar_beams: 33\n    alpha_1_amcl: 0.5\n    alpha_1_tum: 0.7\n    \
                    initial_var_x: 0.3\n    motion_model: default\n    range_method: glt\n    sigma_hit: 0.12\n";
        let import = import(text, 0.05).expect("SynPF's");
        assert_eq!(import.dialect, Dialect::SynPf);
        assert!((value(&import, "alpha_1_amcl") - 0.25).abs() < 1e-9);
        assert!(
            (value(&import, "sigma_hit") - 0.12).abs() < 1e-9,
            "metres in both"
        );
        assert!((value(&import, "initial_std_x") - 0.3).abs() < 1e-9);
        assert_eq!(set_of(&import).to_values()["motion_model"], "mit");
    }

    #[test]
    fn other_files_and_values_are_refused_with_what_is_there() {
        let foreign = import("image: map.pgm\nresolution: 0.05\n", 0.05).expect_err("a map");
        assert!(foreign.to_string().contains("image, resolution"), "{foreign}");
        assert!(matches!(import("- 1\n", 0.05), Err(ImportError::Foreign(_))));
        assert!(matches!(import("a: b: c", 0.05), Err(ImportError::Yaml(_))));
        let faulty = import("angle_step: 18\nsquash_factor: -3\n", 0.05).expect_err("negative");
        assert!(faulty.to_string().contains("squash_factor"), "{faulty}");
        let text = import("angle_step: often\n", 0.05).expect("the rest is sound");
        assert!(
            matches!(outcome(&text, "angle_step"), Outcome::NoCounterpart { why } if why.contains("no number"))
        );
    }

    #[test]
    fn cartographers_lua_becomes_a_set_for_the_pose_graph() {
        let text = "include \"map_builder.lua\"\noptions = { tracking_frame = \"base_link\", odometry_sampling_ratio = 0.5 }\n\
                    TRAJECTORY_BUILDER_2D.submaps.num_range_data = 80\nTRAJECTORY_BUILDER_2D.min_z = -1\n\
                    POSE_GRAPH.constraint_builder.min_score = 0.62\nPOSE_GRAPH.optimize_every_n_nodes = 90\n\
                    POSE_GRAPH.colour = 3\n";
        let import = import_lua(text).expect("Cartographer's");
        let expected = PoseGraphParameters {
            odometry_sampling_ratio: 0.5,
            submaps_num_range_data: 80,
            min_score: 0.62,
            ..PoseGraphParameters::default()
        };
        assert_eq!(set_of(&import), expected.into());
        let explained = |key: &str, part: &str| matches!(outcome(&import, key), Outcome::NoCounterpart { why } if why.contains(part));
        assert!(explained("include", "not read"));
        assert!(explained("options.tracking_frame", "/tf_static"));
        assert!(explained("trajectory_builder_2d.min_z", "no height"));
        assert_eq!(outcome(&import, "pose_graph.colour"), &Outcome::Unknown);
        let key = "pose_graph.optimize_every_n_nodes";
        assert_eq!(
            outcome(&import, key),
            &taken(key, 90),
            "the default is taken, too"
        );
        assert!(!import.set.contains_key(key));
        assert!(matches!(import_lua("x = 3\n"), Err(ImportError::Lua)));
        let faulty = import_lua("POSE_GRAPH.a = {\n").expect_err("open").to_string();
        assert!(faulty.contains("line"), "{faulty}");
    }
}
