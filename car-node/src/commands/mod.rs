//! One file per subcommand.
#![allow(
    clippy::print_stderr,
    reason = "commands print: results on stdout, the rest on stderr"
)]

/// Prints a line of a result.
macro_rules! say {
    ($($line:tt)*) => { $crate::commands::say(&format!($($line)*)) };
}

pub(crate) mod ablate;
pub(crate) mod doctor;
mod drawing;
pub(crate) mod evaluate;
pub(crate) mod figure;
pub(crate) mod grip_test;
pub(crate) mod health;
pub(crate) mod import;
pub(crate) mod placement;
mod plot;
pub(crate) mod race;
mod race_page;
mod race_table;
pub(crate) mod run;
pub(crate) mod stress;
pub(crate) mod track;

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, bail};
use car_node::control::parameter_sets::{self, NamedSet, SetError};
use car_node::evaluate::{read_poses, read_trajectory};
use car_node::localization::EXTERNAL;
use car_node::sensors::bag::{Bag, SensorLog, Topics};
use car_node::sensors::frames::Mount;
use maps::{MapError, OccupancyGrid, is_pbstream};
use simulator::{BUNDLED, Track};
use synpf::{PoseOf, TrackMap};

use crate::cli::{Bags, LocalizerKind, PosedFrame, TopicArguments};

/// Prints a line. Ends the program quietly when stdout is closed, as after `| head`; `println!` would panic.
fn say(line: &str) {
    let mut out = std::io::stdout().lock();
    if let Err(error) = writeln!(out, "{line}") {
        if error.kind() != ErrorKind::BrokenPipe {
            eprintln!("car-node: stdout: {error}");
        }
        std::process::exit(1);
    }
}

/// Wrong usage of the command line: exit code 2, as for what the parser refuses.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct BadUsage(String);

/// Reads what a localizer needs of each bag.
fn read_bags(bags: &Bags) -> anyhow::Result<Vec<(&Path, SensorLog)>> {
    if bags.truth.is_some() && bags.files.len() > 1 {
        bail!(BadUsage(
            "--truth contains the poses of one drive: give one --bag".into()
        ));
    }
    let files = bags.files.iter().map(PathBuf::as_path);
    let with_truth = |bag| {
        let mut log = read_bag(bag, &bags.topics)?;
        if let Some(truth) = &bags.truth {
            let mount = log.mount.unwrap_or_else(Mount::typical);
            log.truth = if is_pbstream(truth) {
                read_trajectory(truth)?
            } else {
                read_poses(truth, mount.base_link_from_laser)?
            };
        }
        if bags.from > 0.0 || bags.lasting.is_some() {
            log.keep(bags.from, bags.lasting.unwrap_or(f64::INFINITY));
            if log.span().is_none() {
                let text = format!("{}: no scan after --from {} s", bag.display(), bags.from);
                bail!(BadUsage(text));
            }
        }
        Ok((bag, log))
    };
    files.map(with_truth).collect()
}

/// Reads what a localizer needs of a bag.
fn read_bag(bag: &Path, arguments: &TopicArguments) -> anyhow::Result<SensorLog> {
    let log = Bag::read(bag)?.sensors(&topics(arguments), arguments.laser)?;
    for note in &log.notes {
        eprintln!("car-node: {}: {note}", bag.display());
    }
    Ok(log)
}

fn topics(arguments: &TopicArguments) -> Topics {
    Topics {
        scan: arguments.scan_topic.clone(),
        odometry: arguments.odom_topic.clone(),
        truth: arguments.truth_topic.clone(),
        imu: arguments.imu_topic.clone(),
        pose: arguments.external_pose_topic.clone(),
        pose_of: arguments.pose_of.map(|of| match of {
            PosedFrame::BaseLink => PoseOf::BaseLink,
            PosedFrame::Laser => PoseOf::Laser,
        }),
    }
}

fn load_map(path: &Path) -> anyhow::Result<Arc<TrackMap>> {
    let map = TrackMap::new(OccupancyGrid::load(path)?).with_context(|| path.display().to_string())?;
    Ok(Arc::new(map))
}

/// How the laser is mounted; prints a warning when that is a guess.
fn mount(bag: &Path, log: &SensorLog) -> Mount {
    log.mount.unwrap_or_else(|| {
        warn_of_guess(&bag.display().to_string());
        Mount::typical()
    })
}

/// Prints that the laser's pose is a guess.
fn warn_of_guess(source: &str) {
    let ahead = Mount::typical().base_link_from_laser.x;
    eprintln!(
        "car-node: warning: {source}: no /tf_static; the laser is assumed {ahead} m ahead of base_link (--laser sets its pose)"
    );
}

/// Loads a parameter set. Prints a warning that lists unknown keys.
fn load_set(name_or_path: &str) -> anyhow::Result<NamedSet> {
    let set = parameter_sets::load(name_or_path).map_err(|error| match error {
        SetError::Unknown(_) => BadUsage(error.to_string()).into(),
        _ => anyhow::Error::from(error),
    })?;
    if !set.unknown_keys.is_empty() {
        eprintln!(
            "car-node: warning: {name_or_path}: unknown keys: {}",
            set.unknown_keys.join(", ")
        );
    }
    Ok(set)
}

/// The set that `--params` names, or else the first one of the kind that `--localizer` names.
fn chosen_set(params: Option<&str>, localizer: Option<LocalizerKind>) -> anyhow::Result<Option<NamedSet>> {
    let first = localizer.map(|kind| match kind {
        LocalizerKind::Synpf => ("hq", "synpf"),
        LocalizerKind::SynpfBaseline => ("synpf-baseline", "reference"),
        LocalizerKind::External => (EXTERNAL, EXTERNAL),
        LocalizerKind::PoseGraph => ("pose-graph", "pose-graph"),
    });
    let Some(name) = params.or(first.map(|(name, _)| name)) else {
        return Ok(None);
    };
    let set = load_set(name)?;
    if let Some((_, kind)) = first
        && set.parameters.kind() != kind
    {
        let other = set.parameters.kind();
        let text = format!("--params {name} is a set for {other}, and --localizer asks for {kind}");
        bail!(BadUsage(text));
    }
    Ok(Some(set))
}

/// The set that `--beside` names, to run beside `set`.
fn set_beside(beside: Option<&str>, set: Option<&NamedSet>) -> anyhow::Result<Option<NamedSet>> {
    let beside = beside.map(load_set).transpose()?;
    if let (Some(beside), Some(set)) = (&beside, set)
        && beside.name == set.name
    {
        let text = format!(
            "--beside {}: the same set is in force; another one is needed",
            set.name
        );
        bail!(BadUsage(text));
    }
    Ok(beside)
}

/// Refuses to follow another localizer whose topic is not given.
fn check_pose_topic<'a>(
    sets: impl IntoIterator<Item = &'a NamedSet>,
    pose_topic: Option<&str>,
) -> anyhow::Result<()> {
    let external = sets.into_iter().any(|set| set.parameters.kind() == EXTERNAL);
    if external && pose_topic.is_none() {
        let text = "the set external follows another localizer: give the topic of its poses with --pose-topic, such as \
                    /amcl_pose or /tracked_pose";
        bail!(BadUsage(text.into()));
    }
    Ok(())
}

/// A bundled track, or the one at a path; `raceline` replaces its raceline.
fn find_track(name_or_path: &str, raceline: Option<&Path>) -> anyhow::Result<Track> {
    if !BUNDLED.contains(&name_or_path) && !Path::new(name_or_path).exists() {
        let bundled = BUNDLED.join(", ");
        let text = format!("no track {name_or_path:?}: it is no folder, no file and none of {bundled}");
        bail!(BadUsage(text));
    }
    Track::find(name_or_path, raceline).map_err(|error| match &error {
        MapError::Read { file, source }
            if raceline.is_none()
                && source.kind() == ErrorKind::NotFound
                && file.ends_with("raceline.csv") =>
        {
            anyhow::Error::from(error).context("a track needs a raceline; --raceline FILE gives one")
        }
        _ => error.into(),
    })
}

/// Prints why a command failed. Each cause appears once, although some libraries repeat their source's message in their own.
pub(crate) fn complain(error: &anyhow::Error) {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if !text.contains(&cause) {
            if !text.is_empty() {
                text += ": ";
            }
            text += &cause;
        }
    }
    eprintln!("car-node: {text}");
}
