//! The verbs.

mod cars;
mod events;
mod export;
mod params;
mod record;
mod replay;
mod report;
mod serve;
mod steer;
mod watch;

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use pitwall::{Hub, PageOptions, Role, Unreadable};
use protocol::CarName;

use crate::cli::{Cli, LinkOptions, Verb};
use crate::output;

/// How long a car may take to be found: those that dial a pit wall that was just opened try again every second.
const FIND: Duration = Duration::from_secs(3);

/// Exit code: no car of that name.
const NO_SUCH_CAR: u8 = 4;

/// What was asked for cannot be: the program ends with exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct BadUsage(String);

/// Does what the command line says.
pub(crate) async fn run(cli: Cli) -> anyhow::Result<ExitCode> {
    let Cli {
        link,
        json,
        page,
        verb,
    } = cli;
    let Some(verb) = verb else {
        return serve::run(&link, page, json).await;
    };
    match verb {
        Verb::Cars { wait } => cars::run(&link, wait, json).await,
        Verb::Watch {
            car,
            time,
            rate,
            wait,
        } => {
            let patience = time.map_or(wait, |time| time.min(wait));
            watch::run(&link, car, time, rate, patience, json).await
        }
        Verb::Params { car, verb } => params::run(&link, &car, verb, json).await,
        Verb::Locate { car, how } => steer::locate(&link, &car, &how, json).await,
        Verb::Rates { car, rates } => steer::rates(&link, &car, &rates, json).await,
        Verb::Auto { car, on } => steer::auto(&link, &car, on, json).await,
        Verb::Events { car, follow, wait } => {
            let patience = if follow { wait } else { FIND };
            events::run(&link, car, follow, patience, json).await
        }
        Verb::Record { output, time } => record::record(&link, &output, time, json).await,
        Verb::Replay { file, speed, at } => {
            let options = PageOptions {
                address: page.address,
                recordings: page.recordings,
            };
            replay::run(&file, options, speed, at.as_secs_f64(), json).await
        }
        Verb::Report { file, output } => report::run(&file, output, json),
        Verb::Export { file, output } => export::run(&file, output, json),
        Verb::Recover { file, output } => record::recover(&file, output, json),
    }
}

async fn open(options: &LinkOptions) -> anyhow::Result<Arc<Hub>> {
    let role = Role::choose(&options.listen, &options.connect);
    tracing::info!("{role}");
    Ok(Hub::open(&role).await?)
}

/// Waits for a car, and says so where that takes longer than usual: the laptop is often started first. False when it is not
/// there within `patience`, or when the program is asked to stop.
async fn await_car(hub: &Hub, car: &CarName, patience: Duration) -> bool {
    let usual = FIND.min(patience);
    if hub.wait_for(car, usual).await {
        return true;
    }
    let longer = patience.saturating_sub(usual);
    if longer.is_zero() {
        return false;
    }
    output::note(&format!(
        "{car} is not there yet: waiting for it, {} s at most; Ctrl-C ends it",
        longer.as_secs_f64().ceil()
    ));
    tokio::select! {
        found = hub.wait_for(car, longer) => {
            if found {
                output::note(&format!("{car} is there"));
            }
            found
        }
        () = interrupted() => false,
    }
}

/// Says that a car is not there.
async fn no_such_car(hub: &Hub, car: &CarName) -> ExitCode {
    let others: Vec<_> = hub.fleet().cars().map(|car| car.name.to_string()).collect();
    let others = if others.is_empty() {
        "no car is on this link".to_owned()
    } else {
        format!("there are {}", others.join(", "))
    };
    output::complain(&format!("no such car: {car}; {others}"));
    hub.close().await;
    ExitCode::from(NO_SUCH_CAR)
}

/// Says what of a recording cannot be read.
fn complain_of(unreadable: &[Unreadable]) {
    for stream in unreadable {
        output::complain(&stream.to_string());
    }
}

/// Ends when the program is asked to stop.
async fn interrupted() {
    use tokio::signal::unix::{SignalKind, signal};
    let Ok(mut terminate) = signal(SignalKind::terminate()) else {
        return std::future::pending().await;
    };
    tokio::select! {
        _ = tokio::signal::ctrl_c() => {}
        _ = terminate.recv() => {}
    }
}

/// Ends after `time`, or when the program is asked to stop.
async fn time_or_interrupt(time: Option<Duration>) {
    match time {
        Some(time) => drop(tokio::time::timeout(time, interrupted()).await),
        None => interrupted().await,
    }
}
