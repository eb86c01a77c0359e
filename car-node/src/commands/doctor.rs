//! `car-node doctor`: checks what a car needs, and says what to do where something is missing.

use std::fs;
use std::net::{TcpStream, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use keys::{Protection, Role};
use maps::OccupancyGrid;
use serde::Serialize;

use crate::cli::Doctor;

/// How long a pit wall may take to accept a connection.
const PATIENCE: Duration = Duration::from_secs(3);
/// Less free space than this is soon used up by a recording \[bytes\].
const DISK: u64 = 1_000_000_000;
/// Memory that a car with a large map takes \[bytes\].
const MEMORY: u64 = 500_000_000;

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

fn check(what: &'static str, outcome: Outcome, text: impl Into<String>, advice: impl Into<String>) -> Check {
    Check {
        what,
        outcome,
        text: text.into(),
        advice: advice.into(),
    }
}

fn good(what: &'static str, text: impl Into<String>) -> Check {
    check(what, Outcome::Good, text, "")
}

pub(crate) fn run(arguments: &Doctor) -> anyhow::Result<ExitCode> {
    let mut checks = vec![clock(), cpu(Path::new("/sys/devices/system/cpu")), memory()];
    checks.extend(arguments.map.as_deref().map(map));
    checks.extend(arguments.state.as_deref().map(state));
    let protection = Protection::read(
        arguments.keys.as_deref(),
        arguments.passphrase_file.as_deref(),
        &[Role::Car],
        Some(&arguments.car),
    );
    match protection {
        Err(error) => checks.push(check(
            "keys",
            Outcome::Bad,
            error.to_string(),
            "see docs/security.md",
        )),
        Ok(protection) => {
            checks.push(keys(&protection));
            checks.extend(
                arguments
                    .connect
                    .iter()
                    .map(|endpoint| wall(endpoint, &protection)),
            );
        }
    }
    let bad = checks.iter().any(|check| check.outcome == Outcome::Bad);
    if arguments.json {
        say!("{}", serde_json::to_string(&checks)?);
    } else {
        for check in &checks {
            let mark = match check.outcome {
                Outcome::Good => "ok",
                Outcome::Warning => "!",
                Outcome::Bad => "BAD",
            };
            say!("{mark:4} {:8} {}", check.what, check.text);
            if !check.advice.is_empty() {
                say!("{:13} {}", "", check.advice);
            }
        }
    }
    Ok(ExitCode::from(u8::from(bad)))
}

fn clock() -> Check {
    // 2025-01-01.
    const EARLIEST: u64 = 1_735_689_600;
    let now = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default()
        .as_secs();
    if now < EARLIEST {
        let text = format!("this clock says {now} s after 1970");
        return check(
            "clock",
            Outcome::Warning,
            text,
            "set it, such as with chrony, or stamps look wrong in recordings",
        );
    }
    good("clock", "set")
}

/// A governor that saves power makes the filter late.
fn cpu(folder: &Path) -> Check {
    let mut slow = Vec::new();
    let mut found = 0;
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let file = entry.path().join("cpufreq/scaling_governor");
        if let Ok(governor) = fs::read_to_string(&file) {
            found += 1;
            if governor.trim() != "performance" && !slow.contains(&governor) {
                slow.push(governor);
            }
        }
    }
    if found == 0 {
        return good("cpu", "this system shows no governor");
    }
    if slow.is_empty() {
        return good("cpu", format!("{found} cores, governor performance"));
    }
    let names: Vec<_> = slow.iter().map(|governor| governor.trim()).collect();
    check(
        "cpu",
        Outcome::Warning,
        format!("governor {}", names.join(", ")),
        "cpupower frequency-set -g performance",
    )
}

fn memory() -> Check {
    let mut system = sysinfo::System::new();
    system.refresh_memory();
    let free = system.available_memory();
    let text = format!("{:.1} GB of memory free", free as f64 / 1e9);
    if free < MEMORY {
        return check(
            "memory",
            Outcome::Warning,
            text,
            "a large map takes 0.5 GB: end other programs",
        );
    }
    good("memory", text)
}

fn map(file: &Path) -> Check {
    let begun = Instant::now();
    match OccupancyGrid::load(file) {
        Err(error) => check(
            "map",
            Outcome::Bad,
            error.to_string(),
            "give a map_server YAML file or a .pbstream with --map",
        ),
        Ok(grid) => good(
            "map",
            format!(
                "{} x {} cells of {} m, read in {:.1} s",
                grid.width,
                grid.height,
                grid.resolution,
                begun.elapsed().as_secs_f64()
            ),
        ),
    }
}

fn state(folder: &Path) -> Check {
    let probe = || -> std::io::Result<()> {
        fs::create_dir_all(folder)?;
        let file = folder.join(format!(".doctor-{}", std::process::id()));
        fs::File::create_new(&file)?;
        fs::remove_file(file)
    };
    if let Err(error) = probe() {
        let text = format!("cannot write into {}: {error}", folder.display());
        return check("disk", Outcome::Bad, text, "give another folder with --state");
    }
    let disks = sysinfo::Disks::new_with_refreshed_list();
    let folder: PathBuf = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    let free = disks
        .iter()
        .filter(|disk| folder.starts_with(disk.mount_point()))
        .max_by_key(|disk| disk.mount_point().as_os_str().len())
        .map(sysinfo::Disk::available_space);
    match free {
        Some(free) if free < DISK => check(
            "disk",
            Outcome::Warning,
            format!("{:.1} GB free in {}", free as f64 / 1e9, folder.display()),
            "recordings on the car need more",
        ),
        Some(free) => good(
            "disk",
            format!("{:.1} GB free in {}", free as f64 / 1e9, folder.display()),
        ),
        None => good("disk", format!("{} can be written", folder.display())),
    }
}

fn keys(protection: &Protection) -> Check {
    let now = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default()
        .as_secs();
    match protection {
        Protection::Keys(keys) => match keys.days_left(now as i64) {
            None => check("keys", Outcome::Bad, "revoked", "copy this car's new file here"),
            Some(days) if days < 0 => check(
                "keys",
                Outcome::Bad,
                "expired",
                "pitwall keys renew, on the laptop",
            ),
            Some(days) if days < 14 => check(
                "keys",
                Outcome::Warning,
                format!("expire in {days} days"),
                "pitwall keys renew, on the laptop",
            ),
            Some(days) => good("keys", format!("car {}, {days} days left", keys.name)),
        },
        Protection::Passphrase(_) => good("keys", "a passphrase; telemetry is not encrypted"),
        Protection::None => check(
            "keys",
            Outcome::Warning,
            "none: others on the network can command this car",
            "pitwall keys new, on the laptop; see docs/security.md",
        ),
    }
}

/// True when something accepts connections at a pit wall's endpoint.
fn wall(endpoint: &str, protection: &Protection) -> Check {
    if let Err(error) = protection.check_endpoint(endpoint) {
        return check("network", Outcome::Bad, error, "");
    }
    let address = endpoint.split_once('/').map_or(endpoint, |(_, address)| address);
    let addresses = match address.to_socket_addrs() {
        Ok(addresses) => addresses,
        Err(error) => {
            let text = format!("{endpoint}: {error}");
            return check(
                "network",
                Outcome::Bad,
                text,
                "give an address in place of the name",
            );
        }
    };
    let mut reason = "no address".to_owned();
    for address in addresses {
        match TcpStream::connect_timeout(&address, PATIENCE) {
            Ok(_) => return good("network", format!("something answers at {endpoint}")),
            Err(error) => reason = error.to_string(),
        }
    }
    check(
        "network",
        Outcome::Bad,
        format!("{endpoint}: {reason}"),
        "does the pit wall run there, in the same network? `pitwall doctor` checks it",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_governor_that_saves_power_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        assert_eq!(cpu(folder.path()).outcome, Outcome::Good);
        for (core, governor) in [("cpu0", "performance\n"), ("cpu1", "powersave\n")] {
            let cpufreq = folder.path().join(core).join("cpufreq");
            fs::create_dir_all(&cpufreq).expect("a folder");
            fs::write(cpufreq.join("scaling_governor"), governor).expect("written");
        }
        let found = cpu(folder.path());
        assert_eq!(found.outcome, Outcome::Warning);
        assert!(
            found.text.contains("powersave") && !found.text.contains("performance"),
            "{}",
            found.text
        );
    }

    #[test]
    fn what_is_not_there_is_bad_and_comes_with_advice() {
        let nowhere = Path::new("/no/such/map.yaml");
        for check in [
            map(nowhere),
            wall("tls/127.0.0.1:1", &Protection::None),
            state(Path::new("/proc/x")),
        ] {
            assert_eq!(check.outcome, Outcome::Bad, "{}", check.text);
        }
        let closed = wall("tcp/127.0.0.1:1", &Protection::None);
        assert!(closed.advice.contains("pitwall doctor"), "{}", closed.text);
    }
}
