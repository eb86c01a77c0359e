//! The demo: three simulated cars and a pit wall in one process. It needs no car, no Docker and no internet.

mod cars;
mod radio;
mod show;

use std::net::SocketAddr;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use clap::Parser;
use keys::Protection;
use pitwall::{PageOptions, PitWallOptions, PitWallServer, Role};

/// Three simulated cars race; a pit wall watches.
#[derive(Debug, Parser)]
#[command(name = "demo", version)]
struct Options {
    /// Track: club, hall, park or mirror, or a folder with map.yaml and raceline.csv.
    #[arg(long, value_name = "NAME|FOLDER", default_value = "club")]
    track: String,
    /// Number of cars, 1 to 10.
    #[arg(long, value_name = "N", default_value_t = 3, allow_negative_numbers = true, value_parser = clap::value_parser!(u8).range(1..=10))]
    cars: u8,
    /// Parameter set that the cars start with.
    #[arg(long, value_name = "NAME|FILE", default_value = "hq")]
    params: String,
    /// Seed of the race.
    #[arg(long, value_name = "N", default_value_t = 1, allow_negative_numbers = true, value_parser = show::parse_seed)]
    seed: u64,
    /// End after this long, such as 30s or 5m; without it, Ctrl-C ends the demo.
    #[arg(long = "for", value_name = "TIME", allow_hyphen_values = true, value_parser = show::parse_duration)]
    time: Option<Duration>,
    /// Where the pit wall listens for cars.
    #[arg(long, value_name = "ENDPOINT", default_value = pitwall::LOCAL_PITWALL)]
    listen: String,
    /// Where the pit wall's page is served.
    #[arg(long, value_name = "ADDRESS:PORT", default_value_t = PageOptions::default().address)]
    page: SocketAddr,
    /// One JSON line a second with all cars, instead of text.
    #[arg(long)]
    json: bool,
}

fn main() -> ExitCode {
    tracing_subscriber::fmt()
        .with_env_filter(
            tracing_subscriber::EnvFilter::try_from_default_env()
                .unwrap_or_else(|_| "warn,zenoh=off,zenoh_transport=off".into()),
        )
        .with_writer(std::io::stderr)
        .init();
    match run(&Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            show::print_error(&error);
            ExitCode::FAILURE
        }
    }
}

fn run(options: &Options) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()?;
    let pitwall = runtime
        .block_on(PitWallServer::start(PitWallOptions {
            role: Role::Router {
                listen: vec![options.listen.clone()],
                discoverable: false,
            },
            protection: Protection::None,
            page: PageOptions {
                address: options.page,
                ..PageOptions::default()
            },
        }))
        .context(
            "if another pit wall runs here, give --listen tcp/127.0.0.1:PORT and --page 127.0.0.1:PORT",
        )?;
    let relay = runtime.block_on(radio::start(&options.listen))?;
    let nodes = cars::start(options, &relay)?;
    let shown = show::banner(options, pitwall.url())
        .and_then(|()| runtime.block_on(show::run(pitwall.service(), options.time, options.json)));
    cars::shutdown(nodes);
    runtime.block_on(pitwall.stop());
    // A closed pipe is no error: the reader has ended.
    match shown {
        Err(error) if show::is_closed_pipe(&error) => Ok(()),
        shown => shown,
    }
}
