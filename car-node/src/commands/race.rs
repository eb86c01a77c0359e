//! `car-node race`.

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use car_node::localization::LocalizerParameters;
use car_node::race::{CarResult, PoseSource, Quality, RaceSetup, RaceSummary, applies_to_races, race};
use car_node::statistics::MeanSigma;
use car_node::stress::Defect;
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use serde::Serialize;
use simulator::{Track, TrackReport};
use synpf::TrackMap;

use super::{BadUsage, chosen_set, find_track, load_set, race_table};
use crate::cli::{self, LocalizerKind};

/// The races of one localizer on one tyre, as reported.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    pub(super) track: String,
    pub(super) localizer: String,
    pub(super) odometry: Quality,
    laps_each: u32,
    pub(super) seeds: Vec<u64>,
    /// The defects of `--faults`, as `KIND:GRADE`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    faults: Vec<String>,
    pub(super) summary: RaceSummary,
    /// By seed, then by car; not in tables.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) races: Vec<Vec<CarResult>>,
}

/// Exit code when a car crashed or did not finish. Wrong usage is 2, a faulty file is 1.
const UNFINISHED: u8 = 3;

pub(crate) fn run(arguments: &cli::Race) -> anyhow::Result<ExitCode> {
    let track = Arc::new(find_track(&arguments.track, arguments.raceline.as_deref())?);
    for fault in TrackReport::of(&track).faults {
        eprintln!("car-node: warning: {}: {fault}", arguments.track);
    }
    let map = TrackMap::new(track.grid.clone()).with_context(|| arguments.track.clone())?;
    let map = Arc::new(map);
    if arguments.table {
        // The rows are for comparison, and some are expected to crash.
        return race_table::run(arguments, &track, &map).map(|()| ExitCode::SUCCESS);
    }
    let (localizer, pose_source) = chosen(arguments)?;
    let quality = match arguments.odometry {
        cli::Odometry::Hq => Quality::Hq,
        cli::Odometry::Lq => Quality::Lq,
    };
    let report = races(arguments, &track, &map, localizer, pose_source, quality)?;
    if arguments.json {
        say!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print_one(&report);
    }
    let summary = &report.summary;
    let clean = summary.finished == summary.started && summary.crashes == 0;
    Ok(if clean {
        ExitCode::SUCCESS
    } else {
        ExitCode::from(UNFINISHED)
    })
}

/// The defects of `--faults`.
fn faults(arguments: &cli::Race) -> anyhow::Result<Vec<Defect>> {
    let defects: Vec<Defect> = arguments.faults.iter().map(|choice| choice.one()).collect();
    match defects.iter().find(|defect| !applies_to_races(defect.kind)) {
        None => Ok(defects),
        Some(defect) => {
            let text =
                format!("--faults {defect}: this defect needs a recorded drive; car-node stress has it");
            bail!(BadUsage(text));
        }
    }
}

/// The pose source that the arguments ask for, with its title.
fn chosen(arguments: &cli::Race) -> anyhow::Result<(String, PoseSource)> {
    let kind = match arguments.localizer {
        Some(cli::PoseSource::Odometry) => return Ok(("odometry".into(), PoseSource::Odometry)),
        Some(cli::PoseSource::Truth) => return Ok(("truth".into(), PoseSource::Truth)),
        Some(cli::PoseSource::Synpf) => Some(LocalizerKind::Synpf),
        Some(cli::PoseSource::SynpfBaseline) => Some(LocalizerKind::SynpfBaseline),
        Some(cli::PoseSource::PoseGraph) => Some(LocalizerKind::PoseGraph),
        None => None,
    };
    let set = match chosen_set(arguments.params.as_deref(), kind)? {
        Some(set) => set,
        None => load_set("hq")?,
    };
    Ok(titled(&set.name, set.parameters))
}

pub(super) fn shipped(name: &str) -> anyhow::Result<(String, PoseSource)> {
    let parameters = LocalizerParameters::named(name).with_context(|| format!("no parameter set {name}"))?;
    Ok(titled(name, parameters))
}

/// A localizer's title says its kind and its set.
fn titled(name: &str, parameters: LocalizerParameters) -> (String, PoseSource) {
    let kind = match parameters.kind() {
        "reference" => "synpf",
        kind => kind,
    };
    let title = if name.starts_with(kind) {
        name.into()
    } else {
        format!("{kind} {name}")
    };
    (title, PoseSource::Localizer(parameters))
}

/// Runs one race for each seed, in parallel on all cores.
pub(super) fn races(
    arguments: &cli::Race,
    track: &Arc<Track>,
    map: &Arc<TrackMap>,
    localizer: String,
    pose_source: PoseSource,
    quality: Quality,
) -> anyhow::Result<Report> {
    let seeds: Vec<u64> = (0..arguments.seeds.unwrap_or(1))
        .map(|i| arguments.seed.wrapping_add(i))
        .collect();
    let setup = RaceSetup {
        laps: arguments.laps,
        cars: arguments.cars.into(),
        quality,
        pose_source,
        speed_scale: arguments.speed,
        seed: 0,
        defects: faults(arguments)?,
    };
    let progress = progress_bar(seeds.len() as u64, &localizer, quality);
    let races = seeds
        .par_iter()
        .map(|&seed| {
            let result = race(
                track,
                map,
                &RaceSetup {
                    seed,
                    ..setup.clone()
                },
            );
            progress.inc(1);
            result
        })
        .collect::<Result<Vec<_>, _>>()?;
    progress.finish_and_clear();
    let cars: Vec<CarResult> = races.iter().flatten().cloned().collect();
    Ok(Report {
        track: track.name.clone(),
        localizer,
        odometry: quality,
        laps_each: arguments.laps,
        seeds,
        faults: setup.defects.iter().map(ToString::to_string).collect(),
        summary: RaceSummary::of(&cars),
        races,
    })
}

fn progress_bar(races: u64, localizer: &str, quality: Quality) -> ProgressBar {
    let bar = ProgressBar::new(races);
    if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} races") {
        bar.set_style(style);
    }
    bar.enable_steady_tick(Duration::from_millis(250));
    bar.set_message(format!("{localizer} {}", name(quality)));
    bar
}

pub(super) fn name(quality: Quality) -> &'static str {
    match quality {
        Quality::Hq => "HQ",
        Quality::Lq => "LQ",
    }
}

/// The value, or a dash.
pub(super) fn or_dash(value: Option<f64>, scale: f64, digits: usize) -> String {
    value.map_or("-".into(), |v| format!("{:.digits$}", v * scale))
}

pub(super) fn mean_sigma(value: Option<MeanSigma>, scale: f64, digits: usize) -> String {
    value.map_or("-".into(), |v| {
        format!("{:.digits$} ± {:.digits$}", v.mean * scale, v.sigma * scale)
    })
}

/// The number of crashes, marked if a car did not finish.
pub(super) fn crashes(summary: &RaceSummary) -> String {
    if summary.finished == summary.started {
        summary.crashes.to_string()
    } else {
        format!("{} (dnf)", summary.crashes)
    }
}

fn print_one(report: &Report) {
    let s = &report.summary;
    say!(
        "{}  {}, {} odometry, {} laps, {} of {} cars finished",
        report.track,
        report.localizer,
        name(report.odometry),
        report.laps_each,
        s.finished,
        s.started
    );
    if !report.faults.is_empty() {
        say!("  with {}", report.faults.join(", "));
    }
    let line = |name: &str, value: String, unit: &str| say!("  {name:<22} {value:>17}  {unit}");
    line("lap time", mean_sigma(s.lap_time_s, 1.0, 3), "s");
    line(
        "estimate to line",
        mean_sigma(s.line_error_m, 100.0, 2),
        "cm, as the paper takes it",
    );
    line("car to line", mean_sigma(s.true_line_error_m, 100.0, 2), "cm");
    line("position error", or_dash(s.position_rmse_m, 100.0, 2), "cm rmse");
    line("position error, max", or_dash(s.position_max_m, 100.0, 2), "cm");
    line(
        "heading error",
        or_dash(s.heading_rmse_rad, 1_f64.to_degrees(), 3),
        "deg rmse",
    );
    line("alignment, paper's", or_dash(s.alignment_paper, 100.0, 2), "%");
    line("alignment, ours", or_dash(s.alignment, 100.0, 2), "%");
    if !s.states.is_empty() {
        let shares = s
            .states
            .iter()
            .map(|(state, share)| format!("{state} {:.2} %", share * 100.0));
        line("states", shares.collect::<Vec<_>>().join(", "), "");
        line("LOST though right", s.false_lost.to_string(), "updates");
        line("LOCALIZED though wrong", s.false_localized.to_string(), "updates");
        line("searches", s.searches.to_string(), "");
    }
    line("crashes", s.crashes.to_string(), "");
    line("scrapes", s.scrapes.to_string(), "");
    line("collisions", s.collisions.to_string(), "");
    line("spins", s.spins.to_string(), "");
    line(
        "load",
        format!("{:.2}", s.load.cpu * 100.0),
        "% of a core, per car",
    );
    line(
        "update",
        format!("{:.0} / {:.0}", s.load.update_us_p50, s.load.update_us_p99),
        "us p50 / p99",
    );
    line(
        "speed of the race",
        format!("{:.1}", s.load.real_time_factor),
        "times real time",
    );
}
