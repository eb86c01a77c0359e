//! `pitwall health`: for a container's health check.

use std::net::{SocketAddr, TcpStream};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;

/// How long a healthy program takes to accept a connection.
const PATIENCE: Duration = Duration::from_secs(3);

/// Succeeds when something accepts connections at `address`.
pub(super) fn run(address: SocketAddr) -> anyhow::Result<ExitCode> {
    TcpStream::connect_timeout(&address, PATIENCE)
        .with_context(|| format!("nothing accepts connections at {address}"))?;
    Ok(ExitCode::SUCCESS)
}
