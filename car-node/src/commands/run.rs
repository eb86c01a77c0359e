//! `car-node run`.

use std::env;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};
use car_node::localization::Start;
use car_node::node::exposure;
use car_node::node::{Node, NodeConfig, RaceMap};
use car_node::recording::RecordOptions;
use car_node::ros2::graph::RosNode;
use car_node::ros2::output::RosSink;
use car_node::ros2::output_publisher::{self, OutputOptions, RosConnection};
use car_node::ros2::services;
use car_node::ros2::topics;
use car_node::sensors::{BagPlayer, Race, Ros2, Ros2Options, Source};
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use keys::{Protection, Role};
use maps::{OccupancyGrid, Raceline};
use protocol::CarName;
use simulator::{CarSetup, Grip, OdometryParams, YawSource};
use synpf::{TablePolicy, TrackMap};

use super::health::Heartbeat;
use crate::cli::{Odometry, Run, Size, SourceKind};

/// Time after the last message of a bag for the pit wall to recover gaps.
const LINGER: Duration = Duration::from_secs(1);

/// The name of a car that is simulated or comes from a bag.
const DEFAULT_NAME: &str = "car-1";

pub(crate) fn run(arguments: &Run) -> anyhow::Result<()> {
    let car = name(arguments)?;
    super::placement::place(arguments.cpus.as_deref(), arguments.priority)?;
    let signal = signals()?;
    // First: wrong keys should show before a bag is read.
    let protection = protection(arguments, &car)?;
    let (mut ros, mut ros_sink) = (None, None);
    let (map, source, start): (_, Box<dyn Source>, _) = match (arguments.source, &arguments.bag) {
        (SourceKind::Bag, Some(bag)) => {
            let mut log = super::read_bag(bag, &arguments.topics)?;
            log.mount = Some(super::mount(bag, &log));
            let player = BagPlayer::new(bag.clone(), log);
            (map_file(arguments)?, Box::new(player), Start::Global)
        }
        (SourceKind::Bag, None) => bail!("--source bag needs --bag BAG"),
        (SourceKind::Ros2, _) => {
            if arguments.connect.is_empty() {
                let text = "--source ros2 needs --connect ENDPOINT, such as tcp/192.168.1.10:7447: the default port on the \
                            car belongs to ROS, not to a pit wall";
                bail!(super::BadUsage(text.into()));
            }
            // The map first, so that its faults show without ROS.
            let map = map_file(arguments)?;
            let source = ros2(arguments, &car, &signal)?;
            let connection = source.ros_connection().clone();
            let ros_node = connection
                .announce()
                .map_err(|error| anyhow!("cannot join the ROS graph: {error}"))?;
            // Two localizers must not publish the same transform.
            if let Some(topic) = &arguments.topics.external_pose_topic {
                eprintln!("{car}: nothing is published to ROS: the localizer on {topic} serves the car");
            } else {
                ros_sink = Some(ros_output(arguments, &car, &connection, &ros_node, &map)?);
            }
            ros = Some((connection, ros_node));
            (map, Box::new(source), Start::Global)
        }
        (SourceKind::Simulator, _) => {
            let track = super::find_track(&arguments.map.to_string_lossy(), arguments.raceline.as_deref())?;
            let map = race_map(
                track.name.clone(),
                track.grid.clone(),
                Some(track.raceline.clone()),
                arguments.table_memory,
            )
            .with_context(|| arguments.map.display().to_string())?;
            let race = Race::new(track, vec![setup(arguments.odometry)], arguments.seed, Vec::new());
            (map, Box::new(race.car(0)), Start::Truth)
        }
    };
    let description = source.description();
    let mut config = NodeConfig::new(car.clone(), map, source);
    config.set = super::chosen_set(arguments.params.as_deref(), arguments.localizer)?;
    config.beside = super::set_beside(arguments.beside.as_deref(), config.set.as_ref())?;
    super::check_pose_topic(
        config.set.iter().chain(&config.beside),
        arguments.topics.external_pose_topic.as_deref(),
    )?;
    config.start = arguments.initial_pose.unwrap_or(start);
    config.seed = arguments.seed;
    config.rate = arguments.rate;
    config.connect.clone_from(&arguments.connect);
    config.search = protection.protects() || arguments.insecure;
    if let Some(text) = exposure(&config.connect, &protection, config.search) {
        eprintln!("{car}: warning: {text}");
    }
    config.protection = protection;
    config.rates.recorded = !arguments.no_recorded;
    config.predict = arguments.predict;
    config.ros = ros_sink;
    config.state = arguments
        .state
        .clone()
        .or_else(|| default_state_folder(car.as_str()));
    config.record = record_options(arguments, config.state.as_deref());
    let searches = config.search;
    let state = config.state.clone();
    let node = Node::start(config)?;
    let _services = ros
        .map(|(connection, ros_node)| ros_services(&connection, &ros_node, &node))
        .transpose()?;
    let wall = sought(arguments, searches);
    eprintln!("{car}: {description}; connects to {wall}. Ctrl-C ends it.");
    let reason = wait(
        &car,
        &node,
        &signal,
        arguments.stay,
        Heartbeat::new(state.as_deref()),
    );
    let estimate = node.shared().latest_pose();
    node.shutdown(reason);
    let last = estimate.map_or_else(
        || "there was no pose".to_owned(),
        |estimate| {
            let pose = estimate.pose;
            let heading = pose.heading.to_degrees();
            format!("last pose {:.2}, {:.2} m, {heading:.1} deg", pose.x, pose.y)
        },
    );
    eprintln!("{car}: {reason}; {last}.");
    Ok(())
}

/// The pit wall that the car connects to, in words.
fn sought(arguments: &Run, searches: bool) -> String {
    if arguments.connect.is_empty() {
        let nearby = if searches { " or nearby" } else { "" };
        format!("a pit wall on this machine{nearby}")
    } else {
        arguments.connect.join(", ")
    }
}

/// The car's name. A real car has no default: two of them would have the same.
fn name(arguments: &Run) -> anyhow::Result<CarName> {
    match &arguments.car {
        Some(car) => Ok(car.clone()),
        None => Ok(CarName::new(DEFAULT_NAME)?),
    }
}

/// Where to record on the car: where the user says, else beside the car's state; None on a car without either.
fn record_options(arguments: &Run, state: Option<&Path>) -> Option<RecordOptions> {
    let folder = arguments.record.clone();
    let start = folder.is_some();
    Some(RecordOptions {
        folder: folder.or_else(|| Some(state?.join("recordings")))?,
        limit: arguments.record_limit.0,
        split: arguments.record_split.0,
        start,
    })
}

/// The keys or the passphrase of the command line.
fn protection(arguments: &Run, car: &CarName) -> anyhow::Result<Protection> {
    let variable = |name| {
        env::var_os(name)
            .filter(|value| !value.is_empty())
            .map(PathBuf::from)
    };
    let (keys, passphrase) = match (&arguments.keys, &arguments.passphrase_file) {
        (None, None) => {
            let keys = variable("SYNPF_KEYS");
            let passphrase = variable("SYNPF_PASSPHRASE_FILE").filter(|_| keys.is_none());
            (keys, passphrase)
        }
        (keys, passphrase) => (keys.clone(), passphrase.clone()),
    };
    let protection = Protection::read(keys.as_deref(), passphrase.as_deref(), &[Role::Car], Some(car))?;
    for endpoint in &arguments.connect {
        protection.check_endpoint(endpoint).map_err(super::BadUsage)?;
    }
    if let Some(file) = keys
        .iter()
        .chain(&passphrase)
        .find(|file| keys::open_to_others(file))
    {
        eprintln!(
            "{car}: warning: others on this machine can read {}; chmod 600 it",
            file.display()
        );
    }
    Ok(protection)
}

/// Finds the live sensors. Prints what is missing while it waits.
fn ros2(arguments: &Run, car: &CarName, signal: &Receiver<&'static str>) -> anyhow::Result<Ros2> {
    let domain = match (arguments.ros_domain, env::var("ROS_DOMAIN_ID")) {
        (Some(domain), _) => domain,
        (None, Ok(text)) if !text.is_empty() => text
            .parse()
            .with_context(|| format!("ROS_DOMAIN_ID={text} is no ROS domain"))?,
        _ => 0,
    };
    let options = Ros2Options {
        endpoint: arguments.ros.clone(),
        domain,
        namespace: arguments.ros_namespace.clone(),
        topics: super::topics(&arguments.topics),
        initial_pose_topic: arguments.initial_pose_topic.clone(),
        // Beside another localizer, this node publishes nothing, and that one's topics may have the same names.
        outputs: if arguments.topics.external_pose_topic.is_some() {
            Vec::new()
        } else {
            let usual = topics::POSES.map(str::to_owned);
            arguments.pose_topic.iter().cloned().chain(usual).collect()
        },
        mount: arguments.topics.laser,
    };
    let mut printed = String::new();
    let source = Ros2::find(&options, |missing| {
        if missing != printed {
            missing.clone_into(&mut printed);
            eprintln!("{car}: waiting for ROS 2 (domain {domain}): {missing}");
        }
        signal.try_recv().is_err()
    })?;
    for note in source.notes() {
        eprintln!("{car}: {note}");
    }
    if source.mount_is_a_guess() {
        super::warn_of_guess("ROS 2");
    }
    Ok(source)
}

/// Publishes to the car's own nodes.
fn ros_output(
    arguments: &Run,
    car: &CarName,
    connection: &RosConnection,
    node: &Arc<RosNode>,
    map: &RaceMap,
) -> anyhow::Result<RosSink> {
    let options = OutputOptions {
        pose_topic: arguments.pose_topic.clone(),
        transform: !arguments.no_tf,
    };
    let (sink, _) = output_publisher::start(connection, node, &options, car.as_str(), map.map.grid())
        .map_err(|error| anyhow!("cannot publish to ROS: {error}"))?;
    Ok(sink)
}

/// Starts the node's ROS services. They end when what is returned is dropped.
fn ros_services(connection: &RosConnection, ros_node: &RosNode, node: &Node) -> anyhow::Result<Sender<()>> {
    let (stop, stops) = bounded(0);
    services::start(connection, ros_node, node.local_commands().clone(), stops)
        .map_err(|error| anyhow!("cannot serve ROS: {error}"))?;
    Ok(stop)
}

/// Waits for the end of the node, and returns the reason.
fn wait(
    car: &CarName,
    node: &Node,
    signal: &Receiver<&'static str>,
    stay: bool,
    mut heartbeat: Heartbeat,
) -> &'static str {
    let mut ended = None;
    loop {
        for refusal in keys::refusals::take() {
            eprintln!("{car}: {refusal}");
        }
        match signal.recv_timeout(Duration::from_millis(50)) {
            Ok(reason) => return reason,
            Err(RecvTimeoutError::Disconnected) => return "the signal handler ended",
            Err(RecvTimeoutError::Timeout) => {}
        }
        let estimate = node.shared().latest_pose().map(|estimate| estimate.stamp);
        heartbeat.beat(estimate, node.source_ended());
        if !stay && node.source_ended() && ended.get_or_insert_with(Instant::now).elapsed() > LINGER {
            return "end of the bag";
        }
    }
}

/// Receives the name of the signal that ends the node.
fn signals() -> anyhow::Result<Receiver<&'static str>> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let (sender, signal) = bounded(1);
    std::thread::Builder::new()
        .name("signals".into())
        .spawn(move || {
            let reason = runtime.block_on(async {
                let Ok(mut terminate) =
                    tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())
                else {
                    return "the signal handler ended";
                };
                tokio::select! {
                    _ = tokio::signal::ctrl_c() => "interrupted",
                    _ = terminate.recv() => "terminated",
                }
            });
            sender.send(reason).ok();
        })?;
    Ok(signal)
}

fn map_file(arguments: &Run) -> anyhow::Result<RaceMap> {
    let grid = OccupancyGrid::load(&arguments.map)?;
    let beside = arguments.map.with_file_name("raceline.csv");
    let raceline = match &arguments.raceline {
        Some(path) => Some(Raceline::load(path)?),
        None if beside.exists() => Some(Raceline::load(beside)?),
        None => None,
    };
    // A map has the name of its folder when its file is only called map.
    let stem = arguments.map.file_stem().unwrap_or_default().to_string_lossy();
    let folder = arguments.map.parent().and_then(Path::file_name);
    let name = match folder {
        Some(folder) if stem == "map" => folder.to_string_lossy(),
        _ => stem,
    };
    race_map(name.into_owned(), grid, raceline, arguments.table_memory)
        .with_context(|| arguments.map.display().to_string())
}

fn race_map(
    name: String,
    grid: OccupancyGrid,
    raceline: Option<Raceline>,
    table_memory: Size,
) -> anyhow::Result<RaceMap> {
    let map = TrackMap::new(grid)?
        .with_table_policy(TablePolicy::Defer)
        .with_table_budget(table_memory.0 as usize);
    Ok(RaceMap {
        name,
        map: Arc::new(map),
        raceline: raceline.map(Arc::new),
    })
}

/// The simulated car. On taped tyres its odometry derives the yaw rate from the steering alone.
fn setup(odometry: Odometry) -> CarSetup {
    let mut setup = CarSetup::default();
    if odometry == Odometry::Lq {
        setup.vehicle = setup.vehicle.with_grip(Grip::LQ);
        setup.odometry = OdometryParams {
            yaw_source: YawSource::Steering,
            ..setup.odometry
        };
    }
    setup
}

/// `$XDG_STATE_HOME/synpf/<car>`, by default in `~/.local/state`; None for a user without a home folder.
fn default_state_folder(car: &str) -> Option<PathBuf> {
    let base = env::var_os("XDG_STATE_HOME")
        .filter(|folder| !folder.is_empty())
        .map(PathBuf::from)
        .or_else(|| Some(PathBuf::from(env::var_os("HOME")?).join(".local/state")))?;
    Some(base.join("synpf").join(car))
}
