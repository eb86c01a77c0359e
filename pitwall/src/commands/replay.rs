//! `pitwall replay`

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

use keys::Bundle;
use pitwall::{Page, PageOptions, Replay};
use serde_json::json;

use super::interrupted;
use crate::output;

pub(super) async fn run(
    file: &Path,
    options: PageOptions,
    keys: Option<Arc<Bundle>>,
    speed: f64,
    at_s: f64,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let path = file.to_owned();
    // Reading a long recording takes a while.
    let replay = tokio::task::spawn_blocking(move || Replay::start(&path)).await??;
    replay
        .set_playback(None, Some(speed), (at_s != 0.0).then_some(at_s))
        .map_err(|fault| anyhow::anyhow!("{fault}"))?;
    let address = options.address;
    let page = Page::serve_replay_with_keys(replay.clone(), options, keys)
        .await
        .map_err(|error| anyhow::anyhow!("cannot serve the page at {address}: {error}"))?;
    let duration = replay.view().duration_s;
    super::print_unreadable(replay.unreadable());
    if json {
        let unreadable = replay.unreadable();
        output::print_json(&json!({"page": page.url(), "duration_s": duration, "unreadable": unreadable}))?;
    } else {
        output::print(&format!(
            "replay of {}, {duration:.1} s: {}\nCtrl-C stops it",
            file.display(),
            page.url()
        ));
    }
    interrupted().await;
    page.stop().await;
    replay.stop();
    Ok(ExitCode::SUCCESS)
}
