//! `pitwall fetch`

use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;

use indicatif::{ProgressBar, ProgressStyle};
use pitwall::{FetchError, FetchOptions, FetchProgress, Fetched};
use protocol::CarName;
use serde_json::json;

use super::{FIND, no_such_car, open};
use crate::cli::NetworkOptions;
use crate::output;

/// Exit code: refused by the car.
const REFUSED: u8 = 3;
/// Exit code: no answer in time.
const NO_ANSWER: u8 = 5;

pub(super) async fn run(
    network: &NetworkOptions,
    car: &CarName,
    folder: Option<PathBuf>,
    rate: f64,
    after: u64,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let service = open(network).await?;
    if !service.wait_for(car, FIND).await {
        return Ok(no_such_car(&service, car).await);
    }
    let options = FetchOptions {
        rate,
        after,
        ..FetchOptions::new(folder.unwrap_or_else(|| PathBuf::from(car.as_str())))
    };
    let bar = progress_bar();
    let files = service.client().files_of(car);
    let outcome = tokio::select! {
        outcome = pitwall::fetch(car, &files, &options, |progress| show(&bar, progress)) => Some(outcome),
        () = super::interrupted() => None,
    };
    bar.finish_and_clear();
    let code = match outcome {
        Some(Ok(fetched)) => {
            if json {
                output::print_json(&json!({"car": car, "folder": options.folder, "files": fetched}))?;
            } else {
                output::print(&describe(car, &options, &fetched));
            }
            ExitCode::SUCCESS
        }
        Some(Err(error)) => {
            output::print_error(&error.to_string());
            match error {
                FetchError::Refused { .. } => ExitCode::from(REFUSED),
                FetchError::NoReply { .. } => ExitCode::from(NO_ANSWER),
                _ => ExitCode::FAILURE,
            }
        }
        None => {
            output::print_error("interrupted; the next fetch goes on here");
            ExitCode::FAILURE
        }
    };
    service.close().await;
    Ok(code)
}

fn progress_bar() -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let style = "{bar:30} {bytes} of {total_bytes}, {bytes_per_sec}, {eta} left, {msg}";
    let bar = ProgressBar::new(0);
    bar.set_style(ProgressStyle::with_template(style).unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar
}

fn show(bar: &ProgressBar, progress: FetchProgress) {
    let [file, files] = progress.files;
    let [here, all] = progress.bytes;
    bar.set_length(all);
    bar.set_position(here);
    bar.set_message(format!("file {} of {files}", (file + 1).min(files)));
}

fn describe(car: &CarName, options: &FetchOptions, fetched: &[Fetched]) -> String {
    if fetched.is_empty() {
        return format!("{car} has no recordings");
    }
    let mut lines: Vec<_> = fetched
        .iter()
        .map(|file| {
            let state = match (file.received, file.finished) {
                (_, false) => ", still being recorded: fetch again for the rest",
                (0, true) => ", already here",
                (_, true) => "",
            };
            let megabytes = file.bytes as f64 / 1e6;
            format!("{}: {megabytes:.1} MB{state}", file.file.display())
        })
        .collect();
    let received: u64 = fetched.iter().map(|file| file.received).sum();
    lines.push(format!(
        "{car}: {} recordings in {}, {:.1} MB received, checksums verified",
        fetched.len(),
        options.folder.display(),
        received as f64 / 1e6
    ));
    lines.join("\n")
}
