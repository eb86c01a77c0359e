//! Which of the topics that are heard of are the car's sensors.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;
use synpf::Stamp;

use super::topics::{Content, Heard, Kind};
use super::{PATIENCE, Ros2Error, Ros2Options};
use crate::sensors::bag::TRUTH_NAMES;
use crate::sensors::clock::wall_now;
use crate::sensors::frames::{Frames, Mount};

/// Once there are a scan and odometry, other topics and `/tf_static` have so long to be heard of.
const LOOK_AROUND: Duration = Duration::from_secs(1);
/// Stamps this far from this machine's time are of a clock of their own, as under `use_sim_time` [s].
const OTHER_CLOCK: f64 = 1.0;

/// What was found of a car's topics.
pub(super) struct Found {
    /// Topic and frame.
    pub(super) scan: (String, String),
    /// Topic and the frame that it moves.
    pub(super) odometry: (String, String),
    pub(super) odometry_hash: Option<String>,
    pub(super) imu: Option<String>,
    pub(super) frames: Frames,
    pub(super) offset: f64,
}

impl Found {
    pub(super) fn wait(
        heard: &Receiver<Heard>,
        options: &Ros2Options,
        waiting: &mut impl FnMut(&str) -> bool,
    ) -> Result<Self, Ros2Error> {
        let (mut scans, mut odometries) = (BTreeMap::new(), BTreeMap::new());
        let mut imus = BTreeMap::new();
        let mut hashes = BTreeMap::new();
        let mut frames = Frames::default();
        let mut offset = 0.0;
        let mut whole: Option<Instant> = None;
        let mut said = Instant::now();
        loop {
            if let Ok(Heard { topic, hash, content }) = heard.recv_timeout(PATIENCE) {
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
                    odometry_hash: hashes.remove(&odometry.0),
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

/// The first of `names` that is there, or, unless one was asked for, the first that is there at all. Truth is none.
pub(super) fn choose(
    there: &BTreeMap<String, String>,
    names: &[&str],
    asked: bool,
) -> Option<(String, String)> {
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
    use crate::sensors::bag::ODOMETRY_NAMES;

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
}
