//! Plays a bag in real time.

use std::path::PathBuf;

use maps::Pose;
use synpf::{Stamp, Twist};

use super::{Feed, Next, PoseEstimate, Source, TrueMotion};
use crate::sensors::bag::SensorLog;
use crate::sensors::clock::SensorClock;
use crate::sensors::frames::Mount;

/// Plays the messages of a bag in the order in which they were logged.
#[derive(Debug)]
pub struct BagPlayer {
    path: PathBuf,
    feeds: std::vec::IntoIter<(Stamp, Feed)>,
    begins: Stamp,
    mount: Mount,
    start: Option<Pose>,
    pose_topic: Option<String>,
}

impl BagPlayer {
    /// A player of `log`, which was read from `path`.
    pub fn new(path: PathBuf, log: SensorLog) -> Self {
        let start = log.truth.first().map(|(_, pose)| *pose);
        let mut feeds: Vec<(Stamp, Feed)> = log
            .arrivals
            .into_iter()
            .map(|arrival| (arrival.log_time, Feed::Sensor(arrival.event)))
            .collect();
        feeds.extend(log.truth.windows(2).filter_map(|pair| {
            let [(stamp, pose), (next, next_pose)] = [pair[0], pair[1]];
            let time = next.since(stamp);
            if time <= 0.0 {
                return None;
            }
            let [linear_x, linear_y, angular] = next_pose.since(pose).log().map(|v| v / time);
            let twist = Twist {
                linear_x,
                linear_y,
                angular,
            };
            Some((stamp, Feed::Truth(TrueMotion { stamp, pose, twist })))
        }));
        feeds.sort_by_key(|(due, _)| *due);
        Self {
            path,
            begins: feeds.first().map_or(Stamp(0), |(due, _)| *due),
            feeds: feeds.into_iter(),
            pose_topic: log.topics.pose,
            mount: log.mount.unwrap_or_else(Mount::typical),
            start,
        }
    }
}

impl Source for BagPlayer {
    fn description(&self) -> String {
        format!("bag {}", self.path.display())
    }

    fn mount(&self) -> Mount {
        self.mount
    }

    fn clock(&mut self, rate: f64) -> SensorClock {
        SensorClock::starting_at(self.begins, rate)
    }

    fn start(&self) -> Option<Pose> {
        self.start
    }

    fn pose_topic(&self) -> Option<&str> {
        self.pose_topic.as_deref()
    }

    fn next(&mut self, _: Option<PoseEstimate>) -> Next {
        self.feeds
            .next()
            .map_or(Next::End, |(due, feed)| Next::Due(due, feed))
    }
}
