//! `car-node race`.

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use car_node::localization::LocalizerParameters;
use car_node::race::{
    CarResult, PAPER_ROWS, PoseSource, Quality, RaceSetup, RaceSummary, SPEED_SCALE, applies_to_races, race,
};
use car_node::statistics::MeanSigma;
use car_node::stress::Defect;
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use serde::Serialize;
use simulator::{Track, TrackReport};
use synpf::TrackMap;

use super::{BadUsage, find_track, load_set};
use crate::cli;

/// The races of one localizer on one tyre, as reported.
#[derive(Debug, Serialize)]
struct Report {
    track: String,
    localizer: String,
    odometry: Quality,
    laps_each: u32,
    seeds: Vec<u64>,
    /// The defects of `--faults`, as `KIND:GRADE`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    faults: Vec<String>,
    summary: RaceSummary,
    /// By seed, then by car; not in tables.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    races: Vec<Vec<CarResult>>,
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
        return table(arguments, &track, &map).map(|()| ExitCode::SUCCESS);
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
    Ok(match arguments.localizer {
        cli::PoseSource::Synpf => {
            let set = load_set(&arguments.params)?;
            (
                format!("synpf {}", set.name),
                PoseSource::Localizer(set.parameters),
            )
        }
        cli::PoseSource::SynpfBaseline => shipped("synpf-baseline")?,
        cli::PoseSource::Odometry => ("odometry".into(), PoseSource::Odometry),
        cli::PoseSource::Truth => ("truth".into(), PoseSource::Truth),
    })
}

fn shipped(name: &str) -> anyhow::Result<(String, PoseSource)> {
    let parameters = LocalizerParameters::named(name).with_context(|| format!("no parameter set {name}"))?;
    let title = if name.starts_with("synpf") {
        name.into()
    } else {
        format!("synpf {name}")
    };
    Ok((title, PoseSource::Localizer(parameters)))
}

/// Runs one race for each seed, in parallel on all cores.
fn races(
    arguments: &cli::Race,
    track: &Arc<Track>,
    map: &Arc<TrackMap>,
    localizer: String,
    pose_source: PoseSource,
    quality: Quality,
) -> anyhow::Result<Report> {
    let seeds: Vec<u64> = (0..arguments.seeds)
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

fn name(quality: Quality) -> &'static str {
    match quality {
        Quality::Hq => "HQ",
        Quality::Lq => "LQ",
    }
}

/// The paper's grid.
fn table(arguments: &cli::Race, track: &Arc<Track>, map: &Arc<TrackMap>) -> anyhow::Result<()> {
    let mut rows = vec![(shipped("hq")?, Quality::Hq), (shipped("lq")?, Quality::Lq)];
    for pose_source in [
        shipped("synpf-baseline")?,
        ("odometry".into(), PoseSource::Odometry),
        ("truth".into(), PoseSource::Truth),
    ] {
        rows.extend([Quality::Hq, Quality::Lq].map(|quality| (pose_source.clone(), quality)));
    }
    let mut reports = Vec::new();
    for ((localizer, pose_source), quality) in rows {
        let mut report = races(arguments, track, map, localizer, pose_source, quality)?;
        report.races.clear();
        reports.push(report);
    }
    if arguments.json {
        say!("{}", serde_json::to_string_pretty(&reports)?);
    } else {
        print_table(arguments, &reports);
    }
    Ok(())
}

/// The value, or a dash.
fn or_dash(value: Option<f64>, scale: f64, digits: usize) -> String {
    value.map_or("-".into(), |v| format!("{:.digits$}", v * scale))
}

fn mean_sigma(value: Option<MeanSigma>, scale: f64, digits: usize) -> String {
    value.map_or("-".into(), |v| {
        format!("{:.digits$} ± {:.digits$}", v.mean * scale, v.sigma * scale)
    })
}

fn print_table(arguments: &cli::Race, reports: &[Report]) {
    say!(
        "laps on {}: {} with each of {} seeds; error to the line by the estimate, as the paper takes it, and by the truth",
        reports.first().map_or("", |report| &report.track),
        arguments.laps,
        arguments.seeds
    );
    say!(
        "{:<16} {:<4} {:>15} {:>15} {:>6} {:>11} {:>8} {:>8} {:>8} {:>7} {:>8}",
        "localizer",
        "odom",
        "lap time",
        "error to line",
        "true",
        "align paper",
        "ours",
        "pos rmse",
        "hdg rmse",
        "load",
        "crashes"
    );
    say!(
        "{:<16} {:<4} {:>15} {:>15} {:>6} {:>11} {:>8} {:>8} {:>8} {:>7} {:>8}",
        "",
        "",
        "s",
        "cm",
        "cm",
        "%",
        "%",
        "cm",
        "deg",
        "% core",
        ""
    );
    for report in reports {
        let s = &report.summary;
        say!(
            "{:<16} {:<4} {:>15} {:>15} {:>6} {:>11} {:>8} {:>8} {:>8} {:>7.2} {:>8}",
            report.localizer,
            name(report.odometry),
            mean_sigma(s.lap_time_s, 1.0, 3),
            mean_sigma(s.line_error_m, 100.0, 2),
            or_dash(s.true_line_error_m.map(|error| error.mean), 100.0, 2),
            or_dash(s.alignment_paper, 100.0, 2),
            or_dash(s.alignment, 100.0, 2),
            or_dash(s.position_rmse_m, 100.0, 2),
            or_dash(s.heading_rmse_rad, 1_f64.to_degrees(), 2),
            s.load.cpu * 100.0,
            crashes(s),
        );
    }
    say!(
        "lap times are calibrated: {SPEED_SCALE} of the raceline's speed on all tyres gives the paper's on clean ones; compare with \
         the rows of the truth"
    );
    say!("the paper, table I (10 laps of a real car on its own track, both tyres at one speed scaling):");
    for row in PAPER_ROWS {
        let pair = |[mean, sigma]: [f64; 2]| Some(MeanSigma { mean, sigma });
        say!(
            "{:<16} {:<4} {:>15} {:>15} {:>6} {:>11} {:>8} {:>8} {:>8} {:>7} {:>8}",
            row.localizer,
            name(row.quality),
            mean_sigma(pair(row.lap_time_s), 1.0, 3),
            mean_sigma(pair(row.line_error_m), 100.0, 2),
            "-",
            or_dash(Some(row.alignment), 100.0, 2),
            "-",
            "-",
            "-",
            or_dash(row.load, 1.0, 2),
            "-"
        );
    }
}

/// The number of crashes, marked if a car did not finish.
fn crashes(summary: &RaceSummary) -> String {
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
