//! Live sensors of a ROS 2 car, over zenoh and without ROS. The car's nodes use `rmw_zenoh`, or run behind a
//! zenoh-bridge-ros2dds.
//!
//! `rmw_zenoh` names a topic `<domain>/<topic>/<type>/<hash>` (its `design.md`); the bridge names it `<topic>`. The payload
//! is the same CDR. With `rmw_zenoh` the sensors are discovered by their types, as in a bag. Behind a bridge they are
//! discovered by the usual names in any namespace, or by names that are given.
//!
//! An initial pose and a request for a global search come on one topic each, in the car's namespace. Other topics of the same
//! types, such as the poses of other localizers, are not subscribed to. Neither is what this node publishes.

mod choice;
mod clock_follower;
mod discovery;
mod ros_graph;
mod topics;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, bounded};
use maps::Pose;
use nalgebra::UnitQuaternion;
use synpf::{PoseOf, Stamp};
use zenoh::sample::Locality;
use zenoh::{Config, Session, Wait};
use zenoh_ext::{AdvancedSubscriberBuilderExt, HistoryConfig};

use self::choice::{Choice, is_transform_topic_of, mount, namespace_of};
use self::clock_follower::ClockFollower;
use self::discovery::{Discovered, discover};
use self::ros_graph::RosGraph;
use self::topics::{Content, Intake, Kind, TopicMessage, listener, pose_listener};
use super::{Feed, Next, PoseEstimate, Source};
use crate::ros2::graph::Naming;
use crate::ros2::messages::{PoseWithCovarianceStamped, TfMessage, Time};
use crate::ros2::output_publisher::RosConnection;
use crate::ros2::topics as outputs;
use crate::sensors::bag::{SensorEvent, Topics};
use crate::sensors::clock::{SensorClock, StampShift, wall_now};
use crate::sensors::external_pose::{PoseFrames, PoseMessage};
use crate::sensors::frames::{Frames, Mount};
use crate::sensors::sweep_stamps::LiveSweepStamps;

/// Which ROS side to connect to, and which topics to take.
#[derive(Debug, Clone, PartialEq)]
pub struct Ros2Options {
    /// The ROS side's zenoh router or bridge.
    pub endpoint: String,
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// The car's namespace, with a leading slash; None takes any, in order of the names.
    pub namespace: Option<String>,
    /// Topics to take; None takes what sends, the usual names first.
    pub topics: Topics,
    /// Topic of initial poses; None takes `/initialpose` in the car's namespace.
    pub initial_pose_topic: Option<String>,
    /// Topics that this node publishes on. They are never inputs.
    pub outputs: Vec<String>,
    /// How the laser is mounted; None takes it from `/tf_static` and `/tf`.
    pub mount: Option<Mount>,
}

impl Ros2Options {
    /// The default endpoint of `rmw_zenoh`'s router and of the bridge.
    pub const ENDPOINT: &'static str = "tcp/127.0.0.1:7447";

    /// Any car of domain 0 at an endpoint.
    pub fn new(endpoint: &str) -> Self {
        Self {
            endpoint: endpoint.to_owned(),
            domain: 0,
            namespace: None,
            topics: Topics::default(),
            initial_pose_topic: None,
            outputs: outputs::POSES.map(str::to_owned).to_vec(),
            mount: None,
        }
    }

    /// Refuses a topic that is both an input and an output.
    fn check(&self) -> Result<(), Ros2Error> {
        let Topics {
            scan,
            odometry,
            imu,
            pose,
            ..
        } = &self.topics;
        let inputs = [scan, odometry, imu, pose, &self.initial_pose_topic];
        let same = |a: &str, b: &str| a.trim_matches('/') == b.trim_matches('/');
        match inputs
            .into_iter()
            .flatten()
            .find(|input| self.outputs.iter().any(|output| same(input, output)))
        {
            Some(topic) => Err(Ros2Error::OwnOutput(topic.clone())),
            None => Ok(()),
        }
    }

    /// The same, with every name as ROS resolves it: with a leading slash and none at the end.
    fn resolved(&self) -> Self {
        let absolute =
            |name: &Option<String>| name.as_deref().map(|name| format!("/{}", name.trim_matches('/')));
        let namespace = self.namespace.as_deref().map(|name| name.trim_matches('/'));
        Self {
            namespace: namespace
                .filter(|name| !name.is_empty())
                .map(|name| format!("/{name}")),
            topics: Topics {
                scan: absolute(&self.topics.scan),
                odometry: absolute(&self.topics.odometry),
                imu: absolute(&self.topics.imu),
                truth: None,
                pose: absolute(&self.topics.pose),
                pose_of: self.topics.pose_of,
            },
            initial_pose_topic: absolute(&self.initial_pose_topic),
            ..self.clone()
        }
    }
}

/// Why there are no live sensors.
#[derive(Debug, thiserror::Error)]
pub enum Ros2Error {
    /// zenoh refuses the endpoint or the domain.
    #[error("{0}")]
    Zenoh(String),
    /// A topic to take is one that this node publishes on.
    #[error("{0}: this node publishes on it, so it cannot take it as an input")]
    OwnOutput(String),
    /// The caller stopped waiting.
    #[error("stopped while waiting for ROS 2: {missing}")]
    Stopped {
        /// What was missing.
        missing: String,
    },
}

/// Messages that wait: those of a start that takes long.
const QUEUE: usize = 4096;
/// Longest wait for the next message.
const PATIENCE: Duration = Duration::from_millis(100);
/// A scan that has waited for longer is skipped, so that a late filter catches up. Odometry is not: it is cheap, and the pose
/// is carried by it.
const SCAN_WAITS: Duration = Duration::from_secs(1);
/// A smaller offset of the sensors' clock is not worth a message \[s\].
const OFFSET_SAID: f64 = 0.1;
/// A transform that moves the laser by less changes nothing \[m\], \[rad\].
const SAME_MOUNT: f64 = 1e-3;

/// The live sensors of a car.
pub struct Ros2 {
    messages: Receiver<TopicMessage>,
    intake: Intake,
    endpoint: String,
    choice: Choice,
    initial_pose: String,
    /// The topic of another localizer's poses, and what they are of.
    pose: (Option<String>, Option<PoseOf>),
    /// Frames of the laser, the IMU and the car.
    scan_frame: String,
    imu_frame: Option<String>,
    base_link: String,
    frames: Frames,
    mount: Mount,
    /// The mount was given, and no transform changes it.
    given: bool,
    /// The mount is a guess, since no transform says it.
    guessed: bool,
    base_link_from_imu: UnitQuaternion<f64>,
    clock: SensorClock,
    follower: ClockFollower,
    sweep_stamps: LiveSweepStamps,
    /// Arrivals are counted from here.
    epoch: Instant,
    /// Odometry has come; scans before that are of no use.
    has_odometry: bool,
    /// The last scan's and the last odometry's stamp as they came.
    last: [Option<Time>; 2],
    /// Feeds that are due at once.
    pending: VecDeque<Feed>,
    /// What is worth knowing about the choice of topics.
    notes: Vec<String>,
    /// Messages that do not decode, by topic.
    undecodable: BTreeMap<String, u64>,
    /// Messages that were dropped because the queue was full, as last said; scans that were skipped.
    dropped: u64,
    skipped: u64,
    /// For publishing to the car's own nodes.
    ros: RosConnection,
    _graph: RosGraph,
    _subscribers: Vec<Box<dyn Send>>,
    _session: Session,
}

impl Ros2 {
    /// Finds the sensors. Blocks until there are a scan and odometry. Calls `waiting` every second with what is missing, and
    /// gives up when it returns false.
    pub fn find(options: &Ros2Options, mut waiting: impl FnMut(&str) -> bool) -> Result<Self, Ros2Error> {
        let options = &options.resolved();
        options.check()?;
        let session = open(&options.endpoint, &mut waiting)?;
        let (sender, messages) = bounded(QUEUE);
        let intake = Intake::new(sender);
        let subscription = Subscription {
            session: &session,
            domain: options.domain,
            intake: &intake,
        };
        let mut subscribers = Vec::new();
        for kind in Kind::DISCOVERED {
            subscribers.extend(subscription.by_type(kind, &options.topics)?);
        }
        let mut graph = RosGraph::watch(&session)
            .map_err(|error| Ros2Error::Zenoh(format!("cannot watch the ROS graph: {error}")))?;
        let found = discover(&messages, options, &mut graph, &mut waiting)?;
        let in_namespace = |kind: Kind| format!("{}{}", found.choice.namespace, kind.usual_names()[0]);
        let initial_pose = options
            .initial_pose_topic
            .clone()
            .unwrap_or_else(|| in_namespace(Kind::InitialPose));
        let clicked_point = in_namespace(Kind::ClickedPoint);
        subscribers.extend(subscription.by_name(Kind::InitialPose, &initial_pose)?);
        subscribers.extend(subscription.by_name(Kind::ClickedPoint, &clicked_point)?);
        if let Some(topic) = &options.topics.pose {
            subscribers.extend(subscription.poses(topic)?);
        }
        // Publishers that were not chosen may stop again.
        graph.rename(
            options.domain,
            &found.choice.namespace,
            |kind, topic| match kind {
                Kind::Transforms => is_transform_topic_of(topic, &found.choice.scan),
                _ => found.choice.has_sensor(topic),
            },
        );
        let notes = notes(&found, options);
        let found_mount = found.mount().map(|(mount, _)| mount);
        let mount = options.mount.or(found_mount);
        let Discovered {
            choice,
            scan_frame,
            imu_frame,
            odometry,
            frames,
            offset,
            ..
        } = found;
        let clock = SensorClock::starting_at(wall_now().plus(offset), 1.0);
        let source = Self {
            messages,
            endpoint: options.endpoint.clone(),
            mount: mount.unwrap_or_else(Mount::typical),
            given: options.mount.is_some(),
            guessed: mount.is_none(),
            follower: ClockFollower::new(Stamp(0), clock.now()),
            sweep_stamps: LiveSweepStamps::default(),
            epoch: Instant::now(),
            clock,
            ros: RosConnection {
                session: session.clone(),
                naming: odometry
                    .hash
                    .map_or(Naming::Bridge, |odometry_hash| Naming::RmwZenoh {
                        domain: options.domain,
                        odometry_hash,
                    }),
                namespace: choice.namespace.clone(),
                odom: odometry.odom,
                base_link: odometry.base_link.clone(),
                shift: StampShift::default(),
            },
            base_link_from_imu: imu_rotation(&frames, &odometry.base_link, imu_frame.as_deref()),
            scan_frame,
            imu_frame,
            base_link: odometry.base_link,
            frames,
            has_odometry: false,
            last: [None; 2],
            pending: notes.iter().cloned().map(Feed::Log).collect(),
            notes,
            pose: (options.topics.pose.clone(), options.topics.pose_of),
            initial_pose,
            undecodable: BTreeMap::new(),
            dropped: 0,
            skipped: 0,
            choice,
            intake,
            _graph: graph,
            _subscribers: subscribers,
            _session: session,
        };
        source.read_only(clicked_point);
        Ok(source)
    }

    /// Reads only the topics that were chosen from now on, and lets other nodes know.
    fn read_only(&self, clicked_point: String) {
        let Choice {
            scan, odometry, imu, ..
        } = &self.choice;
        let mut wanted = BTreeSet::from([
            scan.clone(),
            odometry.clone(),
            self.initial_pose.clone(),
            clicked_point,
        ]);
        wanted.extend(imu.clone());
        let mut namespace = namespace_of(scan);
        loop {
            wanted.insert(format!("{namespace}/tf_static"));
            // A laser does not move while the car runs: what moves is of interest only until the mount is known.
            if self.guessed {
                wanted.insert(format!("{namespace}/tf"));
            }
            if namespace.is_empty() {
                break;
            }
            namespace = namespace_of(namespace);
        }
        self.intake.read_only(wanted);
    }

    /// True when the laser's pose is a guess: the place where most cars have it.
    pub fn mount_is_a_guess(&self) -> bool {
        self.guessed
    }

    /// What is worth knowing about the choice of topics, for people.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// For publishing to the car's own nodes.
    pub fn ros_connection(&self) -> &RosConnection {
        &self.ros
    }

    /// What the filter gets of a message; None when its topic was not chosen.
    fn feed(&mut self, message: TopicMessage) -> Option<Feed> {
        let TopicMessage {
            topic,
            arrival,
            content,
            ..
        } = message;
        match content {
            Ok(Content::Scan(scan)) if topic == self.choice.scan => {
                if !self.has_odometry || !is_new(&mut self.last[0], scan.header.stamp) {
                    return None;
                }
                let stamp = self.followed(Kind::Scan, scan.header.stamp, arrival);
                if arrival.elapsed() > SCAN_WAITS {
                    return self.skip_scan();
                }
                let mut scan = scan.to_scan(self.mount.upside_down);
                let (age, sweep) = (self.clock.at(arrival).since(stamp), scan.sweep());
                if let Some(found) = self.sweep_stamps.learn(age, sweep) {
                    self.pending.push_back(Feed::Log(found.text(&topic)));
                }
                scan.stamp = self.sweep_stamps.first_beam(stamp, sweep);
                Some(Feed::Sensor(SensorEvent::Scan(scan)))
            }
            Ok(Content::Odometry(odometry)) if topic == self.choice.odometry => {
                if !is_new(&mut self.last[1], odometry.header.stamp) {
                    return None;
                }
                self.has_odometry = true;
                let mut event = odometry.to_odometry();
                event.stamp = self.followed(Kind::Odometry, odometry.header.stamp, arrival);
                Some(Feed::Sensor(SensorEvent::Odometry(event)))
            }
            Ok(Content::Imu(imu)) if Some(&topic) == self.choice.imu.as_ref() => {
                let mut event = imu.yaw_rate_turned(&self.base_link_from_imu);
                event.stamp = self.followed(Kind::Imu, imu.header.stamp, arrival);
                Some(Feed::Sensor(SensorEvent::YawRate(event)))
            }
            Ok(Content::InitialPose(pose)) => Some(initial_pose(&topic, &pose)),
            Ok(Content::ClickedPoint) => Some(Feed::GlobalSearch { by: topic }),
            Ok(Content::Pose(message)) => self.external_pose(&topic, &message),
            Ok(Content::Transforms(message)) if is_transform_topic_of(&topic, &self.choice.scan) => {
                self.late_transforms(&topic, &message)
            }
            Ok(_) => None,
            Err(error) => {
                let count = self.undecodable.entry(topic.clone()).or_insert(0);
                *count += 1;
                count
                    .is_power_of_two()
                    .then(|| Feed::Log(format!("{topic}: {count} messages do not decode: {error}")))
            }
        }
    }

    /// A pose of another localizer, its stamp on the filter's clock.
    fn external_pose(&mut self, topic: &str, message: &PoseMessage) -> Option<Feed> {
        let frames = PoseFrames {
            laser: self.scan_frame.clone(),
            odom: self.ros.odom.clone(),
            of: self.pose.1,
        };
        match frames.pose_of(message) {
            Ok(pose) => pose.map(|mut pose| {
                pose.stamp = Stamp(pose.stamp.0.saturating_add(self.follower.shift()));
                Feed::Sensor(SensorEvent::Pose(pose))
            }),
            Err(fault) => {
                let count = self.undecodable.entry(topic.to_owned()).or_insert(0);
                *count += 1;
                count
                    .is_power_of_two()
                    .then(|| Feed::Log(format!("{topic}: {count} poses are not taken: {fault}")))
            }
        }
    }

    /// A stamp on the filter's clock. What the message says of the sensors' clock is queued.
    fn followed(&mut self, kind: Kind, stamp: Time, arrival: Instant) -> Stamp {
        let arrived = Stamp(0).plus(arrival.saturating_duration_since(self.epoch).as_secs_f64());
        let followed = self.follower.follow(kind, stamp.into(), arrived);
        let topic = match kind {
            Kind::Scan => &self.choice.scan,
            Kind::Imu => self.choice.imu.as_ref().unwrap_or(&self.choice.odometry),
            _ => &self.choice.odometry,
        };
        if let Some(step) = followed.step {
            self.ros.shift.set(self.follower.shift());
            let way = if step < 0.0 { "back" } else { "forward" };
            let text = format!(
                "the clock of {topic} was set {way} by {:.2} s; its stamps are followed",
                step.abs()
            );
            self.pending.push_back(Feed::Clock {
                moved: 0.0,
                step: Some(step),
                text: Some(text),
            });
        } else {
            self.ros.shift.set(self.follower.shift());
        }
        if followed.flapping {
            let text = format!("{topic}: stamps go back and forth; are there two publishers on it?");
            self.pending.push_back(Feed::Log(text));
        }
        if let Some(setting) = followed.clock {
            let since = arrival.elapsed().as_secs_f64();
            self.clock
                .set(setting.sensor.plus(since * setting.rate), setting.rate);
            let text = setting.said.then(|| {
                let (by, rate) = (setting.by, setting.rate);
                format!(
                    "the sensors' clock is followed: moved by {by:.2} s, it runs at {rate:.2} of real time"
                )
            });
            self.pending.push_back(Feed::Clock {
                moved: setting.by,
                step: None,
                text,
            });
        }
        followed.stamp
    }

    /// Skips a scan that has waited too long, and says so now and then.
    fn skip_scan(&mut self) -> Option<Feed> {
        self.skipped += 1;
        self.skipped.is_power_of_two().then(|| {
            Feed::Log(format!(
                "{} scans were skipped: they had waited for more than {} s",
                self.skipped,
                SCAN_WAITS.as_secs()
            ))
        })
    }

    /// Takes in transforms that came after the choice of topics. One that says how the laser is mounted replaces what was known.
    fn late_transforms(&mut self, topic: &str, message: &TfMessage) -> Option<Feed> {
        for transform in &message.transforms {
            self.frames.insert(transform);
        }
        self.base_link_from_imu = imu_rotation(&self.frames, &self.base_link, self.imu_frame.as_deref());
        if self.given {
            return None;
        }
        let (mount, base) = mount(&self.frames, &self.base_link, &self.scan_frame)?;
        let (new, old) = (mount.base_link_from_laser, self.mount.base_link_from_laser);
        let same =
            new.distance(old) < SAME_MOUNT && maps::wrap_angle(new.heading - old.heading).abs() < SAME_MOUNT;
        let guessed = std::mem::take(&mut self.guessed);
        if guessed {
            self.read_only(format!(
                "{}{}",
                self.choice.namespace,
                Kind::ClickedPoint.usual_names()[0]
            ));
        }
        if same && mount.upside_down == self.mount.upside_down {
            return guessed.then(|| Feed::Log(format!("{topic}: the laser is where it was assumed")));
        }
        let turned = mount.upside_down != self.mount.upside_down;
        self.mount = mount;
        let Pose { x, y, heading } = new;
        let way = if mount.upside_down { ", upside down" } else { "" };
        let text = format!(
            "{topic}: the laser is at {x:.3}, {y:.3} m, {:.1} deg on {base}{way}",
            heading.to_degrees()
        );
        Some(Feed::Mount { mount, turned, text })
    }
}

/// True for a stamp other than the last one. With several ways to a publisher a message may come twice.
fn is_new(last: &mut Option<Time>, stamp: Time) -> bool {
    last.replace(stamp) != Some(stamp)
}

/// How the IMU is turned on the car; upright where the transforms do not say.
fn imu_rotation(frames: &Frames, base_link: &str, imu: Option<&str>) -> UnitQuaternion<f64> {
    imu.and_then(|imu| {
        [base_link, "base_link", "base_footprint"]
            .into_iter()
            .find_map(|base| frames.rotation(base, imu))
    })
    .unwrap_or_default()
}

/// What is worth knowing about the choice of topics.
fn notes(found: &Discovered, options: &Ros2Options) -> Vec<String> {
    let mut notes = Vec::new();
    if let Some(others) = &found.not_taken {
        let Choice { scan, odometry, .. } = &found.choice;
        notes.push(format!("taken are {scan} and {odometry}; not taken: {others}"));
    }
    let (base_link, laser) = (&found.odometry.base_link, &found.scan_frame);
    match found.mount() {
        Some((_, base)) if options.mount.is_none() && &base != base_link => {
            notes.push(format!(
                "no transform from {base_link}, which odometry moves, to {laser}; the one from {base} is taken"
            ));
        }
        None if options.mount.is_none() && !found.frames.is_empty() => {
            notes.push(format!(
                "no transform from {base_link} to {laser}: the laser's pose is assumed until one comes"
            ));
        }
        _ => {}
    }
    if found.offset.abs() > OFFSET_SAID {
        notes.push(format!(
            "the sensors' clock differs from this machine's by {:.2} s; it is followed",
            found.offset
        ));
    }
    notes
}

/// An initial pose, such as from `RViz`. One that is not in the frame `map` is refused.
fn initial_pose(topic: &str, message: &PoseWithCovarianceStamped) -> Feed {
    let frame = message.header.frame_id.trim_start_matches('/');
    let pose = message.pose.planar();
    if frame != "map" {
        Feed::Log(format!(
            "{topic}: initial pose refused: its frame is {frame:?} and not \"map\""
        ))
    } else if !pose.is_finite() {
        Feed::Log(format!("{topic}: initial pose refused: it is not finite"))
    } else {
        Feed::InitialPose {
            pose,
            by: topic.to_owned(),
        }
    }
}

impl Source for Ros2 {
    fn description(&self) -> String {
        let Choice {
            scan, odometry, imu, ..
        } = &self.choice;
        let imu = imu.as_ref().map_or(String::new(), |imu| format!(", {imu}"));
        let pose = self
            .pose
            .0
            .as_ref()
            .map_or(String::new(), |pose| format!(", {pose}"));
        format!(
            "ROS 2 at {}: {scan}, {odometry}{imu}{pose}; initial poses from {}",
            self.endpoint, self.initial_pose
        )
    }

    fn pose_topic(&self) -> Option<&str> {
        self.pose.0.as_deref()
    }

    fn mount(&self) -> Mount {
        self.mount
    }

    fn clock(&mut self, _: f64) -> SensorClock {
        self.clock.clone()
    }

    fn start(&self) -> Option<Pose> {
        None
    }

    fn next(&mut self, _: Option<PoseEstimate>) -> Next {
        if let Some(feed) = self.pending.pop_front() {
            return Next::Due(self.clock.now(), feed);
        }
        let dropped = self.intake.dropped();
        // Said whenever the number has doubled.
        if dropped > 2 * self.dropped {
            self.dropped = dropped;
            let text = format!(
                "{dropped} messages from ROS were dropped: they came faster than they could be taken"
            );
            return Next::Due(self.clock.now(), Feed::Log(text));
        }
        match self.messages.recv_timeout(PATIENCE) {
            Ok(message) => match self.feed(message) {
                // What was found out about the clock comes first.
                Some(feed) if !self.pending.is_empty() => {
                    self.pending.push_back(feed);
                    self.next(None)
                }
                Some(feed) => Next::Due(self.clock.now(), feed),
                None => Next::Quiet,
            },
            Err(RecvTimeoutError::Timeout) => Next::Quiet,
            Err(RecvTimeoutError::Disconnected) => Next::End,
        }
    }
}

/// Joins the ROS side as one of its nodes does: as a peer of the other nodes, introduced by the router, so that they still hear
/// each other when the router is gone. Retries until the router answers.
fn open(endpoint: &str, waiting: &mut impl FnMut(&str) -> bool) -> Result<Session, Ros2Error> {
    let settings = [
        ("mode", r#""peer""#.to_owned()),
        ("connect/endpoints", serde_json::json!([endpoint]).to_string()),
        ("connect/timeout_ms", "1000".to_owned()),
        ("connect/exit_on_failure", "true".to_owned()),
        (
            "connect/retry",
            r#"{"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2}"#.to_owned(),
        ),
        ("listen/endpoints", r#"["tcp/127.0.0.1:0"]"#.to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "true".to_owned()),
        // As rmw_zenoh's sessions: of two peers, the one with the greater number dials.
        (
            "scouting/gossip/autoconnect_strategy",
            r#"{"peer": {"to_router": "always", "to_peer": "greater-zid"}}"#.to_owned(),
        ),
        // Caches for late subscribers need it.
        ("timestamping/enabled", "true".to_owned()),
    ];
    let mut config = Config::default();
    for (key, value) in settings {
        config
            .insert_json5(key, &value)
            .map_err(|error| Ros2Error::Zenoh(format!("zenoh refuses {key} = {value}: {error}")))?;
    }
    loop {
        let begun = Instant::now();
        match zenoh::open(config.clone()).wait() {
            Ok(session) => return Ok(session),
            Err(error) => {
                tracing::debug!(%error, "no router");
                let missing = format!("no zenoh router or bridge answers at {endpoint}");
                if !waiting(&missing) {
                    return Err(Ros2Error::Stopped { missing });
                }
                std::thread::sleep(Duration::from_secs(1).saturating_sub(begun.elapsed()));
            }
        }
    }
}

/// Where subscribers are declared, and where their messages go.
struct Subscription<'a> {
    session: &'a Session,
    domain: u32,
    intake: &'a Intake,
}

/// A subscriber of any kind, which ends when it is dropped.
type AnySubscriber = Box<dyn Send>;

impl Subscription<'_> {
    /// Every topic of a type with `rmw_zenoh`; behind a bridge the name that was asked for, or the usual ones in any namespace.
    fn by_type(&self, kind: Kind, asked: &Topics) -> Result<Vec<AnySubscriber>, Ros2Error> {
        let rmw = format!("{}/**/{}/*", self.domain, kind.ros_type().dds);
        let bridged: Vec<String> = if let Some(name) = kind.asked(asked) {
            vec![name.trim_matches('/').to_owned()]
        } else {
            let names = kind.usual_names().iter();
            names
                .map(|name| format!("**/{}", name.trim_matches('/')))
                .collect()
        };
        std::iter::once(rmw)
            .chain(bridged)
            .map(|key| self.declare(kind, &key))
            .collect()
    }

    /// One topic, with `rmw_zenoh` and behind a bridge.
    fn by_name(&self, kind: Kind, topic: &str) -> Result<Vec<AnySubscriber>, Ros2Error> {
        let name = topic.trim_matches('/');
        let rmw = format!("{}/{name}/{}/*", self.domain, kind.ros_type().dds);
        [rmw, name.to_owned()]
            .into_iter()
            .map(|key| self.declare(kind, &key))
            .collect()
    }

    /// The poses of another localizer, of any type, with `rmw_zenoh` and behind a bridge.
    fn poses(&self, topic: &str) -> Result<Vec<AnySubscriber>, Ros2Error> {
        let name = topic.trim_matches('/');
        let mut subscribers: Vec<AnySubscriber> = Vec::new();
        for key in [format!("{}/{name}/*/*", self.domain), name.to_owned()] {
            let failed =
                |error: zenoh::Error| Ros2Error::Zenoh(format!("cannot subscribe to {key}: {error}"));
            let subscriber = self
                .session
                .declare_subscriber(key.clone())
                .with(pose_listener(topic, self.intake))
                .allowed_origin(Locality::Remote);
            subscribers.push(Box::new(subscriber.wait().map_err(failed)?));
        }
        Ok(subscribers)
    }

    fn declare(&self, kind: Kind, key: &str) -> Result<AnySubscriber, Ros2Error> {
        let failed = |error: zenoh::Error| Ros2Error::Zenoh(format!("cannot subscribe to {key}: {error}"));
        // What this node publishes on the same session is no input.
        let subscriber = self
            .session
            .declare_subscriber(key.to_owned())
            .with(listener(kind, self.domain, self.intake))
            .allowed_origin(Locality::Remote);
        // Static transforms are sent once, before this node subscribes. Their publishers keep them for late subscribers.
        Ok(if kind == Kind::Transforms {
            let subscriber = subscriber
                .advanced()
                .history(HistoryConfig::default().detect_late_publishers())
                .wait()
                .map_err(failed)?;
            Box::new(subscriber)
        } else {
            Box::new(subscriber.wait().map_err(failed)?)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::messages::{Header, RosPose};

    #[test]
    fn an_initial_pose_is_taken_in_the_frame_map_only() {
        let message = |frame: &str, x| PoseWithCovarianceStamped {
            header: Header {
                frame_id: frame.into(),
                ..Header::default()
            },
            pose: RosPose::from(Pose::new(x, 2.0, 1.0)),
            ..PoseWithCovarianceStamped::default()
        };
        assert!(
            matches!(initial_pose("/initialpose", &message("map", 1.0)), Feed::InitialPose { pose, .. } if pose.distance(Pose::new(1.0, 2.0, 1.0)) < 1e-9)
        );
        assert!(
            matches!(initial_pose("/initialpose", &message("odom", 1.0)), Feed::Log(text) if text.contains("odom"))
        );
        assert!(matches!(
            initial_pose("/initialpose", &message("map", f64::NAN)),
            Feed::Log(_)
        ));
    }
}
