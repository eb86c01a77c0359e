//! `car-node run`.

use std::env;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};
use car_node::node::{Begin, Node, NodeConfig, RaceMap};
use car_node::ros2::pose_publisher;
use car_node::sensors::frames::Mount;
use car_node::sensors::{BagPlayer, PoseEstimate, Race, Ros2, Ros2Options, Source};
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use maps::{OccupancyGrid, Raceline};
use simulator::{CarSetup, Grip, OdometryParams, YawSource};
use synpf::{TablePolicy, TrackMap};

use crate::cli::{Odometry, Run, SourceKind};

/// After the last message of a bag: time for the pit wall to fetch what it has missed.
const LINGER: Duration = Duration::from_secs(1);

pub(crate) fn run(arguments: &Run) -> anyhow::Result<()> {
    let signal = signals()?;
    let mut pose_sink = None;
    let (map, source, begin): (_, Box<dyn Source>, _) = match (arguments.source, &arguments.bag) {
        (SourceKind::Bag, Some(bag)) => {
            let mut log = super::read_bag(bag, &arguments.topics)?;
            log.mount = Some(super::mount(bag, &log));
            let player = BagPlayer::new(bag.clone(), log);
            (map_file(arguments)?, Box::new(player), Begin::Global)
        }
        (SourceKind::Bag, None) => bail!("--source bag needs --bag FILE.mcap"),
        (SourceKind::Ros2, _) => {
            if arguments.connect.is_empty() {
                let text = "--source ros2 needs --connect ENDPOINT, such as tcp/192.168.1.10:7447: what answers at that \
                            port on the car is ROS, not a pit wall";
                bail!(super::BadUsage(text.into()));
            }
            // The map first: its faults show without ROS.
            let map = map_file(arguments)?;
            let source = ros2(arguments, &signal)?;
            pose_sink = pose_for_ros(arguments, &source)?;
            (map, Box::new(source), Begin::Global)
        }
        (SourceKind::Simulator, _) => {
            let track = super::find_track(&arguments.map.to_string_lossy(), arguments.raceline.as_deref())?;
            let map = race_map(
                track.name.clone(),
                track.grid.clone(),
                Some(track.raceline.clone()),
            )?;
            let race = Race::new(track, vec![setup(arguments.odometry)], arguments.seed, Vec::new());
            (map, Box::new(race.car(0)), Begin::Source)
        }
    };
    let description = source.description();
    let mut config = NodeConfig::new(arguments.car.clone(), map, source);
    config.set = arguments.params.as_deref().map(super::load_set).transpose()?;
    config.begin = arguments.initial_pose.unwrap_or(begin);
    config.seed = arguments.seed;
    config.rate = arguments.rate;
    config.connect.clone_from(&arguments.connect);
    config.rates.recorded = !arguments.no_recorded;
    config.predict = arguments.predict;
    config.pose_sink = pose_sink;
    config.state = arguments
        .state
        .clone()
        .or_else(|| default_state_folder(arguments.car.as_str()));
    let node = Node::start(config)?;
    let wall = if arguments.connect.is_empty() {
        "a pit wall on this machine or nearby".to_owned()
    } else {
        arguments.connect.join(", ")
    };
    eprintln!("{}: {description}; dials {wall}. Ctrl-C ends it.", arguments.car);
    let reason = wait(&node, &signal, arguments.stay);
    let estimate = node.shared().latest_pose();
    node.shutdown(reason);
    match estimate {
        Some(estimate) => eprintln!(
            "{}: {reason}; last at {:.2}, {:.2} m, {:.1} deg.",
            arguments.car,
            estimate.pose.x,
            estimate.pose.y,
            estimate.pose.heading.to_degrees()
        ),
        None => eprintln!("{}: {reason}; never had a pose.", arguments.car),
    }
    Ok(())
}

/// Finds the live sensors, and says what it waits for.
fn ros2(arguments: &Run, signal: &Receiver<&'static str>) -> anyhow::Result<Ros2> {
    let domain = match (arguments.ros_domain, env::var("ROS_DOMAIN_ID")) {
        (Some(domain), _) => domain,
        (None, Ok(text)) if !text.is_empty() => text
            .parse()
            .with_context(|| format!("ROS_DOMAIN_ID={text} is not a domain"))?,
        _ => 0,
    };
    let options = Ros2Options {
        endpoint: arguments.ros.clone(),
        domain,
        topics: super::topics(&arguments.topics),
        mount: arguments.topics.laser.map(Mount::upright),
    };
    let mut said = String::new();
    let source = Ros2::find(&options, |missing| {
        if missing != said {
            missing.clone_into(&mut said);
            eprintln!(
                "{}: waiting for ROS 2 (domain {domain}): {missing}",
                arguments.car
            );
        }
        signal.try_recv().is_err()
    })?;
    if source.mount_is_a_guess() {
        super::warn_of_guess("ROS 2");
    }
    Ok(source)
}

/// Where the pose goes for the car's own nodes, unless they are behind a bridge.
fn pose_for_ros(arguments: &Run, source: &Ros2) -> anyhow::Result<Option<Sender<PoseEstimate>>> {
    let Some(ros) = source.ros_connection() else {
        eprintln!(
            "car-node: warning: behind a bridge the pose is not published to ROS ({}): it takes rmw_zenoh",
            arguments.pose_topic
        );
        return Ok(None);
    };
    let (pose_sink, _) = pose_publisher::start(ros.clone(), &arguments.pose_topic)
        .map_err(|error| anyhow!("{}: cannot be published: {error}", arguments.pose_topic))?;
    Ok(Some(pose_sink))
}

/// Waits for whatever ends the node first, and says what that was.
fn wait(node: &Node, signal: &Receiver<&'static str>, stay: bool) -> &'static str {
    let mut ended = None;
    loop {
        match signal.recv_timeout(Duration::from_millis(50)) {
            Ok(reason) => return reason,
            Err(RecvTimeoutError::Disconnected) => return "signals are gone",
            Err(RecvTimeoutError::Timeout) => {}
        }
        if !stay && node.source_ended() && ended.get_or_insert_with(Instant::now).elapsed() > LINGER {
            return "end of the bag";
        }
    }
}

/// The name of the signal that ends the node, when it comes.
fn signals() -> anyhow::Result<Receiver<&'static str>> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let (tell, told) = bounded(1);
    std::thread::Builder::new()
        .name("signals".into())
        .spawn(move || {
            let reason = runtime.block_on(async {
                let Ok(mut terminate) =
                    tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())
                else {
                    return "signals are gone";
                };
                tokio::select! {
                    _ = tokio::signal::ctrl_c() => "interrupted",
                    _ = terminate.recv() => "terminated",
                }
            });
            tell.send(reason).ok();
        })?;
    Ok(told)
}

fn map_file(arguments: &Run) -> anyhow::Result<RaceMap> {
    let grid = OccupancyGrid::load(&arguments.map)?;
    let beside = arguments.map.with_file_name("raceline.csv");
    let raceline = match &arguments.raceline {
        Some(path) => Some(Raceline::load(path)?),
        None if beside.exists() => Some(Raceline::load(beside)?),
        None => None,
    };
    // A map is called by its folder when its file is only called map.
    let stem = arguments.map.file_stem().unwrap_or_default().to_string_lossy();
    let folder = arguments.map.parent().and_then(Path::file_name);
    let name = match folder {
        Some(folder) if stem == "map" => folder.to_string_lossy(),
        _ => stem,
    };
    race_map(name.into_owned(), grid, raceline).with_context(|| arguments.map.display().to_string())
}

fn race_map(name: String, grid: OccupancyGrid, raceline: Option<Raceline>) -> anyhow::Result<RaceMap> {
    Ok(RaceMap {
        name,
        map: Arc::new(TrackMap::new(grid)?.with_table_policy(TablePolicy::Defer)),
        raceline: raceline.map(Arc::new),
    })
}

/// The simulated car: on taped tyres its odometry knows its turning from the steering alone.
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

/// `$XDG_STATE_HOME/synpf/<car>`, by default in `~/.local/state`; None for a user without a home.
fn default_state_folder(car: &str) -> Option<PathBuf> {
    let base = env::var_os("XDG_STATE_HOME")
        .filter(|folder| !folder.is_empty())
        .map(PathBuf::from)
        .or_else(|| Some(PathBuf::from(env::var_os("HOME")?).join(".local/state")))?;
    Some(base.join("synpf").join(car))
}
