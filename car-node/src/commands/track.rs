//! `car-node track new|check|draw`.

use std::fs;
use std::path::Path;

use anyhow::{Context, bail};
use maps::Cell;
use simulator::{Track, TrackReport, TrackSpec};

use super::drawing;
use super::find_track;
use crate::cli::TrackCommand;

pub(crate) fn run(command: &TrackCommand) -> anyhow::Result<()> {
    match command {
        TrackCommand::New {
            folder,
            from,
            length,
            width,
            seed,
            force,
            json,
        } => {
            let (spec, text) = match from {
                Some(path) => described(path)?,
                None => invented(*seed, *length, *width)?,
            };
            new(folder, &spec, &text, *force, *json)
        }
        TrackCommand::Check { track, json } => {
            check(&find_track(&track.track, track.raceline.as_deref())?, *json)
        }
        TrackCommand::Draw { track, svg, columns } => {
            let track = find_track(&track.track, track.raceline.as_deref())?;
            draw(&track, svg.as_deref(), (*columns).into())
        }
    }
}

fn described(path: &Path) -> anyhow::Result<(TrackSpec, String)> {
    let file = path.display().to_string();
    let text = maps::read_text(path)?;
    Ok((TrackSpec::parse(&file, &text)?, text))
}

fn invented(seed: u64, length: f64, width: f64) -> anyhow::Result<(TrackSpec, String)> {
    let spec = TrackSpec::random(seed, length, width);
    let text = serde_saphyr::to_string(&spec)?;
    Ok((spec, text))
}

fn new(folder: &Path, spec: &TrackSpec, text: &str, force: bool, json: bool) -> anyhow::Result<()> {
    let map = folder.join("map.yaml");
    if map.exists() && !force {
        bail!("{} already exists; --force overwrites it", map.display());
    }
    let track = spec.generate().with_context(|| format!("track {}", spec.name))?;
    // A track that cannot be raced on is printed with its faults, and not written.
    check(&track, json)?;
    track.save(folder, text)?;
    Ok(())
}

/// Prints the properties of a track. Fails when it cannot be raced on.
fn check(track: &Track, json: bool) -> anyhow::Result<()> {
    let report = TrackReport::of(track);
    if json {
        say!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print(&report);
    }
    match report.faults.len() {
        0 => Ok(()),
        1 => bail!("{} cannot be raced on: {}", report.name, report.faults[0]),
        n => bail!(
            "{} cannot be raced on: {}, and {} more",
            report.name,
            report.faults[0],
            n - 1
        ),
    }
}

fn print(report: &TrackReport) {
    say!("{}", report.name);
    let line = |name: &str, value: String| say!("  {name:<12} {value}");
    line(
        "lap",
        format!(
            "{:.1} m, {:.2} s at the raceline's speeds",
            report.length_m, report.lap_time_s
        ),
    );
    let [slowest, fastest] = report.speed_mps;
    line("speed", format!("{slowest:.1} to {fastest:.1} m/s"));
    line(
        "corners",
        format!(
            "down to {:.2} m radius, up to {:.1} m/s^2",
            report.least_radius_m, report.lateral_mps2
        ),
    );
    line(
        "room",
        format!(
            "{:.2} m to the nearest wall, {:.2} m wide at the narrowest",
            report.clearance_m, report.width_m
        ),
    );
    let [width, height] = report.map_m;
    line(
        "map",
        format!(
            "{width:.1} x {height:.1} m at {} m a cell, {:.0} m^2 free",
            report.resolution_m, report.free_m2
        ),
    );
    let [mean, sigma] = report.map_error_m;
    line(
        "map error",
        format!(
            "{:+.1} cm mean, {:.1} cm sigma against the true walls",
            mean * 100.0,
            sigma * 100.0
        ),
    );
    for fault in &report.faults {
        line("fault", fault.clone());
    }
}

fn draw(track: &Track, svg: Option<&Path>, columns: usize) -> anyhow::Result<()> {
    if let Some(path) = svg {
        fs::write(path, drawing::svg(track)).with_context(|| path.display().to_string())?;
        return Ok(());
    }
    let grid = &track.grid;
    let free = |cell| cell == Cell::Free;
    if !grid.cells.iter().copied().any(free) {
        bail!("{}: the map has no free cell", track.name);
    }
    say!("{}", drawing::terminal(track, columns).trim_end_matches('\n'));
    Ok(())
}
