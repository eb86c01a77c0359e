//! `pitwall router`: only passes messages on between cars, pit walls and viewers, by the rules of their keys.

use std::process::ExitCode;
use std::time::Duration;

use pitwall::open_router;
use serde_json::json;

use super::{interrupted, link};
use crate::cli::NetworkOptions;
use crate::output;

pub(super) async fn run(network: &NetworkOptions, json: bool) -> anyhow::Result<ExitCode> {
    let (role, protection) = link(network)?;
    let how = role.to_string();
    let router = open_router(&role, &protection).await?;
    if json {
        output::print_json(&json!({"link": how, "protection": protection.as_str()}))?;
    } else {
        output::print(&format!("router: {how}; Ctrl-C stops it"));
    }
    if !protection.protects() && role.reachable_endpoint().is_some() {
        output::print_error(
            "warning: unprotected: whoever reaches this router can read and command every car",
        );
    }
    let mut ticks = tokio::time::interval(Duration::from_secs(1));
    let end = interrupted();
    tokio::pin!(end);
    loop {
        tokio::select! {
            () = &mut end => break,
            _ = ticks.tick() => {
                for refusal in router.refusals().await {
                    tracing::warn!("{refusal}");
                }
            }
        }
    }
    router.close().await;
    Ok(ExitCode::SUCCESS)
}
