//! Faults that are added to a log, to measure how the health state reacts.

use std::f64::consts::FRAC_PI_4;
use std::fmt;
use std::str::FromStr;

use maps::Pose;
use serde::Serialize;
use synpf::{Scan, Stamp};

use crate::sensors::bag::{Arrival, SensorEvent, SensorLog};

/// The kinds of faults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum FaultKind {
    /// The car is carried to where it is at the end of the fault, and odometry does not notice: the time between is cut out.
    Kidnap,
    /// The same time is cut out, as from an edited bag. Odometry stays as it was logged, so that its pose jumps.
    Splice,
    /// No scans arrive.
    NoScans,
    /// No odometry arrives.
    NoOdometry,
    /// A car drives 0.7 m ahead and blocks the middle 90 deg of the view.
    Blocked,
    /// Half of the walls are black tubes: every other stripe of 10 deg has no returns.
    BlackTubes,
}

impl FaultKind {
    const NAMES: [(Self, &'static str); 6] = [
        (Self::Kidnap, "kidnap"),
        (Self::Splice, "splice"),
        (Self::NoScans, "no-scans"),
        (Self::NoOdometry, "no-odometry"),
        (Self::Blocked, "blocked"),
        (Self::BlackTubes, "black-tubes"),
    ];

    /// True when it cuts its time out of the log, so that everything after it moves by that time.
    pub fn cuts(self) -> bool {
        matches!(self, Self::Kidnap | Self::Splice)
    }
}

/// A fault in a log. As text: `kidnap@20+4`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Fault {
    /// Its kind.
    pub kind: FaultKind,
    /// Its start, after the first scan \[s\].
    pub at: f64,
    /// Its duration \[s\].
    pub duration: f64,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = FaultKind::NAMES
            .iter()
            .find_map(|(kind, name)| (*kind == self.kind).then_some(*name))
            .expect("every kind has a name");
        write!(f, "{name}@{}+{}", self.at, self.duration)
    }
}

impl FromStr for Fault {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let usage = || {
            let names = FaultKind::NAMES.map(|(_, name)| name).join(", ");
            format!("{text:?} is not KIND@SECONDS+SECONDS, as in kidnap@20+4; kinds are {names}")
        };
        let (name, times) = text.split_once('@').ok_or_else(usage)?;
        let (at, duration) = times.split_once('+').ok_or_else(usage)?;
        let kind = FaultKind::NAMES
            .iter()
            .find_map(|(kind, known)| (*known == name).then_some(*kind))
            .ok_or_else(usage)?;
        let seconds = |text: &str| {
            let seconds: f64 = text.parse().map_err(|_| usage())?;
            if (0.0..1e6).contains(&seconds) {
                Ok(seconds)
            } else {
                Err(usage())
            }
        };
        Ok(Self {
            kind,
            at: seconds(at)?,
            duration: seconds(duration)?,
        })
    }
}

impl Fault {
    /// When it first shows, after the first scan \[s\]: at its start, or at the end of what it cuts out.
    pub fn shows_at(&self) -> f64 {
        if self.kind.cuts() {
            self.at + self.duration
        } else {
            self.at
        }
    }

    /// Adds the fault to a log. A log without a scan stays as it is.
    pub fn apply(&self, log: &mut SensorLog) {
        let Some([first, _]) = log.span() else {
            return;
        };
        let begin = first.plus(self.at);
        let within = |stamp: Stamp| (0.0..self.duration).contains(&stamp.since(begin));
        match self.kind {
            FaultKind::Kidnap => {
                self.cut(log, begin);
                rejoin_odometry(log, begin);
            }
            FaultKind::Splice => self.cut(log, begin),
            FaultKind::NoScans => log.arrivals.retain(|arrival| {
                !(matches!(arrival.event, SensorEvent::Scan(_)) && within(arrival.event.stamp()))
            }),
            FaultKind::NoOdometry => log.arrivals.retain(|arrival| {
                matches!(arrival.event, SensorEvent::Scan(_)) || !within(arrival.event.stamp())
            }),
            FaultKind::Blocked => on_beams(log, within, |angle, range| {
                if angle.abs() < FRAC_PI_4 {
                    *range = range.min(0.7);
                }
            }),
            FaultKind::BlackTubes => on_beams(log, within, |angle, range| {
                if (angle.to_degrees() / 10.0).floor().rem_euclid(2.0) < 1.0 {
                    *range = f32::INFINITY;
                }
            }),
        }
    }

    /// Cuts the time of the fault out of the log.
    fn cut(&self, log: &mut SensorLog, begin: Stamp) {
        let within = |stamp: Stamp| (0.0..self.duration).contains(&stamp.since(begin));
        let close_up = |stamp: &mut Stamp, by: Stamp| {
            if by.since(begin) >= self.duration {
                *stamp = stamp.plus(-self.duration);
            }
        };
        log.arrivals.retain(|arrival| !within(arrival.event.stamp()));
        for Arrival { log_time, event } in &mut log.arrivals {
            let stamp = event.stamp();
            close_up(log_time, stamp);
            close_up(event.stamp_mut(), stamp);
        }
        log.truth.retain(|(stamp, _)| !within(*stamp));
        for (stamp, _) in &mut log.truth {
            close_up(stamp, *stamp);
        }
    }
}

/// Makes odometry continue after `cut` from where it was before.
fn rejoin_odometry(log: &mut SensorLog, cut: Stamp) {
    let (mut before, mut after) = (None, None);
    for arrival in &mut log.arrivals {
        if let SensorEvent::Odometry(odometry) = &mut arrival.event {
            if odometry.stamp.since(cut) >= 0.0 {
                let from: Pose = *after.get_or_insert(odometry.pose);
                let to: Pose = *before.get_or_insert(odometry.pose);
                odometry.pose = to * odometry.pose.since(from);
            } else {
                before = Some(odometry.pose);
            }
        }
    }
}

/// Changes every beam of the scans within the fault; `change` gets its direction in the laser's frame \[rad\].
fn on_beams(log: &mut SensorLog, within: impl Fn(Stamp) -> bool, change: impl Fn(f64, &mut f32)) {
    let scans = log
        .arrivals
        .iter_mut()
        .filter_map(|arrival| match &mut arrival.event {
            SensorEvent::Scan(scan) if within(scan.stamp) => Some(scan),
            _ => None,
        });
    for Scan {
        angle_min,
        angle_increment,
        ranges,
        ..
    } in scans
    {
        for (beam, range) in ranges.iter_mut().enumerate() {
            change(*angle_min + beam as f64 * *angle_increment, range);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensors::bag::Topics;
    use synpf::{Odometry, Twist};

    /// Ten seconds at 1 m/s along x: a scan of four beams and odometry, ten times a second, and the truth.
    fn log() -> SensorLog {
        let mut log = SensorLog {
            notes: Vec::new(),
            arrivals: Vec::new(),
            mount: None,
            truth: Vec::new(),
            topics: Topics::default(),
        };
        for tenth in 0..100 {
            let t = f64::from(tenth) / 10.0;
            let stamp = Stamp(1_000_000_000).plus(t);
            let pose = Pose::new(t, 0.0, 0.0);
            let odometry = Odometry {
                stamp,
                pose,
                twist: Twist::default(),
            };
            let scan = Scan {
                stamp,
                angle_min: -0.2,
                angle_increment: 0.15,
                time_increment: 0.0,
                scan_time: None,
                angle_max: None,
                range_min: 0.1,
                range_max: 10.0,
                ranges: vec![5.0; 4],
            };
            for event in [SensorEvent::Odometry(odometry), SensorEvent::Scan(scan)] {
                let log_time = stamp.plus(0.02);
                log.arrivals.push(Arrival { log_time, event });
            }
            log.truth.push((stamp, pose));
        }
        log
    }

    fn after(fault: &str) -> SensorLog {
        let mut log = log();
        fault.parse::<Fault>().expect("a fault").apply(&mut log);
        log
    }

    fn odometry(log: &SensorLog) -> Vec<Odometry> {
        let events = log.arrivals.iter().map(|arrival| &arrival.event);
        events
            .filter_map(|event| match event {
                SensorEvent::Odometry(odometry) => Some(*odometry),
                _ => None,
            })
            .collect()
    }

    #[test]
    fn in_a_spliced_log_time_goes_on_and_odometry_jumps_as_far_as_the_car() {
        let (kidnapped, spliced) = (after("kidnap@4+3"), after("splice@4+3"));
        assert_eq!(spliced.truth, kidnapped.truth);
        let [hidden, jumps] = [&kidnapped, &spliced].map(odometry);
        let stamps = |list: &[Odometry]| list.iter().map(|o| o.stamp).collect::<Vec<_>>();
        assert_eq!(stamps(&jumps), stamps(&hidden));
        let steps: Vec<f64> = jumps
            .windows(2)
            .map(|pair| pair[1].pose.x - pair[0].pose.x)
            .collect();
        let far: Vec<_> = steps.iter().filter(|step| **step > 0.11).collect();
        assert!(far.len() == 1 && (far[0] - 3.1).abs() < 1e-9, "{far:?}");
        assert!(jumps.iter().all(|o| spliced.truth.contains(&(o.stamp, o.pose))));
    }

    #[test]
    fn a_kidnapped_car_is_elsewhere_without_a_jump_of_odometry_or_time() {
        let log = after("kidnap@4+3");
        assert_eq!(log.arrivals.len(), 140);
        let odometry = odometry(&log);
        let truth = |stamp| log.truth.iter().find(|(at, _)| *at == stamp).expect("known").1;
        for pair in odometry.windows(2) {
            assert!((pair[1].stamp.since(pair[0].stamp) - 0.1).abs() < 1e-9);
            assert!(pair[1].pose.x - pair[0].pose.x < 0.11);
        }
        let last = odometry.last().expect("some");
        // The first step after the cut is lost with it.
        assert!((truth(last.stamp).x - last.pose.x - 3.1).abs() < 1e-9);
        assert!(
            log.arrivals
                .windows(2)
                .all(|pair| pair[0].log_time <= pair[1].log_time)
        );
    }

    #[test]
    fn sensors_are_silent_for_the_duration() {
        assert_eq!(after("no-scans@2+1.5").arrivals.len(), 185);
        assert_eq!(after("no-odometry@2+1.5").arrivals.len(), 185);
    }

    #[test]
    fn beams_are_blocked_and_lost_only_during_the_fault() {
        let ranges = |log: &SensorLog, index: usize| match &log.arrivals[index].event {
            SensorEvent::Scan(scan) => scan.ranges.clone(),
            _ => panic!("no scan"),
        };
        let blocked = after("blocked@1+1");
        assert_eq!(ranges(&blocked, 21), [0.7; 4]);
        assert_eq!(ranges(&blocked, 41), [5.0; 4]);
        // At -11, -3, 6 and 14 degrees.
        let tubes = after("black-tubes@1+1");
        assert_eq!(ranges(&tubes, 21), [f32::INFINITY, 5.0, f32::INFINITY, 5.0]);
    }

    #[test]
    fn text_and_fault_are_the_same() {
        let fault: Fault = "kidnap@20+4".parse().expect("a fault");
        assert_eq!((fault.at, fault.duration), (20.0, 4.0));
        assert_eq!(fault.to_string(), "kidnap@20+4");
        for text in [
            "",
            "kidnap",
            "kidnap@1",
            "kidnap@-1+2",
            "kidnap@1+NaN",
            "flood@1+2",
        ] {
            let error = text.parse::<Fault>().expect_err("no fault");
            assert!(error.contains("black-tubes"), "{error}");
        }
    }
}
