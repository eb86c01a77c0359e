//! `pitwall doctor`: checks what a pit wall needs, and says what to do where something is missing.

use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use ::keys::Protection;
use pitwall::{FleetService, Role, unix_now};
use serde::Serialize;

use super::link;
use crate::cli::{NetworkOptions, Page};
use crate::output;

/// Time to find cars.
const LISTEN: Duration = Duration::from_secs(3);
/// Clocks that differ by more than this make ages hard to believe \[s\].
const CLOCKS: f64 = 5.0;
/// Less free space than this is soon used up by a recording \[bytes\].
const DISK: u64 = 2_000_000_000;
/// Fewer open files than this may run out.
const FILES: u64 = 4096;

/// How a check ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum Outcome {
    Good,
    Warning,
    Bad,
}

/// One check.
#[derive(Debug, Serialize)]
struct Check {
    what: &'static str,
    outcome: Outcome,
    text: String,
    /// What to do about it; empty when it is good.
    advice: String,
}

fn good(what: &'static str, text: impl Into<String>) -> Check {
    Check {
        what,
        outcome: Outcome::Good,
        text: text.into(),
        advice: String::new(),
    }
}

fn poor(what: &'static str, outcome: Outcome, text: impl Into<String>, advice: impl Into<String>) -> Check {
    Check {
        what,
        outcome,
        text: text.into(),
        advice: advice.into(),
    }
}

pub(super) async fn run(network: &NetworkOptions, page: &Page, json: bool) -> anyhow::Result<ExitCode> {
    let mut checks = vec![clock(), files(), disk(&page.recordings)];
    checks.push(page_port(page.address));
    match link(network) {
        Err(error) => checks.push(poor(
            "keys",
            Outcome::Bad,
            format!("{error:#}"),
            "see docs/security.md",
        )),
        Ok((role, protection)) => {
            checks.push(keys(&role, &protection));
            checks.extend(cars(&role, &protection).await);
        }
    }
    let bad = checks.iter().any(|check| check.outcome == Outcome::Bad);
    if json {
        output::print_json(&checks)?;
    } else {
        for check in &checks {
            let mark = match check.outcome {
                Outcome::Good => "ok",
                Outcome::Warning => "!",
                Outcome::Bad => "BAD",
            };
            output::print(&format!("{mark:4} {:8} {}", check.what, check.text));
            if !check.advice.is_empty() {
                output::print(&format!("{:13} {}", "", check.advice));
            }
        }
    }
    Ok(if bad { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

/// Certificates are checked with this clock.
fn clock() -> Check {
    // 2025-01-01.
    const EARLIEST: i64 = 1_735_689_600;
    let now = unix_now() / 1_000_000_000;
    if now < EARLIEST {
        let text = format!("this clock says {now} s after 1970");
        return poor(
            "clock",
            Outcome::Bad,
            text,
            "set it: certificates and recordings depend on it",
        );
    }
    good("clock", "set")
}

fn files() -> Check {
    match rlimit::getrlimit(rlimit::Resource::NOFILE) {
        Ok((soft, _)) if soft < FILES => poor(
            "files",
            Outcome::Warning,
            format!("at most {soft} open files"),
            "raise the limit: ulimit -n 8192, or LimitNOFILE= in a systemd unit",
        ),
        Ok((soft, _)) => good("files", format!("at most {soft} open files")),
        Err(error) => poor(
            "files",
            Outcome::Warning,
            error.to_string(),
            "the limit cannot be read",
        ),
    }
}

fn disk(folder: &Path) -> Check {
    let place = folder.display();
    if let Err(error) = tempfile_in(folder) {
        let text = format!("cannot write into {place}: {error}");
        return poor(
            "disk",
            Outcome::Bad,
            text,
            "give another folder with --recordings",
        );
    }
    match pitwall::disk_free(folder) {
        Some(free) if free < DISK => poor(
            "disk",
            Outcome::Warning,
            format!("{:.1} GB free in {place}", free as f64 / 1e9),
            "an hour with three cars takes about 1.5 GB",
        ),
        Some(free) => good("disk", format!("{:.1} GB free in {place}", free as f64 / 1e9)),
        None => poor(
            "disk",
            Outcome::Warning,
            format!("free space of {place} is not known"),
            "",
        ),
    }
}

/// Makes a file and removes it.
fn tempfile_in(folder: &Path) -> std::io::Result<()> {
    let file = folder.join(format!(".pitwall-doctor-{}", std::process::id()));
    std::fs::File::create_new(&file)?;
    std::fs::remove_file(file)
}

fn page_port(address: SocketAddr) -> Check {
    match TcpListener::bind(address) {
        Ok(_) => good("page", format!("{address} is free")),
        Err(error) if error.kind() == std::io::ErrorKind::AddrInUse => poor(
            "page",
            Outcome::Warning,
            format!("{address} is taken"),
            "a pit wall runs already, or give another address with --page",
        ),
        Err(error) => poor(
            "page",
            Outcome::Bad,
            format!("{address}: {error}"),
            "give an address of this machine with --page",
        ),
    }
}

fn keys(role: &Role, protection: &Protection) -> Check {
    match protection {
        Protection::Keys(keys) => {
            let host = format!("{} {}", keys.role, keys.name);
            match keys.days_left(unix_now() / 1_000_000_000) {
                None => poor(
                    "keys",
                    Outcome::Bad,
                    format!("those of {host} are revoked"),
                    "copy its new file here",
                ),
                Some(days) if days < 0 => poor(
                    "keys",
                    Outcome::Bad,
                    format!("those of {host} have expired"),
                    "pitwall keys renew",
                ),
                Some(days) if days < 14 => poor(
                    "keys",
                    Outcome::Warning,
                    format!("those of {host} expire in {days} days"),
                    "pitwall keys renew",
                ),
                Some(days) => good("keys", format!("{host}, {days} days left")),
            }
        }
        Protection::Passphrase(_) => good("keys", "a passphrase; telemetry is not encrypted"),
        Protection::None if role.reachable_endpoint().is_some() => poor(
            "keys",
            Outcome::Warning,
            "none, and the network reaches this pit wall",
            "pitwall keys new, see docs/security.md",
        ),
        Protection::None => good("keys", "none; cars on this machine only"),
    }
}

/// What the cars say of themselves.
async fn cars(role: &Role, protection: &Protection) -> Vec<Check> {
    let service = match FleetService::open_protected(role, protection).await {
        Ok(service) => service,
        Err(error) => {
            let advice = "is the port taken, or the address wrong?";
            return vec![poor("network", Outcome::Bad, error.to_string(), advice)];
        }
    };
    tokio::time::sleep(LISTEN).await;
    let cars = service.fleet().view(unix_now());
    service.close().await;
    let mut checks = vec![good("network", role.to_string())];
    if cars.is_empty() {
        checks.push(poor(
            "cars",
            Outcome::Warning,
            format!("none within {} s", LISTEN.as_secs()),
            "start one: car-node run ... --connect; `car-node doctor` checks a car",
        ));
    }
    for car in cars {
        let name = &car.car;
        let version = car.info.as_ref().map(|info| info.version.as_str());
        if let Some(version) = version.filter(|version| *version != env!("CARGO_PKG_VERSION")) {
            let text = format!(
                "{name} runs version {version}, this is {}",
                env!("CARGO_PKG_VERSION")
            );
            checks.push(poor("version", Outcome::Warning, text, "update the older one"));
        }
        if let Some(offset) = car.clock_offset_s.filter(|offset| offset.abs() > CLOCKS) {
            let text = format!("{name}'s clock differs by {offset:.1} s");
            checks.push(poor(
                "clock",
                Outcome::Warning,
                text,
                "set the car's clock, such as with chrony",
            ));
        }
        checks.push(good("cars", format!("{name}: {}", car.state)));
    }
    checks
}
