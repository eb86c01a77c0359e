//! Chooses the topics of one car, and makes of their messages what a localizer takes.

use maps::Pose;
use synpf::{ExternalPose, Odometry, Stamp};

use super::{
    Arrival, Bag, BagError, IMU_NAMES, Messages, ODOMETRY_NAMES, SensorEvent, SensorLog, StampedPoses,
    TRUTH_NAMES, Topics, is_wheel_odometry,
};
use crate::ros2::messages::{LaserScan, RosOdometry};
use crate::sensors::external_pose::PoseFrames;
use crate::sensors::frames::{BASE_LINK, Frames, Mount, is_base};
use crate::sensors::sweep_stamps::EndStamps;
use crate::statistics::percentile;

/// Stamps of a sensor that are this far from those of the others are of another clock \[s\].
const OTHER_CLOCK: f64 = 0.5;
/// Where odometry's frame is nearer than this to `base_link`, it counts as `base_link` \[m\].
const SAME_PLACE: f64 = 1e-3;

/// The messages of a kind on one topic.
type OfTopic<'a, T> = (&'a str, &'a [(Stamp, T)]);

impl Bag {
    /// The sensor data. `mount` overrides `/tf_static`.
    pub fn sensors(&self, wanted: &Topics, mount: Option<Mount>) -> Result<SensorLog, BagError> {
        let mut notes = self.notes.clone();
        // Truth first, so that it is not taken for odometry.
        let truth = self.truth(wanted.truth.as_deref())?;
        let truth_topic = truth.as_ref().map(|(topic, _)| *topic);

        let scans = self.of_kind("sensor_msgs/LaserScan", wanted.scan.as_deref(), |m| match m {
            Messages::Scan(list) => Some(list),
            _ => None,
        })?;
        let odometries: Vec<_> = self
            .of_kind("nav_msgs/Odometry", wanted.odometry.as_deref(), |m| match m {
                Messages::Odometry(list) => Some(list),
                _ => None,
            })?
            .into_iter()
            .filter(|(topic, _)| {
                let other = [truth_topic, wanted.pose.as_deref()].contains(&Some(*topic));
                wanted.odometry.is_some() || (!other && is_wheel_odometry(topic))
            })
            .collect();
        let imus = self.of_kind("sensor_msgs/Imu", wanted.imu.as_deref(), |m| match m {
            Messages::Imu(list) => Some(list),
            _ => None,
        });
        // A car without a gyroscope is a car, unless one was asked for.
        let imus = imus.or_else(|error| wanted.imu.as_ref().map_or(Ok(Vec::new()), |_| Err(error)))?;

        let frames = self.frames();
        let namespaces: Vec<&str> = scans.iter().map(|(topic, _)| namespace(topic)).collect();
        let preference = |scan: &OfTopic<LaserScan>| preference(scan, &odometries, &frames, &namespaces);
        // Of two that are equal, the first.
        let scan = scans
            .iter()
            .rev()
            .max_by(|a, b| preference(a).total_cmp(&preference(b)))
            .copied();
        let (scan_topic, scans_taken) = scan.ok_or_else(|| self.missing("of type sensor_msgs/LaserScan"))?;
        let (odometry_topic, odometry) = beside(scan_topic, &namespaces, &odometries, &ODOMETRY_NAMES)
            .ok_or_else(|| self.missing("of type nav_msgs/Odometry that is wheel odometry"))?;
        let imu = beside(scan_topic, &namespaces, &imus, &IMU_NAMES);
        note_of_choice(&mut notes, "scans are", scan_topic, &scans);
        note_of_choice(&mut notes, "odometry is", odometry_topic, &odometries);

        let carrier = Carrier::new(odometry_topic, odometry, &frames, &mut notes);
        let mount = match mount {
            Some(mount) => Some(mount),
            None => self.mount(&carrier, scans_taken, &frames)?,
        };
        let upside_down = mount.is_some_and(|mount| mount.upside_down);
        let mut scan_events = events(scans_taken, |m| SensorEvent::Scan(m.to_scan(upside_down)));
        let mut odometry_events = events(odometry, |m| {
            SensorEvent::Odometry(carrier.at_base_link(m.to_odometry()))
        });
        let mut imu_events = imu.map_or(Vec::new(), |(_, imu)| {
            events(imu, |m| SensorEvent::YawRate(m.to_yaw_rate()))
        });
        stamps_to_first_beams(scan_topic, &mut scan_events, &mut notes);
        let mut streams = [
            (odometry_topic, &mut odometry_events),
            (scan_topic, &mut scan_events),
            (imu.map_or("", |(topic, _)| topic), &mut imu_events),
        ];
        to_one_clock(&mut streams, &mut notes);

        let frames = PoseFrames {
            laser: scans_taken
                .first()
                .map_or_else(String::new, |(_, scan)| scan.header.frame_id.clone()),
            odom: odometry
                .first()
                .map_or_else(String::new, |(_, odometry)| odometry.header.frame_id.clone()),
            of: wanted.pose_of,
        };
        let mut poses = match &wanted.pose {
            Some(topic) => self.external_poses(topic, &frames)?,
            None => Vec::new(),
        };

        // Of messages with the same log time, odometry comes first: the prediction for a scan needs it.
        let mut arrivals = odometry_events;
        arrivals.append(&mut imu_events);
        arrivals.append(&mut poses);
        arrivals.append(&mut scan_events);
        arrivals.sort_by_key(|arrival| arrival.log_time);
        let mut log = SensorLog {
            arrivals,
            mount,
            topics: Topics {
                scan: Some(scan_topic.to_owned()),
                odometry: Some(odometry_topic.to_owned()),
                truth: truth_topic.map(str::to_owned),
                imu: imu.map(|(topic, _)| topic.to_owned()),
                pose: wanted.pose.clone(),
                pose_of: wanted.pose_of,
            },
            truth: truth.map(|(_, poses)| poses).unwrap_or_default(),
            notes,
        };
        log.leave_out_truth_of_another_time();
        Ok(log)
    }

    /// The topics of a kind that have messages, or the one that is asked for. An error names what is missing or empty.
    fn of_kind<'a, T>(
        &'a self,
        kind: &str,
        wanted: Option<&str>,
        of_kind: impl Fn(&'a Messages) -> Option<&'a Vec<(Stamp, T)>>,
    ) -> Result<Vec<OfTopic<'a, T>>, BagError> {
        let topics: Vec<OfTopic<'a, T>> = self
            .topics
            .iter()
            .filter(|(topic, _)| wanted.is_none_or(|wanted| wanted == *topic))
            .filter_map(|(topic, messages)| Some((topic.as_str(), of_kind(messages)?.as_slice())))
            .collect();
        let empty = |(topic, messages): &OfTopic<'a, T>| {
            messages.is_empty() && (wanted.is_some() || is_wheel_odometry(topic))
        };
        let usable = |(topic, messages): &&OfTopic<'a, T>| {
            !messages.is_empty() && (wanted.is_some() || is_wheel_odometry(topic))
        };
        if topics.iter().any(|topic| usable(&topic)) {
            return Ok(topics.into_iter().filter(|(_, list)| !list.is_empty()).collect());
        }
        match (topics.iter().find(|topic| empty(topic)), wanted) {
            (Some((topic, _)), _) => Err(BagError::NoMessages {
                path: self.path.clone(),
                topic: (*topic).to_owned(),
            }),
            (None, Some(name)) => Err(self.missing(&format!("{name} of type {kind}"))),
            (None, None) => Err(self.missing(&format!("of type {kind}"))),
        }
    }

    fn truth(&self, wanted: Option<&str>) -> Result<Option<(&str, StampedPoses)>, BagError> {
        let names: Vec<&str> = wanted.map_or(TRUTH_NAMES.to_vec(), |name| vec![name]);
        let found = names.iter().find_map(|name| {
            let (topic, messages) = self.topics.get_key_value(*name)?;
            let poses: StampedPoses = match messages {
                Messages::Odometry(list) => list
                    .iter()
                    .map(|(_, m)| (m.header.stamp.into(), m.pose.planar()))
                    .collect(),
                Messages::Pose(list) => list
                    .iter()
                    .map(|(_, m)| (m.header.stamp.into(), m.pose.planar()))
                    .collect(),
                _ => return None,
            };
            Some((topic.as_str(), poses))
        });
        match (found, wanted) {
            (None, Some(name)) => Err(self.missing(&format!(
                "{name} of type nav_msgs/Odometry or geometry_msgs/PoseStamped"
            ))),
            (Some((topic, poses)), Some(_)) if poses.is_empty() => Err(BagError::NoMessages {
                path: self.path.clone(),
                topic: topic.to_owned(),
            }),
            (found, _) => Ok(found),
        }
    }

    /// The poses of another localizer.
    fn external_poses(&self, topic: &str, frames: &PoseFrames) -> Result<Vec<Arrival>, BagError> {
        let fault = |fault: String| BagError::Topic {
            path: self.path.clone(),
            topic: topic.to_owned(),
            fault,
        };
        let poses = match self.topics.get(topic) {
            Some(Messages::Odometry(list)) => read(list, |message| frames.odometry(message).map(Some)),
            Some(Messages::Pose(list)) => read(list, |message| frames.pose_stamped(message).map(Some)),
            Some(Messages::PoseWithCovariance(list)) => {
                read(list, |message| frames.with_covariance(message).map(Some))
            }
            Some(Messages::Tf(list)) => read(list, |message| Ok(frames.transform(message))),
            Some(Messages::Scan(_) | Messages::Imu(_)) | None => {
                return Err(self.missing(&format!("{topic} of a type with poses")));
            }
        };
        let poses = poses.map_err(fault)?;
        if poses.is_empty() {
            let text = "there is no pose on it: no message, or no transform from map to a frame of the car";
            return Err(fault(text.into()));
        }
        Ok(poses)
    }

    /// The frames that do not move: those of `/tf_static`, and what `/tf` repeats without a change.
    fn frames(&self) -> Frames {
        let mut frames = Frames::default();
        let lists = |is_static: bool| {
            self.topics
                .iter()
                .filter_map(move |(topic, messages)| match messages {
                    Messages::Tf(list) if topic.ends_with("tf_static") == is_static => Some(list),
                    _ => None,
                })
                .flatten()
                .flat_map(|(_, message)| &message.transforms)
        };
        for transform in lists(false) {
            frames.insert_if_constant(transform);
        }
        frames.drop_moving();
        for transform in lists(true) {
            frames.insert(transform);
        }
        frames
    }

    /// The mount by the frames; None in a bag without them.
    fn mount(
        &self,
        carrier: &Carrier,
        scans: &[(Stamp, LaserScan)],
        frames: &Frames,
    ) -> Result<Option<Mount>, BagError> {
        let Some((_, scan)) = scans.first() else {
            return Ok(None);
        };
        if frames.is_empty() {
            return Ok(None);
        }
        let laser = &scan.header.frame_id;
        frames
            .mount(&carrier.frame, laser)
            .map(Some)
            .ok_or_else(|| BagError::NoMount {
                path: self.path.clone(),
                base_link: carrier.frame.clone(),
                laser: laser.clone(),
            })
    }

    fn missing(&self, wanted: &str) -> BagError {
        let present = self.topics.keys().map(String::as_str).collect::<Vec<_>>();
        BagError::NoTopic {
            path: self.path.clone(),
            wanted: wanted.into(),
            present: if present.is_empty() {
                "none that a localizer can use".into()
            } else {
                present.join(", ")
            },
        }
    }
}

impl SensorLog {
    /// Truth at other times than the scans' is of no use.
    fn leave_out_truth_of_another_time(&mut self) {
        let Some([first, last]) = self.span() else {
            return;
        };
        let within = |(stamp, _): &(Stamp, Pose)| (first.plus(-1.0)..=last.plus(1.0)).contains(stamp);
        if !self.truth.is_empty() && !self.truth.iter().any(within) {
            let topic = self.topics.truth.as_deref().unwrap_or("truth");
            let stamp = self.truth[0].0;
            self.notes.push(format!(
                "{topic}: its stamps, such as {:.3} s, are not of the time of the scans, which begin at {:.3} s: it is not used",
                stamp.since(Stamp(0)),
                first.since(Stamp(0))
            ));
            self.truth.clear();
        }
    }
}

/// The arrivals of another localizer's poses.
fn read<T>(
    messages: &[(Stamp, T)],
    pose: impl Fn(&T) -> Result<Option<ExternalPose>, String>,
) -> Result<Vec<Arrival>, String> {
    let arrival = |(log_time, message): &(Stamp, T)| {
        let event = pose(message).transpose()?;
        Some(event.map(|pose| Arrival {
            log_time: *log_time,
            event: SensorEvent::Pose(pose),
        }))
    };
    messages.iter().filter_map(arrival).collect()
}

/// The namespace of a topic: `/car2` for `/car2/scan`, nothing for `/scan`.
fn namespace(topic: &str) -> &str {
    topic.rsplit_once('/').map_or("", |(namespace, _)| namespace)
}

/// True for a topic in a namespace or below it.
fn is_in(topic: &str, namespace: &str) -> bool {
    topic
        .strip_prefix(namespace)
        .is_some_and(|rest| rest.starts_with('/'))
}

/// True for a topic in the namespace of a scan that is not in `own`: of another car, perhaps.
fn is_of_another(topic: &str, own: &str, namespaces: &[&str]) -> bool {
    namespaces
        .iter()
        .any(|other| !other.is_empty() && *other != own && is_in(topic, other))
}

/// How much one topic of scans is to be preferred: with odometry beside it, then with a frame that is connected to the car's,
/// then by its usual name, then by its field of view, of which a depth camera's is narrow.
fn preference(
    (topic, scans): &OfTopic<LaserScan>,
    odometries: &[OfTopic<RosOdometry>],
    frames: &Frames,
    namespaces: &[&str],
) -> f64 {
    let own = namespace(topic);
    let beside: Vec<_> = odometries
        .iter()
        .filter(|(odometry, _)| is_in(odometry, own) && !is_of_another(odometry, own, namespaces))
        .collect();
    let connected = odometries.iter().any(|(_, odometry)| {
        odometry
            .first()
            .zip(scans.first())
            .is_some_and(|((_, odometry), (_, scan))| {
                frames.mount(base_of(odometry), &scan.header.frame_id).is_some()
            })
    });
    let view = scans.first().map_or(0.0, |(_, scan)| {
        f64::from((scan.angle_max - scan.angle_min).abs().clamp(0.0, 7.0))
    });
    let view = if view.is_finite() { view } else { 0.0 };
    let count = |holds: bool, weight: f64| if holds { weight } else { 0.0 };
    count(!beside.is_empty(), 400.0)
        + count(connected, 200.0)
        + count(super::SCAN_NAMES.contains(topic), 100.0)
        + view
}

/// The topic that belongs to the scans': in their namespace, else in none of another car; the usual names first, then by the
/// alphabet.
fn beside<'a, T>(
    scan: &str,
    namespaces: &[&str],
    topics: &[OfTopic<'a, T>],
    usual: &[&str],
) -> Option<OfTopic<'a, T>> {
    let own = namespace(scan);
    let rank = |topic: &str| {
        let inside = is_in(topic, own);
        let bare = if inside { &topic[own.len()..] } else { topic };
        let place = if is_of_another(topic, own, namespaces) {
            2
        } else {
            usize::from(!inside)
        };
        let name = usual.iter().position(|name| *name == bare);
        (place, name.unwrap_or(usual.len()))
    };
    topics.iter().min_by_key(|(topic, _)| rank(topic)).copied()
}

fn note_of_choice<T>(notes: &mut Vec<String>, what: &str, taken: &str, all: &[OfTopic<T>]) {
    let others: Vec<&str> = all
        .iter()
        .map(|(topic, _)| *topic)
        .filter(|topic| *topic != taken)
        .collect();
    if !others.is_empty() {
        notes.push(format!(
            "{what} from {taken}; there is also {}",
            others.join(", ")
        ));
    }
}

fn base_of(odometry: &RosOdometry) -> &str {
    match odometry.child_frame_id.as_str() {
        "" => BASE_LINK,
        frame => frame,
    }
}

/// The frame that odometry moves, and where it is on the car.
struct Carrier {
    /// The frame that poses are of.
    frame: String,
    /// `base_link` in the frame that odometry moves; None where the two are one.
    from_base_link: Option<Pose>,
}

impl Carrier {
    fn new(topic: &str, odometry: &[(Stamp, RosOdometry)], frames: &Frames, notes: &mut Vec<String>) -> Self {
        let named = odometry
            .first()
            .map_or("", |(_, odometry)| &odometry.child_frame_id);
        let frame = odometry
            .first()
            .map_or(BASE_LINK, |(_, odometry)| base_of(odometry));
        if named.is_empty() && !frames.is_empty() {
            notes.push(format!(
                "{topic} names no frame that it moves: {BASE_LINK} is assumed"
            ));
        }
        if !is_base(frame)
            && let Some((base_link, from_base_link)) = frames.base_link_beside(frame)
            && from_base_link.x.hypot(from_base_link.y) > SAME_PLACE
        {
            notes.push(format!("{topic} moves {frame}: it is converted to {base_link}"));
            return Self {
                frame: base_link,
                from_base_link: Some(from_base_link),
            };
        }
        Self {
            frame: frame.to_owned(),
            from_base_link: None,
        }
    }

    /// Odometry of `base_link`, which is fixed to the frame that it was measured for.
    fn at_base_link(&self, odometry: Odometry) -> Odometry {
        self.from_base_link
            .map_or(odometry, |from_base_link| odometry.carried_to(from_base_link))
    }
}

fn events<T>(messages: &[(Stamp, T)], event: impl Fn(&T) -> SensorEvent) -> Vec<Arrival> {
    messages
        .iter()
        .map(|(log_time, message)| Arrival {
            log_time: *log_time,
            event: event(message),
        })
        .collect()
}

/// Stamps of the last beam become those of the first.
fn stamps_to_first_beams(topic: &str, scans: &mut [Arrival], notes: &mut Vec<String>) {
    let sweep = |arrival: &Arrival| match &arrival.event {
        SensorEvent::Scan(scan) => scan.sweep(),
        _ => 0.0,
    };
    let ages: Vec<[f64; 2]> = scans
        .iter()
        .map(|arrival| [arrival.log_time.since(arrival.event.stamp()), sweep(arrival)])
        .collect();
    let Some(found) = EndStamps::find(&ages) else {
        return;
    };
    notes.push(found.text(topic));
    for arrival in scans {
        let sweep = sweep(arrival);
        let stamp = arrival.event.stamp_mut();
        *stamp = stamp.plus(-sweep);
    }
}

/// Puts sensors whose stamps are of another clock, such as the time since boot, on the clock of the others. Each arrival's
/// time shows the difference. The sensor whose stamps are nearest to the times of arrival is right.
fn to_one_clock(streams: &mut [(&str, &mut Vec<Arrival>)], notes: &mut Vec<String>) {
    let behind = |arrivals: &[Arrival]| {
        let differences: Vec<f64> = arrivals
            .iter()
            .map(|arrival| arrival.log_time.since(arrival.event.stamp()))
            .collect();
        percentile(&differences, 0.5)
    };
    let right = streams
        .iter()
        .filter_map(|(_, arrivals)| behind(arrivals))
        .min_by(|a, b| a.abs().total_cmp(&b.abs()));
    let Some(right) = right else {
        return;
    };
    for (topic, arrivals) in streams {
        let Some(off) = behind(arrivals).map(|behind| behind - right) else {
            continue;
        };
        if off.abs() < OTHER_CLOCK {
            continue;
        }
        let first = arrivals[0].event.stamp();
        if arrivals.iter().all(|arrival| arrival.event.stamp() == first) {
            notes.push(format!(
                "{topic}: every stamp is {} s: the times of arrival are used in place",
                first.since(Stamp(0))
            ));
            for arrival in arrivals.iter_mut() {
                *arrival.event.stamp_mut() = arrival.log_time;
            }
        } else {
            notes.push(format!(
                "{topic}: its stamps are {off:.3} s behind those of the other sensors: they are moved by that"
            ));
            for arrival in arrivals.iter_mut() {
                let stamp = arrival.event.stamp_mut();
                *stamp = stamp.plus(off);
            }
        }
    }
}
