//! `pitwall record` and `pitwall recover`

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use pitwall::{FleetService, RecordingError, RecordingSummary, Recovered};

use super::{FIND, NO_SUCH_CAR, open, time_or_interrupt};
use crate::cli::{NetworkOptions, Page};
use crate::output;

/// Exit code: something in the file could not be saved, or is missing.
pub(super) const DATA_LOST: u8 = 7;

/// A recording that takes longer than this to end prints why.
const QUIET: Duration = Duration::from_millis(600);

pub(super) async fn record(
    network: &NetworkOptions,
    file: Option<PathBuf>,
    page: &Page,
    time: Option<Duration>,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let service = open(network).await?;
    service.fleet().keep_only_newest();
    let file = if let Some(file) = file {
        file
    } else {
        // The name has the track, which the first car knows.
        let has_map = |fleet: &pitwall::Fleet| fleet.cars().any(|car| car.map.is_some());
        tokio::select! {
            _ = service.wait_until(FIND, has_map) => {}
            () = super::interrupted() => return Ok(ExitCode::from(NO_SUCH_CAR)),
        }
        page.recordings.join(service.session_name())
    };
    let options = page.recorder.options(network.operator());
    service.start_recording_with(&file, options).await?;
    let waiting = service.wait_until(FIND, |fleet| fleet.cars().any(|car| car.alive));
    tokio::select! {
        found = waiting => if !found {
            output::print_note("no car is connected yet; every car that connects is recorded");
        },
        () = super::interrupted() => {}
    }
    output::print_note(&format!(
        "recording all cars into {}; Ctrl-C stops it",
        service.recording_path().unwrap_or_else(|| file.clone()).display()
    ));
    tokio::select! {
        () = time_or_interrupt(time) => {}
        error = service.recording_failed() => {
            service.close().await;
            anyhow::bail!("recording failed: {error}");
        }
    }
    let summary = end(&service).await.context("the recorder has stopped")??;
    service.close().await;
    if json {
        output::print_json(&summary)?;
    } else {
        output::print(&summary.to_string());
    }
    if summary.streams.is_empty() {
        output::print_error(&format!("no car has sent anything: {} is empty", file.display()));
        return Ok(ExitCode::from(NO_SUCH_CAR));
    }
    Ok(ExitCode::SUCCESS)
}

/// Ends the recording after a final sync, or at once at a second interrupt.
async fn end(service: &FleetService) -> Option<Result<RecordingSummary, RecordingError>> {
    let patience = async {
        tokio::time::sleep(QUIET).await;
        output::print_note("waiting for messages that are still missing; Ctrl-C stops at once");
        super::interrupted().await;
    };
    tokio::select! {
        summary = service.stop_recording() => summary,
        () = patience => service.cut_recording().await,
    }
}

pub(super) fn recover(file: &Path, output: Option<PathBuf>, json: bool) -> anyhow::Result<ExitCode> {
    let to = output.unwrap_or_else(|| file.with_extension("recovered.mcap"));
    let recovered = pitwall::recover(file, &to)?;
    if json {
        output::print_json(&recovered)?;
    } else {
        output::print(&describe(&recovered, &to));
    }
    Ok(if recovered.has_losses() {
        ExitCode::from(DATA_LOST)
    } else {
        ExitCode::SUCCESS
    })
}

fn describe(recovered: &Recovered, to: &Path) -> String {
    let Recovered {
        messages,
        attachments,
        metadata,
        duration_s,
        ..
    } = recovered;
    let mut lines = vec![format!(
        "{}: saved {messages} messages over {duration_s:.1} s, {attachments} attachments, {metadata} metadata records",
        to.display()
    )];
    let count = recovered
        .lost
        .map_or_else(String::new, |lost| format!(", {lost} records"));
    let kind = if recovered.has_losses() { "lost" } else { "damaged" };
    lines.extend(recovered.damage.iter().map(|damage| format!("{kind} {damage}")));
    lines.push(match (recovered.has_losses(), recovered.complete) {
        (true, _) => format!("DATA WAS LOST{count}"),
        (false, true) => "nothing was lost".to_owned(),
        (false, false) => "the recording was not completed; everything in the file was saved".to_owned(),
    });
    lines.join("\n")
}
