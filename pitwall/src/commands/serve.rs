//! `pitwall`: the page.

use std::process::ExitCode;

use keys::Protection;
use pitwall::{PageOptions, PitWallOptions, PitWallServer, Role};
use serde_json::json;

use super::{interrupted, link, this_machine};
use crate::cli::{NetworkOptions, Page};
use crate::{output, qr_code};

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
    if page.qr && !json {
        print_qr_code(server.url(), page.address.ip().is_unspecified())?;
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

/// Prints the page's address for a phone. A page that listens on every address is printed at the one on the network.
fn print_qr_code(url: &str, everywhere: bool) -> anyhow::Result<()> {
    let network = this_machine::addresses().into_iter().find(|ip| !ip.is_loopback());
    let url = match network {
        Some(ip) if everywhere => {
            url.replacen("127.0.0.1", &ip.to_string(), 1)
                .replacen("[::1]", &ip.to_string(), 1)
        }
        _ => url.to_owned(),
    };
    output::print(&qr_code::draw(&url)?);
    let address = url.split('?').next().unwrap_or_default();
    if url.contains("token=") {
        output::print_note(&format!(
            "The code opens {address} and holds the token: whoever photographs it can open the page and command. Show it to the team alone."
        ));
    } else {
        output::print_note(&format!(
            "The code opens {address}. Other machines reach it only when --page names an address on the network."
        ));
    }
    Ok(())
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
