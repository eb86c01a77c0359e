//! `pitwall export --rrd`: a file for the Rerun viewer.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use pitwall::{RecordingError, RerunOutlet, RerunView, read_in_order};
use protocol::Topic;
use serde_json::json;

use super::BadUsage;
use crate::output;

/// Events that wait to be written.
const QUEUE: usize = 1000;

/// The viewer shows the scans as end points.
fn wanted(topic: Topic) -> bool {
    !matches!(topic, Topic::RecordedScan | Topic::RecordedOdometry)
}

pub(super) fn run(file: &Path, to: Option<PathBuf>, json: bool) -> anyhow::Result<ExitCode> {
    let to = to.unwrap_or_else(|| file.with_extension("rrd"));
    let events = read_in_order(file, wanted)?;
    if events.is_empty() {
        return Err(RecordingError::Empty(file.display().to_string()).into());
    }
    if to.exists() {
        let to = to.display();
        return Err(BadUsage(format!("{to} exists already; nothing is overwritten")).into());
    }
    let (sender, receiver) = crossbeam_channel::bounded(QUEUE);
    let view = RerunView::start(receiver, &RerunOutlet::Save(to.clone()))?;
    let mut count = 0_u64;
    for event in events {
        if sender.send(Arc::new(event?)).is_err() {
            anyhow::bail!("{}: cannot be written", to.display());
        }
        count += 1;
    }
    drop(sender);
    view.finish();
    if json {
        output::print_json(&json!({"file": to, "events": count}))?;
    } else {
        output::print(&format!("{}: {count} events", to.display()));
    }
    Ok(ExitCode::SUCCESS)
}
