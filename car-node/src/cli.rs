//! The command line.
#![allow(clippy::doc_markdown, reason = "these comments are what --help prints")]

use std::fmt;
use std::path::PathBuf;

use car_node::evaluate::Fault;
use car_node::localization::Start;
use car_node::network::endpoint;
use car_node::recording::RecordOptions;
use car_node::sensors::Ros2Options;
use car_node::sensors::frames::Mount;
use car_node::stress::{Defect, DefectChoice, DefectKind};
use clap::{Args, Parser, Subcommand, ValueEnum};
use maps::Pose;
use protocol::CarName;

use crate::commands::placement::cpu_list;

/// The on-car node: localizes a 1:10 race car and publishes its pose and health.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
pub(crate) struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// What the node can do.
#[derive(Debug, Subcommand)]
#[expect(clippy::large_enum_variant, reason = "there is one, at the start")]
pub(crate) enum Command {
    /// Run the car: read sensors, publish pose, particles, health and load over zenoh, execute commands.
    ///
    /// Ends with Ctrl-C, or when a bag has been played.
    Run(Run),
    /// Run the localizer over recorded bags as fast as it can, and report errors, consistency, health and times.
    ///
    /// Results go to stdout, progress to stderr. The same bag, set and seed give the same poses.
    Evaluate(Evaluate),
    /// Measure what each improvement over the reference contributes: from synpf-baseline to a set, one row each.
    ///
    /// First each improvement on top of the ones before, then the whole set without each of them.
    Ablate(Ablate),
    /// Damage a recorded drive in many ways, and report where a parameter set holds and where it does not.
    ///
    /// Defects of the map, of what stands around the car, of every sensor and of the clock, mostly in three grades. With
    /// true poses in the bag, errors are against them; without, against the set's own undamaged run. Uses all cores.
    Stress(Stress),
    /// Race simulated cars that drive on the localizer's estimates, and compare the laps with the paper's.
    ///
    /// The same seed gives the same race; only the load differs from run to run. Exit code: 0 when every car drove all laps
    /// without a crash, 3 when one did not, 1 for a faulty file, 2 for wrong usage. With --table it is 0.
    Race(Race),
    /// Draw a figure of the paper, or one that explains SynPF, as SVG.
    Figure(Figure),
    /// Pull the simulated car sideways until it slides, on each kind of tyres, as the paper does with its car.
    GripTest(GripTest),
    /// Make, check or draw a track.
    Track(Track),
    /// Make a parameter set of another localizer's file: SynPF's pf2_params.yaml, MIT's particle filter's, nav2's or ROS 1's
    /// AMCL's. Says of each value what became of it.
    Import(Import),
    /// Check clock, CPU, memory, map, disk, keys and network, and say what to do. The exit code is 1 if something is bad.
    Doctor(Doctor),
    /// Exit with 0 if the car with this state folder runs: a container's health check.
    Health {
        /// The car's --state folder.
        #[arg(long, value_name = "FOLDER")]
        state: PathBuf,
    },
}

/// Arguments of `doctor`, as for `run`.
#[derive(Debug, Args)]
pub(crate) struct Doctor {
    /// Map: a map_server YAML file, or a Cartographer state (.pbstream).
    #[arg(long, value_name = "MAP")]
    pub(crate) map: Option<PathBuf>,
    /// The car's name.
    #[arg(long, value_name = "NAME", default_value = "car-1")]
    pub(crate) car: CarName,
    /// Pit wall that the car connects to; may be repeated.
    #[arg(long, value_name = "ENDPOINT", value_parser = endpoint)]
    pub(crate) connect: Vec<String>,
    /// Keys of this car.
    #[arg(long, value_name = "FILE")]
    pub(crate) keys: Option<PathBuf>,
    /// File with the passphrase.
    #[arg(long, value_name = "FILE", conflicts_with = "keys")]
    pub(crate) passphrase_file: Option<PathBuf>,
    /// Folder for sets that are stored on the car.
    #[arg(long, value_name = "FOLDER")]
    pub(crate) state: Option<PathBuf>,
    /// One JSON array on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Where the sensor data comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum SourceKind {
    /// A bag, played in real time.
    Bag,
    /// A simulated car that races on a simulated track.
    Simulator,
    /// Live sensors of a ROS 2 car, from rmw_zenoh's router or a zenoh-bridge-ros2dds.
    Ros2,
}

/// Grip of a simulated car's tyres.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Odometry {
    /// Clean tyres: 26 N of lateral pull.
    Hq,
    /// Taped tyres: 19 N of lateral pull, slipping.
    Lq,
}

/// Arguments of `run`.
#[derive(Debug, Args)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "each is a switch on the command line"
)]
pub(crate) struct Run {
    /// Where the sensor data comes from.
    #[arg(long, value_enum)]
    pub(crate) source: SourceKind,
    /// Bag to play: a rosbag2 folder, or a file (.mcap, .db3, .bag of ROS 1), compressed or not.
    #[arg(long, value_name = "BAG", required_if_eq("source", "bag"))]
    pub(crate) bag: Option<PathBuf>,
    /// With --source ros2: the zenoh router (rmw_zenohd) or bridge of the ROS side.
    #[arg(long, value_name = "ENDPOINT", default_value = Ros2Options::ENDPOINT, value_parser = endpoint)]
    pub(crate) ros: String,
    /// With --source ros2: the ROS domain [default: $ROS_DOMAIN_ID, else 0].
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = |text: &str| whole::<u32>(text, 0, 232))]
    pub(crate) ros_domain: Option<u32>,
    /// With --source ros2: the car's namespace, where several cars share a router, such as /car1 [default: the first that has a scan
    /// and odometry].
    #[arg(long, value_name = "NAMESPACE")]
    pub(crate) ros_namespace: Option<String>,
    /// With --source ros2: topic to publish the pose on for the car's own nodes (nav_msgs/Odometry in frame map)
    /// [default: /pf/pose/odom in the car's namespace].
    #[arg(long = "output-topic", value_name = "TOPIC")]
    pub(crate) pose_topic: Option<String>,
    /// With --source ros2: do not publish the transform from map to odom.
    #[arg(long)]
    pub(crate) no_tf: bool,
    /// With --source ros2: topic of initial poses (geometry_msgs/PoseWithCovarianceStamped in frame map) [default: /initialpose
    /// in the namespace of the scan].
    #[arg(long, value_name = "TOPIC")]
    pub(crate) initial_pose_topic: Option<String>,
    /// Map: a map_server YAML file, or a Cartographer state (.pbstream). For the simulator, a track: club, hall, park, mirror,
    /// or a folder.
    #[arg(long, value_name = "MAP|TRACK")]
    pub(crate) map: PathBuf,
    /// Raceline to measure progress along [default: raceline.csv beside the map, if it exists].
    #[arg(long, value_name = "FILE")]
    pub(crate) raceline: Option<PathBuf>,
    /// Parameter set: hq, lq, adaptive, synpf-baseline, pose-graph, pose-graph-tuned, a YAML file, or a team's .lua for
    /// Cartographer [default: the first of --localizer, else the one last in force, else hq].
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) params: Option<String>,
    /// Kind of localizer; without --params, its first set. `external` follows the one on --pose-topic.
    #[arg(long, value_enum)]
    pub(crate) localizer: Option<LocalizerKind>,
    /// A second set on the same scans, compared with the one in force; `external` compares with the localizer on --pose-topic.
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) beside: Option<String>,
    /// Pose of base_link in the map at the start [m, m, rad]; `truth` takes it from the source, `global` searches
    /// the map [default: truth for the simulator, else global].
    #[arg(long, value_name = "X,Y,HEADING|truth|global", value_parser = start_or_global, allow_hyphen_values = true)]
    pub(crate) initial_pose: Option<Start>,
    /// The car's name on the network. Two cars must not have the same [default: car-1; none with --source ros2].
    #[arg(long, alias = "name", value_name = "NAME", required_if_eq("source", "ros2"))]
    pub(crate) car: Option<CarName>,
    /// Play a bag this many times as fast, 0.01 to 1000.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, allow_negative_numbers = true, value_parser = rate)]
    pub(crate) rate: f64,
    /// Pit wall to connect to: tls/192.168.1.10:7447 with keys, else tcp/...; may be repeated [default: one on this machine; with
    /// --keys, --passphrase-file or --insecure also one found by multicast].
    #[arg(long, value_name = "ENDPOINT", value_parser = endpoint)]
    pub(crate) connect: Vec<String>,
    /// Keys of this car, made by `pitwall keys new` [default: $SYNPF_KEYS].
    #[arg(long, value_name = "FILE")]
    pub(crate) keys: Option<PathBuf>,
    /// File with the passphrase that pit wall and cars share, where there are no keys [default: $SYNPF_PASSPHRASE_FILE].
    #[arg(long, value_name = "FILE", conflicts_with = "keys")]
    pub(crate) passphrase_file: Option<PathBuf>,
    /// Without keys and passphrase, look for a pit wall by multicast, too; everybody on that network can command the car.
    #[arg(long)]
    pub(crate) insecure: bool,
    /// Publish predicted poses at odometry rate, and not only at scan rate.
    #[arg(long)]
    pub(crate) predict: bool,
    /// Do not publish the full-rate streams for the recorder (about 1 Mbit/s).
    #[arg(long)]
    pub(crate) no_recorded: bool,
    /// Cores to run on, such as 3 or 2-3 [default: all].
    #[arg(long, value_name = "LIST", value_parser = cpu_list)]
    pub(crate) cpus: Option<String>,
    /// Niceness, -20 to 19; negative comes before other programs, and needs the right to do so.
    #[arg(long, value_name = "NICE", allow_negative_numbers = true, value_parser = clap::value_parser!(i8).range(-20..=19))]
    pub(crate) priority: Option<i8>,
    /// Stay on the network after the end of the bag.
    #[arg(long)]
    pub(crate) stay: bool,
    /// Folder for sets that are stored on the car [default: synpf/<car> in the user's state folder].
    #[arg(long, value_name = "FOLDER")]
    pub(crate) state: Option<PathBuf>,
    /// Record everything on the car's own disk into this folder, from the start. A pit wall can stop it, and start it without this
    /// option, too [default folder: recordings in the state folder].
    #[arg(long, value_name = "FOLDER")]
    pub(crate) record: Option<PathBuf>,
    /// Most space for all recordings on the car, such as 8G; then the oldest are deleted.
    #[arg(long, value_name = "SIZE", default_value_t = Size(RecordOptions::LIMIT), value_parser = size)]
    pub(crate) record_limit: Size,
    /// Size of one file of a recording.
    #[arg(long, value_name = "SIZE", default_value_t = Size(RecordOptions::SPLIT), value_parser = size)]
    pub(crate) record_split: Size,
    /// Most memory for the range tables of the map. Where they would take more, they are coarser or replaced, which is said at start.
    #[arg(long, value_name = "SIZE", default_value_t = Size(synpf::TABLE_BUDGET as u64), value_parser = size)]
    pub(crate) table_memory: Size,
    /// Seed of the filter's and the simulator's random numbers.
    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true, value_parser = seed)]
    pub(crate) seed: u64,
    /// Grip of the simulated car.
    #[arg(long, value_enum, default_value = "hq")]
    pub(crate) odometry: Odometry,
    /// Which topics to take.
    #[command(flatten)]
    pub(crate) topics: TopicArguments,
}

/// A size \[bytes\].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Size(pub(crate) u64);

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let unit = SIZE_UNITS
            .iter()
            .find(|(_, unit)| self.0 >= *unit && self.0.is_multiple_of(*unit));
        match unit {
            Some((name, unit)) => write!(f, "{}{name}", self.0 / unit),
            None => write!(f, "{}", self.0),
        }
    }
}

const SIZE_UNITS: [(&str, u64); 3] = [("G", 1 << 30), ("M", 1 << 20), ("k", 1 << 10)];

/// `8G`, `64M`, `500k`, or a number of bytes. A unit is 1024 of the one below.
fn size(text: &str) -> Result<Size, String> {
    let (number, unit) = SIZE_UNITS
        .iter()
        .find_map(|(name, unit)| Some((text.strip_suffix(name)?, *unit)))
        .unwrap_or((text, 1));
    let number: u64 = number
        .parse()
        .map_err(|_| format!("{text:?} is not a size; use 8G, 64M or 500k"))?;
    number
        .checked_mul(unit)
        .map(Size)
        .ok_or_else(|| format!("{text:?} is too large"))
}

/// Heading of the topics in --help.
const TOPICS: &str = "Topics";

/// Which topics of a bag or of a live car to take, and the laser's pose if they lack it.
#[derive(Debug, Args)]
pub(crate) struct TopicArguments {
    /// Laser scans (sensor_msgs/LaserScan) [default: /scan, else the first].
    #[arg(long, help_heading = TOPICS, value_name = "TOPIC")]
    pub(crate) scan_topic: Option<String>,
    /// Wheel odometry (nav_msgs/Odometry) [default: by the usual names, fused odometry first, else the first].
    #[arg(long, help_heading = TOPICS, value_name = "TOPIC")]
    pub(crate) odom_topic: Option<String>,
    /// True poses (nav_msgs/Odometry or geometry_msgs/PoseStamped) [default: /ground_truth/odom, if it exists].
    #[arg(long, help_heading = TOPICS, value_name = "TOPIC")]
    pub(crate) truth_topic: Option<String>,
    /// Gyroscope (sensor_msgs/Imu) [default: by the usual names, else the first, if any].
    #[arg(long, help_heading = TOPICS, value_name = "TOPIC")]
    pub(crate) imu_topic: Option<String>,
    /// Poses of another localizer, such as /tracked_pose (nav_msgs/Odometry, geometry_msgs/PoseStamped,
    /// geometry_msgs/PoseWithCovarianceStamped, or tf2_msgs/TFMessage with a transform from map).
    #[arg(long = "pose-topic", help_heading = TOPICS, value_name = "TOPIC")]
    pub(crate) external_pose_topic: Option<String>,
    /// What these poses are of [default: by the message, else base_link].
    #[arg(long, value_enum, help_heading = TOPICS, requires = "external_pose_topic")]
    pub(crate) pose_of: Option<PosedFrame>,
    /// Pose of the laser on base_link [m, m, rad], and whether it is mounted upside down [default: from /tf_static; 0.27 m ahead
    /// without it].
    #[arg(long, help_heading = TOPICS, value_name = "X,Y,HEADING[,upside-down]", value_parser = laser, allow_hyphen_values = true)]
    pub(crate) laser: Option<Mount>,
}

/// Bags, and the map that they were driven on.
#[derive(Debug, Args)]
pub(crate) struct Bags {
    /// Map: a map_server YAML file, or a Cartographer state (.pbstream).
    #[arg(long, value_name = "MAP")]
    pub(crate) map: PathBuf,
    /// Bag: a rosbag2 folder, or a file (.mcap, .db3, .bag of ROS 1), compressed or not; may be repeated.
    #[arg(long = "bag", value_name = "BAG", required = true, num_args = 1..)]
    pub(crate) files: Vec<PathBuf>,
    /// True poses, in place of a topic of the bag (one bag): CSV with stamp_s,x_m,y_m,heading_rad of base_link, as --poses
    /// writes, or stamp_s,laser_x_m,laser_y_m,laser_yaw_rad; or the trajectory of a Cartographer state (.pbstream).
    #[arg(long, value_name = "FILE", conflicts_with = "truth_topic")]
    pub(crate) truth: Option<PathBuf>,
    /// Start this long after the first scan [s].
    #[arg(long, value_name = "S", default_value = "0", allow_negative_numbers = true, value_parser = log_seconds)]
    pub(crate) from: f64,
    /// Length of the part to take [s] [default: to the end].
    #[arg(long = "for", value_name = "S", allow_negative_numbers = true, value_parser = log_seconds)]
    pub(crate) lasting: Option<f64>,
    /// Which topics of the bags to take.
    #[command(flatten)]
    pub(crate) topics: TopicArguments,
}

/// Arguments of `evaluate`.
#[derive(Debug, Args)]
pub(crate) struct Evaluate {
    /// What to run over.
    #[command(flatten)]
    pub(crate) bags: Bags,
    /// Parameter set: hq, lq, adaptive, synpf-baseline, pose-graph, pose-graph-tuned, a YAML file, or a team's .lua for
    /// Cartographer [default: the first of --localizer, else hq].
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) params: Option<String>,
    /// Kind of localizer; without --params, its first set. `external` follows the one on --pose-topic.
    #[arg(long, value_enum)]
    pub(crate) localizer: Option<LocalizerKind>,
    /// Another set to run over the same bag, in a row of its own; `external` is the localizer on --pose-topic.
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) beside: Option<String>,
    /// Pose of base_link in the map at the first scan [m, m, rad], or `truth`; without it the localizer searches the map.
    #[arg(long, value_name = "X,Y,HEADING|truth", value_parser = start, allow_hyphen_values = true)]
    pub(crate) initial_pose: Option<Start>,
    /// Seed of the filter's random numbers; may be repeated, or a list: 0,1,2.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "0", allow_negative_numbers = true, value_parser = seed)]
    pub(crate) seed: Vec<u64>,
    /// Add a fault to the log, and report how the health state reacts. kidnap@20+4 moves the car by 4 s of driving, 20 s after
    /// the first scan, and hides it from odometry. splice@20+4 cuts the same piece out and leaves odometry as it was logged, as
    /// in an edited bag. The others are no-scans, no-odometry, blocked (an opponent ahead) and black-tubes. May be repeated.
    #[arg(long, value_name = "KIND@S+S", allow_hyphen_values = true)]
    pub(crate) fault: Vec<Fault>,
    /// Write every update to this CSV file (one bag, one seed): stamp_s,x_m,y_m,heading_rad of base_link, the covariance
    /// xx,xy,yy,xh,yh,hh, the state and the mode, and the fit of the scan align,short,long.
    #[arg(long, value_name = "OUT.csv")]
    pub(crate) poses: Option<PathBuf>,
    /// One JSON object on stdout; an array of them for several bags or seeds.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Arguments of `ablate`.
#[derive(Debug, Args)]
pub(crate) struct Ablate {
    /// What to run over.
    #[command(flatten)]
    pub(crate) bags: Bags,
    /// The set to end with: hq, lq, adaptive, or a YAML file.
    #[arg(long, value_name = "NAME|FILE", default_value = "hq")]
    pub(crate) params: String,
    /// Pose of base_link in the map at the first scan [m, m, rad], or `truth`. The reference cannot search a map, so
    /// a pose is needed.
    #[arg(long, value_name = "X,Y,HEADING|truth", value_parser = start, allow_hyphen_values = true, default_value = "truth")]
    pub(crate) initial_pose: Start,
    /// Seeds, as a list; results are means over them.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "0,1,2", allow_negative_numbers = true, value_parser = seed)]
    pub(crate) seed: Vec<u64>,
    /// A JSON array of rows on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Arguments of `stress`.
#[derive(Debug, Args)]
#[command(after_long_help = catalogue())]
pub(crate) struct Stress {
    /// What to run over.
    #[command(flatten)]
    pub(crate) inputs: Bags,
    /// Parameter sets: hq, lq, adaptive, synpf-baseline, or YAML files; may be repeated, or a list.
    #[arg(long, value_name = "NAME|FILE", value_delimiter = ',', num_args = 1.., default_value = "hq")]
    pub(crate) params: Vec<String>,
    /// Pose of base_link in the map at the first scan [m, m, rad], for a bag without truth; without it the localizer searches
    /// the map.
    #[arg(long, value_name = "X,Y,HEADING", value_parser = start, allow_hyphen_values = true)]
    pub(crate) initial_pose: Option<Start>,
    /// Seeds of the filter's random numbers and of the defects; may be repeated, or a list: 0,1,2.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "0", allow_negative_numbers = true, value_parser = seed)]
    pub(crate) seed: Vec<u64>,
    /// Only these defects, as a list: people,range-noise:severe [default: all].
    #[arg(long, value_name = "KIND[:GRADE]", value_delimiter = ',')]
    pub(crate) only: Vec<DefectChoice>,
    /// Write a page with plots to this file.
    #[arg(long, value_name = "OUT.html")]
    pub(crate) html: Option<PathBuf>,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Arguments of `race`.
#[derive(Debug, Clone, Args)]
pub(crate) struct Race {
    /// Track: club, hall, park, mirror, a folder, or a map.yaml of your own.
    #[arg(long, value_name = "NAME|FOLDER|MAP.yaml", default_value = "club")]
    pub(crate) track: String,
    /// Its raceline: CSV, or race_stack's global_waypoints.json [default: raceline.csv beside the map]. On a map of your own
    /// it is slowed to what the simulated car can do.
    #[arg(long, value_name = "FILE")]
    pub(crate) raceline: Option<PathBuf>,
    /// Laps for every car, 1 to 10000.
    #[arg(long, value_name = "N", default_value = "10", allow_negative_numbers = true, value_parser = |text: &str| whole::<u32>(text, 1, 10_000))]
    pub(crate) laps: u32,
    /// Grip of the tyres.
    #[arg(long, value_enum, default_value = "hq")]
    pub(crate) odometry: Odometry,
    /// Parameter set: hq, lq, adaptive, synpf-baseline, pose-graph, pose-graph-tuned, a YAML file, or a team's .lua for
    /// Cartographer [default: the first of --localizer, else hq].
    #[arg(long, value_name = "NAME|FILE")]
    pub(crate) params: Option<String>,
    /// Where the driver gets the car's pose from [default: the localizer that --params is for].
    #[arg(long, value_enum)]
    pub(crate) localizer: Option<PoseSource>,
    /// Cars on the track, each with a localizer of its own, 1 to 20.
    #[arg(long, value_name = "N", default_value = "1", allow_negative_numbers = true, value_parser = |text: &str| whole::<u8>(text, 1, 20))]
    pub(crate) cars: u8,
    /// Races to run, each with the next seed, 1 to 1000 [default: 1; with --table 5].
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = |text: &str| whole::<u64>(text, 1, 1000))]
    pub(crate) seeds: Option<u64>,
    /// Seed of the first race.
    #[arg(long, value_name = "N", default_value = "0", allow_negative_numbers = true, value_parser = seed)]
    pub(crate) seed: u64,
    /// Speed over the raceline's own, 0.1 to 2.
    #[arg(long, value_name = "FACTOR", default_value = "1.0", allow_negative_numbers = true, value_parser = speed)]
    pub(crate) speed: f64,
    /// Damage sensors and map by these defects, each medium unless a grade is given: people,range-noise:severe. Names are
    /// those in stress --help; kidnap, bent-map and scaled-map are for logs only. The driver's speed control has sensors of
    /// its own.
    #[arg(long, value_name = "KIND[:GRADE]", value_delimiter = ',')]
    pub(crate) faults: Vec<DefectChoice>,
    /// Run the paper's grid (every localizer on both tyres) and print it beside table I of the paper.
    #[arg(long, conflicts_with_all = ["odometry", "params", "localizer", "cars", "faults"])]
    pub(crate) table: bool,
    /// With --table: write a page with the tables, the deviation along the track and the distributions to this file.
    #[arg(long, value_name = "OUT.html", requires = "table")]
    pub(crate) html: Option<PathBuf>,
    /// One JSON object on stdout; an array of rows with --table.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Kinds of localizers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LocalizerKind {
    /// SynPF.
    Synpf,
    /// The emulation of the reference.
    SynpfBaseline,
    /// Pose-graph localization, after Cartographer.
    PoseGraph,
    /// Another program, such as AMCL or Cartographer.
    External,
}

/// What the poses of another localizer are poses of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
pub(crate) enum PosedFrame {
    /// The car.
    BaseLink,
    /// The laser, as MIT's particle filter has it.
    Laser,
}

/// Where the driver gets the pose from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum PoseSource {
    /// SynPF.
    Synpf,
    /// The emulation of the reference.
    SynpfBaseline,
    /// Pose-graph localization, after Cartographer.
    PoseGraph,
    /// Wheel odometry alone.
    Odometry,
    /// The true pose.
    Truth,
}

/// What can be drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum FigureKind {
    /// The paper's figure 1: particles of the differential-drive and the race car's motion model, at low and high speed.
    MotionModels,
    /// Where the beams of the uniform and the boxed layout end in a corridor.
    BeamLayouts,
    /// The density of the beam model.
    SensorModel,
    /// The error of each method that predicts ranges.
    RangeMethods,
}

/// Arguments of `figure`.
#[derive(Debug, Args)]
pub(crate) struct Figure {
    /// What to draw.
    #[arg(value_name = "FIGURE")]
    pub(crate) what: FigureKind,
    /// File to write; one that exists is overwritten.
    #[arg(short, long, value_name = "FILE.svg")]
    pub(crate) out: PathBuf,
}

/// Arguments of `grip-test`.
#[derive(Debug, Clone, Copy, Args)]
pub(crate) struct GripTest {
    /// One JSON array on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Arguments of `import`.
#[derive(Debug, Args)]
pub(crate) struct Import {
    /// The other localizer's YAML file, which may hold other nodes, too, or Cartographer's .lua.
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// The set to write [default: FILE_set.yaml in this folder].
    #[arg(long, value_name = "SET.yaml")]
    pub(crate) out: Option<PathBuf>,
    /// Edge of a cell of the map that the file was used with [m], 0.001 to 1: MIT's sigma_hit is in cells.
    #[arg(long, value_name = "METRES", default_value = "0.05", allow_negative_numbers = true, value_parser = |text: &str| within(text, 0.001, 1.0))]
    pub(crate) resolution: f64,
    /// Overwrite an existing set.
    #[arg(long)]
    pub(crate) force: bool,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

/// Arguments of `track`.
#[derive(Debug, Args)]
pub(crate) struct Track {
    /// What to do with it.
    #[command(subcommand)]
    pub(crate) command: TrackCommand,
}

/// What can be done with a track.
#[derive(Debug, Subcommand)]
pub(crate) enum TrackCommand {
    /// Make a track: map.yaml, map.png, raceline.csv, walls.csv and its description, track.yaml.
    New {
        /// Folder to write to.
        #[arg(value_name = "FOLDER")]
        folder: PathBuf,
        /// Description to make it from [default: a random one].
        #[arg(long, value_name = "TRACK.yaml", conflicts_with_all = ["length", "width", "seed"])]
        from: Option<PathBuf>,
        /// Length of a random track's lap, about [m], 20 to 500.
        #[arg(long, value_name = "METRES", default_value = "50", allow_negative_numbers = true, value_parser = lap_length)]
        length: f64,
        /// Width of a random track [m], 1.2 to 6.
        #[arg(long, value_name = "METRES", default_value = "2", allow_negative_numbers = true, value_parser = track_width)]
        width: f64,
        /// Seed of a random track.
        #[arg(long, value_name = "N", default_value = "0", allow_negative_numbers = true, value_parser = seed)]
        seed: u64,
        /// Overwrite an existing track.
        #[arg(long)]
        force: bool,
        /// One JSON object on stdout.
        #[arg(long)]
        json: bool,
    },
    /// Check that a track can be raced on. If not, print every fault, with exit code 1.
    Check {
        /// Which track.
        #[command(flatten)]
        track: TrackArguments,
        /// One JSON object on stdout.
        #[arg(long)]
        json: bool,
    },
    /// Draw a track in the terminal, or as an SVG file.
    Draw {
        /// Which track.
        #[command(flatten)]
        track: TrackArguments,
        /// Write an SVG file: walls, map and raceline coloured by speed.
        #[arg(long, value_name = "FILE.svg")]
        svg: Option<PathBuf>,
        /// Columns to draw in, 20 to 400.
        #[arg(long, value_name = "N", default_value = "100", allow_negative_numbers = true, value_parser = |text: &str| whole::<u16>(text, 20, 400))]
        columns: u16,
    },
}

/// An existing track.
#[derive(Debug, Args)]
pub(crate) struct TrackArguments {
    /// Track: club, hall, park, mirror, a folder, or a map.yaml of your own.
    #[arg(value_name = "NAME|FOLDER|MAP.yaml")]
    pub(crate) track: String,
    /// Its raceline [default: raceline.csv beside the map].
    #[arg(long, value_name = "FILE")]
    pub(crate) raceline: Option<PathBuf>,
}

/// The defects, as the help of `stress` lists them.
fn catalogue() -> String {
    let mut text = "Defects, with the sizes of their grades mild, medium and severe:\n".to_owned();
    let mut part = None;
    for kind in DefectKind::ALL {
        if part != Some(kind.part()) {
            part = Some(kind.part());
            text.push_str(&kind.part().to_string());
            text.push('\n');
        }
        let sizes: Vec<_> = kind
            .grades()
            .map(Defect::size_text)
            .filter(|size| !size.is_empty())
            .collect();
        let sizes = if sizes.is_empty() {
            String::new()
        } else {
            format!(" ({})", sizes.join(" | "))
        };
        let line = format!("  {:<18} {}{sizes}\n", kind.name(), kind.text());
        text.push_str(&line);
    }
    text
}

/// Parses a number within a range. The error names the range.
fn within(text: &str, least: f64, most: f64) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (least..=most).contains(&value) => Ok(value),
        _ => Err(format!("expected a number from {least} to {most}")),
    }
}

/// Parses a whole number within a range. The error names the range.
fn whole<T: TryFrom<u64>>(text: &str, least: u64, most: u64) -> Result<T, String> {
    let value = text.parse().ok().filter(|value| (least..=most).contains(value));
    value
        .and_then(|value| value.try_into().ok())
        .ok_or_else(|| format!("expected a whole number from {least} to {most}"))
}

fn seed(text: &str) -> Result<u64, String> {
    whole(text, 0, u64::MAX)
}

fn speed(text: &str) -> Result<f64, String> {
    within(text, 0.1, 2.0)
}

fn log_seconds(text: &str) -> Result<f64, String> {
    within(text, 0.0, 1e6)
}

fn rate(text: &str) -> Result<f64, String> {
    within(text, 0.01, 1000.0)
}

fn lap_length(text: &str) -> Result<f64, String> {
    within(text, 20.0, 500.0)
}

fn track_width(text: &str) -> Result<f64, String> {
    within(text, 1.2, 6.0)
}

/// `x,y,heading`.
fn pose(text: &str) -> Result<Pose, String> {
    let numbers = text
        .split(',')
        .map(|part| part.trim().parse::<f64>())
        .collect::<Result<Vec<_>, _>>()
        .map_err(|error| format!("{error}; expected x,y,heading in m, m, rad"))?;
    let [x, y, heading] = numbers[..] else {
        return Err(format!("{} numbers; expected three: x,y,heading", numbers.len()));
    };
    let pose = Pose::new(x, y, heading);
    if pose.is_finite() {
        Ok(pose)
    } else {
        Err("not finite".into())
    }
}

/// `x,y,heading` of a laser.
fn laser(text: &str) -> Result<Mount, String> {
    let (place, upside_down) = match text.rsplit_once(',') {
        Some((place, word)) if word.trim() == "upside-down" => (place, true),
        _ => (text, false),
    };
    let base_link_from_laser = pose(place)?;
    if base_link_from_laser.x.hypot(base_link_from_laser.y) < 10.0 {
        Ok(Mount {
            base_link_from_laser,
            upside_down,
        })
    } else {
        Err("the laser must be within 10 m of base_link".into())
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
fn start_or_global(text: &str) -> Result<Start, String> {
    match text {
        "truth" => Ok(Start::Truth),
        "global" => Ok(Start::Global),
        _ => pose(text).map(Start::Pose),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_well_defined() {
        Cli::command().debug_assert();
    }

    #[test]
    fn poses_parse_or_name_the_fault() {
        assert_eq!(pose("1, -2,0.5"), Ok(Pose::new(1.0, -2.0, 0.5)));
        assert!(pose("1,2").expect_err("two").contains("2 numbers"));
        assert!(pose("1,2,north").is_err());
        assert_eq!(pose("1,2,NaN"), Err("not finite".into()));
        assert_eq!(start("truth"), Ok(Start::Truth));
        assert!(laser("0.27,0,0").is_ok() && laser("270,0,0").is_err());
    }

    #[test]
    fn a_negative_number_is_refused_by_its_option() {
        let bags = "--map m.yaml --bag b.mcap";
        for (call, option) in [
            ("race --seed -1", "--seed"),
            ("race --laps -1", "--laps"),
            ("race --cars -1", "--cars"),
            ("race --seeds -1", "--seeds"),
            ("race --speed -1", "--speed"),
            (&format!("evaluate {bags} --seed -1"), "--seed"),
            (&format!("evaluate {bags} --seed 0,-1"), "--seed"),
            (&format!("ablate {bags} --seed -1"), "--seed"),
            (&format!("stress {bags} --seed -1"), "--seed"),
            ("track new folder --length -1", "--length"),
            ("track new folder --width -1", "--width"),
            ("track new folder --seed -1", "--seed"),
            ("track draw club --columns -1", "--columns"),
            ("run --source simulator --map club --seed -1", "--seed"),
            ("run --source simulator --map club --rate -1", "--rate"),
            ("run --source ros2 --map club --ros-domain -1", "--ros-domain"),
        ] {
            let error = Cli::try_parse_from(["car-node"].into_iter().chain(call.split(' ')));
            let said = error.expect_err(call).to_string();
            assert!(said.contains(&format!("'-1' for '{option} ")), "{call}: {said}");
            assert!(said.contains("number from"), "{call}: {said}");
        }
    }

    #[test]
    fn faulty_endpoints_are_refused() {
        for good in ["tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tls/pit.local:7447"] {
            assert_eq!(endpoint(good), Ok(good.into()));
        }
        for bad in [
            "",
            "nonsense",
            "127.0.0.1:7447",
            "tcp/127.0.0.1",
            "tcp/a:b",
            "tpc/a:1",
            "tcp/a:70000",
        ] {
            assert!(endpoint(bad).is_err(), "{bad}");
        }
    }
}
