//! The commands.

mod cars;
mod check;
mod control;
mod doctor;
mod events;
mod export;
mod export_bag;
#[cfg(feature = "rerun")]
mod export_rrd;
mod fetch;
mod health;
#[cfg(unix)]
mod keep;
mod keys;
mod merge;
mod params;
mod record;
mod replay;
mod report;
mod router;
mod serve;
mod sessions;
mod this_machine;
mod watch;

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use ::keys::Protection;
use pitwall::{FleetService, PageOptions, Role, Unreadable};
use protocol::{Action, CarName, RecordAction};

use crate::cli::{Cli, NetworkOptions, Verb};
use crate::output;

/// Time to find a car. Cars try to connect every second.
const FIND: Duration = Duration::from_secs(3);

/// Exit code: no car of that name.
const NO_SUCH_CAR: u8 = 4;

/// The arguments are invalid: the program exits with code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct BadUsage(String);

/// Runs the command.
pub(crate) async fn run(cli: Cli) -> anyhow::Result<ExitCode> {
    let Cli {
        network,
        json,
        page,
        verb,
    } = cli;
    let Some(verb) = verb else {
        return serve::run(&network, page, json).await;
    };
    match verb {
        Verb::Cars { wait } => cars::run(&network, wait, json).await,
        Verb::Watch {
            car,
            time,
            rate,
            wait,
        } => {
            let patience = time.map_or(wait, |time| time.min(wait));
            watch::run(&network, car, time, rate, patience, json).await
        }
        Verb::Params { car, verb } => params::run(&network, &car, verb, json).await,
        Verb::Locate { car, how } => control::locate(&network, &car, &how, json).await,
        Verb::Rates { car, rates } => control::rates(&network, &car, &rates, json).await,
        Verb::Auto { car, on } => control::auto(&network, &car, on, json).await,
        Verb::Events { car, follow, wait } => {
            let patience = if follow { wait } else { FIND };
            events::run(&network, car, follow, patience, json).await
        }
        Verb::Record { output, on_car, time } => match on_car.car {
            Some(car) => {
                let action = match (on_car.stop, on_car.state) {
                    (true, _) => RecordAction::Stop,
                    (false, true) => RecordAction::Get,
                    (false, false) => RecordAction::Start,
                };
                control::send_command(&network, &car, Action::Record(action), None, json).await
            }
            None => record::record(&network, output, &page, time, json).await,
        },
        Verb::Fetch { car, to, rate, after } => fetch::run(&network, &car, to, rate, after, json).await,
        Verb::Merge { inputs, output } => merge::run(&inputs, &output, json),
        Verb::Sessions {
            words,
            folder,
            rebuild,
        } => sessions::run(&folder, &words, rebuild, json),
        Verb::Replay { file, speed, at } => {
            let keys = match network.protection()? {
                Protection::Keys(keys) => Some(keys),
                Protection::None | Protection::Passphrase(_) => None,
            };
            let options = PageOptions {
                address: page.address,
                recordings: page.recordings,
                ..PageOptions::default()
            };
            replay::run(&file, options, keys, speed, at.as_secs_f64(), json).await
        }
        Verb::Report { file, output, with } => report::run(&file, output, &with, json),
        Verb::Check { file } => check::run(&file, json),
        Verb::Export {
            file,
            output,
            bag: true,
            ..
        } => export_bag::run(&file, output, json),
        #[cfg(feature = "rerun")]
        Verb::Export {
            file,
            output,
            rrd: true,
            ..
        } => export_rrd::run(&file, output, json),
        Verb::Export { file, output, .. } => export::run(&file, output, json),
        Verb::Doctor => doctor::run(&network, &page, json).await,
        Verb::Router => router::run(&network, json).await,
        Verb::Health { address } => health::run(address),
        #[cfg(unix)]
        Verb::Keep { socket, project } => keep::run(&socket, &project).await,
        Verb::Keys { folder, verb } => keys::run(folder, &verb, json),
        Verb::Recover { file, output } => record::recover(&file, output, json),
    }
}

async fn open(options: &NetworkOptions) -> anyhow::Result<Arc<FleetService>> {
    let (role, protection) = link(options)?;
    tracing::info!("{role}");
    Ok(FleetService::open_protected(&role, &protection).await?)
}

/// How to connect, and how that is protected. Refuses to listen on a network without protection, unless that is wanted.
fn link(options: &NetworkOptions) -> anyhow::Result<(Role, Protection)> {
    let protection = options.protection()?;
    let role = Role::choose(&options.listen, &options.connect, &protection, options.insecure);
    for endpoint in role.endpoints() {
        protection.check_endpoint(endpoint).map_err(BadUsage)?;
    }
    if let Protection::Keys(keys) = &protection {
        let listens = matches!(role, Role::Router { .. });
        if listens && !matches!(keys.role, ::keys::Role::Pit | ::keys::Role::Router) {
            let text = format!(
                "the keys of {} {} cannot listen for cars: give --connect, or the keys of a pit wall",
                keys.role, keys.name
            );
            return Err(BadUsage(text).into());
        }
        warn_of_expiry(keys);
    }
    if let (Protection::None, false, Some(endpoint)) =
        (&protection, options.insecure, role.reachable_endpoint())
    {
        let text = format!(
            "on {endpoint} everybody on the network could read and command every car: give --keys FILE (`pitwall keys new`), \
             --passphrase-file FILE, or --insecure"
        );
        return Err(BadUsage(text).into());
    }
    Ok((role, protection))
}

/// Says that keys expire soon, or are not in force any more.
fn warn_of_expiry(keys: &::keys::Bundle) {
    let host = format!("{} {}", keys.role, keys.name);
    match keys.days_left(pitwall::unix_now() / 1_000_000_000) {
        None => output::print_error(&format!(
            "the keys of {host} are not in force: they were revoked or renewed"
        )),
        Some(days) if days < 0 => output::print_error(&format!(
            "the keys of {host} have expired; `pitwall keys renew` replaces them"
        )),
        Some(days) if days < 14 => output::print_note(&format!(
            "the keys of {host} expire in {days} days; `pitwall keys renew` replaces them"
        )),
        Some(_) => {}
    }
}

/// Waits for a car, and prints a note when that takes long, because the laptop is often started first. False when the car is
/// not connected within `patience`, or at an interrupt.
async fn await_car(service: &FleetService, car: &CarName, patience: Duration) -> bool {
    let usual = FIND.min(patience);
    if service.wait_for(car, usual).await {
        return true;
    }
    let longer = patience.saturating_sub(usual);
    if longer.is_zero() {
        return false;
    }
    output::print_note(&format!(
        "waiting for {car}, {} s at most; Ctrl-C stops",
        longer.as_secs_f64().ceil()
    ));
    tokio::select! {
        found = service.wait_for(car, longer) => {
            if found {
                output::print_note(&format!("{car} is connected"));
            }
            found
        }
        () = interrupted() => false,
    }
}

/// Prints that a car is not connected.
async fn no_such_car(service: &FleetService, car: &CarName) -> ExitCode {
    let others: Vec<_> = service.fleet().cars().map(|car| car.name.to_string()).collect();
    let others = if others.is_empty() {
        "no car is connected".to_owned()
    } else {
        format!("connected: {}", others.join(", "))
    };
    output::print_error(&format!("no such car: {car}; {others}"));
    service.close().await;
    ExitCode::from(NO_SUCH_CAR)
}

/// Prints which messages of a recording cannot be decoded.
fn print_unreadable(unreadable: &[Unreadable]) {
    for stream in unreadable {
        output::print_error(&stream.to_string());
    }
}

/// Waits for an interrupt.
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

/// Waits for `time` or for an interrupt.
async fn time_or_interrupt(time: Option<Duration>) {
    match time {
        Some(time) => drop(tokio::time::timeout(time, interrupted()).await),
        None => interrupted().await,
    }
}
