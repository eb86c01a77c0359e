//! `car-node ablate`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;
use car_node::evaluate::ablation::{Change, Step, steps};
use car_node::evaluate::{Outcome, Summaries, Truth, run as run_over};
use car_node::localization::Start;
use car_node::sensors::bag::SensorLog;
use car_node::sensors::frames::Mount;
use car_node::statistics::mean;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use synpf::{SetUpError, TrackMap};

use crate::cli::Ablate;

/// One set over one bag: means over the seeds.
#[derive(Debug, Clone, Serialize)]
struct Row {
    bag: PathBuf,
    name: String,
    change: Change,
    #[serde(skip_serializing_if = "serde_json::Map::is_empty")]
    values: serde_json::Map<String, serde_json::Value>,
    /// Position RMSE \[m\], and its parts across and along the car.
    position_rmse_m: Option<f64>,
    lateral_rmse_m: Option<f64>,
    longitudinal_rmse_m: Option<f64>,
    heading_rmse_rad: Option<f64>,
    /// Largest error of all seeds \[m\].
    position_max_m: Option<f64>,
    excursions: Option<f64>,
    alignment: Option<f64>,
    update_us_p50: Option<f64>,
}

impl Row {
    fn new(bag: &Path, step: &Step, outcomes: &[Outcome]) -> Self {
        let of_errors = |of: fn(&Summaries) -> f64| -> Vec<f64> {
            outcomes
                .iter()
                .filter_map(|o| o.errors.as_ref().map(of))
                .collect()
        };
        let average = |of: fn(&Summaries) -> f64| mean(&of_errors(of));
        let all = |of: fn(&Outcome) -> Option<f64>| -> Option<f64> {
            mean(&outcomes.iter().filter_map(of).collect::<Vec<_>>())
        };
        Self {
            bag: bag.into(),
            name: step.name.clone(),
            change: step.change,
            values: step.values.clone().into_iter().collect(),
            position_rmse_m: average(|errors| errors.position_error_m.rmse),
            lateral_rmse_m: average(|errors| errors.lateral_error_m.rmse),
            longitudinal_rmse_m: average(|errors| errors.longitudinal_error_m.rmse),
            heading_rmse_rad: average(|errors| errors.heading_error_rad.rmse),
            position_max_m: of_errors(|errors| errors.position_error_m.max)
                .into_iter()
                .reduce(f64::max),
            excursions: average(|errors| errors.excursions as f64),
            alignment: all(|outcome| outcome.alignment.map(|alignment| alignment.mean)),
            update_us_p50: all(|outcome| outcome.update_us.map(|times| times.p50)),
        }
    }
}

pub(crate) fn run(arguments: &Ablate) -> anyhow::Result<()> {
    let set = super::load_set(&arguments.params)?;
    let steps = steps(&set.parameters)
        .map_err(SetUpError::Parameters)
        .with_context(|| format!("{}: no steps lead to it from synpf-baseline", set.name))?;
    let map = super::load_map(&arguments.bags.map)?;
    let logs = super::read_bags(&arguments.bags)?;

    let progress = ProgressBar::new((logs.len() * steps.len() * arguments.seed.len()) as u64);
    if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len}") {
        progress.set_style(style);
    }
    let mut rows = Vec::new();
    for (bag, log) in &logs {
        let truth = Truth::new(log.truth.clone());
        let mount = super::mount(bag, log);
        for step in &steps {
            progress.set_message(step.name.clone());
            let outcomes = arguments
                .seed
                .iter()
                .map(|&seed| {
                    let outcome = over(&map, log, mount, &truth, step, arguments.initial_pose, seed);
                    progress.inc(1);
                    outcome
                })
                .collect::<anyhow::Result<Vec<_>>>()
                .with_context(|| bag.display().to_string())?;
            rows.push(Row::new(bag, step, &outcomes));
        }
    }
    progress.finish_and_clear();

    if arguments.json {
        say!("{}", serde_json::to_string_pretty(&rows)?);
        return Ok(());
    }
    for rows in rows.chunk_by(|a, b| a.bag == b.bag) {
        print_table(rows, &set.name, arguments.seed.len());
    }
    Ok(())
}

fn over(
    map: &Arc<TrackMap>,
    log: &SensorLog,
    mount: Mount,
    truth: &Truth,
    step: &Step,
    start: Start,
    seed: u64,
) -> anyhow::Result<Outcome> {
    let mut localizer = step.parameters.build(map, mount.base_link_from_laser, seed)?;
    Ok(run_over(
        localizer.as_mut(),
        &log.arrivals,
        truth,
        start,
        |_, _, _| {},
    )?)
}

fn print_table(rows: &[Row], set: &str, seeds: usize) {
    let Some(first) = rows.first() else { return };
    say!(
        "{}: from synpf-baseline to {set}, mean of {seeds} {}",
        first.bag.display(),
        if seeds == 1 { "seed" } else { "seeds" }
    );
    say!(
        "  {:<44} {:>8} {:>8} {:>8} {:>8} {:>8} {:>7} {:>6} {:>7}",
        "",
        "pos rmse",
        "lat rmse",
        "lon rmse",
        "max",
        "hdg rmse",
        "excurs",
        "align",
        "us p50"
    );
    say!(
        "  {:<44} {:>8} {:>8} {:>8} {:>8} {:>8}",
        "",
        "cm",
        "cm",
        "cm",
        "cm",
        "deg"
    );
    let mut change = Change::None;
    for row in rows {
        if row.change == Change::LeftOut && change != Change::LeftOut {
            say!("  {set}, but without");
        }
        change = row.change;
        let cell = |value: Option<f64>, scale: f64, digits: usize| {
            value.map_or("-".into(), |value| format!("{:.digits$}", value * scale))
        };
        let lead = match row.change {
            Change::None | Change::Replaced => "",
            Change::Added => "+ ",
            Change::LeftOut => "- ",
        };
        say!(
            "  {:<44} {:>8} {:>8} {:>8} {:>8} {:>8} {:>7} {:>6} {:>7}",
            format!("{lead}{}", row.name),
            cell(row.position_rmse_m, 100.0, 2),
            cell(row.lateral_rmse_m, 100.0, 2),
            cell(row.longitudinal_rmse_m, 100.0, 2),
            cell(row.position_max_m, 100.0, 1),
            cell(row.heading_rmse_rad, 1_f64.to_degrees(), 3),
            cell(row.excursions, 1.0, 1),
            cell(row.alignment, 1.0, 3),
            cell(row.update_us_p50, 1.0, 0),
        );
    }
}
