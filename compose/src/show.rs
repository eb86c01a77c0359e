//! What the demo prints.
#![allow(clippy::print_stderr, reason = "this is the program's output")]

use std::io::{self, ErrorKind, Write};
use std::time::Duration;

use pitwall::{CarView, FleetService, unix_now};
use protocol::Severity;

use crate::Options;
use crate::{cars, radio};

/// Period of the table of cars.
const TABLE_PERIOD: Duration = Duration::from_secs(10);
/// Period of log entries and of JSON lines.
const TICK: Duration = Duration::from_secs(1);

/// Writes a line to stdout and flushes it.
fn print_line(line: &str) -> io::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "{line}")?;
    out.flush()
}

/// True if stdout was closed by its reader, as by `| head`.
pub(crate) fn is_closed_pipe(error: &anyhow::Error) -> bool {
    error
        .downcast_ref::<io::Error>()
        .is_some_and(|error| error.kind() == ErrorKind::BrokenPipe)
}

/// Prints where the page is, commands to try, and the schedule of incidents.
pub(crate) fn banner(options: &Options, url: &str) -> anyhow::Result<()> {
    if options.json {
        return Ok(());
    }
    let last = options.cars;
    let clock = |time: Duration| format!("{}:{:02}", time.as_secs() / 60, time.as_secs() % 60);
    let events = [
        (
            cars::DUST[0],
            "car-1 drives onto dust: slip and lateral error grow, the pose stays good".to_owned(),
        ),
        (cars::DUST[1], "car-1 is off the dust again".to_owned()),
        (
            cars::KNOCK,
            format!("car-{last} is knocked into a spin; it turns round and stays localized"),
        ),
        (
            radio::OUTAGE[0],
            format!("car-{last}'s radio link is cut: the pit wall shows BLIND"),
        ),
        (
            radio::OUTAGE[1],
            format!("car-{last}'s radio link is back: the gaps in its telemetry are filled"),
        ),
    ];
    let taped = if options.cars > 1 {
        "car-2 has taped tyres and slips all the time. "
    } else {
        ""
    };
    let events = events
        .map(|(at, what)| format!("  {}  {what}", clock(at)))
        .join("\n");
    print_line(&format!(
        "{} cars race on {}; the pit wall listens at {}.

Open the page:  {url}

Or look at it from another terminal:
  pitwall cars                         state of each car, with causes
  pitwall watch car-1                  live view of one car
  pitwall params car-1 select lq       switch the parameter set of a running car
  pitwall record -o race.mcap --for 30s
(cargo run --release -p pitwall -- cars, and so on.)

{taped}An opponent drives ahead of car-{last} and blocks part of its scans.
Incidents (minutes:seconds), repeated every {}:
{events}
Ctrl-C ends the demo.
",
        options.cars,
        options.track,
        options.listen,
        clock(cars::ROUND),
    ))?;
    Ok(())
}

/// Writes an error to stderr.
pub(crate) fn print_error(error: &anyhow::Error) {
    eprintln!("demo: {error:#}");
}

/// Prints log entries and tables until `time` is over or Ctrl-C.
pub(crate) async fn run(service: &FleetService, time: Option<Duration>, json: bool) -> anyhow::Result<()> {
    let timeout = async {
        match time {
            Some(time) => tokio::time::sleep(time).await,
            None => std::future::pending().await,
        }
    };
    tokio::select! {
        result = print_updates(service, json) => result,
        () = timeout => Ok(()),
        result = tokio::signal::ctrl_c() => Ok(result?),
    }
}

async fn print_updates(service: &FleetService, json: bool) -> anyhow::Result<()> {
    let mut ticks = tokio::time::interval(TICK);
    let (mut last_entry, mut table_due) = (0, tokio::time::Instant::now() + TABLE_PERIOD);
    loop {
        ticks.tick().await;
        let (cars, entries) = {
            let fleet = service.fleet();
            let entries: Vec<_> = fleet.log().since(last_entry).cloned().collect();
            last_entry = fleet.log().last();
            (fleet.view(unix_now()), entries)
        };
        if json {
            print_line(&serde_json::to_string(&cars)?)?;
            continue;
        }
        for entry in entries {
            let mark = match entry.severity {
                Severity::Info => " ",
                Severity::Warning => "!",
                Severity::Critical => "#",
            };
            let car = entry.car.map_or_else(String::new, |car| car.to_string());
            let who = entry.who.map_or_else(String::new, |who| format!(" ({who})"));
            print_line(&format!("{mark} {car:<8} {}{who}", entry.text))?;
        }
        if tokio::time::Instant::now() >= table_due {
            table_due += TABLE_PERIOD;
            print_line(&table(&cars))?;
        }
    }
}

/// A table with a line for each car.
fn table(cars: &[CarView]) -> String {
    let mut text = format!(
        "\n  {:<8} {:<13} {:<9} {:>5} {:>8} {:>8} {:>7} {:>7}",
        "car", "state", "set", "lap", "last s", "speed", "align", "age ms"
    );
    for car in cars {
        let or_dash = |value: Option<f64>, digits: usize| {
            value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
        };
        let pose = car.pose.as_ref();
        let metrics = car.health.as_ref().and_then(|health| health.metrics);
        let line = format!(
            "\n  {:<8} {:<13} {:<9} {:>5} {:>8} {:>8} {:>7} {:>7}",
            car.car,
            car.state,
            car.set.as_ref().map_or("-", |set| set.name.as_str()),
            pose.map_or(0, |pose| pose.lap),
            or_dash(car.last_lap_s, 2),
            or_dash(pose.map(|pose| pose.speed_mps), 1),
            or_dash(metrics.map(|metrics| f64::from(metrics.alignment)), 2),
            or_dash(pose.map(|pose| pose.age_s * 1e3), 0),
        );
        text.push_str(&line);
    }
    text + "\n"
}

/// Parses `30s`, `5m`, `2h`, or a number of seconds.
pub(crate) fn parse_duration(text: &str) -> Result<Duration, String> {
    let (number, unit) = text.split_at(text.find(|c: char| c.is_alphabetic()).unwrap_or(text.len()));
    let number: f64 = number
        .parse()
        .map_err(|_| format!("{text:?} is not a duration; use 30s or 5m"))?;
    let scale = match unit {
        "" | "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err(format!("unknown unit {unit:?}; use s, m or h")),
    };
    Duration::try_from_secs_f64(number * scale).map_err(|_| "a duration is 0 s or more".to_owned())
}

/// Parses a seed.
pub(crate) fn parse_seed(text: &str) -> Result<u64, String> {
    text.parse()
        .map_err(|_| format!("the seed must be a whole number from 0 to {}", u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_parse_or_are_refused() {
        assert_eq!(parse_duration("30s"), Ok(Duration::from_secs(30)));
        assert_eq!(parse_duration("1.5m"), Ok(Duration::from_secs(90)));
        assert_eq!(parse_duration("2"), Ok(Duration::from_secs(2)));
        for text in ["", "s", "-1s", "1y", "NaN"] {
            assert!(parse_duration(text).is_err(), "{text}");
        }
    }
}
