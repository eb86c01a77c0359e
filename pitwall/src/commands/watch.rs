//! `pitwall watch`: the cars on the full terminal screen, or as lines or JSON.

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use pitwall::{CarView, FleetService, LogEntry, unix_now};
use protocol::CarName;

use super::{FIND, await_car, no_such_car, open, time_or_interrupt};
use crate::cli::NetworkOptions;
use crate::output;
use crate::terminal::{screen, text};

pub(super) async fn run(
    network: &NetworkOptions,
    car: Option<CarName>,
    time: Option<Duration>,
    rate: Option<f64>,
    patience: Duration,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let screen = !json && output::on_terminal();
    let rate = rate.unwrap_or(if screen { 10.0 } else { 1.0 });
    let period = Duration::from_secs_f64(1.0 / rate);
    let service = open(network).await?;
    if let Some(car) = &car
        && !await_car(&service, car, patience).await
    {
        return Ok(no_such_car(&service, car).await);
    }
    if screen {
        let operator = network.operator();
        tokio::select! {
            outcome = screen::run(service.clone(), car, operator, period) => outcome?,
            () = time_or_interrupt(time) => {}
        }
    } else {
        tokio::select! {
            outcome = lines(&service, car.as_ref(), period, json) => outcome?,
            () = time_or_interrupt(time) => {}
        }
    }
    service.close().await;
    Ok(ExitCode::SUCCESS)
}

/// Prints one car, or all if none is named, periodically.
async fn lines(
    service: &Arc<FleetService>,
    car: Option<&CarName>,
    period: Duration,
    json: bool,
) -> anyhow::Result<()> {
    let mut ticks = tokio::time::interval(period);
    let mut seen = 0;
    // The first output waits for data from a car.
    service
        .wait_until(FIND, |fleet| {
            let mut cars = fleet.cars().filter(|c| car.is_none_or(|car| *car == c.name));
            cars.any(|car| car.health.is_some() && car.pose.is_some())
        })
        .await;
    loop {
        ticks.tick().await;
        let (views, news): (Vec<CarView>, Vec<LogEntry>) = {
            let fleet = service.fleet();
            let news = fleet.log().since(seen);
            let news = news.filter(|e| car.is_none() || e.car.as_ref() == car);
            let news = news.cloned().collect();
            seen = fleet.log().last();
            let views = fleet.cars().filter(|c| car.is_none_or(|car| *car == c.name));
            (views.map(|car| car.view(unix_now())).collect(), news)
        };
        match (car, &views[..]) {
            (Some(_), []) => {}
            (Some(_), [view, ..]) if json => output::print_json(view)?,
            (None, views) if json => output::print_json(&views)?,
            (car, views) => {
                for entry in &news {
                    output::print(&text::log_line(entry));
                }
                output::print(&text::recorders(&service.recorders()));
                output::print(&match (car, views) {
                    (Some(_), [view, ..]) => text::card(view),
                    _ => text::table(views),
                });
            }
        }
    }
}
