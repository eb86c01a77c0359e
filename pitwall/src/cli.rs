//! The command line.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand};
use pitwall::Replay;
use protocol::{CarName, Pose2, Rates};

use crate::network::endpoint;

/// The pit wall: how well every car is localized and why. Without a command it serves the page.
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
    /// Where the page is served. On any but a loopback address it asks for the token that is printed.
    #[arg(
        long = "page",
        global = true, help_heading = GLOBAL,
        value_name = "ADDRESS:PORT",
        default_value = "127.0.0.1:7448"
    )]
    pub(crate) address: SocketAddr,
    /// The folder that recordings started from the page go to.
    #[arg(long, value_name = "FOLDER", default_value = ".")]
    pub(crate) recordings: PathBuf,
    /// Write what the Rerun viewer shows into this file too.
    #[cfg(feature = "rerun")]
    #[arg(long, value_name = "FILE.rrd")]
    pub(crate) rerun_save: Option<PathBuf>,
    /// Send it to a Rerun viewer that listens there.
    #[cfg(feature = "rerun")]
    #[arg(long, value_name = "URL", num_args = 0..=1, default_missing_value = "rerun+http://127.0.0.1:9876/proxy")]
    pub(crate) rerun_connect: Option<String>,
}

/// Over the options that every command takes, apart from its own.
const GLOBAL: &str = "Global options";

const EXIT_CODES: &str = "Without --listen and --connect, a pit wall that already runs on this laptop is joined; where \
none does, this program listens for the cars itself, on tcp/0.0.0.0:7447, while it runs.

Exit codes: 0 done, 1 failed, 2 bad usage, 3 refused by the car, 4 no such car, 5 no answer in time, 6 revision conflict,
7 recovered with losses.";

#[derive(Debug, Args)]
pub(crate) struct NetworkOptions {
    /// Listen for cars here, as tcp/ADDRESS:PORT; may be given several times.
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "ENDPOINT", value_parser = endpoint)]
    pub(crate) listen: Vec<String>,
    /// Join a running pit wall or router there.
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "ENDPOINT", conflicts_with = "listen", value_parser = endpoint)]
    pub(crate) connect: Vec<String>,
    /// Your name, as the cars and the others at the pit wall see it; $USER unless given.
    #[arg(long, global = true, help_heading = GLOBAL, value_name = "NAME")]
    operator: Option<String>,
}

impl NetworkOptions {
    /// Who gives commands.
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
        /// How long to listen before the list is written.
        #[arg(long, value_name = "TIME", default_value = "2s", allow_hyphen_values = true, value_parser = duration)]
        wait: Duration,
    },
    /// Follow the cars on a whole screen, with the switch; as plain lines where stdout is no terminal.
    Watch {
        /// The car to begin with; without a terminal, the only one to be told of.
        car: Option<CarName>,
        /// Stop after this time.
        #[arg(long = "for", value_name = "TIME", allow_hyphen_values = true, value_parser = duration)]
        time: Option<Duration>,
        /// Views per second, 0.01 to 100; 10 on a terminal, else 1.
        #[arg(long, value_name = "HZ", allow_negative_numbers = true, value_parser = views)]
        rate: Option<f64>,
        /// Wait so long for a car that is not there yet.
        #[arg(long, value_name = "TIME", default_value = "10m", allow_hyphen_values = true, value_parser = duration)]
        wait: Duration,
    },
    /// Look at a car's parameter sets, or change the one in force.
    Params {
        /// The car.
        car: CarName,
        #[command(subcommand)]
        verb: Option<ParamsVerb>,
    },
    /// Tell a car where it is, or let it search.
    Locate {
        /// The car.
        car: CarName,
        #[command(flatten)]
        how: Place,
    },
    /// See or set how often a car sends what.
    Rates {
        /// The car.
        car: CarName,
        #[command(flatten)]
        rates: RateOptions,
    },
    /// Let a car switch sets by itself, or not.
    Auto {
        /// The car.
        car: CarName,
        /// On or off.
        #[arg(value_name = "ON|OFF", value_parser = on_off, action = clap::ArgAction::Set)]
        on: bool,
    },
    /// List what happened.
    Events {
        /// Only this car.
        car: Option<CarName>,
        /// Go on until interrupted.
        #[arg(long, short)]
        follow: bool,
        /// With --follow: wait so long for a car to appear.
        #[arg(long, value_name = "TIME", default_value = "10m", allow_hyphen_values = true, value_parser = duration)]
        wait: Duration,
    },
    /// Record all cars into an MCAP file, until interrupted.
    Record {
        /// The new file; never overwritten.
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
        /// Stop after this time.
        #[arg(long = "for", value_name = "TIME", allow_hyphen_values = true, value_parser = duration)]
        time: Option<Duration>,
    },
    /// Serve the page from a recording, as if the cars were there.
    Replay {
        /// The recording.
        file: PathBuf,
        /// Times real time, 0.1 to 50.
        #[arg(long, value_name = "FACTOR", default_value = "1", allow_negative_numbers = true, value_parser = speed)]
        speed: f64,
        /// Begin here, as 90s or 5m.
        #[arg(long, value_name = "TIME", default_value = "0s", allow_hyphen_values = true, value_parser = duration)]
        at: Duration,
    },
    /// Tell what a recording says: laps, sectors, alignment, load, true error; with figures as one HTML file.
    Report {
        /// The recording.
        file: PathBuf,
        /// The page; FILE.html unless given.
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
    /// Write a recording's poses, truth, health and laps as CSV files.
    Export {
        /// The recording.
        file: PathBuf,
        /// The new folder; FILE.csv unless given.
        #[arg(short, long, value_name = "FOLDER")]
        output: Option<PathBuf>,
    },
    /// Repair a recording that was cut off or damaged; exit code 7 when something was lost.
    Recover {
        /// The damaged file; it stays as it is.
        file: PathBuf,
        /// The new file; FILE.recovered.mcap unless given.
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
}

#[derive(Debug, Subcommand)]
pub(crate) enum ParamsVerb {
    /// Show the set in force, every value.
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
        /// The file: `parameter: value`, one a line. What it does not name keeps its value.
        file: PathBuf,
        /// The set's name; the file's unless given.
        #[arg(long)]
        name: Option<String>,
        #[command(flatten)]
        change: Change,
    },
    /// Keep the set in force: the car will not fall back by itself.
    Confirm {
        #[command(flatten)]
        change: Expect,
    },
    /// Go back to the set that was in force before.
    Revert {
        #[command(flatten)]
        change: Expect,
    },
    /// Run a set beside the one in force, on the same scans, and see how the two compare.
    Shadow {
        /// Its name, or `off`; without it, the comparison is shown.
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
pub(crate) struct Change {
    /// Fall back by itself after this time unless confirmed.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true, value_parser = duration)]
    pub(crate) revert_after: Option<Duration>,
    #[command(flatten)]
    pub(crate) expect: Expect,
}

#[derive(Debug, Args)]
pub(crate) struct Expect {
    /// Only if the set in force has this revision.
    #[arg(long, value_name = "REVISION", allow_negative_numbers = true, value_parser = revision)]
    pub(crate) expect: Option<u64>,
}

#[derive(Debug, Args)]
#[group(required = true)]
pub(crate) struct Place {
    /// Where it is: x, y [m] and heading [rad] in the map.
    #[arg(long, value_name = "X,Y,HEADING", value_parser = pose, allow_hyphen_values = true, conflicts_with_all = ["global", "pick"])]
    pub(crate) pose: Option<Pose2>,
    /// Let it search the whole map and show the candidates.
    #[arg(long)]
    pub(crate) global: bool,
    /// Take this candidate of the last search.
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
    /// Send the full-rate streams for the recorder: on or off.
    #[arg(long, value_name = "ON|OFF", value_parser = on_off, action = clap::ArgAction::Set)]
    pub(crate) recorded: Option<bool>,
}

/// `30s`, `5m`, `1.5h`, `200ms`, or a bare number of seconds.
fn duration(text: &str) -> Result<Duration, String> {
    let split = text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let number: f64 = number
        .trim()
        .parse()
        .map_err(|_| format!("{text:?} is no time; say 30s or 5m"))?;
    let scale = match unit {
        "ms" => 1e-3,
        "" | "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err(format!("unknown unit {unit:?}; use ms, s, m or h")),
    };
    Duration::try_from_secs_f64(number * scale).map_err(|_| "a time is 0 s or more".to_owned())
}

/// Views per second.
fn views(text: &str) -> Result<f64, String> {
    let views = text.parse().ok().filter(|rate| (0.01..=100.0).contains(rate));
    views.ok_or_else(|| "wanted is a number from 0.01 to 100".to_owned())
}

fn candidate(text: &str) -> Result<u32, String> {
    let number = text.parse().ok().filter(|number| *number > 0);
    number.ok_or_else(|| "candidates are numbered 1, 2, 3 and so on".to_owned())
}

fn revision(text: &str) -> Result<u64, String> {
    text.parse()
        .map_err(|_| "a revision is a whole number, as `pitwall params CAR` tells it".to_owned())
}

fn speed(text: &str) -> Result<f64, String> {
    let speed: f64 = text.parse().map_err(|_| format!("{text:?} is no number"))?;
    let allowed = Replay::SPEEDS;
    if allowed.contains(&speed) {
        Ok(speed)
    } else {
        Err(format!("a speed is {} to {}", allowed.start(), allowed.end()))
    }
}

fn on_off(text: &str) -> Result<bool, String> {
    match text {
        "on" => Ok(true),
        "off" => Ok(false),
        _ => Err("say on or off".to_owned()),
    }
}

fn rate(text: &str) -> Result<f32, String> {
    let rate: f32 = text.parse().map_err(|_| format!("{text:?} is no number"))?;
    if (0.0..=Rates::MAX).contains(&rate) {
        Ok(rate)
    } else {
        Err(format!("a rate is 0 to {} Hz", Rates::MAX))
    }
}

fn pose(text: &str) -> Result<Pose2, String> {
    let numbers: Vec<f64> = text
        .split(',')
        .map(|part| part.trim().parse().map_err(|_| format!("{part:?} is no number")))
        .collect::<Result<_, _>>()?;
    match numbers[..] {
        [x, y, heading] if numbers.iter().all(|n| n.is_finite()) => Ok(Pose2 { x, y, heading }),
        [_, _, _] => Err("all three must be finite".to_owned()),
        _ => Err("say X,Y,HEADING, as in 1.5,-0.2,3.14".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_makes_sense() {
        Cli::command().debug_assert();
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
            let said = error.expect_err(call).to_string();
            assert!(said.contains(&format!("for '{option} ")), "{call}: {said}");
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
