//! `pitwall cars`

use std::process::ExitCode;
use std::time::Duration;

use pitwall::unix_now;

use super::open;
use crate::cli::NetworkOptions;
use crate::output;
use crate::terminal::text;

pub(super) async fn run(network: &NetworkOptions, wait: Duration, json: bool) -> anyhow::Result<ExitCode> {
    let service = open(network).await?;
    super::time_or_interrupt(Some(wait)).await;
    let cars = service.fleet().view(unix_now());
    if json {
        output::print_json(&cars)?;
    } else if cars.is_empty() {
        output::print_note("no car is on this link");
    } else {
        output::print(&text::table(&cars));
    }
    service.close().await;
    Ok(ExitCode::SUCCESS)
}
