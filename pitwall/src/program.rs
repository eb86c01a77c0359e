//! The program: what `main` does, in the library so that a test can run it as a process of its own.

use std::process::ExitCode;

use clap::Parser;
use tracing_subscriber::EnvFilter;

use crate::{cli, commands, output};

/// Reads the command line and does what it says, until the end or until interrupted.
pub fn program() -> ExitCode {
    let cli = cli::Cli::parse();
    // zenoh speaks of every closed connection as an error; what concerns the operator we say ourselves.
    // On the full screen, lines in between would be in the way.
    let screen = matches!(cli.verb, Some(cli::Verb::Watch { .. })) && !cli.json && output::on_terminal();
    let usual = if screen {
        "off"
    } else {
        "warn,zenoh=off,zenoh_transport=off"
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(usual));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .without_time()
        .with_target(false)
        .init();
    let outcome = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .map_err(anyhow::Error::from)
        .and_then(|runtime| runtime.block_on(commands::run(cli)));
    outcome.unwrap_or_else(|error| {
        output::complain(&format!("{error:#}"));
        ExitCode::FAILURE
    })
}
