//! Which of the topics that send belong to the car: a scan, odometry, an IMU and transforms that go together.
//!
//! Several cars may share a router, each in its namespace; a car may have several lidars. A scan decides. Odometry is looked for
//! in the scan's namespace and in those around it, and where it is found the car's namespace begins. What is in the namespace of
//! another car is left alone.

use std::collections::BTreeMap;

use super::Ros2Options;
use super::topics::Kind;
use crate::sensors::bag::{ODOMETRY_NAMES, is_wheel_odometry};
use crate::sensors::frames::{Frames, Mount};

/// More topics of a kind are not kept.
const MOST_TOPICS: usize = 256;

/// A topic with odometry.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct OdometryTopic {
    /// The frame of its poses.
    pub(super) odom: String,
    /// The frame that it moves.
    pub(super) base_link: String,
    /// The hash of its type; None behind a bridge.
    pub(super) hash: Option<String>,
}

/// The topics that have sent something, by name.
#[derive(Debug, Default)]
pub(super) struct Sending {
    /// With the frame of the scans.
    pub(super) scans: BTreeMap<String, String>,
    pub(super) odometries: BTreeMap<String, OdometryTopic>,
    /// With the frame of the sensor.
    pub(super) imus: BTreeMap<String, String>,
    /// With the transforms that came on them.
    pub(super) transforms: BTreeMap<String, Frames>,
}

/// Adds a topic, unless there are too many.
pub(super) fn insert<T>(topics: &mut BTreeMap<String, T>, topic: String, value: T) {
    if topics.len() < MOST_TOPICS || topics.contains_key(&topic) {
        topics.insert(topic, value);
    }
}

/// The topics of the car.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Choice {
    pub(super) scan: String,
    pub(super) odometry: String,
    pub(super) imu: Option<String>,
    /// The car's namespace: empty, or with a leading slash.
    pub(super) namespace: String,
}

impl Choice {
    /// Whether the scan, the odometry or the IMU is read from this topic.
    pub(super) fn has_sensor(&self, topic: &str) -> bool {
        let Self {
            scan, odometry, imu, ..
        } = self;
        topic == scan || topic == odometry || imu.as_deref() == Some(topic)
    }
}

/// The namespace of a topic: empty for `/scan`, `/car2` for `/car2/scan`.
pub(super) fn namespace_of(topic: &str) -> &str {
    topic.rsplit_once('/').map_or("", |(namespace, _)| namespace)
}

/// A namespace and those around it, up to the root, which is empty.
fn upwards(namespace: &str) -> impl Iterator<Item = &str> {
    std::iter::successors(Some(namespace), |inner| {
        (!inner.is_empty()).then(|| namespace_of(inner))
    })
}

/// True for a topic in a namespace or in one inside it.
fn within(topic: &str, namespace: &str) -> bool {
    topic
        .strip_prefix(namespace)
        .is_some_and(|rest| rest.starts_with('/'))
}

impl Sending {
    /// The car's topics; None while there is no scan or no odometry that fits.
    pub(super) fn choose(&self, options: &Ros2Options) -> Option<Choice> {
        let scan = self.scan(options)?;
        let (odometry, namespace) = self.odometry(scan, options)?;
        Some(Choice {
            imu: self.imu(scan, namespace, options).map(str::to_owned),
            scan: scan.to_owned(),
            odometry: odometry.to_owned(),
            namespace: namespace.to_owned(),
        })
    }

    /// The scan to take. One whose frame is connected to the car is preferred, then one with the usual name.
    pub(super) fn scan(&self, options: &Ros2Options) -> Option<&str> {
        if let Some(asked) = &options.topics.scan {
            return self.scans.get_key_value(asked).map(|(topic, _)| topic.as_str());
        }
        let wanted = options.namespace.as_deref().unwrap_or_default();
        self.scans
            .iter()
            .filter(|(topic, _)| within(topic, wanted))
            .min_by_key(|(topic, frame)| {
                let usual = topic.as_str() == format!("{wanted}/scan");
                let named = topic.ends_with("/scan");
                (!self.is_connected(topic, frame), !usual, !named)
            })
            .map(|(topic, _)| topic.as_str())
    }

    /// True when the transforms connect a laser's frame to some odometry.
    fn is_connected(&self, scan: &str, frame: &str) -> bool {
        let frames = self.frames(scan);
        !frames.is_empty()
            && self
                .odometries
                .values()
                .any(|odometry| mount(&frames, &odometry.base_link, frame).is_some())
    }

    /// True for a topic in the namespace of another car: one that has a scan and odometry and does not hold this scan.
    fn of_another_car(&self, topic: &str, scan: &str) -> bool {
        upwards(namespace_of(topic)).any(|namespace| {
            !namespace.is_empty()
                && !within(scan, namespace)
                && self.scans.keys().any(|other| within(other, namespace))
                && self.odometries.keys().any(|other| within(other, namespace))
        })
    }

    /// The first of `names` in a namespace that sends, else the first topic there that fits and is of no other car.
    fn in_namespace<'a, T>(
        &self,
        topics: &'a BTreeMap<String, T>,
        names: &[&str],
        namespace: &str,
        scan: &str,
        fits: impl Fn(&str) -> bool,
    ) -> Option<&'a str> {
        names
            .iter()
            .find_map(|name| topics.get_key_value(&format!("{namespace}{name}")))
            .or_else(|| {
                topics.iter().find(|(topic, _)| {
                    within(topic, namespace) && fits(topic) && !self.of_another_car(topic, scan)
                })
            })
            .map(|(topic, _)| topic.as_str())
    }

    /// The odometry that goes with a scan, and the car's namespace.
    fn odometry<'a>(&'a self, scan: &'a str, options: &'a Ros2Options) -> Option<(&'a str, &'a str)> {
        let innermost = namespace_of(scan);
        if let Some(asked) = &options.topics.odometry {
            let (topic, _) = self.odometries.get_key_value(asked)?;
            return Some((topic, options.namespace.as_deref().unwrap_or(innermost)));
        }
        let outermost = options.namespace.as_deref().unwrap_or_default();
        let is_output = |topic: &str| options.outputs.iter().any(|output| output == topic);
        upwards(innermost)
            .take_while(|namespace| namespace.len() >= outermost.len())
            .find_map(|namespace| {
                let fits = |topic: &str| is_wheel_odometry(topic) && !is_output(topic);
                let topic = self.in_namespace(&self.odometries, &ODOMETRY_NAMES, namespace, scan, fits)?;
                Some((topic, namespace))
            })
    }

    fn imu(&self, scan: &str, namespace: &str, options: &Ros2Options) -> Option<&str> {
        if let Some(asked) = &options.topics.imu {
            return self.imus.get_key_value(asked).map(|(topic, _)| topic.as_str());
        }
        let names = Kind::Imu.usual_names();
        self.in_namespace(&self.imus, names, namespace, scan, |_| true)
    }

    /// The transforms that a scan's namespace and those around it have.
    pub(super) fn frames(&self, scan: &str) -> Frames {
        let mut frames = Frames::default();
        for (topic, of_topic) in &self.transforms {
            if is_transform_topic_of(topic, scan) {
                frames.extend(of_topic);
            }
        }
        frames
    }

    /// What sends and was not chosen, for people; None when that is nothing.
    pub(super) fn not_taken(&self, choice: &Choice) -> Option<String> {
        let others = |topics: Vec<&String>, taken: Option<&str>| -> Vec<String> {
            topics
                .into_iter()
                .filter(|topic| Some(topic.as_str()) != taken)
                .cloned()
                .collect()
        };
        let kinds = [
            ("scans", others(self.scans.keys().collect(), Some(&choice.scan))),
            (
                "odometry",
                others(self.odometries.keys().collect(), Some(&choice.odometry)),
            ),
            ("IMU", others(self.imus.keys().collect(), choice.imu.as_deref())),
        ];
        let texts: Vec<String> = kinds
            .into_iter()
            .filter(|(_, topics)| !topics.is_empty())
            .map(|(kind, topics)| format!("{kind} {}", listed(&topics)))
            .collect();
        (!texts.is_empty()).then(|| texts.join("; "))
    }
}

/// True for `/tf` and `/tf_static` in a scan's namespace and in those around it.
pub(super) fn is_transform_topic_of(topic: &str, scan: &str) -> bool {
    within(scan, namespace_of(topic))
}

/// How a laser is mounted on the frame that odometry moves, else on `base_link`.
pub(super) fn mount(frames: &Frames, base_link: &str, laser: &str) -> Option<(Mount, String)> {
    [base_link, "base_link", "base_footprint"]
        .into_iter()
        .filter(|base| !base.is_empty())
        .find_map(|base| Some((frames.mount(base, laser)?, base.to_owned())))
}

/// A list for people, of six at most.
pub(super) fn listed(names: &[String]) -> String {
    let shown = names.iter().take(6).cloned().collect::<Vec<_>>().join(", ");
    match names.len() {
        0..=6 => shown,
        all => format!("{shown} and {} more", all - 6),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::messages::{Header, RosPose, TransformStamped};
    use crate::sensors::bag::Topics;

    fn sending(scans: &[&str], odometries: &[&str]) -> Sending {
        let mut sending = Sending::default();
        for scan in scans {
            insert(&mut sending.scans, (*scan).to_owned(), "laser".to_owned());
        }
        for odometry in odometries {
            let topic = OdometryTopic {
                base_link: "base_link".into(),
                ..OdometryTopic::default()
            };
            insert(&mut sending.odometries, (*odometry).to_owned(), topic);
        }
        sending
    }

    fn options() -> Ros2Options {
        Ros2Options::new("tcp/127.0.0.1:7447")
    }

    /// Scan, odometry and namespace that are chosen.
    fn chosen(scans: &[&str], odometries: &[&str], options: &Ros2Options) -> Option<[String; 3]> {
        let choice = sending(scans, odometries).choose(options)?;
        Some([choice.scan, choice.odometry, choice.namespace])
    }

    fn expect(scans: &[&str], odometries: &[&str], expected: [&str; 3]) {
        assert_eq!(
            chosen(scans, odometries, &options()),
            Some(expected.map(str::to_owned)),
            "{scans:?} {odometries:?}"
        );
    }

    #[test]
    fn the_usual_name_is_preferred_and_truth_is_no_odometry() {
        expect(&["/scan"], &["/a", "/odom"], ["/scan", "/odom", ""]);
        expect(&["/scan"], &["/a", "/ground_truth/odom"], ["/scan", "/a", ""]);
        expect(
            &["/scan"],
            &["/pf/pose/odom", "/wheels"],
            ["/scan", "/wheels", ""],
        );
        for output in ["/ground_truth/odom", "/car2/pf/pose/odom"] {
            assert_eq!(chosen(&["/scan"], &[output], &options()), None);
        }
        let asked = Ros2Options {
            topics: Topics {
                odometry: Some("/b".into()),
                ..Topics::default()
            },
            ..options()
        };
        assert_eq!(
            chosen(&["/scan"], &["/a"], &asked),
            None,
            "another one was asked for"
        );
    }

    #[test]
    fn the_topics_of_one_car_belong_together() {
        let scans = ["/car1/scan", "/car2/scan"];
        let odometries = ["/car1/odom", "/car2/vesc/odom"];
        expect(&scans, &odometries, ["/car1/scan", "/car1/odom", "/car1"]);
        let second = Ros2Options {
            namespace: Some("/car2".into()),
            ..options()
        };
        assert_eq!(
            chosen(&scans, &odometries, &second),
            Some(["/car2/scan", "/car2/vesc/odom", "/car2"].map(str::to_owned))
        );
        let third = Ros2Options {
            namespace: Some("/car3".into()),
            ..options()
        };
        assert_eq!(chosen(&scans, &odometries, &third), None);
        // A car in no namespace beside one that has one.
        expect(
            &["/car2/scan", "/scan"],
            &["/car2/odom", "/odom"],
            ["/scan", "/odom", ""],
        );
        assert_eq!(
            chosen(&["/car2/scan", "/scan"], &["/car2/odom"], &options()),
            None
        );
    }

    #[test]
    fn a_lidar_in_a_namespace_of_its_own_belongs_to_the_car_around_it() {
        expect(
            &["/front/scan", "/rear/scan"],
            &["/odom"],
            ["/front/scan", "/odom", ""],
        );
        expect(
            &["/car1/front/scan"],
            &["/car1/odom"],
            ["/car1/front/scan", "/car1/odom", "/car1"],
        );
        // The simulator of F1TENTH.
        expect(
            &["/opp_scan", "/scan"],
            &["/ego_racecar/odom", "/opp_racecar/odom"],
            ["/scan", "/ego_racecar/odom", ""],
        );
    }

    #[test]
    fn a_scan_that_is_connected_to_the_car_is_preferred() {
        let mut sending = sending(&["/rear/scan", "/scan"], &["/odom"]);
        sending.scans.insert("/rear/scan".into(), "rear_laser".into());
        let transform = TransformStamped {
            header: Header {
                frame_id: "base_link".into(),
                ..Header::default()
            },
            child_frame_id: "rear_laser".into(),
            transform: RosPose::default(),
        };
        let mut frames = Frames::default();
        frames.insert(&transform);
        // The transforms of another car say nothing.
        sending
            .transforms
            .insert("/car2/tf_static".into(), frames.clone());
        assert_eq!(sending.scan(&options()), Some("/scan"));
        sending.transforms.insert("/tf_static".into(), frames);
        assert_eq!(sending.scan(&options()), Some("/rear/scan"));
        let choice = sending.choose(&options()).expect("chosen");
        assert_eq!(sending.not_taken(&choice).as_deref(), Some("scans /scan"));
    }

    #[test]
    fn topics_without_end_are_not_kept() {
        let mut topics = BTreeMap::new();
        for i in 0..10_000 {
            insert(&mut topics, format!("/{i}"), i);
        }
        assert_eq!(topics.len(), MOST_TOPICS);
    }
}
