//! The command line.
#![allow(clippy::doc_markdown, reason = "these comments are what --help prints")]

use std::path::PathBuf;

use car_node::evaluate::Start;
use car_node::node::Begin;
use clap::{Args, Parser, Subcommand, ValueEnum};
use maps::Pose;
use protocol::CarName;

/// The on-car node: localizes a 1:10 race car and publishes what it knows.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
pub(crate) struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// What the node can do.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Run the car: sensors in, pose, particles, health and load out over zenoh, commands obeyed.
    ///
    /// Ends with Ctrl-C, or when a bag has been played.
    Run(Run),
    /// Run the filter over recorded bags as fast as it goes, and say how good it was.
    ///
    /// Results go to stdout, progress to stderr. The same bag, set and seed give the same poses.
    Evaluate(Evaluate),
}

/// Where the sensor data comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum SourceKind {
    /// A ROS 2 bag, played in real time.
    Bag,
    /// A simulated car that races on a simulated track.
    Simulator,
}

/// How well a simulated car's tyres hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Odometry {
    /// Clean tyres: 26 N of lateral pull.
    Hq,
    /// Taped tyres: 19 N of lateral pull, slipping.
    Lq,
}

/// Arguments of `run`.
#[derive(Debug, Args)]
pub(crate) struct Run {
    /// Where the sensor data comes from.
    #[arg(long, value_enum)]
    pub(crate) source: SourceKind,
    /// ROS 2 bag (MCAP) to play.
    #[arg(long, value_name = "FILE.mcap", required_if_eq("source", "bag"))]
    pub(crate) bag: Option<PathBuf>,
    /// Map: a map_server YAML file. For the simulator, a track's folder or its map.
    #[arg(long, value_name = "MAP.yaml")]
    pub(crate) map: PathBuf,
    /// Raceline to measure progress along [default: raceline.csv beside the map, if there].
    #[arg(long, value_name = "FILE")]
    pub(crate) raceline: Option<PathBuf>,
    /// Parameter set: hq, lq, adaptive, synpf-baseline, or a YAML file [default: the one last in force, else hq].
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) params: Option<String>,
    /// Pose of base_link in the map at the start [m, m, rad]; `truth` takes it from the source, `global` searches
    /// the map [default: truth for the simulator, global for a bag].
    #[arg(long, value_name = "X,Y,HEADING|truth|global", value_parser = begin, allow_hyphen_values = true)]
    pub(crate) initial_pose: Option<Begin>,
    /// The car's name on the network.
    #[arg(long, value_name = "NAME", default_value = "car-1")]
    pub(crate) car: CarName,
    /// Play a bag this many times as fast.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0)]
    pub(crate) rate: f64,
    /// Pit wall to dial, such as tcp/192.168.1.10:7447; may be repeated [default: one on this machine, or found by
    /// multicast].
    #[arg(long, value_name = "ENDPOINT")]
    pub(crate) connect: Vec<String>,
    /// Publish predicted poses at odometry rate, and not only at scan rate.
    #[arg(long)]
    pub(crate) predict: bool,
    /// Do not publish the full-rate streams for the recorder (about 1 Mbit/s).
    #[arg(long)]
    pub(crate) no_recorded: bool,
    /// Stay on the network when the bag has been played.
    #[arg(long)]
    pub(crate) stay: bool,
    /// Folder for sets that were put on the car [default: synpf/<car> in the user's state folder].
    #[arg(long, value_name = "FOLDER")]
    pub(crate) state: Option<PathBuf>,
    /// Seed of the filter's and the simulator's random numbers.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) seed: u64,
    /// Grip of the simulated car.
    #[arg(long, value_enum, default_value = "hq")]
    pub(crate) odometry: Odometry,
    /// Which topics of the bag to take.
    #[command(flatten)]
    pub(crate) topics: TopicArguments,
}

/// Which topics of a bag to take, and what it does not say.
#[derive(Debug, Args)]
pub(crate) struct TopicArguments {
    /// Laser scans (sensor_msgs/LaserScan) [default: what is in the bag].
    #[arg(long, value_name = "TOPIC")]
    pub(crate) scan_topic: Option<String>,
    /// Wheel odometry (nav_msgs/Odometry) [default: what is in the bag, fused odometry first].
    #[arg(long, value_name = "TOPIC")]
    pub(crate) odom_topic: Option<String>,
    /// True poses (nav_msgs/Odometry or geometry_msgs/PoseStamped) [default: /ground_truth/odom, if there].
    #[arg(long, value_name = "TOPIC")]
    pub(crate) truth_topic: Option<String>,
    /// Gyroscope (sensor_msgs/Imu) [default: what is in the bag, if any].
    #[arg(long, value_name = "TOPIC")]
    pub(crate) imu_topic: Option<String>,
    /// Pose of the laser on base_link [m, m, rad] [default: by /tf_static; 0.27 m ahead in a bag without it].
    #[arg(long, value_name = "X,Y,HEADING", value_parser = pose, allow_hyphen_values = true)]
    pub(crate) laser: Option<Pose>,
}

/// Arguments of `evaluate`.
#[derive(Debug, Args)]
pub(crate) struct Evaluate {
    /// Map: a map_server YAML file.
    #[arg(long, value_name = "MAP.yaml")]
    pub(crate) map: PathBuf,
    /// ROS 2 bag (MCAP); may be repeated.
    #[arg(long, value_name = "FILE.mcap", required = true)]
    pub(crate) bag: Vec<PathBuf>,
    /// Parameter set: hq, lq, adaptive, synpf-baseline, or a YAML file.
    #[arg(long, value_name = "NAME|FILE", default_value = "hq")]
    pub(crate) params: String,
    /// Pose of base_link in the map at the first scan [m, m, rad], or `truth`; without it the map is searched.
    #[arg(long, value_name = "X,Y,HEADING|truth", value_parser = start, allow_hyphen_values = true)]
    pub(crate) initial_pose: Option<Start>,
    /// Seed of the filter's random numbers; may be repeated, or a list: 0,1,2.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "0")]
    pub(crate) seed: Vec<u64>,
    /// Which topics of the bags to take.
    #[command(flatten)]
    pub(crate) topics: TopicArguments,
    /// Write `stamp_s,x_m,y_m,heading_rad` of base_link at every update to this CSV file (one bag, one seed).
    #[arg(long, value_name = "OUT.csv")]
    pub(crate) poses: Option<PathBuf>,
    /// One JSON object on stdout; an array of them for several bags or seeds.
    #[arg(long)]
    pub(crate) json: bool,
}

/// `x,y,heading`.
fn pose(text: &str) -> Result<Pose, String> {
    let numbers = text
        .split(',')
        .map(|part| part.trim().parse::<f64>())
        .collect::<Result<Vec<_>, _>>()
        .map_err(|error| format!("{error}; wanted x,y,heading in m, m, rad"))?;
    let [x, y, heading] = numbers[..] else {
        return Err(format!("{} numbers where x,y,heading are three", numbers.len()));
    };
    let pose = Pose::new(x, y, heading);
    if pose.is_finite() {
        Ok(pose)
    } else {
        Err("not finite".into())
    }
}

/// `truth` or `x,y,heading`.
fn start(text: &str) -> Result<Start, String> {
    if text == "truth" {
        Ok(Start::Truth)
    } else {
        pose(text).map(Start::Pose)
    }
}

/// `truth`, `global` or `x,y,heading`.
fn begin(text: &str) -> Result<Begin, String> {
    match text {
        "truth" => Ok(Begin::Source),
        "global" => Ok(Begin::Global),
        _ => pose(text).map(Begin::Pose),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_definition_is_sound() {
        Cli::command().debug_assert();
    }

    #[test]
    fn poses_parse_or_say_what_is_wrong() {
        assert_eq!(pose("1, -2,0.5"), Ok(Pose::new(1.0, -2.0, 0.5)));
        assert!(pose("1,2").expect_err("two").contains("2 numbers"));
        assert!(pose("1,2,north").is_err());
        assert_eq!(pose("1,2,NaN"), Err("not finite".into()));
        assert_eq!(start("truth"), Ok(Start::Truth));
    }
}
