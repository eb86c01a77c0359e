//! `pitwall`: the page.

use std::process::ExitCode;

use keys::Protection;
use pitwall::{PageOptions, PitWallOptions, PitWallServer, Role};
use serde_json::json;

use super::{interrupted, link};
use crate::cli::{NetworkOptions, Page};
use crate::output;

pub(super) async fn run(network: &NetworkOptions, page: Page, json: bool) -> anyhow::Result<ExitCode> {
    let (role, protection) = link(network)?;
    let how = role.to_string();
    let options = PageOptions {
        address: page.address,
        recordings: page.recordings.clone(),
        recorder: page.recorder.options(network.operator()),
    };
    let unprotected = matches!(protection, Protection::None);
    let listens = matches!(role, Role::Router { .. });
    let server = PitWallServer::start(PitWallOptions {
        role,
        protection,
        page: options,
    })
    .await?;
    #[cfg(feature = "rerun")]
    let views = rerun_views(&server, &page)?;
    if json {
        output::print_json(
            &json!({"page": server.url(), "link": how, "warning": server.service().warning()}),
        )?;
    } else {
        output::print(&format!("pit wall: {}\n{how}; Ctrl-C stops it", server.url()));
    }
    if let Some(warning) = server.service().warning() {
        output::print_error(&format!("warning: {warning}"));
    } else if unprotected && listens && !json {
        output::print_note(
            "without keys, cars on this machine only; `pitwall keys new` makes keys for others, see docs/security.md",
        );
    }
    interrupted().await;
    #[cfg(feature = "rerun")]
    views.into_iter().for_each(pitwall::RerunView::finish);
    server.stop().await;
    Ok(ExitCode::SUCCESS)
}

/// The Rerun outputs of the command line.
#[cfg(feature = "rerun")]
fn rerun_views(server: &PitWallServer, page: &Page) -> anyhow::Result<Vec<pitwall::RerunView>> {
    use pitwall::{RerunOutlet, RerunView};
    let save = page.rerun_save.clone().map(RerunOutlet::Save);
    let connect = page.rerun_connect.clone().map(RerunOutlet::Connect);
    let start = |outlet| RerunView::start(server.service().subscribe(), &outlet);
    Ok(save
        .into_iter()
        .chain(connect)
        .map(start)
        .collect::<Result<_, _>>()?)
}
