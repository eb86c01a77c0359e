//! `pitwall events`

use std::process::ExitCode;
use std::time::Duration;

use pitwall::LogEntry;
use protocol::{CarName, Severity};

use super::{interrupted, open};
use crate::cli::LinkOptions;
use crate::output;

pub(super) async fn run(
    link: &LinkOptions,
    car: Option<CarName>,
    follow: bool,
    patience: Duration,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let hub = open(link).await?;
    if let Some(car) = &car
        && !super::await_car(&hub, car, patience).await
    {
        return Ok(super::no_such_car(&hub, car).await);
    }
    let write_since = |seen: u64| -> anyhow::Result<u64> {
        let (entries, last) = {
            let fleet = hub.fleet();
            let wanted = |entry: &&LogEntry| car.is_none() || entry.car == car;
            let entries: Vec<_> = fleet.log().since(seen).filter(wanted).cloned().collect();
            (entries, fleet.log().last())
        };
        for entry in entries {
            if json {
                output::say_json(&entry)?;
            } else {
                output::say(&line(&entry));
            }
        }
        Ok(last)
    };
    // What the cars have kept comes in within a second of their being found.
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
    hub.close().await;
    Ok(ExitCode::SUCCESS)
}

/// `12:03:04.250 WARNING  car-1 set: ... [ana]`, in UTC.
pub(super) fn line(entry: &LogEntry) -> String {
    let LogEntry {
        at,
        car,
        severity,
        text,
        who,
        ..
    } = entry;
    let severity = match severity {
        Severity::Info => "",
        Severity::Warning => "WARNING ",
        Severity::Critical => "CRITICAL ",
    };
    let car = car.as_ref().map_or_else(String::new, |car| format!("{car} "));
    let who = who.as_ref().map_or_else(String::new, |who| format!(" [{who}]"));
    format!("{} {severity}{car}{text}{who}", clock(*at))
}

/// Time of day, UTC.
fn clock(unix_ns: i64) -> String {
    let millis = unix_ns.rem_euclid(86_400_000_000_000) / 1_000_000;
    let (seconds, millis) = (millis / 1000, millis % 1000);
    format!(
        "{:02}:{:02}:{:02}.{millis:03}",
        seconds / 3600,
        seconds / 60 % 60,
        seconds % 60
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_says_when_what_and_who() {
        let entry = LogEntry {
            number: 1,
            at: 1_700_000_000_250_000_000,
            car: CarName::new("car-1").ok(),
            severity: Severity::Warning,
            kind: "set",
            text: "set lq".into(),
            who: Some("ana".into()),
        };
        assert_eq!(line(&entry), "22:13:20.250 WARNING car-1 set lq [ana]");
    }
}
