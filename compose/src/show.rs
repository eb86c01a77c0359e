//! What the demo prints.
#![allow(clippy::print_stderr, reason = "this is the program's output")]

use std::io::{self, ErrorKind, Write};
use std::time::Duration;

use pitwall::{CarView, FleetService, unix_now};
use protocol::Severity;

use crate::Options;
use crate::{cars, radio};

/// How often the cars are listed.
const LIST: Duration = Duration::from_secs(10);
/// How often news and JSON are written.
const TICK: Duration = Duration::from_secs(1);

/// Writes a line to stdout.
fn say(line: &str) -> io::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "{line}")?;
    out.flush()
}

/// Whether the demo ended because nobody reads what it prints, as after `| head`.
pub(crate) fn is_closed_pipe(error: &anyhow::Error) -> bool {
    error
        .downcast_ref::<io::Error>()
        .is_some_and(|error| error.kind() == ErrorKind::BrokenPipe)
}

/// Says what to look at.
pub(crate) fn banner(options: &Options, url: &str) -> anyhow::Result<()> {
    if options.json {
        return Ok(());
    }
    let last = options.cars;
    let clock = |time: Duration| format!("{}:{:02}", time.as_secs() / 60, time.as_secs() % 60);
    let events = [
        (
            cars::DUST[0],
            "car-1 drives onto dust: slip and the distance to its line grow, the pose stays good".to_owned(),
        ),
        (cars::DUST[1], "car-1 is off the dust again".to_owned()),
        (
            cars::KNOCK,
            format!("car-{last} is knocked round: it turns, and is localized on"),
        ),
        (
            radio::SILENT[0],
            format!("car-{last}'s radio falls silent: BLIND at the wall, then its gaps fill"),
        ),
        (
            radio::SILENT[0] + radio::SILENT[1],
            format!("car-{last}'s radio is back"),
        ),
    ];
    let taped = if options.cars > 1 {
        "car-2 has taped tyres: it slips all the time. "
    } else {
        ""
    };
    let events = events
        .map(|(at, what)| format!("  {}  {what}", clock(at)))
        .join("\n");
    say(&format!(
        "{} cars race on {}; the pit wall listens at {}.

Open the page:  {url}

Or look at it from another terminal:
  pitwall cars                         who is localized, and who is not, and why
  pitwall watch car-1                  one car, live
  pitwall params car-1 select lq       another parameter set, on the running car
  pitwall record -o race.mcap --for 30s
(cargo run --release -p pitwall -- cars, and so on.)

{taped}An opponent drives ahead of car-{last}, and stands in its scans.
What happens, in every round of {}:
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

/// Says why the demo failed.
pub(crate) fn complain(error: &anyhow::Error) {
    eprintln!("demo: {error:#}");
}

/// Shows what happens until the time is over or somebody presses Ctrl-C.
pub(crate) async fn until_the_end(
    service: &FleetService,
    time: Option<Duration>,
    json: bool,
) -> anyhow::Result<()> {
    let over = async {
        match time {
            Some(time) => tokio::time::sleep(time).await,
            None => std::future::pending().await,
        }
    };
    tokio::select! {
        result = show(service, json) => result,
        () = over => Ok(()),
        result = tokio::signal::ctrl_c() => Ok(result?),
    }
}

async fn show(service: &FleetService, json: bool) -> anyhow::Result<()> {
    let mut ticks = tokio::time::interval(TICK);
    let (mut seen, mut list_due) = (0, tokio::time::Instant::now() + LIST);
    loop {
        ticks.tick().await;
        let (cars, news) = {
            let fleet = service.fleet();
            let news: Vec<_> = fleet.log().since(seen).cloned().collect();
            seen = fleet.log().last();
            (fleet.view(unix_now()), news)
        };
        if json {
            say(&serde_json::to_string(&cars)?)?;
            continue;
        }
        for entry in news {
            let mark = match entry.severity {
                Severity::Info => " ",
                Severity::Warning => "!",
                Severity::Critical => "#",
            };
            let car = entry.car.map_or_else(String::new, |car| car.to_string());
            let who = entry.who.map_or_else(String::new, |who| format!(" ({who})"));
            say(&format!("{mark} {car:<8} {}{who}", entry.text))?;
        }
        if tokio::time::Instant::now() >= list_due {
            list_due += LIST;
            say(&list(&cars))?;
        }
    }
}

/// The cars, a line each.
fn list(cars: &[CarView]) -> String {
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

/// `30s`, `5m`, or plain seconds.
pub(crate) fn duration(text: &str) -> Result<Duration, String> {
    let (number, unit) = text.split_at(text.find(|c: char| c.is_alphabetic()).unwrap_or(text.len()));
    let number: f64 = number
        .parse()
        .map_err(|_| format!("{text:?} is no time; say 30s or 5m"))?;
    let scale = match unit {
        "" | "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err(format!("unknown unit {unit:?}; use s, m or h")),
    };
    Duration::try_from_secs_f64(number * scale).map_err(|_| "a time is 0 s or more".to_owned())
}

pub(crate) fn seed(text: &str) -> Result<u64, String> {
    text.parse()
        .map_err(|_| format!("wanted is a whole number from 0 to {}", u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_parse_or_say_what_is_wrong() {
        assert_eq!(duration("30s"), Ok(Duration::from_secs(30)));
        assert_eq!(duration("1.5m"), Ok(Duration::from_secs(90)));
        assert_eq!(duration("2"), Ok(Duration::from_secs(2)));
        for text in ["", "s", "-1s", "1y", "NaN"] {
            assert!(duration(text).is_err(), "{text}");
        }
    }
}
