//! The program. It is in the library so that a test can run it as a separate process.

use std::io::ErrorKind;
use std::process::ExitCode;

use clap::Parser;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

use crate::{RecordingError, StartRecordingError, cli, commands, output};

/// Reads the command line and runs the command, until it ends or is interrupted.
pub fn program() -> ExitCode {
    let cli = cli::Cli::parse();
    // zenoh logs every closed connection as an error. We report what concerns the operator.
    // On the full screen, log lines would spoil the view.
    let screen = matches!(cli.verb, Some(cli::Verb::Watch { .. })) && !cli.json && output::on_terminal();
    let usual = if screen {
        "off"
    } else {
        "warn,zenoh=off,zenoh_transport=off,zenoh_link_tls=off"
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(usual));
    // At debug level zenoh prints its configuration, and with it the password.
    let filter = match "zenoh::api::session=off".parse() {
        Ok(quiet) if !screen => filter.add_directive(quiet),
        _ => filter,
    };
    let to_stderr = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .without_time()
        .with_target(false)
        .with_filter(filter);
    tracing_subscriber::registry()
        .with(to_stderr)
        .with(keys::refusals::watch())
        .init();
    raise_file_limit();
    let outcome = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .map_err(anyhow::Error::from)
        .and_then(|runtime| runtime.block_on(commands::run(cli)));
    outcome.unwrap_or_else(|error| {
        output::print_error(&format!("{error:#}"));
        if bad_usage(&error) {
            ExitCode::from(BAD_USAGE)
        } else {
            ExitCode::FAILURE
        }
    })
}

/// Takes as many file handles as the system allows. The usual 1024 are few when somebody opens sockets to do harm.
fn raise_file_limit() {
    if let Err(error) = rlimit::increase_nofile_limit(FILES) {
        tracing::debug!(%error, "the limit of open files stays");
    }
}

/// Most open files.
const FILES: u64 = 16_384;

/// Exit code: the command line is invalid.
const BAD_USAGE: u8 = 2;

/// True when a named file is missing, exists already, or is of another kind.
fn bad_usage(error: &anyhow::Error) -> bool {
    let by_system = |kind: ErrorKind| {
        use ErrorKind::{AlreadyExists, IsADirectory, NotADirectory, NotFound, PermissionDenied};
        matches!(
            kind,
            AlreadyExists | IsADirectory | NotADirectory | NotFound | PermissionDenied
        )
    };
    let recording = |error: &RecordingError| match error {
        RecordingError::Exists(_) | RecordingError::Foreign(_) | RecordingError::Empty(_) => true,
        RecordingError::Io { reason, .. } => by_system(reason.kind()),
        RecordingError::Mcap { .. } | RecordingError::Broken { .. } | RecordingError::Nothing { .. } => false,
    };
    error.chain().any(|cause| {
        cause.is::<commands::BadUsage>()
            || cause
                .downcast_ref()
                .is_some_and(|error: &std::io::Error| by_system(error.kind()))
            || cause.downcast_ref().is_some_and(recording)
            || matches!(cause.downcast_ref(), Some(StartRecordingError::File(error)) if recording(error))
    })
}
