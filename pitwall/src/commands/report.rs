//! `pitwall report`

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use pitwall::{CarReport, Report};

use crate::output;
use crate::terminal::text;

pub(super) fn run(
    file: &Path,
    output: Option<PathBuf>,
    with: &[PathBuf],
    json: bool,
) -> anyhow::Result<ExitCode> {
    let report = Report::with(file, with)?;
    let to = output.unwrap_or_else(|| file.with_extension("html"));
    std::fs::write(&to, report.to_html()).with_context(|| to.display().to_string())?;
    super::print_unreadable(&report.unreadable);
    if json {
        output::print_json(&report)?;
    } else {
        for car in &report.cars {
            output::print(&summary(car));
        }
        output::print(&format!("with figures: {}", to.display()));
    }
    Ok(ExitCode::SUCCESS)
}

fn summary(car: &CarReport) -> String {
    let mut lines = vec![format!("{}", car.car)];
    let shares: Vec<_> = car
        .states
        .iter()
        .map(|(state, share)| format!("{state} {:.1} %", share * 100.0))
        .collect();
    lines.push(format!("  states   {}", shares.join(", ")));
    for row in &car.table {
        let lateral = row.lateral_m.map_or_else(
            || "-".to_owned(),
            |lateral| format!("{:.2} ± {:.2} cm", lateral.mean * 100.0, lateral.sigma * 100.0),
        );
        lines.push(format!(
            "  {:<8} {} laps, {} left out, median {} s, mean {:.3} ± {:.3} s, off the line {lateral}, alignment {} %",
            row.set,
            row.laps,
            row.left_out,
            text::number(row.quartiles_s.map(|[_, median, _]| median), 3),
            row.time_s.mean,
            row.time_s.sigma,
            text::number(row.alignment.map(|a| a * 100.0), 1),
        ));
    }
    if let Some(truth) = &car.truth {
        lines.push(format!(
            "  truth    RMSE {:.2} cm, along {:.2}, across {:.2}, at most {:.1} cm, heading {:.3} deg",
            truth.rmse_m * 100.0,
            truth.along_m * 100.0,
            truth.across_m * 100.0,
            truth.max_m * 100.0,
            truth.heading_rad.to_degrees(),
        ));
    }
    lines.push(format!(
        "  load     {} cores, update p99 at most {} ms; {} alarms, {} messages missing",
        text::number(car.cpu, 2),
        text::number(car.update_p99_ms, 2),
        car.alarms,
        car.missing,
    ));
    lines.join("\n")
}
