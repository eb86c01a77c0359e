//! Discovery: waits until the car's sensors send, and chooses their topics.

use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;
use synpf::Stamp;

use super::choice::{Choice, OdometryTopic, Sending, insert, listed, mount};
use super::ros_graph::RosGraph;
use super::topics::{Content, Kind, TopicMessage};
use super::{PATIENCE, Ros2Error, Ros2Options};
use crate::sensors::clock::wall_now;
use crate::sensors::frames::{Frames, Mount};

/// Discovery goes on this long after the first scan and the first odometry, for other topics and transforms.
const LOOK_AROUND: Duration = Duration::from_secs(1);
/// ... and this long when there are transforms, but none yet from the car to the laser.
const TRANSFORM_PATIENCE: Duration = Duration::from_secs(10);
/// What is missing is said so often.
const REPORT: Duration = Duration::from_secs(1);
/// Topics that have been announced are subscribed to so often.
const ANNOUNCE: Duration = Duration::from_millis(100);
/// Sensors that come in so late are on this machine's clock \[s\]; others on one of their own, as with `use_sim_time`.
const SAME_CLOCK: std::ops::RangeInclusive<f64> = -0.002..=0.05;

/// What was found.
pub(super) struct Discovered {
    pub(super) choice: Choice,
    pub(super) scan_frame: String,
    pub(super) imu_frame: Option<String>,
    pub(super) odometry: OdometryTopic,
    pub(super) frames: Frames,
    /// Sensor time minus wall time \[s\].
    pub(super) offset: f64,
    /// What else sends.
    pub(super) not_taken: Option<String>,
}

impl Discovered {
    /// How the laser is mounted, and the frame that it was found on; None while the transforms do not say.
    pub(super) fn mount(&self) -> Option<(Mount, String)> {
        mount(&self.frames, &self.odometry.base_link, &self.scan_frame)
    }
}

/// Waits until there are a scan and odometry. Calls `waiting` every second with what is missing, and gives up when it
/// returns false.
pub(super) fn discover(
    messages: &Receiver<TopicMessage>,
    options: &Ros2Options,
    graph: &mut RosGraph,
    waiting: &mut impl FnMut(&str) -> bool,
) -> Result<Discovered, Ros2Error> {
    let mut sending = Sending::default();
    // The least time from a stamp to its arrival \[s\].
    let mut behind = f64::INFINITY;
    // When there were a scan and odometry.
    let mut sufficient: Option<Instant> = None;
    let mut reported = Instant::now();
    let mut announced = Instant::now();
    loop {
        if let Ok(message) = messages.recv_timeout(PATIENCE) {
            note(message, &mut sending, &mut behind);
        }
        if announced.elapsed() >= ANNOUNCE {
            announced = Instant::now();
            graph.subscribe(options.domain, "", |_, _| true);
        }
        let choice = sending.choose(options);
        let missing = if let Some(choice) = &choice {
            let since = sufficient.get_or_insert_with(Instant::now).elapsed();
            let found = discovered(&sending, choice.clone(), behind);
            let connected = options.mount.is_some() || found.mount().is_some();
            // Without any transform there is nothing to wait for.
            let transforms = sending.transforms.values().any(|frames| !frames.is_empty())
                || !graph.announced(Kind::Transforms, options.domain).is_empty();
            let patience = if connected || !transforms {
                LOOK_AROUND
            } else {
                TRANSFORM_PATIENCE
            };
            if since >= patience {
                return Ok(found);
            }
            (since >= LOOK_AROUND).then(|| {
                let (base_link, laser) = (&found.odometry.base_link, &found.scan_frame);
                format!("no transform yet from {base_link} to {laser} on /tf_static or /tf")
            })
        } else {
            Some(missing(&sending, options, graph))
        };
        if let Some(missing) = missing
            && reported.elapsed() >= REPORT
        {
            reported = Instant::now();
            if !waiting(&missing) {
                return Err(Ros2Error::Stopped { missing });
            }
        }
    }
}

/// Notes that a topic sends.
fn note(message: TopicMessage, sending: &mut Sending, behind: &mut f64) {
    let TopicMessage {
        topic,
        hash,
        arrival,
        content,
    } = message;
    let arrived = wall_now().plus(-arrival.elapsed().as_secs_f64());
    let mut stamped = |stamp| *behind = behind.min(arrived.since(Stamp::from(stamp)));
    match content {
        Ok(Content::Scan(scan)) => {
            stamped(scan.header.stamp);
            insert(&mut sending.scans, topic, scan.header.frame_id);
        }
        Ok(Content::Odometry(odometry)) => {
            stamped(odometry.header.stamp);
            let of_topic = OdometryTopic {
                odom: odometry.header.frame_id,
                base_link: odometry.child_frame_id,
                hash,
            };
            insert(&mut sending.odometries, topic, of_topic);
        }
        Ok(Content::Imu(imu)) => insert(&mut sending.imus, topic, imu.header.frame_id),
        Ok(Content::Transforms(message)) => {
            let mut frames = sending.transforms.remove(&topic).unwrap_or_default();
            for transform in &message.transforms {
                frames.insert(transform);
            }
            insert(&mut sending.transforms, topic, frames);
        }
        Ok(Content::InitialPose(_) | Content::ClickedPoint | Content::Pose(_)) => {}
        Err(error) => tracing::warn!(%topic, %error, "a message cannot be read"),
    }
}

fn discovered(sending: &Sending, choice: Choice, behind: f64) -> Discovered {
    let mut odometry = sending
        .odometries
        .get(&choice.odometry)
        .cloned()
        .unwrap_or_default();
    for (frame, usual) in [
        (&mut odometry.base_link, "base_link"),
        (&mut odometry.odom, "odom"),
    ] {
        let bare = frame.trim_start_matches('/');
        // Some drivers leave it empty.
        *frame = if bare.is_empty() { usual } else { bare }.to_owned();
    }
    Discovered {
        scan_frame: sending.scans.get(&choice.scan).cloned().unwrap_or_default(),
        imu_frame: choice.imu.as_ref().and_then(|imu| sending.imus.get(imu)).cloned(),
        frames: sending.frames(&choice.scan),
        offset: if SAME_CLOCK.contains(&behind) || !behind.is_finite() {
            0.0
        } else {
            -behind
        },
        not_taken: sending.not_taken(&choice),
        odometry,
        choice,
    }
}

/// What is missing, and where it may be.
fn missing(sending: &Sending, options: &Ros2Options, graph: &RosGraph) -> String {
    let scan = sending.scan(options);
    let needed = |kind: Kind| {
        let names = kind.asked(&options.topics).map_or_else(
            || {
                let namespace = options.namespace.as_deref().unwrap_or_default();
                let names = kind.usual_names().iter();
                names
                    .map(|name| format!("{namespace}{name}"))
                    .collect::<Vec<_>>()
                    .join(" or ")
            },
            str::to_owned,
        );
        format!("{names} ({})", kind.ros_type().name())
    };
    let kinds = if scan.is_none() && sending.odometries.is_empty() {
        vec![Kind::Scan, Kind::Odometry]
    } else if scan.is_none() {
        vec![Kind::Scan]
    } else {
        vec![Kind::Odometry]
    };
    let needs: Vec<_> = kinds.iter().map(|kind| needed(*kind)).collect();
    let mut texts = vec![format!("no message yet on {}", needs.join(" and "))];
    if let (Some(scan), Kind::Odometry) = (scan, kinds[0]) {
        texts[0] += &[" to go with ", scan].concat();
    }
    for kind in kinds {
        let sends: Vec<String> = match kind {
            Kind::Scan => sending.scans.keys().cloned().collect(),
            _ => sending.odometries.keys().cloned().collect(),
        };
        let silent: Vec<String> = graph
            .announced(kind, options.domain)
            .into_iter()
            .filter(|topic| !sends.contains(topic))
            .collect();
        let name = kind.ros_type().name();
        if !sends.is_empty() {
            texts.push(format!("other {name} on {}", listed(&sends)));
        }
        if !silent.is_empty() {
            texts.push(format!("announced and silent: {name} on {}", listed(&silent)));
        }
    }
    texts.extend(graph.other_domains(options.domain));
    texts.join("; ")
}
