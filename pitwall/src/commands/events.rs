//! `pitwall events`

use std::process::ExitCode;
use std::time::Duration;

use pitwall::LogEntry;
use protocol::CarName;

use super::{interrupted, open};
use crate::cli::NetworkOptions;
use crate::output;
use crate::terminal::text;

pub(super) async fn run(
    network: &NetworkOptions,
    car: Option<CarName>,
    follow: bool,
    patience: Duration,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let service = open(network).await?;
    if let Some(car) = &car
        && !super::await_car(&service, car, patience).await
    {
        return Ok(super::no_such_car(&service, car).await);
    }
    let write_since = |seen: u64| -> anyhow::Result<u64> {
        let (entries, last) = {
            let fleet = service.fleet();
            let wanted = |entry: &&LogEntry| car.is_none() || entry.car == car;
            let entries: Vec<_> = fleet.log().since(seen).filter(wanted).cloned().collect();
            (entries, fleet.log().last())
        };
        for entry in entries {
            if json {
                output::print_json(&entry)?;
            } else {
                output::print(&text::log_line(&entry));
            }
        }
        Ok(last)
    };
    // Past events arrive within a second after a car is found.
    super::time_or_interrupt(Some(Duration::from_secs(2))).await;
    let mut seen = write_since(0)?;
    if follow {
        let mut ticks = tokio::time::interval(Duration::from_millis(100));
        let mut stop = std::pin::pin!(interrupted());
        loop {
            tokio::select! {
                _ = ticks.tick() => seen = write_since(seen)?,
                () = &mut stop => break,
            }
        }
    }
    service.close().await;
    Ok(ExitCode::SUCCESS)
}
