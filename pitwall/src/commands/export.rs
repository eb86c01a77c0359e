//! `pitwall export`: poses, truth, health and laps as CSV, for spreadsheets and notebooks.
//!
//! The rows of each car are in the order of publishing, with what was recovered later in its place. Nothing is kept in memory
//! but messages that stand late in the file.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use pitwall::{EventPayload, Fleet, InOrder, RecordingError, UnreadableCount, read_in_order};
use protocol::{Telemetry, Topic};
use serde_json::json;

use super::BadUsage;
use crate::output;

/// The topics that are exported.
fn wanted(topic: Topic) -> bool {
    matches!(
        topic,
        Topic::Pose
            | Topic::RecordedPose
            | Topic::Health
            | Topic::RecordedHealth
            | Topic::RecordedTruth
            | Topic::Event
    )
}

/// The events of these topics, for a folder that must not exist yet. This reads the whole file, so that a damaged recording
/// leaves no files.
pub(super) fn events_for(file: &Path, folder: &Path, wanted: fn(Topic) -> bool) -> anyhow::Result<InOrder> {
    let events = read_in_order(file, wanted)?;
    if events.is_empty() {
        return Err(RecordingError::Empty(file.display().to_string()).into());
    }
    if folder.exists() {
        let folder = folder.display();
        return Err(BadUsage(format!("{folder} exists already; nothing is overwritten")).into());
    }
    Ok(events)
}

pub(super) fn run(file: &Path, folder: Option<PathBuf>, json: bool) -> anyhow::Result<ExitCode> {
    let folder = folder.unwrap_or_else(|| file.with_extension("csv"));
    let events = events_for(file, &folder, wanted)?;
    fs::create_dir(&folder).with_context(|| folder.display().to_string())?;
    let Written {
        counts: [poses, truths, healths, laps],
        unreadable,
    } = write(events, &folder)?;
    let unreadable = unreadable.list();
    super::print_unreadable(&unreadable);
    if json {
        output::print_json(&json!({
            "folder": folder, "poses": poses, "truths": truths, "healths": healths, "laps": laps,
            "unreadable": unreadable,
        }))?;
    } else {
        output::print(&format!(
            "{}: {poses} poses, {truths} true poses, {healths} health messages, {laps} laps",
            folder.display()
        ));
    }
    Ok(ExitCode::SUCCESS)
}

struct Written {
    /// Poses, true poses, health messages and laps.
    counts: [u64; 4],
    unreadable: UnreadableCount,
}

fn write(events: InOrder, folder: &Path) -> anyhow::Result<Written> {
    let create = |name: &str, head: &str| -> anyhow::Result<BufWriter<File>> {
        let path = folder.join(name);
        let mut out = BufWriter::new(File::create_new(&path).with_context(|| path.display().to_string())?);
        writeln!(out, "{head}")?;
        Ok(out)
    };
    let head =
        "car,sensor_unix_ns,laptop_unix_ns,x_m,y_m,heading_rad,speed_mps,yaw_rate_radps,s_m,d_m,lap,update";
    let mut poses = create("poses.csv", head)?;
    let head = "car,sensor_unix_ns,x_m,y_m,heading_rad";
    let mut truths = create("truth.csv", head)?;
    let head = "car,sensor_unix_ns,state,alignment,residual_m,slip,spread_along_m,spread_across_m,particles";
    let mut healths = create("health.csv", head)?;
    let mut fleet = Fleet::default();
    events.prepare(&mut fleet);
    let mut unreadable = UnreadableCount::default();
    let mut counts = [0_u64; 4];
    for event in events {
        let event = event?;
        fleet.apply(&event);
        unreadable.add(&event);
        let EventPayload::Message {
            header, telemetry, ..
        } = &event.payload
        else {
            continue;
        };
        let (car, sensor) = (&event.car, header.sensor);
        match &**telemetry {
            Telemetry::Pose(p) => {
                let place = p
                    .track
                    .map_or_else(|| ",".to_owned(), |track| format!("{},{}", track.s, track.d));
                let speed = p.twist.linear_x.hypot(p.twist.linear_y);
                writeln!(
                    poses,
                    "{car},{sensor},{},{},{},{},{speed},{},{place},{},{}",
                    event.at, p.pose.x, p.pose.y, p.pose.heading, p.twist.angular, p.lap, p.update
                )?;
                counts[0] += 1;
            }
            Telemetry::Truth(t) => {
                writeln!(
                    truths,
                    "{car},{sensor},{},{},{}",
                    t.pose.x, t.pose.y, t.pose.heading
                )?;
                counts[1] += 1;
            }
            Telemetry::Health(h) => {
                let numbers = h.metrics.map_or_else(
                    || ",,,,,".to_owned(),
                    |m| {
                        format!(
                            "{},{},{},{},{},{}",
                            m.alignment, m.residual, m.slip, m.spread_along, m.spread_across, m.particles
                        )
                    },
                );
                writeln!(healths, "{car},{sensor},{},{numbers}", h.state)?;
                counts[2] += 1;
            }
            _ => {}
        }
    }
    let head = "car,lap,time_s,void,s1_s,s2_s,s3_s,set,slipping,worst_slip,alignment,lateral_m";
    let mut laps = create("laps.csv", head)?;
    counts[3] = write_laps(&mut laps, &fleet)?;
    for mut out in [poses, truths, healths, laps] {
        out.flush().with_context(|| folder.display().to_string())?;
    }
    Ok(Written { counts, unreadable })
}

/// Writes one line per lap; returns the number of laps.
fn write_laps(laps: &mut impl Write, fleet: &Fleet) -> std::io::Result<u64> {
    let mut lap_count = 0;
    for car in fleet.cars() {
        for lap in car.laps() {
            let or_empty = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
            let grip = |of: fn(pitwall::LapGrip) -> f64| or_empty(lap.grip.map(of));
            let [s1, s2, s3] = lap.sectors_s.map(or_empty);
            writeln!(
                laps,
                "{},{},{},{},{s1},{s2},{s3},{},{},{},{},{}",
                car.name,
                lap.lap,
                lap.time_s,
                lap.void.unwrap_or_default(),
                lap.set,
                grip(|g| g.slipping),
                grip(|g| g.worst_slip),
                grip(|g| g.alignment),
                or_empty(lap.lateral_m),
            )?;
            lap_count += 1;
        }
    }
    Ok(lap_count)
}
