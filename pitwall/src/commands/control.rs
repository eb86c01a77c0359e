//! `pitwall locate`, `pitwall rates` and `pitwall auto`, and the output of any command's outcome.

use std::process::ExitCode;

use pitwall::{FleetService, Verdict};
use protocol::{Action, CarName, Outcome, Rates, RatesAction, RelocalizeAction, Reply};

use super::{FIND, no_such_car, open};
use crate::cli::{NetworkOptions, Place, RateOptions};
use crate::output;

pub(super) async fn locate(
    network: &NetworkOptions,
    car: &CarName,
    how: &Place,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let action = match (how.pose, how.pick) {
        (Some(pose), _) => Action::Pose(pose),
        (None, Some(candidate)) => Action::Relocalize(RelocalizeAction::Pick { candidate }),
        (None, None) => Action::Relocalize(RelocalizeAction::Search),
    };
    send_command(network, car, action, None, json).await
}

pub(super) async fn auto(
    network: &NetworkOptions,
    car: &CarName,
    on: bool,
    json: bool,
) -> anyhow::Result<ExitCode> {
    send_command(network, car, Action::Auto(on), None, json).await
}

pub(super) async fn rates(
    network: &NetworkOptions,
    car: &CarName,
    wanted: &RateOptions,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let service = open(network).await?;
    if !service.wait_for(car, FIND).await {
        return Ok(no_such_car(&service, car).await);
    }
    let verdict = service
        .client()
        .command(car, &network.operator(), None, Action::Rates(RatesAction::Get))
        .await?;
    let now = reply(&verdict).and_then(|reply| match reply {
        Reply::Rates(rates) => Some(*rates),
        _ => None,
    });
    let RateOptions {
        pose,
        cloud,
        scan,
        health,
        recorded,
    } = wanted;
    let change =
        pose.is_some() || cloud.is_some() || scan.is_some() || health.is_some() || recorded.is_some();
    let verdict = match now {
        Some(now) if change => {
            let rates = Rates {
                pose: pose.unwrap_or(now.pose),
                cloud: cloud.unwrap_or(now.cloud),
                scan: scan.unwrap_or(now.scan),
                health: health.unwrap_or(now.health),
                recorded: recorded.unwrap_or(now.recorded),
            };
            let action = Action::Rates(RatesAction::Set(rates));
            service
                .client()
                .command(car, &network.operator(), None, action)
                .await?
        }
        _ => verdict,
    };
    report(&service, car, &verdict, json).await
}

/// Sends a command and reports its outcome.
pub(super) async fn send_command(
    network: &NetworkOptions,
    car: &CarName,
    action: Action,
    expect: Option<u64>,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let service = open(network).await?;
    if !service.wait_for(car, FIND).await {
        return Ok(no_such_car(&service, car).await);
    }
    let verdict = service
        .client()
        .command(car, &network.operator(), expect, action)
        .await?;
    report(&service, car, &verdict, json).await
}

/// Prints the outcome of a command; returns its exit code.
pub(super) async fn report(
    service: &FleetService,
    car: &CarName,
    verdict: &Verdict,
    json: bool,
) -> anyhow::Result<ExitCode> {
    if json {
        output::print_json(verdict)?;
    } else {
        match reply(verdict) {
            Some(Reply::Candidates(candidates)) => {
                for c in candidates {
                    let heading = c.pose.heading.to_degrees();
                    output::print(&format!(
                        "candidate {}: ({:.2}, {:.2}) m, {heading:.1} deg, fits the scans to {:.0} %",
                        c.number,
                        c.pose.x,
                        c.pose.y,
                        c.score * 100.0
                    ));
                }
            }
            Some(Reply::Rates(rates)) => {
                output::print(&rates.to_string());
            }
            Some(Reply::Recorder(state)) => {
                output::print(&format!("{car}: {state}"));
            }
            _ => {}
        }
        let text = verdict.text(car);
        if verdict.exit_code() == 0 {
            output::print(&text);
        } else {
            output::print_error(&text);
        }
    }
    service.close().await;
    Ok(ExitCode::from(verdict.exit_code()))
}

/// The reply of a command that was executed.
pub(super) fn reply(verdict: &Verdict) -> Option<&Reply> {
    match verdict {
        Verdict::Answered { answer, .. } => match &answer.outcome {
            Outcome::Done { reply, .. } => Some(reply),
            _ => None,
        },
        _ => None,
    }
}
