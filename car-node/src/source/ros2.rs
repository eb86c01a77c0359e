//! Live sensors off ROS 2, over zenoh and without ROS: a car whose nodes talk through `rmw_zenoh`, or through a
//! zenoh-bridge-ros2dds beside them.
//!
//! `rmw_zenoh` names a topic `<domain>/<topic>/<type>/<hash>` (its `design.md`), the bridge `<topic>` alone; the payload is the
//! same CDR. Under `rmw_zenoh` topics are found by their types, as in a bag; behind a bridge by the usual names, or by those
//! that are given.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};
use maps::Pose;
use serde::de::DeserializeOwned;
use synpf::Stamp;
use zenoh::handlers::Callback;
use zenoh::sample::Sample;
use zenoh::{Config, Session, Wait};
use zenoh_ext::{AdvancedSubscriberBuilderExt, HistoryConfig};

use super::{Belief, Feed, Next, Source};
use crate::bag::{IMU_NAMES, ODOMETRY_NAMES, SCAN_NAMES, SensorEvent, TRUTH_NAMES, Topics};
use crate::clock::{SensorClock, wall_now};
use crate::frames::{Frames, Mount};
use crate::ros::{self, CdrError, Imu, LaserScan, PoseWithCovarianceStamped, RosOdometry, TfMessage};

/// Where to listen, and for what.
#[derive(Debug, Clone, PartialEq)]
pub struct Ros2Options {
    /// The ROS side's zenoh router or bridge.
    pub endpoint: String,
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// Topics to take; None takes what is there, the usual names first.
    pub topics: Topics,
    /// Where the laser is; None takes it from `/tf_static`.
    pub mount: Option<Mount>,
}

impl Ros2Options {
    /// Where `rmw_zenoh`'s router and the bridge listen unless told otherwise.
    pub const ENDPOINT: &'static str = "tcp/127.0.0.1:7447";
}

/// Why there are no live sensors.
#[derive(Debug, thiserror::Error)]
pub enum Ros2Error {
    /// zenoh refuses the endpoint or the domain.
    #[error("{0}")]
    Zenoh(String),
    /// Whoever waited has given up.
    #[error("stopped while waiting for ROS 2: {missing}")]
    Stopped {
        /// What had not come.
        missing: String,
    },
    /// `/tf_static` does not say where the laser is.
    #[error(
        "/tf_static does not connect {base_link} with {laser}; say where the laser is with --laser x,y,heading"
    )]
    NoMount {
        /// The frame that odometry moves.
        base_link: String,
        /// The frame of the scans.
        laser: String,
    },
}

/// Messages that wait to be taken: some seconds of all sensors.
const QUEUE: usize = 1024;
/// Once there are a scan and odometry, other topics and `/tf_static` have so long to be heard of.
const LOOK_AROUND: Duration = Duration::from_secs(1);
/// Longest wait for the next message.
const PATIENCE: Duration = Duration::from_millis(100);
/// Stamps this far from this machine's time are of a clock of their own, as under `use_sim_time` [s].
const OTHER_CLOCK: f64 = 1.0;

/// The types that are listened for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Scan,
    Odometry,
    Imu,
    StaticTransform,
    InitialPose,
}

impl Kind {
    const ALL: [Self; 5] = [
        Self::Scan,
        Self::Odometry,
        Self::Imu,
        Self::StaticTransform,
        Self::InitialPose,
    ];

    /// The type as `rmw_zenoh`'s keys spell it.
    fn dds_type(self) -> &'static str {
        match self {
            Self::Scan => "sensor_msgs::msg::dds_::LaserScan_",
            Self::Odometry => "nav_msgs::msg::dds_::Odometry_",
            Self::Imu => "sensor_msgs::msg::dds_::Imu_",
            Self::StaticTransform => "tf2_msgs::msg::dds_::TFMessage_",
            Self::InitialPose => "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_",
        }
    }

    /// The type as ROS spells it.
    fn ros_type(self) -> String {
        self.dds_type()
            .trim_end_matches('_')
            .replace("::msg::dds_::", "/msg/")
    }

    /// The topic that is wanted, or else the usual names, the preferred one first.
    fn names(self, wanted: &Topics) -> Vec<&str> {
        let (wanted, usual): (_, &[&str]) = match self {
            Self::Scan => (&wanted.scan, &SCAN_NAMES),
            Self::Odometry => (&wanted.odometry, &ODOMETRY_NAMES),
            Self::Imu => (&wanted.imu, &IMU_NAMES),
            Self::StaticTransform => (&None, &["/tf_static"]),
            Self::InitialPose => (&None, &["/initialpose"]),
        };
        wanted
            .as_deref()
            .map_or_else(|| usual.to_vec(), |wanted| vec![wanted])
    }

    fn decode(self, payload: &[u8]) -> Result<Content, CdrError> {
        fn of<T: DeserializeOwned>(payload: &[u8]) -> Result<Box<T>, CdrError> {
            ros::decode(payload).map(Box::new)
        }
        Ok(match self {
            Self::Scan => Content::Scan(of(payload)?),
            Self::Odometry => Content::Odometry(of(payload)?),
            Self::Imu => Content::Imu(of(payload)?),
            Self::StaticTransform => Content::StaticTransform(of(payload)?),
            Self::InitialPose => Content::InitialPose(of(payload)?),
        })
    }
}

/// A message, decoded.
#[derive(Debug)]
enum Content {
    Scan(Box<LaserScan>),
    Odometry(Box<RosOdometry>),
    Imu(Box<Imu>),
    StaticTransform(Box<TfMessage>),
    InitialPose(Box<PoseWithCovarianceStamped>),
}

/// What zenoh has brought.
#[derive(Debug)]
struct Heard {
    /// The ROS name, with its leading slash.
    topic: String,
    content: Result<Content, CdrError>,
}

/// The live sensors of a car.
pub struct Ros2 {
    heard: Receiver<Heard>,
    endpoint: String,
    scan: String,
    odometry: String,
    imu: Option<String>,
    mount: Mount,
    /// The mount is a guess: nothing told it.
    guessed: bool,
    /// Sensor time less wall time [s].
    offset: f64,
    clock: SensorClock,
    /// Messages that could not be read, by topic.
    broken: BTreeMap<String, u64>,
    _subscribers: Vec<Box<dyn Send>>,
    _session: Session,
}

impl Ros2 {
    /// Finds the sensors. Blocks until there are a scan and odometry; says every second to `waiting` what is still
    /// missing, and gives up when that returns false.
    pub fn find(options: &Ros2Options, mut waiting: impl FnMut(&str) -> bool) -> Result<Self, Ros2Error> {
        let session = open(&options.endpoint, &mut waiting)?;
        let (sender, heard) = bounded(QUEUE);
        let subscribers = subscribe(&session, options, &sender)?;
        let found = Found::wait(&heard, options, &mut waiting)?;
        let (mount, guessed) = found.mount(options.mount)?;
        Ok(Self {
            heard,
            endpoint: options.endpoint.clone(),
            mount,
            guessed,
            offset: found.offset,
            clock: live_clock(found.offset),
            scan: found.scan.0,
            odometry: found.odometry.0,
            imu: found.imu,
            broken: BTreeMap::new(),
            _subscribers: subscribers,
            _session: session,
        })
    }

    /// True when nothing said where the laser is, so that it is taken to be where most cars have it.
    pub fn mount_is_a_guess(&self) -> bool {
        self.guessed
    }

    /// What the filter gets of a message; None when it is of a topic that was not chosen.
    fn feed(&mut self, heard: Heard) -> Option<Feed> {
        let Heard { topic, content } = heard;
        match content {
            Ok(Content::Scan(scan)) => (topic == self.scan)
                .then(|| Feed::Sensor(SensorEvent::Scan(scan.to_scan(self.mount.upside_down)))),
            Ok(Content::Odometry(odometry)) => {
                (topic == self.odometry).then(|| Feed::Sensor(SensorEvent::Odometry(odometry.to_odometry())))
            }
            Ok(Content::Imu(imu)) => (Some(&topic) == self.imu.as_ref())
                .then(|| Feed::Sensor(SensorEvent::YawRate(imu.to_yaw_rate()))),
            Ok(Content::InitialPose(pose)) => Some(placed(&topic, &pose)),
            // A laser that is moved while the car runs is no laser to localize with.
            Ok(Content::StaticTransform(_)) => None,
            Err(error) => {
                let count = self.broken.entry(topic.clone()).or_insert(0);
                *count += 1;
                count
                    .is_power_of_two()
                    .then(|| Feed::Word(format!("{topic}: {count} messages cannot be read: {error}")))
            }
        }
    }
}

/// Somebody has clicked a pose in `RViz`.
fn placed(topic: &str, message: &PoseWithCovarianceStamped) -> Feed {
    let frame = message.header.frame_id.trim_start_matches('/');
    let pose = message.pose.planar();
    if frame != "map" {
        Feed::Word(format!("{topic}: a pose in frame {frame:?}, not in map: ignored"))
    } else if !pose.is_finite() {
        Feed::Word(format!("{topic}: a pose that is not finite: ignored"))
    } else {
        Feed::Placed(pose)
    }
}

impl Source for Ros2 {
    fn description(&self) -> String {
        let imu = self.imu.as_ref().map_or(String::new(), |imu| format!(", {imu}"));
        format!(
            "ROS 2 at {}: {}, {}{imu}",
            self.endpoint, self.scan, self.odometry
        )
    }

    fn mount(&self) -> Mount {
        self.mount
    }

    fn clock(&mut self, _: f64) -> SensorClock {
        self.clock = live_clock(self.offset);
        self.clock
    }

    fn start(&self) -> Option<Pose> {
        None
    }

    fn next(&mut self, _: Option<Belief>) -> Next {
        match self.heard.recv_timeout(PATIENCE) {
            Ok(heard) => match self.feed(heard) {
                Some(feed) => Next::Due(self.clock.now(), feed),
                None => Next::Quiet,
            },
            Err(RecvTimeoutError::Timeout) => Next::Quiet,
            Err(RecvTimeoutError::Disconnected) => Next::End,
        }
    }
}

fn live_clock(offset: f64) -> SensorClock {
    SensorClock::starting_at(wall_now().plus(offset), 1.0)
}

/// Joins the ROS side's router as a client, as soon as there is one.
fn open(endpoint: &str, waiting: &mut impl FnMut(&str) -> bool) -> Result<Session, Ros2Error> {
    let settings = [
        ("mode", r#""client""#.to_owned()),
        ("connect/endpoints", serde_json::json!([endpoint]).to_string()),
        ("connect/timeout_ms", "1000".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
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

/// Subscribes to every kind, under `rmw_zenoh`'s keys by type and under a bridge's by name.
fn subscribe(
    session: &Session,
    options: &Ros2Options,
    sender: &Sender<Heard>,
) -> Result<Vec<Box<dyn Send>>, Ros2Error> {
    let mut subscribers: Vec<Box<dyn Send>> = Vec::new();
    for kind in Kind::ALL {
        let rmw = format!("{}/**/{}/*", options.domain, kind.dds_type());
        let bridged = kind
            .names(&options.topics)
            .into_iter()
            .map(|name| name.trim_matches('/').to_owned());
        for key in std::iter::once(rmw).chain(bridged) {
            let failed =
                |error: zenoh::Error| Ros2Error::Zenoh(format!("cannot subscribe to {key}: {error}"));
            let listener = listener(kind, options.domain, sender);
            // Static transforms are sent once, before we listen: their publishers keep them for those who ask.
            if kind == Kind::StaticTransform {
                let subscriber = session
                    .declare_subscriber(key.clone())
                    .with(listener)
                    .advanced()
                    .history(HistoryConfig::default().detect_late_publishers())
                    .wait()
                    .map_err(failed)?;
                subscribers.push(Box::new(subscriber));
            } else {
                let subscriber = session
                    .declare_subscriber(key.clone())
                    .with(listener)
                    .wait()
                    .map_err(failed)?;
                subscribers.push(Box::new(subscriber));
            }
        }
    }
    Ok(subscribers)
}

/// Decodes in zenoh's thread and hands on; what finds the queue full is gone.
fn listener(kind: Kind, domain: u32, sender: &Sender<Heard>) -> Callback<Sample> {
    let sender = sender.clone();
    Callback::from(move |sample: Sample| {
        let topic = topic(sample.key_expr().as_str(), kind, domain);
        // Moving transforms are of the same type.
        if kind == Kind::StaticTransform && !topic.ends_with("tf_static") {
            return;
        }
        let content = kind.decode(&sample.payload().to_bytes());
        if sender.try_send(Heard { topic, content }).is_err() {
            tracing::debug!("messages from ROS come faster than they are taken");
        }
    })
}

/// The ROS name of a key.
fn topic(key: &str, kind: Kind, domain: u32) -> String {
    let rmw = key
        .strip_prefix(&format!("{domain}/"))
        .and_then(|rest| Some(rest.rsplit_once('/')?.0))
        .and_then(|rest| rest.strip_suffix(kind.dds_type()))
        .and_then(|rest| rest.strip_suffix('/'));
    format!("/{}", rmw.unwrap_or(key))
}

/// What was found of a car's topics.
struct Found {
    /// Topic and frame.
    scan: (String, String),
    /// Topic and the frame that it moves.
    odometry: (String, String),
    imu: Option<String>,
    frames: Frames,
    offset: f64,
}

impl Found {
    fn wait(
        heard: &Receiver<Heard>,
        options: &Ros2Options,
        waiting: &mut impl FnMut(&str) -> bool,
    ) -> Result<Self, Ros2Error> {
        let (mut scans, mut odometries) = (BTreeMap::new(), BTreeMap::new());
        let mut imus = BTreeMap::new();
        let mut frames = Frames::default();
        let mut offset = 0.0;
        let mut whole: Option<Instant> = None;
        let mut said = Instant::now();
        loop {
            if let Ok(Heard { topic, content }) = heard.recv_timeout(PATIENCE) {
                match content {
                    Ok(Content::Scan(scan)) => {
                        let behind = wall_now().since(Stamp::from(scan.header.stamp));
                        offset = if behind.abs() > OTHER_CLOCK { -behind } else { 0.0 };
                        scans.insert(topic, scan.header.frame_id);
                    }
                    Ok(Content::Odometry(odometry)) => {
                        odometries.insert(topic, odometry.child_frame_id);
                    }
                    Ok(Content::Imu(_)) => {
                        imus.insert(topic, String::new());
                    }
                    Ok(Content::StaticTransform(message)) => {
                        for transform in &message.transforms {
                            frames.insert(transform);
                        }
                    }
                    Ok(Content::InitialPose(_)) => {}
                    Err(error) => tracing::warn!(%topic, %error, "a message cannot be read"),
                }
            }
            let scan = choose(
                &scans,
                &Kind::Scan.names(&options.topics),
                options.topics.scan.is_some(),
            );
            let odometry = choose(
                &odometries,
                &Kind::Odometry.names(&options.topics),
                options.topics.odometry.is_some(),
            );
            if let (Some(scan), Some(odometry)) = (&scan, &odometry)
                && whole.get_or_insert_with(Instant::now).elapsed() >= LOOK_AROUND
            {
                let imu = choose(
                    &imus,
                    &Kind::Imu.names(&options.topics),
                    options.topics.imu.is_some(),
                );
                return Ok(Self {
                    scan: scan.clone(),
                    odometry: odometry.clone(),
                    imu: imu.map(|(topic, _)| topic),
                    frames,
                    offset,
                });
            }
            if whole.is_none() && said.elapsed() >= Duration::from_secs(1) {
                said = Instant::now();
                let missing: Vec<_> = [(Kind::Scan, scan.is_none()), (Kind::Odometry, odometry.is_none())]
                    .into_iter()
                    .filter(|(_, missing)| *missing)
                    .map(|(kind, _)| {
                        format!(
                            "{} ({})",
                            kind.names(&options.topics).join(" or "),
                            kind.ros_type()
                        )
                    })
                    .collect();
                let missing = format!("nothing heard yet on {}", missing.join(" and "));
                if !waiting(&missing) {
                    return Err(Ros2Error::Stopped { missing });
                }
            }
        }
    }

    /// Where the laser is, and whether that is a guess.
    fn mount(&self, given: Option<Mount>) -> Result<(Mount, bool), Ros2Error> {
        if let Some(mount) = given {
            return Ok((mount, false));
        }
        if self.frames.is_empty() {
            return Ok((Mount::typical(), true));
        }
        let (base_link, laser) = (&self.odometry.1, &self.scan.1);
        self.frames
            .mount(base_link, laser)
            .map(|mount| (mount, false))
            .ok_or_else(|| Ros2Error::NoMount {
                base_link: base_link.clone(),
                laser: laser.clone(),
            })
    }
}

/// The first of `names` that is there, or, unless one was asked for, the first that is there at all. Truth is none.
fn choose(there: &BTreeMap<String, String>, names: &[&str], asked: bool) -> Option<(String, String)> {
    names
        .iter()
        .find_map(|name| there.get_key_value(*name))
        .or_else(|| {
            there
                .iter()
                .find(|(topic, _)| !asked && !TRUTH_NAMES.contains(&topic.as_str()))
        })
        .map(|(topic, frame)| (topic.clone(), frame.clone()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::{Header, RosPose};

    #[test]
    fn keys_of_rmw_zenoh_and_of_a_bridge_name_the_same_topic() {
        let rmw = "0/car/scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_64c1";
        assert_eq!(topic(rmw, Kind::Scan, 0), "/car/scan");
        assert_eq!(topic("car/scan", Kind::Scan, 0), "/car/scan");
        assert_eq!(
            topic(
                "7/odom/nav_msgs::msg::dds_::Odometry_/TypeHashNotSupported",
                Kind::Odometry,
                7
            ),
            "/odom"
        );
    }

    #[test]
    fn the_usual_name_is_preferred_and_truth_never_taken_for_odometry() {
        let there = |names: &[&str]| {
            names
                .iter()
                .map(|name| ((*name).to_owned(), "base_link".to_owned()))
                .collect::<BTreeMap<_, _>>()
        };
        let name = |names: &[&str], usual: &[&str], asked| {
            choose(&there(names), usual, asked).map(|(topic, _)| topic)
        };
        let some = |name: &str| Some(name.to_owned());
        assert_eq!(name(&["/a", "/odom"], &ODOMETRY_NAMES, false), some("/odom"));
        assert_eq!(
            name(&["/a", "/ground_truth/odom"], &ODOMETRY_NAMES, false),
            some("/a")
        );
        assert_eq!(name(&["/ground_truth/odom"], &ODOMETRY_NAMES, false), None);
        assert_eq!(name(&["/a"], &["/b"], true), None, "another one was asked for");
    }

    #[test]
    fn a_pose_from_rviz_counts_in_the_map_alone() {
        let message = |frame: &str, x| PoseWithCovarianceStamped {
            header: Header {
                frame_id: frame.into(),
                ..Header::default()
            },
            pose: RosPose::from(Pose::new(x, 2.0, 1.0)),
            ..PoseWithCovarianceStamped::default()
        };
        assert!(matches!(placed("/initialpose", &message("map", 1.0)), Feed::Placed(pose) if pose.x == 1.0));
        assert!(
            matches!(placed("/initialpose", &message("odom", 1.0)), Feed::Word(text) if text.contains("odom"))
        );
        assert!(matches!(
            placed("/initialpose", &message("map", f64::NAN)),
            Feed::Word(_)
        ));
    }
}
