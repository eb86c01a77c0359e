//! The on-car node's command line.

mod cli;
mod commands;

use std::process::ExitCode;

use clap::Parser;
use cli::{Cli, Command};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

fn main() -> ExitCode {
    // zenoh warns of what is meant to be so; what concerns the driver we say ourselves.
    let filter = EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| "warn,zenoh=off,zenoh_transport=off,zenoh_link_tls=off".into());
    // At debug level zenoh prints its configuration, and with it the password.
    let filter = match "zenoh::api::session=off".parse() {
        Ok(quiet) => filter.add_directive(quiet),
        Err(_) => filter,
    };
    tracing_subscriber::registry()
        .with(
            tracing_subscriber::fmt::layer()
                .with_writer(std::io::stderr)
                .with_filter(filter),
        )
        .with(keys::refusals::watch())
        .init();
    let result = match Cli::parse().command {
        Command::Run(arguments) => commands::run::run(&arguments).map(|()| ExitCode::SUCCESS),
        Command::Evaluate(arguments) => commands::evaluate::run(&arguments).map(|()| ExitCode::SUCCESS),
        Command::Ablate(arguments) => commands::ablate::run(&arguments).map(|()| ExitCode::SUCCESS),
        Command::Stress(arguments) => commands::stress::run(&arguments).map(|()| ExitCode::SUCCESS),
        Command::Race(arguments) => commands::race::run(&arguments),
        Command::Figure(arguments) => commands::figure::run(&arguments).map(|()| ExitCode::SUCCESS),
        Command::GripTest(arguments) => commands::grip_test::run(arguments).map(|()| ExitCode::SUCCESS),
        Command::Import(arguments) => commands::import::run(&arguments).map(|()| ExitCode::SUCCESS),
        Command::Doctor(arguments) => commands::doctor::run(&arguments),
        Command::Health { state } => commands::health::run(&state).map(|()| ExitCode::SUCCESS),
        Command::Track(arguments) => commands::track::run(&arguments.command).map(|()| ExitCode::SUCCESS),
    };
    match result {
        Ok(code) => code,
        Err(error) => {
            tracing::debug!(?error);
            commands::complain(&error);
            ExitCode::from(if error.is::<commands::BadUsage>() { 2 } else { 1 })
        }
    }
}
