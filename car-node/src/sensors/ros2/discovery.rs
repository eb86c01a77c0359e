//! Discovery: chooses the car's sensors among the topics that send.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;
use synpf::Stamp;

use super::topics::{Content, Kind, TopicMessage};
use super::{PATIENCE, Ros2Error, Ros2Options};
use crate::sensors::bag::is_wheel_odometry;
use crate::sensors::clock::wall_now;
use crate::sensors::frames::{Frames, Mount};

/// Discovery goes on this long after the first scan and the first odometry, for other topics and `/tf_static`.
const LOOK_AROUND: Duration = Duration::from_secs(1);
/// Stamps further than this from this machine's time belong to another clock, as with `use_sim_time` \[s\].
const OTHER_CLOCK: f64 = 1.0;

/// The topics of a car.
pub(super) struct CarTopics {
    /// Topic and frame.
    pub(super) scan: (String, String),
    /// Topic and the frame that it moves.
    pub(super) odometry: (String, String),
    /// The hash of the odometry's type; None behind a bridge.
    pub(super) odometry_hash: Option<String>,
    pub(super) imu: Option<String>,
    pub(super) frames: Frames,
    /// Sensor time minus wall time \[s\].
    pub(super) offset: f64,
}

impl CarTopics {
    /// Waits until there are a scan and odometry. Calls `waiting` every second with what is missing, and gives up when it
    /// returns false.
    pub(super) fn discover(
        messages: &Receiver<TopicMessage>,
        options: &Ros2Options,
        waiting: &mut impl FnMut(&str) -> bool,
    ) -> Result<Self, Ros2Error> {
        let (mut scans, mut odometries) = (BTreeMap::new(), BTreeMap::new());
        let mut imus = BTreeMap::new();
        let mut hashes = BTreeMap::new();
        let mut frames = Frames::default();
        let mut offset = 0.0;
        // When there were a scan and odometry.
        let mut sufficient: Option<Instant> = None;
        let mut reported = Instant::now();
        loop {
            if let Ok(TopicMessage { topic, hash, content }) = messages.recv_timeout(PATIENCE) {
                match content {
                    Ok(Content::Scan(scan)) => {
                        let behind = wall_now().since(Stamp::from(scan.header.stamp));
                        offset = if behind.abs() > OTHER_CLOCK { -behind } else { 0.0 };
                        scans.insert(topic, scan.header.frame_id);
                    }
                    Ok(Content::Odometry(odometry)) => {
                        hashes.extend(hash.map(|hash| (topic.clone(), hash)));
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
                    Ok(Content::InitialPose(_) | Content::ClickedPoint) => {}
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
                && sufficient.get_or_insert_with(Instant::now).elapsed() >= LOOK_AROUND
            {
                let imu = choose(
                    &imus,
                    &Kind::Imu.names(&options.topics),
                    options.topics.imu.is_some(),
                );
                return Ok(Self {
                    scan: scan.clone(),
                    odometry_hash: hashes.remove(&odometry.0),
                    odometry: odometry.clone(),
                    imu: imu.map(|(topic, _)| topic),
                    frames,
                    offset,
                });
            }
            if sufficient.is_none() && reported.elapsed() >= Duration::from_secs(1) {
                reported = Instant::now();
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
                let missing = format!("no message yet on {}", missing.join(" and "));
                if !waiting(&missing) {
                    return Err(Ros2Error::Stopped { missing });
                }
            }
        }
    }

    /// How the laser is mounted, and true when that is a guess.
    pub(super) fn mount(&self, given: Option<Mount>) -> Result<(Mount, bool), Ros2Error> {
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

/// The first of `names` that sends. If none does and no topic was asked for, the first topic that sends, but neither ground
/// truth nor the output of a localizer. The frame comes with it.
pub(super) fn choose(
    sending: &BTreeMap<String, String>,
    names: &[&str],
    asked: bool,
) -> Option<(String, String)> {
    names
        .iter()
        .find_map(|name| sending.get_key_value(*name))
        .or_else(|| {
            sending
                .iter()
                .find(|(topic, _)| !asked && is_wheel_odometry(topic))
        })
        .map(|(topic, frame)| (topic.clone(), frame.clone()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensors::bag::ODOMETRY_NAMES;

    #[test]
    fn the_usual_name_is_preferred_and_truth_is_no_odometry() {
        let sending = |names: &[&str]| {
            names
                .iter()
                .map(|name| ((*name).to_owned(), "base_link".to_owned()))
                .collect::<BTreeMap<_, _>>()
        };
        let name = |names: &[&str], usual: &[&str], asked| {
            choose(&sending(names), usual, asked).map(|(topic, _)| topic)
        };
        let some = |name: &str| Some(name.to_owned());
        assert_eq!(name(&["/a", "/odom"], &ODOMETRY_NAMES, false), some("/odom"));
        assert_eq!(
            name(&["/a", "/ground_truth/odom"], &ODOMETRY_NAMES, false),
            some("/a")
        );
        assert_eq!(name(&["/ground_truth/odom"], &ODOMETRY_NAMES, false), None);
        assert_eq!(
            name(&["/pf/pose/odom", "/wheels"], &ODOMETRY_NAMES, false),
            some("/wheels"),
            "the output of a localizer is no odometry"
        );
        assert_eq!(name(&["/car2/pf/pose/odom"], &ODOMETRY_NAMES, false), None);
        assert_eq!(name(&["/a"], &["/b"], true), None, "another one was asked for");
    }
}
