//! The command line.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand};
use keys::{Protection, Role};
use pitwall::{RecorderOptions, Replay};
use protocol::{CarName, Pose2, Rates};

use crate::network::endpoint;

/// Shows how well every car is localized, and why. Without a command, serves the page.
#[derive(Debug, Parser)]
#[command(version, after_help = EXIT_CODES)]
pub(crate) struct Cli {
    #[command(flatten)]
    pub(crate) network: NetworkOptions,
    /// Write JSON on stdout instead of text.
    #[arg(long, global = true, help_heading = GLOBAL)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) page: Page,
    #[command(subcommand)]
    pub(crate) verb: Option<Verb>,
}

#[derive(Debug, Args)]
pub(crate) struct Page {
    /// Address of the page. If it is not a loopback address, the page requires the token that is printed. With --keys it is then
    /// served over HTTPS.
    #[arg(
        long = "page",
        global = true, help_heading = GLOBAL,
        value_name = "ADDRESS:PORT",
        default_value = "127.0.0.1:7448"
    )]
    pub(crate) address: SocketAddr,
    /// Also print the page's address as a QR code, for a phone. It holds the token, if there is one.
    #[arg(long)]
    pub(crate) qr: bool,
    /// Folder for the recordings that are started from the page.
    #[arg(long, value_name = "FOLDER", default_value = ".")]
    pub(crate) recordings: PathBuf,
    #[command(flatten)]
    pub(crate) recorder: RecorderArguments,
    /// Also write the data for the Rerun viewer into this file.
    #[cfg(feature = "rerun")]
    #[arg(long, value_name = "FILE.rrd")]
    pub(crate) rerun_save: Option<PathBuf>,
    /// Also send the data to a running Rerun viewer.
    #[cfg(feature = "rerun")]
    #[arg(long, value_name = "URL", num_args = 0..=1, default_missing_value = "rerun+http://127.0.0.1:9876/proxy")]
    pub(crate) rerun_connect: Option<String>,
}

/// How to record.
#[derive(Debug, Args)]
pub(crate) struct RecorderArguments {
    /// Begin another file when one has this size, such as 500MB or 2GB.
    #[arg(long, global = true, help_heading = RECORDING, value_name = "SIZE", value_parser = size)]
    pub(crate) split_size: Option<u64>,
    /// Begin another file after this time, such as 10m.
    #[arg(long, global = true, help_heading = RECORDING, value_name = "TIME", allow_hyphen_values = true, value_parser = split_time)]
    pub(crate) split_time: Option<Duration>,
    /// Folder to go on in when the file cannot be written any more: the disk is full, or is gone.
    #[arg(long, global = true, help_heading = RECORDING, value_name = "FOLDER")]
    pub(crate) spare: Option<PathBuf>,
}

impl RecorderArguments {
    /// The options for a recording of this operator.
    pub(crate) fn options(&self, operator: String) -> RecorderOptions {
        RecorderOptions {
            split_bytes: self.split_size,
            split_after: self.split_time,
            spare: self.spare.clone(),
            operator,
        }
    }
}

const RECORDING: &str = "Recording";

/// Heading of the options that every command accepts.
const GLOBAL: &str = "Global options";

const EXIT_CODES: &str = "Without --listen and --connect, the program joins the pit wall that runs on this laptop. If none \
runs, it listens for the cars itself: with --keys on tls/0.0.0.0:7447, with --passphrase-file on tcp/0.0.0.0:7447, and without \
either on this machine only.

Exit codes: 0 done, 1 failed, 2 bad usage, 3 refused by the car, 4 no such car, 5 no answer in time, 6 revision conflict, \
7 data is lost or missing, 8 nothing is missing but what a car itself has lost (check).";

#[derive(Debug, Args)]
pub(crate) struct NetworkOptions {
    /// Listen for cars on tcp/ADDRESS:PORT. May be given several times.
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "ENDPOINT", value_parser = endpoint)]
    pub(crate) listen: Vec<String>,
    /// Connect to a running pit wall or router.
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "ENDPOINT", conflicts_with = "listen", value_parser = endpoint)]
    pub(crate) connect: Vec<String>,
    /// Keys of this pit wall or viewer, made by `pitwall keys new` [default: `$SYNPF_KEYS`]
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "FILE")]
    keys: Option<PathBuf>,
    /// File with the passphrase that pit wall and cars share, where there are no keys [default: `$SYNPF_PASSPHRASE_FILE`]
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "FILE", conflicts_with = "keys")]
    passphrase_file: Option<PathBuf>,
    /// Listen on the network without keys and without a passphrase: everybody there can read and command every car.
    #[arg(long, global = true, help_heading = GLOBAL)]
    pub(crate) insecure: bool,
    /// Your name, as shown to the others at the pit wall [default: $USER]
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "NAME")]
    operator: Option<String>,
}

impl NetworkOptions {
    /// How the network is protected.
    pub(crate) fn protection(&self) -> Result<Protection, keys::KeyError> {
        let variable = |name| {
            std::env::var_os(name)
                .filter(|value| !value.is_empty())
                .map(PathBuf::from)
        };
        let (keys, passphrase) = match (&self.keys, &self.passphrase_file) {
            (None, None) => {
                let keys = variable("SYNPF_KEYS");
                let passphrase = variable("SYNPF_PASSPHRASE_FILE").filter(|_| keys.is_none());
                (keys, passphrase)
            }
            (keys, passphrase) => (keys.clone(), passphrase.clone()),
        };
        Protection::read(
            keys.as_deref(),
            passphrase.as_deref(),
            &[Role::Pit, Role::Viewer, Role::Router],
            None,
        )
    }

    /// The operator's name, which every command carries.
    pub(crate) fn operator(&self) -> String {
        let user = || std::env::var("USER").ok().filter(|user| !user.is_empty());
        self.operator
            .clone()
            .or_else(user)
            .unwrap_or_else(|| "pitwall".to_owned())
    }
}

#[derive(Debug, Subcommand)]
pub(crate) enum Verb {
    /// List the cars: state and cause, set in force, rates, ages, losses.
    Cars {
        /// Time to listen before the list is printed.
        #[arg(long, value_name = "TIME", default_value = "2s", allow_hyphen_values = true, value_parser = duration)]
        wait: Duration,
    },
    /// Show the cars in the terminal and switch their sets. Prints lines if stdout is not a terminal.
    Watch {
        /// The car to select first. Without a terminal, the only car to print.
        car: Option<CarName>,
        /// Stop after this time.
        #[arg(long = "for", value_name = "TIME", allow_hyphen_values = true, value_parser = duration)]
        time: Option<Duration>,
        /// Updates per second, 0.01 to 100 [default: 10 on a terminal, else 1]
        #[arg(long, value_name = "HZ", allow_negative_numbers = true, value_parser = views)]
        rate: Option<f64>,
        /// Maximum time to wait for the car.
        #[arg(long, value_name = "TIME", default_value = "10m", allow_hyphen_values = true, value_parser = duration)]
        wait: Duration,
    },
    /// Show or change a car's parameter sets.
    Params {
        /// The car.
        car: CarName,
        #[command(subcommand)]
        verb: Option<ParamsVerb>,
    },
    /// Set a car's pose, or start a global search.
    Locate {
        /// The car.
        car: CarName,
        #[command(flatten)]
        how: Place,
    },
    /// Show or set the rates at which a car publishes.
    Rates {
        /// The car.
        car: CarName,
        #[command(flatten)]
        rates: RateOptions,
    },
    /// Switch automatic selection of the parameter set on or off.
    Auto {
        /// The car.
        car: CarName,
        /// On or off.
        #[arg(value_name = "ON|OFF", value_parser = on_off, action = clap::ArgAction::Set)]
        on: bool,
    },
    /// List the events.
    Events {
        /// Only this car.
        car: Option<CarName>,
        /// Keep printing new events until interrupted.
        #[arg(long, short)]
        follow: bool,
        /// With --follow: maximum time to wait for the car.
        #[arg(long, value_name = "TIME", default_value = "10m", allow_hyphen_values = true, value_parser = duration)]
        wait: Duration,
    },
    /// Record all cars into an MCAP file until interrupted, or have a car record on its own disk.
    Record {
        /// The new file. Existing files are never overwritten [default: the time and the track, in the folder --recordings].
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
        #[command(flatten)]
        on_car: OnCar,
        /// Stop after this time.
        #[arg(long = "for", value_name = "TIME", allow_hyphen_values = true, value_parser = duration)]
        time: Option<Duration>,
    },
    /// Copy a car's own recordings to this laptop. Goes on where the last fetch ended.
    Fetch {
        /// The car.
        car: CarName,
        /// Folder for the copies [default: a folder with the car's name]
        #[arg(long, value_name = "FOLDER")]
        to: Option<PathBuf>,
        /// Most bytes per second, such as 500k or 4M.
        #[arg(long, value_name = "BYTES", default_value = "2M", allow_negative_numbers = true, value_parser = byte_rate)]
        rate: f64,
        /// Only recordings with a higher number.
        #[arg(long, value_name = "NUMBER", default_value_t = 0)]
        after: u64,
    },
    /// Merge recordings of a session, from laptops and from cars, into one file without doubles. The exit code is 7 if
    /// something is missing in it.
    Merge {
        /// The recordings, or folders of them.
        #[arg(required = true, value_name = "FILE|FOLDER")]
        inputs: Vec<PathBuf>,
        /// The new file. Existing files are never overwritten.
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
    },
    /// List the recordings of a folder: date, track, cars, laps, best lap, sets, and what is missing.
    Sessions {
        /// Only those in which each of these words occurs: a date, a track, a car, a set, a marker.
        words: Vec<String>,
        /// The folder.
        #[arg(long, value_name = "FOLDER", default_value = ".")]
        folder: PathBuf,
        /// Read every recording anew.
        #[arg(long)]
        rebuild: bool,
    },
    /// Serve the page from a recording.
    Replay {
        /// The recording.
        file: PathBuf,
        /// Speed as a multiple of real time, 0.1 to 50.
        #[arg(long, value_name = "FACTOR", default_value = "1", allow_negative_numbers = true, value_parser = speed)]
        speed: f64,
        /// Time in the recording to start at, such as 90s or 5m.
        #[arg(long, value_name = "TIME", default_value = "0s", allow_hyphen_values = true, value_parser = duration)]
        at: Duration,
    },
    /// Report laps, sectors, alignment, load and true error of a recording, with figures in one HTML file.
    Report {
        /// The recording.
        file: PathBuf,
        /// The HTML file [default: FILE.html]
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
        /// Another recording, whose laps are laid over these; may be given several times.
        #[arg(long, value_name = "FILE")]
        with: Vec<PathBuf>,
    },
    /// List what each car published, what is here and what is missing, from when to when. The exit code is 0 only if nothing
    /// is, and 8 if nothing is but what a car itself has lost when its power was cut.
    Check {
        /// The recording.
        file: PathBuf,
    },
    /// Write a recording's poses, truth, health and laps as CSV files, or all of it for ROS 2 or Rerun.
    Export {
        /// The recording.
        file: PathBuf,
        /// Write a ROS 2 bag for each car: scans, odometry, poses, truth, tf.
        #[arg(long)]
        bag: bool,
        /// Write a file for the Rerun viewer.
        #[cfg(feature = "rerun")]
        #[arg(long, conflicts_with = "bag")]
        rrd: bool,
        /// The new folder or file [default: FILE.csv, FILE.bags or FILE.rrd]
        #[arg(short, long, value_name = "PATH")]
        output: Option<PathBuf>,
    },
    /// Make, list, renew and revoke the keys of cars, pit walls and viewers.
    Keys {
        /// Folder of the keys [default: synpf/keys in the user's configuration folder]
        #[arg(long, global = true, value_name = "FOLDER")]
        folder: Option<PathBuf>,
        #[command(subcommand)]
        verb: KeysVerb,
    },
    /// Check clock, files, disk, ports, keys and cars, and say what to do. The exit code is 1 if something is bad.
    Doctor,
    /// Only pass messages on between cars, pit walls and viewers.
    Router,
    /// Exit with 0 if something accepts connections at an address: a container's health check.
    Health {
        /// The address.
        #[arg(value_name = "ADDRESS:PORT")]
        address: SocketAddr,
    },
    /// Start containers of a Compose project again after `docker kill`.
    #[cfg(unix)]
    Keep {
        /// Socket of the Docker daemon.
        #[arg(long, value_name = "SOCKET", default_value = "/var/run/docker.sock")]
        socket: PathBuf,
        /// Name of the Compose project.
        #[arg(long, value_name = "NAME")]
        project: String,
    },
    /// Save what is intact in a damaged recording. The exit code is 7 if something is lost.
    Recover {
        /// The damaged file. It is not changed.
        file: PathBuf,
        /// The new file [default: FILE.recovered.mcap]
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
}

#[derive(Debug, Subcommand)]
pub(crate) enum KeysVerb {
    /// Make keys. The first call also makes the authority; without names it makes keys for pit, car-1, car-2, car-3 and viewer.
    New {
        #[command(flatten)]
        owners: Owners,
        /// Name or address of the pit wall's machine, for the page. May be repeated [default: those of this machine]
        #[arg(long = "host", value_name = "NAME|ADDRESS")]
        hosts: Vec<String>,
        /// Leave keys alone that exist already.
        #[arg(long)]
        missing: bool,
        /// Also write the keys of NAME into this folder, such as one that a container sees.
        #[arg(long = "copy", value_name = "NAME=FOLDER", value_parser = copy_to)]
        copies: Vec<(CarName, PathBuf)>,
        /// With --token: also print the page at this address, with the token, as a QR code for the operator's phone.
        #[arg(long, value_name = "ADDRESS:PORT", requires = "tokens")]
        qr: Option<String>,
        /// Days until the keys expire, 1 to 3650.
        #[arg(long, value_name = "DAYS", default_value_t = 365, allow_negative_numbers = true, value_parser = clap::value_parser!(u32).range(1..=3650))]
        days: u32,
    },
    /// Put keys out of force, such as those of a car that was stolen.
    Revoke {
        #[command(flatten)]
        owners: Owners,
    },
    /// Replace keys by new ones.
    Renew {
        #[command(flatten)]
        owners: Owners,
    },
    /// List all keys and when they expire.
    List,
}

/// Whose keys. Each may be repeated.
#[derive(Debug, Clone, Args)]
pub(crate) struct Owners {
    /// A car: publishes under its own name only.
    #[arg(long, value_name = "NAME")]
    pub(crate) car: Vec<CarName>,
    /// A pit wall: listens for cars and commands.
    #[arg(long, value_name = "NAME")]
    pub(crate) pit: Vec<CarName>,
    /// A router: passes messages on and cannot command.
    #[arg(long, value_name = "NAME")]
    pub(crate) router: Vec<CarName>,
    /// A viewer: reads only.
    #[arg(long, value_name = "NAME")]
    pub(crate) viewer: Vec<CarName>,
    /// An operator who logs in to the page with a token of their own.
    #[arg(long = "token", value_name = "OPERATOR")]
    pub(crate) tokens: Vec<CarName>,
}

impl Owners {
    /// True when nobody is named.
    pub(crate) fn is_empty(&self) -> bool {
        self.hosts().next().is_none() && self.tokens.is_empty()
    }

    /// The owners of certificates.
    pub(crate) fn hosts(&self) -> impl Iterator<Item = (Role, CarName)> {
        let with = |role, names: &[CarName]| {
            let names = names.to_vec();
            names.into_iter().map(move |name| (role, name))
        };
        with(Role::Pit, &self.pit)
            .chain(with(Role::Car, &self.car))
            .chain(with(Role::Viewer, &self.viewer))
            .chain(with(Role::Router, &self.router))
    }
}

#[derive(Debug, Subcommand)]
pub(crate) enum ParamsVerb {
    /// Show the set in force with all its values.
    Get,
    /// List all sets on the car.
    List,
    /// Compare two sets of the car.
    Diff {
        /// One set.
        a: String,
        /// The other.
        b: String,
    },
    /// Put a set of the car in force.
    Select {
        /// Its name.
        name: String,
        #[command(flatten)]
        change: Change,
    },
    /// Store a set from a YAML or JSON file on the car, and put it in force.
    Put {
        /// File with one `parameter: value` per line. Other parameters keep their values.
        file: PathBuf,
        /// Name of the set [default: the file's name]
        #[arg(long)]
        name: Option<String>,
        #[command(flatten)]
        change: Change,
    },
    /// Keep the set in force, so that the car does not fall back.
    Confirm {
        #[command(flatten)]
        change: Expect,
    },
    /// Return to the set that was in force before.
    Revert {
        #[command(flatten)]
        change: Expect,
    },
    /// Run a second set on the same scans and compare the two.
    Shadow {
        /// Name of the set, or `off`. Without a name, shows the comparison.
        name: Option<String>,
    },
    /// Delete a set that was put on the car.
    Delete {
        /// Its name.
        name: String,
        #[command(flatten)]
        change: Expect,
    },
}

#[derive(Debug, Args)]
pub(crate) struct OnCar {
    /// Have this car record on its own disk. It goes on until it is stopped, over restarts, too.
    #[arg(id = "on_car", long = "on-car", value_name = "CAR", conflicts_with_all = ["output", "time"])]
    pub(crate) car: Option<CarName>,
    /// With --on-car: end the recording.
    #[arg(long, requires = "on_car")]
    pub(crate) stop: bool,
    /// With --on-car: only show the state.
    #[arg(long, requires = "on_car", conflicts_with = "stop")]
    pub(crate) state: bool,
}

#[derive(Debug, Args)]
pub(crate) struct Change {
    /// Fall back after this time unless the change is confirmed.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true, value_parser = duration)]
    pub(crate) revert_after: Option<Duration>,
    #[command(flatten)]
    pub(crate) expect: Expect,
}

#[derive(Debug, Args)]
pub(crate) struct Expect {
    /// Refuse the change unless the set in force has this revision.
    #[arg(long, value_name = "REVISION", allow_negative_numbers = true, value_parser = revision)]
    pub(crate) expect: Option<u64>,
}

#[derive(Debug, Args)]
#[group(required = true)]
pub(crate) struct Place {
    /// The pose in the map: x and y in m, heading in rad.
    #[arg(long, value_name = "X,Y,HEADING", value_parser = pose, allow_hyphen_values = true, conflicts_with_all = ["global", "pick"])]
    pub(crate) pose: Option<Pose2>,
    /// Search the whole map and list the candidates.
    #[arg(long)]
    pub(crate) global: bool,
    /// Use this candidate of the last search.
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = candidate, conflicts_with = "global")]
    pub(crate) pick: Option<u32>,
}

#[derive(Debug, Args)]
pub(crate) struct RateOptions {
    /// Poses per second.
    #[arg(long, value_name = "HZ", value_parser = rate, allow_negative_numbers = true)]
    pub(crate) pose: Option<f32>,
    /// Particle clouds per second.
    #[arg(long, value_name = "HZ", value_parser = rate, allow_negative_numbers = true)]
    pub(crate) cloud: Option<f32>,
    /// Scan views per second.
    #[arg(long, value_name = "HZ", value_parser = rate, allow_negative_numbers = true)]
    pub(crate) scan: Option<f32>,
    /// Health messages per second.
    #[arg(long, value_name = "HZ", value_parser = rate, allow_negative_numbers = true)]
    pub(crate) health: Option<f32>,
    /// Publish the full-rate streams for recordings: on or off.
    #[arg(long, value_name = "ON|OFF", value_parser = on_off, action = clap::ArgAction::Set)]
    pub(crate) recorded: Option<bool>,
}

/// `NAME=FOLDER`.
fn copy_to(text: &str) -> Result<(CarName, PathBuf), String> {
    let (name, folder) = text
        .split_once('=')
        .ok_or("use NAME=FOLDER, such as car-1=/mnt/car-1")?;
    let name = CarName::new(name).map_err(|error| error.to_string())?;
    Ok((name, folder.into()))
}

/// `30s`, `5m`, `1.5h`, `200ms`, or a bare number of seconds.
fn duration(text: &str) -> Result<Duration, String> {
    let split = text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let number: f64 = number
        .trim()
        .parse()
        .map_err(|_| format!("{text:?} is not a time; use 30s or 5m"))?;
    let scale = match unit {
        "ms" => 1e-3,
        "" | "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err(format!("unknown unit {unit:?}; use ms, s, m or h")),
    };
    Duration::try_from_secs_f64(number * scale).map_err(|_| "a time must be 0 s or more".to_owned())
}

/// Bytes per second: `500k`, `4M`, or a number.
fn byte_rate(text: &str) -> Result<f64, String> {
    let units = [("k", 1e3), ("M", 1e6)];
    let found = units
        .iter()
        .find_map(|(unit, scale)| Some((text.strip_suffix(unit)?, *scale)));
    let (number, scale) = found.unwrap_or((text, 1.0));
    let number: Option<f64> = number.parse().ok();
    number
        .map(|number| number * scale)
        .filter(|rate| (1e3..=1e9).contains(rate))
        .ok_or_else(|| format!("{text:?} is not a rate from 1k to 1000M bytes per second"))
}

/// `500MB`, `2GB`, or a number of bytes.
fn size(text: &str) -> Result<u64, String> {
    let split = text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let scale = match unit.to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "kb" => 1e3,
        "mb" => 1e6,
        "gb" => 1e9,
        _ => return Err(format!("unknown unit {unit:?}; use MB or GB")),
    };
    let bytes = number.trim().parse::<f64>().ok().map(|number| number * scale);
    let bytes = bytes.filter(|bytes| (1e6..=1e15).contains(bytes));
    bytes
        .map(|bytes| bytes as u64)
        .ok_or_else(|| format!("{text:?} is not a size of 1 MB or more, such as 500MB or 2GB"))
}

/// A time after which a file is split.
fn split_time(text: &str) -> Result<Duration, String> {
    let time = duration(text)?;
    if time < Duration::from_secs(1) {
        return Err("the time must be 1 s or more".to_owned());
    }
    Ok(time)
}

/// Updates per second.
fn views(text: &str) -> Result<f64, String> {
    let views = text.parse().ok().filter(|rate| (0.01..=100.0).contains(rate));
    views.ok_or_else(|| "the rate must be a number from 0.01 to 100".to_owned())
}

fn candidate(text: &str) -> Result<u32, String> {
    let number = text.parse().ok().filter(|number| *number > 0);
    number.ok_or_else(|| "candidates are numbered 1, 2, 3 and so on".to_owned())
}

fn revision(text: &str) -> Result<u64, String> {
    text.parse()
        .map_err(|_| "a revision is a whole number; `pitwall params CAR` shows it".to_owned())
}

fn speed(text: &str) -> Result<f64, String> {
    let speed: f64 = text.parse().map_err(|_| format!("{text:?} is not a number"))?;
    let allowed = Replay::SPEEDS;
    if allowed.contains(&speed) {
        Ok(speed)
    } else {
        Err(format!(
            "the speed must be {} to {}",
            allowed.start(),
            allowed.end()
        ))
    }
}

fn on_off(text: &str) -> Result<bool, String> {
    match text {
        "on" => Ok(true),
        "off" => Ok(false),
        _ => Err("use on or off".to_owned()),
    }
}

fn rate(text: &str) -> Result<f32, String> {
    let rate: f32 = text.parse().map_err(|_| format!("{text:?} is not a number"))?;
    if (0.0..=Rates::MAX).contains(&rate) {
        Ok(rate)
    } else {
        Err(format!("a rate must be 0 to {} Hz", Rates::MAX))
    }
}

fn pose(text: &str) -> Result<Pose2, String> {
    let numbers: Vec<f64> = text
        .split(',')
        .map(|part| {
            part.trim()
                .parse()
                .map_err(|_| format!("{part:?} is not a number"))
        })
        .collect::<Result<_, _>>()?;
    match numbers[..] {
        [x, y, heading] if numbers.iter().all(|n| n.is_finite()) => Ok(Pose2 { x, y, heading }),
        [_, _, _] => Err("all three must be finite".to_owned()),
        _ => Err("use X,Y,HEADING, such as 1.5,-0.2,3.14".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn owners_of_keys_are_read() {
        let call =
            "pitwall keys new --car car-1 --car car-2 --pit pit --token ana --copy pit=/mnt --operator ben";
        let cli = Cli::try_parse_from(call.split(' ')).expect("valid");
        let Some(Verb::Keys {
            verb: KeysVerb::New { owners, copies, .. },
            ..
        }) = cli.verb
        else {
            panic!("another command");
        };
        assert_eq!(owners.hosts().count(), 3);
        assert_eq!((owners.tokens[0].as_str(), copies.len()), ("ana", 1));
        assert_eq!(cli.network.operator(), "ben");
    }

    #[test]
    fn times_are_read_as_people_write_them() {
        assert_eq!(duration("30s"), Ok(Duration::from_secs(30)));
        assert_eq!(duration("1.5m"), Ok(Duration::from_secs(90)));
        assert_eq!(duration("200ms"), Ok(Duration::from_millis(200)));
        assert_eq!(duration("2"), Ok(Duration::from_secs(2)));
        for text in ["", "s", "-1s", "1y", "NaN"] {
            assert!(duration(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_negative_number_is_refused_by_its_option() {
        for (call, option) in [
            ("record -o a.mcap --for -1s", "--for"),
            ("watch --for -1s", "--for"),
            ("watch --rate -1", "--rate"),
            ("watch car-1 --wait -1s", "--wait"),
            ("events --wait -1s", "--wait"),
            ("cars --wait -1s", "--wait"),
            ("replay a.mcap --speed -1", "--speed"),
            ("replay a.mcap --at -1s", "--at"),
            ("locate car-1 --pick -1", "--pick"),
            ("params car-1 select hq --expect -1", "--expect"),
            ("params car-1 select hq --revert-after -1s", "--revert-after"),
            ("rates car-1 --pose -1", "--pose"),
        ] {
            let error = Cli::try_parse_from(["pitwall"].into_iter().chain(call.split(' ')));
            let text = error.expect_err(call).to_string();
            assert!(text.contains(&format!("for '{option} ")), "{call}: {text}");
        }
    }

    #[test]
    fn sizes_are_read_as_people_write_them() {
        assert_eq!(
            [size("500MB"), size("2gb"), size("1000000")],
            [Ok(500_000_000), Ok(2_000_000_000), Ok(1_000_000)]
        );
        for text in ["", "MB", "-1GB", "1TB", "NaN", "10", "infGB"] {
            assert!(size(text).is_err(), "{text}");
        }
    }

    #[test]
    fn an_endpoint_is_a_way_to_somewhere() {
        assert_eq!(endpoint("tcp/10.0.0.2:7447").as_deref(), Ok("tcp/10.0.0.2:7447"));
        for text in ["", "10.0.0.2:7447", "nonsense"] {
            assert!(endpoint(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_replay_goes_no_faster_than_it_can() {
        assert_eq!(speed("0.5"), Ok(0.5));
        for text in ["0", "51", "NaN", "-1", "fast"] {
            assert!(speed(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_rate_is_what_a_car_can_send() {
        assert_eq!(rate("12.5"), Ok(12.5));
        for text in ["-1", "NaN", "inf", "1001", "fast"] {
            assert!(rate(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_pose_is_three_numbers() {
        let expected = Pose2 {
            x: 1.0,
            y: -2.0,
            heading: 0.5,
        };
        assert_eq!(pose("1, -2,0.5"), Ok(expected));
        for text in ["1,2", "1,2,x", "1,2,NaN", "1,2,3,4"] {
            assert!(pose(text).is_err(), "{text}");
        }
    }
}
