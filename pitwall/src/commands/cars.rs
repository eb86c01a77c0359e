//! `pitwall cars`

use std::process::ExitCode;
use std::time::Duration;

use pitwall::unix_now;

use super::open;
use crate::cli::LinkOptions;
use crate::output;

pub(super) async fn run(link: &LinkOptions, wait: Duration, json: bool) -> anyhow::Result<ExitCode> {
    let hub = open(link).await?;
    super::time_or_interrupt(Some(wait)).await;
    let cars = hub.fleet().view(unix_now());
    if json {
        output::say_json(&cars)?;
    } else if cars.is_empty() {
        output::note("no car is on this link");
    } else {
        output::say(&output::table(&cars));
    }
    hub.close().await;
    Ok(ExitCode::SUCCESS)
}
