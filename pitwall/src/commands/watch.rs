//! `pitwall watch`

use std::process::ExitCode;
use std::time::Duration;

use pitwall::{Hub, unix_now};
use protocol::CarName;

use super::{FIND, no_such_car, open, time_or_interrupt};
use crate::cli::LinkOptions;
use crate::output;

pub(super) async fn run(
    link: &LinkOptions,
    car: &CarName,
    time: Option<Duration>,
    rate: Option<f64>,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let hub = open(link).await?;
    if !hub.wait_for(car, FIND).await {
        return Ok(no_such_car(&hub, car).await);
    }
    let screen = !json && output::on_terminal();
    let rate = rate.unwrap_or(if screen { 5.0 } else { 1.0 });
    let period = Duration::try_from_secs_f64(1.0 / rate)
        .ok()
        .filter(|period| !period.is_zero())
        .ok_or_else(|| anyhow::anyhow!("--rate {rate}: not a rate"))?;
    tokio::select! {
        outcome = show(&hub, car, period, screen, json) => outcome?,
        () = time_or_interrupt(time) => {}
    }
    hub.close().await;
    Ok(ExitCode::SUCCESS)
}

async fn show(hub: &Hub, car: &CarName, period: Duration, screen: bool, json: bool) -> anyhow::Result<()> {
    let mut ticks = tokio::time::interval(period);
    let mut seen = 0;
    // The first view waits for the car to have said something.
    hub.wait_until(FIND, |fleet| {
        fleet
            .car(car)
            .is_some_and(|car| car.health.is_some() && car.pose.is_some())
    })
    .await;
    loop {
        ticks.tick().await;
        let (view, news) = {
            let fleet = hub.fleet();
            let news: Vec<_> = fleet
                .log()
                .since(seen)
                .filter(|e| e.car.as_ref() == Some(car))
                .cloned()
                .collect();
            seen = fleet.log().last();
            (fleet.car(car).map(|car| car.view(unix_now())), news)
        };
        let Some(view) = view else {
            continue;
        };
        if json {
            output::say_json(&view)?;
        } else if screen {
            let fleet = hub.fleet();
            let log: Vec<_> = fleet
                .log()
                .since(0)
                .filter(|e| e.car.as_ref() == Some(car))
                .collect();
            let last = log
                .iter()
                .rev()
                .take(8)
                .rev()
                .map(|entry| super::events::line(entry));
            let text = [output::card(&view), String::new()]
                .into_iter()
                .chain(last)
                .collect::<Vec<_>>();
            output::redraw(&text.join("\n"));
        } else {
            for entry in &news {
                output::say(&super::events::line(entry));
            }
            output::say(&output::card(&view));
        }
    }
}
