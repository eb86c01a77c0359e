//! Defects of what the sensors deliver, message by message, for logs and for races.

use std::collections::VecDeque;
use std::f64::consts::FRAC_PI_4;

use maps::Pose;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use synpf::{Odometry, Scan, Stamp, Twist, YawRate};

use super::catalogue::{Defect, DefectKind};
use super::surroundings;
use super::sweep::SweepMaker;
use crate::sensors::bag::{Arrival, SensorEvent};

/// The true pose `map_from_base_link` at a time; None where it is not known.
pub type TruePose<'a> = &'a dyn Fn(Stamp) -> Option<Pose>;

/// Slip, frozen scans and gaps repeat after this time \[s\].
const SLIP_EVERY: f64 = 5.0;
const FAULT_EVERY: f64 = 10.0;

/// A car that is slower than this does not slip [m/s].
const DRIVING: f64 = 0.3;

/// Rate of a gyroscope that is added to a car without one: one reading per this time \[s\].
const GYRO_PERIOD: f64 = 0.01;

/// A message as it arrives, with the time at which it was measured: a damaged stamp may differ from it.
#[derive(Debug, Clone, PartialEq)]
pub struct DamagedArrival {
    /// The message.
    pub arrival: Arrival,
    /// When it was measured.
    pub measured: Stamp,
}

/// Damages the messages of one car, in the order in which they arrive.
#[derive(Debug)]
pub(super) struct SensorDamage {
    defect: Defect,
    base_link_from_laser: Pose,
    /// The car has a gyroscope of its own; otherwise one is added for the defects of gyroscopes.
    has_gyro: bool,
    random: SmallRng,
    /// The stamp of the first message.
    begin: Option<Stamp>,
    /// The latest odometry, as it came in and as it went out.
    odometry: Option<[Odometry; 2]>,
    latest_gyro: Option<Stamp>,
    /// The latest scan or odometry message that was passed on, for lower rates.
    latest_passed: Option<Stamp>,
    frozen: Option<Vec<f32>>,
    sweep: Option<SweepMaker>,
}

impl SensorDamage {
    /// None for a defect that is none of the sensors.
    pub(super) fn new(defect: Defect, base_link_from_laser: Pose, has_gyro: bool, seed: u64) -> Option<Self> {
        use super::catalogue::Part;
        let sensors = !matches!(defect.kind.part(), Part::Map | Part::Car);
        sensors.then(|| Self {
            defect,
            base_link_from_laser,
            has_gyro,
            random: SmallRng::seed_from_u64(
                seed.wrapping_mul(1009)
                    .wrapping_add(defect.kind as u64 * 3 + defect.grade as u64),
            ),
            begin: None,
            odometry: None,
            latest_gyro: None,
            latest_passed: None,
            frozen: None,
            sweep: (defect.kind == DefectKind::NoTimeIncrement)
                .then(|| SweepMaker::new(1.0 / defect.size(), base_link_from_laser)),
        })
    }

    /// Adds what becomes of a message to `out`: nothing, the message, or more than one. `truth` is the true pose at its stamp
    /// and a little before.
    pub(super) fn damage(&mut self, arrival: Arrival, truth: TruePose<'_>, out: &mut Vec<DamagedArrival>) {
        let Arrival { log_time, event } = arrival;
        let measured = event.stamp();
        let begin = *self.begin.get_or_insert(measured);
        let elapsed = measured.since(begin);
        let damaged = match event {
            SensorEvent::Scan(scan) => self.scan(scan, log_time, elapsed, truth),
            SensorEvent::Odometry(odometry) => {
                if self.defect.kind.part() == super::catalogue::Part::Gyro && !self.has_gyro {
                    self.add_gyro(odometry.stamp, log_time, truth, out);
                }
                self.odometry(odometry, log_time, elapsed)
            }
            SensorEvent::YawRate(reading) => self.gyro(reading).map(|reading| Arrival {
                log_time,
                event: SensorEvent::YawRate(reading),
            }),
            // What another localizer makes of its sensors is not damaged here.
            event @ SensorEvent::Pose(_) => Some(Arrival { log_time, event }),
        };
        out.extend(damaged.map(|arrival| DamagedArrival {
            // A sweep begins earlier than the scan that completes it.
            measured: match &arrival.event {
                SensorEvent::Scan(scan) if self.sweep.is_some() => scan.stamp,
                _ => measured,
            },
            arrival,
        }));
    }

    fn normal(&mut self) -> f64 {
        StandardNormal.sample(&mut self.random)
    }

    /// True with this probability in percent.
    fn chance(&mut self, percent: f64) -> bool {
        self.random.random_range(0.0..100.0) < percent
    }

    /// True when a message at `rate` \[Hz\] is due; the caller then passes it on.
    fn due(&mut self, stamp: Stamp, rate: f64) -> bool {
        let due = self
            .latest_passed
            .is_none_or(|latest| stamp.since(latest) > 0.9 / rate);
        if due {
            self.latest_passed = Some(stamp);
        }
        due
    }

    #[expect(clippy::too_many_lines, reason = "one arm for each kind of defect")]
    fn scan(
        &mut self,
        mut scan: Scan,
        mut log_time: Stamp,
        elapsed: f64,
        truth: TruePose<'_>,
    ) -> Option<Arrival> {
        let size = self.defect.size();
        let map_from_laser = |stamp: Stamp| truth(stamp).map(|pose| pose * self.base_link_from_laser);
        match self.defect.kind {
            DefectKind::Boards => {
                if let Some(laser) = map_from_laser(middle(&scan)) {
                    surroundings::boards(&mut scan, laser, size / 100.0);
                }
            }
            DefectKind::People => {
                if let Some(laser) = map_from_laser(middle(&scan)) {
                    surroundings::people(&mut scan, laser, size / 100.0);
                }
            }
            DefectKind::Cars => {
                let twist = self.odometry.map_or(Twist::default(), |[came, _]| came.twist);
                let noise = &mut self.random;
                surroundings::cars(&mut scan, self.base_link_from_laser, twist, size as usize, noise);
            }
            DefectKind::RangeNoise => {
                for beam in 0..scan.ranges.len() {
                    let noise = (size / 100.0 * self.normal()) as f32;
                    let range = scan.ranges[beam] + noise;
                    // A range below the scanner's least would be no return; NaN is none.
                    if range.is_finite() {
                        scan.ranges[beam] = range.max(scan.range_min as f32);
                    }
                }
            }
            DefectKind::Dropout => {
                for beam in 0..scan.ranges.len() {
                    if self.chance(size) {
                        scan.ranges[beam] = f32::INFINITY;
                    }
                }
            }
            DefectKind::ShortReturns => {
                for beam in 0..scan.ranges.len() {
                    if self.chance(size) {
                        let wall = scan.ranges[beam].min(scan.range_max as f32);
                        let share: f32 = self.random.random_range(0.0..1.0);
                        scan.ranges[beam] = (share * wall).max(scan.range_min as f32);
                    }
                }
            }
            DefectKind::RangeBias => {
                for range in &mut scan.ranges {
                    *range += (size / 100.0) as f32;
                }
            }
            DefectKind::LaserTurned => {
                // The beams point elsewhere than the transform says.
                scan.angle_min += size.to_radians();
                scan.angle_max = scan.angle_max.map(|angle| angle + size.to_radians());
            }
            DefectKind::BlockedSector => {
                let (from, increment) = (scan.angle_min, scan.angle_increment);
                for (beam, range) in scan.ranges.iter_mut().enumerate() {
                    let angle = from + beam as f64 * increment;
                    if (angle - FRAC_PI_4).abs() < size.to_radians() / 2.0 {
                        *range = range.min(0.25);
                    }
                }
            }
            DefectKind::FewBeams => {
                let every = (scan.ranges.len() / size as usize).max(1);
                scan.ranges = scan.ranges.into_iter().step_by(every).collect();
                scan.angle_increment *= every as f64;
                scan.time_increment *= every as f64;
                scan.angle_max = None;
            }
            DefectKind::SlowScans => {
                if !self.due(scan.stamp, size) {
                    return None;
                }
                scan.scan_time = scan.scan_time.map(|time| time.max(1.0 / size));
            }
            DefectKind::NarrowView => narrow(&mut scan, size.to_radians()),
            DefectKind::ShortRange => {
                for range in &mut scan.ranges {
                    if f64::from(*range) >= size {
                        *range = f32::INFINITY;
                    }
                }
                scan.range_max = scan.range_max.min(size);
            }
            DefectKind::NoTimeIncrement => {
                scan = self.sweep.as_mut()?.add(&scan, truth)?;
            }
            DefectKind::FrozenScans => {
                let within = elapsed >= FAULT_EVERY && elapsed.rem_euclid(FAULT_EVERY) < size;
                if within {
                    let frozen = self.frozen.get_or_insert_with(|| scan.ranges.clone());
                    scan.ranges.clone_from(frozen);
                } else {
                    self.frozen = None;
                }
            }
            DefectKind::ScanJitter => {
                let by = self.random.random_range(-1.0..1.0) * size / 1e3;
                scan.stamp = scan.stamp.plus(by);
            }
            DefectKind::LateStamps => {
                scan.stamp = scan.stamp.plus(size / 1e3);
                log_time = log_time.plus(size / 1e3);
            }
            _ => {}
        }
        Some(Arrival {
            log_time: log_time.max(scan.stamp),
            event: SensorEvent::Scan(scan),
        })
    }

    fn odometry(&mut self, odometry: Odometry, mut log_time: Stamp, elapsed: f64) -> Option<Arrival> {
        let size = self.defect.size();
        let [before, out] = self.odometry.unwrap_or([odometry, odometry]);
        let seconds = odometry.stamp.since(before.stamp).clamp(0.0, 1.0);
        let slips = odometry.twist.linear_x.abs() > DRIVING
            && elapsed >= SLIP_EVERY
            && elapsed.rem_euclid(SLIP_EVERY) < size;
        // Factors on the distance and on the turn, and speeds that are added to both.
        let (mut along, mut turn, mut creep, mut bias) = (1.0, 1.0, 0.0, 0.0);
        match self.defect.kind {
            DefectKind::WheelScale => along = size,
            DefectKind::WheelSpin if slips => along = 2.0,
            DefectKind::WheelLock if slips => along = 0.0,
            DefectKind::TurnScale => turn = size,
            DefectKind::TurnBias => bias = size,
            DefectKind::Creep => creep = -size,
            _ => {}
        }
        let mut damaged = odometry;
        let [x, y, heading] = odometry.pose.since(before.pose).log();
        let step = [
            x * along + creep * seconds,
            y * along,
            heading * turn + bias * seconds,
        ];
        damaged.pose = out.pose * Pose::exp(step);
        damaged.twist = Twist {
            linear_x: odometry.twist.linear_x * along + creep,
            linear_y: odometry.twist.linear_y * along,
            angular: odometry.twist.angular * turn + bias,
        };
        self.odometry = Some([odometry, damaged]);
        let kind = self.defect.kind;
        match kind {
            DefectKind::OdometryNoise => {
                damaged.pose.x += size / 100.0 * self.normal();
                damaged.pose.y += size / 100.0 * self.normal();
            }
            DefectKind::OdometrySlow if !self.due(odometry.stamp, size) => return None,
            DefectKind::OdometryGap if elapsed >= FAULT_EVERY && elapsed.rem_euclid(FAULT_EVERY) < size => {
                return None;
            }
            DefectKind::OdometryLate => {
                damaged.stamp = damaged.stamp.plus(size / 1e3);
                log_time = log_time.plus(size / 1e3);
            }
            DefectKind::TwistZero => damaged.twist = Twist::default(),
            DefectKind::PoseZero => damaged.pose = Pose::IDENTITY,
            DefectKind::Bursts => {
                let period = (size * 1e6) as i64;
                let late = log_time.0.rem_euclid(period);
                log_time = Stamp(log_time.0 + (period - late) % period);
            }
            _ => {}
        }
        Some(Arrival {
            log_time,
            event: SensorEvent::Odometry(damaged),
        })
    }

    fn gyro(&self, mut reading: YawRate) -> Option<YawRate> {
        match self.defect.kind {
            DefectKind::GyroBias => reading.rate += self.defect.size(),
            DefectKind::GyroDegrees => reading.rate = reading.rate.to_degrees(),
            DefectKind::GyroFlipped => reading.rate = -reading.rate,
            DefectKind::GyroZero => reading.rate = 0.0,
            DefectKind::GyroNone => return None,
            _ => {}
        }
        Some(reading)
    }

    /// Adds the readings of a gyroscope from the latest one to `until`, by the truth.
    fn add_gyro(
        &mut self,
        until: Stamp,
        log_time: Stamp,
        truth: TruePose<'_>,
        out: &mut Vec<DamagedArrival>,
    ) {
        let mut stamp = self.latest_gyro.unwrap_or(until.plus(-GYRO_PERIOD));
        // After a gap of the log, it goes on from its end.
        if until.since(stamp) > 1.0 {
            stamp = until.plus(-GYRO_PERIOD);
        }
        while until.since(stamp) >= GYRO_PERIOD {
            let before = stamp;
            stamp = stamp.plus(GYRO_PERIOD);
            let (Some(from), Some(to)) = (truth(before), truth(stamp)) else {
                continue;
            };
            let rate = to.since(from).heading / GYRO_PERIOD;
            if let Some(reading) = self.gyro(YawRate { stamp, rate }) {
                out.push(DamagedArrival {
                    arrival: Arrival {
                        log_time,
                        event: SensorEvent::YawRate(reading),
                    },
                    measured: stamp,
                });
            }
        }
        self.latest_gyro = Some(stamp);
    }
}

/// The time of a scan's middle beam.
fn middle(scan: &Scan) -> Stamp {
    scan.stamp
        .plus(scan.time_increment * scan.ranges.len() as f64 / 2.0)
}

/// Leaves only the beams within half of `view` of straight ahead \[rad\].
fn narrow(scan: &mut Scan, view: f64) {
    let angle = |beam: usize| scan.angle_min + beam as f64 * scan.angle_increment;
    let within = |beam: &usize| angle(*beam).abs() <= view / 2.0 + 1e-9;
    let Some(first) = (0..scan.ranges.len()).find(within) else {
        return;
    };
    let count = (first..scan.ranges.len()).take_while(within).count();
    let angle_min = angle(first);
    scan.ranges = scan.ranges[first..first + count].to_vec();
    scan.stamp = scan.stamp.plus(scan.time_increment * first as f64);
    scan.angle_min = angle_min;
    scan.angle_max = None;
}

/// Passes messages on in the order of their arrival. A defect may delay some of them.
#[derive(Debug, Default)]
pub struct ArrivalQueue(VecDeque<DamagedArrival>);

impl ArrivalQueue {
    /// Adds a message behind all that arrive no later.
    pub fn push(&mut self, damaged: DamagedArrival) {
        let at = damaged.arrival.log_time;
        let index = self.0.partition_point(|other| other.arrival.log_time <= at);
        self.0.insert(index, damaged);
    }

    /// The next message that has arrived by `now`.
    pub fn pop(&mut self, now: Stamp) -> Option<DamagedArrival> {
        let due = self.0.front()?.arrival.log_time <= now;
        due.then(|| self.0.pop_front()).flatten()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stress::DefectChoice;

    /// Twenty seconds on a circle of 5 m radius at 2 m/s: odometry 50 times a second, a scan of 61 beams 20 times.
    #[expect(clippy::unnecessary_wraps, reason = "a truth may be unknown elsewhere")]
    fn truth(stamp: Stamp) -> Option<Pose> {
        let angle = 0.4 * stamp.since(Stamp(0));
        Some(Pose::exp([5.0 * angle, 0.0, angle]))
    }

    fn drive() -> Vec<Arrival> {
        let twist = Twist {
            linear_x: 2.0,
            linear_y: 0.0,
            angular: 0.4,
        };
        let mut drive = Vec::new();
        for tick in 0..2000 {
            let stamp = Stamp(0).plus(f64::from(tick) / 100.0);
            let log_time = stamp.plus(0.005);
            if tick % 2 == 0 {
                let pose = truth(stamp).expect("known");
                let event = SensorEvent::Odometry(Odometry { stamp, pose, twist });
                drive.push(Arrival { log_time, event });
            }
            if tick % 5 == 0 {
                let event = SensorEvent::Scan(Scan {
                    stamp,
                    angle_min: -1.5,
                    angle_increment: 0.05,
                    angle_max: Some(1.5),
                    time_increment: 0.0,
                    scan_time: None,
                    range_min: 0.05,
                    range_max: 20.0,
                    // Wall by wall a little longer, so that a frozen scan differs.
                    ranges: vec![4.0 + tick as f32 * 1e-3; 61],
                });
                drive.push(Arrival { log_time, event });
            }
        }
        drive
    }

    fn after(text: &str) -> Vec<DamagedArrival> {
        let defect = text.parse::<DefectChoice>().expect("a defect").one();
        let mut damage =
            SensorDamage::new(defect, Pose::new(0.2, 0.0, 0.0), false, 1).expect("of the sensors");
        let (mut out, mut queue, mut arrived) = (Vec::new(), ArrivalQueue::default(), Vec::new());
        for arrival in drive() {
            damage.damage(arrival, &truth, &mut out);
            out.drain(..).for_each(|damaged| queue.push(damaged));
        }
        while let Some(damaged) = queue.pop(Stamp(i64::MAX)) {
            arrived.push(damaged);
        }
        assert!(arrived.is_sorted_by_key(|damaged| damaged.arrival.log_time));
        arrived
    }

    fn odometry(text: &str) -> Vec<Odometry> {
        let of = |damaged: DamagedArrival| match damaged.arrival.event {
            SensorEvent::Odometry(odometry) => Some(odometry),
            _ => None,
        };
        after(text).into_iter().filter_map(of).collect()
    }

    fn scans(text: &str) -> Vec<Scan> {
        let of = |damaged: DamagedArrival| match damaged.arrival.event {
            SensorEvent::Scan(scan) => Some(scan),
            _ => None,
        };
        after(text).into_iter().filter_map(of).collect()
    }

    /// The way between the first and the last pose of odometry, as its poses add up \[m\].
    fn way(odometry: &[Odometry]) -> f64 {
        odometry
            .windows(2)
            .map(|pair| pair[1].pose.distance(pair[0].pose))
            .sum()
    }

    #[test]
    fn pose_and_twist_of_odometry_are_damaged_alike() {
        let scaled = odometry("wheel-scale:medium");
        assert!((way(&scaled) / 40.0 - 1.2).abs() < 0.01, "{}", way(&scaled));
        assert!((scaled[500].twist.linear_x - 2.4).abs() < 1e-12);
        // Three times for one second each in twenty, from 5 s on.
        assert!((way(&odometry("wheel-lock:severe")) - 34.0).abs() < 0.2);
        assert!((way(&odometry("wheel-spin:severe")) - 46.0).abs() < 0.2);
        let turned = odometry("turn-scale:severe");
        let last = turned.last().expect("some");
        assert!((last.pose.heading - maps::wrap_angle(0.2 * 19.98)).abs() < 1e-6);
        assert!((odometry("creep:mild")[10].twist.linear_x - 1.95).abs() < 1e-12);
    }

    #[test]
    fn odometry_loses_a_part_or_comes_less_often() {
        assert!(odometry("twist-zero").iter().all(|o| o.twist == Twist::default()));
        assert!(odometry("pose-zero").iter().all(|o| o.pose == Pose::IDENTITY));
        assert!(odometry("odometry-slow:medium").len().abs_diff(200) < 10);
        assert_eq!(odometry("odometry-gap:severe").len(), 950);
        let late = after("odometry-late:medium");
        let late = late
            .iter()
            .filter(|d| matches!(d.arrival.event, SensorEvent::Odometry(_)));
        for damaged in late {
            assert!((damaged.arrival.event.stamp().since(damaged.measured) - 0.05).abs() < 1e-9);
        }
    }

    #[test]
    fn bursts_arrive_together_and_in_order() {
        let times: std::collections::BTreeSet<_> = after("bursts:severe")
            .into_iter()
            .filter(|damaged| matches!(damaged.arrival.event, SensorEvent::Odometry(_)))
            .map(|damaged| damaged.arrival.log_time)
            .collect();
        assert_eq!(times.len(), 100);
    }

    #[test]
    fn scanners_are_lesser_by_the_grade() {
        assert_eq!(scans("few-beams:severe")[0].ranges.len(), 61);
        let narrow = &scans("narrow-view:severe")[0];
        assert_eq!(narrow.ranges.len(), 31);
        assert!((narrow.angle_min + 0.75).abs() < 1e-9);
        assert!(scans("slow-scans:severe").len().abs_diff(100) < 5);
        assert!(
            scans("short-range:severe")[100]
                .ranges
                .iter()
                .all(|range| range.is_infinite())
        );
        let lost = |text: &str| {
            let all: Vec<_> = scans(text).into_iter().flat_map(|scan| scan.ranges).collect();
            all.iter().filter(|range| range.is_infinite()).count() as f64 / all.len() as f64
        };
        assert!((lost("dropout:medium") - 0.5).abs() < 0.02);
        let blocked = scans("blocked-sector:medium")[0]
            .ranges
            .iter()
            .filter(|r| **r < 1.0)
            .count();
        assert!(blocked.abs_diff(21) <= 1, "{blocked}");
    }

    /// A beam without return used to become a reading of the scanner's least range.
    #[test]
    fn noise_makes_no_reading_of_a_beam_without_return() {
        let defect = "range-noise:severe"
            .parse::<DefectChoice>()
            .expect("a defect")
            .one();
        let mut damage = SensorDamage::new(defect, Pose::IDENTITY, false, 1).expect("of the sensors");
        let mut arrival = drive().swap_remove(1);
        if let SensorEvent::Scan(scan) = &mut arrival.event {
            scan.ranges[..3].copy_from_slice(&[f32::NAN, f32::INFINITY, 4.0]);
        }
        let mut out = Vec::new();
        damage.damage(arrival, &truth, &mut out);
        let [DamagedArrival { arrival, .. }] = &out[..] else {
            panic!("one message");
        };
        let SensorEvent::Scan(scan) = &arrival.event else {
            panic!("a scan");
        };
        assert!(scan.ranges[0].is_nan() && scan.ranges[1].is_infinite());
        assert!((3.0..5.0).contains(&scan.ranges[2]));
    }

    #[test]
    fn a_frozen_scan_repeats_under_new_stamps() {
        let scans = scans("frozen-scans:severe");
        let repeats = scans.windows(2).filter(|pair| pair[0].ranges == pair[1].ranges);
        assert_eq!(repeats.count(), 19);
        assert!(scans.windows(2).all(|pair| pair[0].stamp < pair[1].stamp));
    }

    #[test]
    fn a_late_stamp_keeps_when_the_scan_was_measured() {
        for (text, most) in [("late-stamps:medium", 0.021), ("scan-jitter:medium", 0.010)] {
            let mut differ = false;
            for damaged in after(text) {
                let off = damaged.arrival.event.stamp().since(damaged.measured);
                assert!(off.abs() < most, "{text} {off}");
                assert!(damaged.arrival.log_time >= damaged.arrival.event.stamp());
                differ |= off != 0.0;
            }
            assert!(differ, "{text}");
        }
    }

    #[test]
    fn a_car_without_a_gyroscope_gets_one() {
        let rates = |text: &str| -> Vec<f64> {
            after(text)
                .into_iter()
                .filter_map(|damaged| match damaged.arrival.event {
                    SensorEvent::YawRate(reading) => Some(reading.rate),
                    _ => None,
                })
                .collect()
        };
        let flipped = rates("gyro-flipped");
        assert!(flipped.len().abs_diff(2000) < 10, "{}", flipped.len());
        assert!(flipped.iter().all(|rate| (rate + 0.4).abs() < 1e-6));
        assert!(
            rates("gyro-degrees")
                .iter()
                .all(|rate| (rate - 0.4f64.to_degrees()).abs() < 1e-4)
        );
        assert!(
            rates("gyro-bias:severe")
                .iter()
                .all(|rate| (rate - 0.7).abs() < 1e-6)
        );
        assert_eq!(rates("gyro-none"), Vec::<f64>::new());
    }

    #[test]
    fn the_same_seed_gives_the_same_damage() {
        for text in ["range-noise", "people", "scan-jitter", "cars"] {
            assert_eq!(after(text), after(text), "{text}");
        }
    }
}
