//! Races: simulated cars that drive on a localizer's estimates, measured as the paper does.
//!
//! The loop is closed: a wrong estimate steers the car off its line and costs time. There is no network and no clock: a race
//! runs as fast as the machine allows, and the same setup gives the same race. Only [`LoadSummary`] depends on the machine.

mod alignment;
mod paper;
mod results;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use maps::{Pose, wrap_angle};
use serde::{Deserialize, Serialize};
use simulator::{CarSetup, Estimate, Grip, Guidance, Manoeuvre, Message, TICK, Track, World};

use synpf::{Localizer, Odometry, Scan, SetUpError, Stamp, TrackMap, Twist, YawRate};

pub use alignment::{PAPER_DISTANCE, paper_alignment};
pub use paper::{PAPER_ROWS, PaperRow};
pub use results::{CarResult, LapRecord, LoadSummary, Mishap, MishapKind, RaceSummary};

use crate::health::{Monitor, Thresholds};
use crate::localization::LocalizerParameters;
use crate::sensors::{Script, ScriptedIncident};
use results::CarMeasurements;

/// Where a driver gets the car's pose from.
#[derive(Debug, Clone, PartialEq)]
pub enum PoseSource {
    /// A localizer with a parameter set.
    Localizer(LocalizerParameters),
    /// Wheel odometry alone, from the true start.
    Odometry,
    /// The truth, as an upper bound.
    Truth,
}

/// The two conditions of the paper's table I.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Quality {
    /// Clean tyres: odometry is good.
    Hq,
    /// Taped tyres: they slip, and odometry is wrong.
    Lq,
}

impl Quality {
    /// The grip of these tyres.
    pub fn grip(self) -> Grip {
        match self {
            Self::Hq => Grip::HQ,
            Self::Lq => Grip::LQ,
        }
    }
}

/// Speed as a share of the raceline's. It is the same on all tyres: the paper drove both conditions at one scaling. It is
/// calibrated: with it a car that drives on the truth laps `club` on clean tyres in the time of the paper's cars. So a lap time
/// itself has no meaning; its differences between tyres and localizers have.
pub const SPEED_SCALE: f64 = 0.995;

/// The setup of a race.
#[derive(Debug, Clone, PartialEq)]
pub struct RaceSetup {
    /// Laps for every car.
    pub laps: u32,
    /// Cars on the track, one behind the other.
    pub cars: usize,
    /// Grip.
    pub quality: Quality,
    /// Where every driver gets the pose from.
    pub pose_source: PoseSource,
    /// Factor on the speed, on top of [`SPEED_SCALE`].
    pub speed_scale: f64,
    /// Seed of all random numbers.
    pub seed: u64,
}

/// Gap between two cars at the start, along the raceline \[m\].
const GRID_GAP: f64 = 3.0;

/// Runs a race until all laps are driven, or four times their expected time has passed. `map` is the track's map, prepared
/// once for all races.
pub fn race(
    track: &Arc<Track>,
    map: &Arc<TrackMap>,
    setup: &RaceSetup,
) -> Result<Vec<CarResult>, SetUpError> {
    let expected = f64::from(setup.laps) * track.lap_time() / setup.speed_scale;
    let end = End {
        laps: Some(setup.laps),
        time: Duration::from_secs_f64(10.0 + 4.0 * expected),
    };
    run(
        track,
        map,
        &field(setup),
        Vec::new(),
        &setup.pose_source,
        end,
        setup.seed,
    )
}

/// When a race ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct End {
    /// When all cars have driven this many laps; None: after `time` only.
    pub laps: Option<u32>,
    /// After this time at the latest.
    pub time: Duration,
}

/// The cars of a race.
fn field(setup: &RaceSetup) -> Vec<CarSetup> {
    let mut car = CarSetup::default();
    car.vehicle = car.vehicle.with_grip(setup.quality.grip());
    car.driver.speed_scale = setup.speed_scale * SPEED_SCALE;
    (0..setup.cars)
        .map(|index| CarSetup {
            start: car.start - GRID_GAP * index as f64,
            ..car
        })
        .collect()
}

/// Runs a race of any cars, with incidents. Cars that are guided by the truth have no localizer, whatever `pose_source` is.
pub fn run(
    track: &Arc<Track>,
    map: &Arc<TrackMap>,
    setups: &[CarSetup],
    script: Vec<ScriptedIncident>,
    pose_source: &PoseSource,
    end: End,
    seed: u64,
) -> Result<Vec<CarResult>, SetUpError> {
    let mut world = World::new(Arc::clone(track), setups, seed);
    let mut script = Script::new(script);
    let mut runners = (0..)
        .zip(setups)
        .map(|(index, car)| CarRunner::new(&world, index, map, pose_source, car, seed))
        .collect::<Result<Vec<_>, _>>()?;

    let begin = Instant::now();
    let done = |runners: &[CarRunner]| {
        end.laps.is_some_and(|laps| {
            runners
                .iter()
                .all(|runner| runner.measurements.laps() >= laps as usize)
        })
    };
    while !done(&runners) && world.now() < end.time {
        script.play(&mut world);
        for output in world.step() {
            let index = output.car;
            if let Some(estimate) = runners[index].handle(&world, index, &output.message) {
                world.guide(index, estimate);
            }
        }
    }
    let elapsed = begin.elapsed();
    Ok(runners
        .into_iter()
        .map(|runner| runner.measurements.result(world.now(), elapsed, end.laps))
        .collect())
}

/// One car's localizer and its measurements.
struct CarRunner {
    pose_source: ActivePoseSource,
    measurements: CarMeasurements,
    /// True poses of the last half second, for estimates of the past.
    truths: VecDeque<(Stamp, Pose)>,
    base_link_from_laser: Pose,
    latest: Option<simulator::Odometry>,
}

enum ActivePoseSource {
    Localizer(Box<dyn Localizer>, Box<Monitor>),
    /// `map_from_odom`, once it is known.
    Odometry(Option<Pose>, Pose),
    Truth,
}

impl CarRunner {
    fn new(
        world: &World,
        index: usize,
        map: &Arc<TrackMap>,
        pose_source: &PoseSource,
        car: &CarSetup,
        seed: u64,
    ) -> Result<Self, SetUpError> {
        let start = world.truth(index).pose;
        let base_link_from_laser = car.lidar.base_link_from_laser;
        let pose_source = match pose_source {
            _ if car.guidance == Guidance::Truth => ActivePoseSource::Truth,
            PoseSource::Localizer(parameters) => {
                let seed = seed.wrapping_add(index as u64);
                // The tables are built before the start.
                parameters.prepare_tables(map, Some(start));
                let mut localizer = parameters.build(map, base_link_from_laser, seed)?;
                localizer.initialize(start)?;
                let mut monitor = Monitor::new(Thresholds::default(), stamp(world.now()));
                monitor.on_new_pose(stamp(world.now()));
                ActivePoseSource::Localizer(localizer, Box::new(monitor))
            }
            PoseSource::Odometry => ActivePoseSource::Odometry(None, start),
            PoseSource::Truth => ActivePoseSource::Truth,
        };
        Ok(Self {
            pose_source,
            measurements: CarMeasurements::new(Arc::clone(world.track()), Arc::clone(map)),
            truths: VecDeque::new(),
            base_link_from_laser,
            latest: None,
        })
    }

    /// Gives a message to the localizer. Returns a new estimate, if there is one.
    fn handle(&mut self, world: &World, index: usize, message: &Message) -> Option<Estimate> {
        match message {
            Message::Odometry(odometry) => {
                self.latest = Some(*odometry);
                let pose = self.on_odometry(odometry, world, index)?;
                self.measurements.on_a_lap = world.on_a_lap(index);
                self.measurements.driven(pose, world.truth(index).track.d);
                Some(Estimate {
                    time: odometry.stamp,
                    pose,
                    speed: odometry.speed,
                    yaw_rate: odometry.yaw_rate,
                })
            }
            Message::Gyro(gyro) => {
                if let ActivePoseSource::Localizer(localizer, _) = &mut self.pose_source {
                    let reading = YawRate {
                        stamp: stamp(gyro.stamp),
                        rate: gyro.yaw_rate,
                    };
                    self.measurements.timed(|| localizer.on_yaw_rate(&reading)).ok();
                }
                None
            }
            Message::Scan(scan) => {
                let pose = self.on_scan(scan, stamp(world.now()))?;
                let latest = self.latest?;
                Some(Estimate {
                    time: latest.stamp,
                    pose,
                    speed: latest.speed,
                    yaw_rate: latest.yaw_rate,
                })
            }
            Message::Truth(truth) => {
                self.truths.push_back((stamp(truth.stamp), truth.pose));
                if self.truths.len() > 50 {
                    self.truths.pop_front();
                }
                None
            }
            Message::Placed(pose) => {
                // The localizer gets the pose at which the recovery crew put the car.
                match &mut self.pose_source {
                    ActivePoseSource::Localizer(localizer, monitor) => {
                        localizer.initialize(*pose).ok();
                        monitor.on_new_pose(stamp(world.now()));
                    }
                    ActivePoseSource::Odometry(map_from_odom, start) => {
                        (*map_from_odom, *start) = (None, *pose);
                    }
                    ActivePoseSource::Truth => {}
                }
                None
            }
            Message::Lap(lap) => {
                self.measurements.lap(lap.time);
                None
            }
            Message::Crash(contact) => self.mishap(world, index, MishapKind::Crash, contact.impact),
            Message::Scrape(contact) => self.mishap(world, index, MishapKind::Scrape, contact.impact),
            Message::Collision(contact) => self.mishap(world, index, MishapKind::Collision, contact.impact),
            Message::Spin => self.mishap(world, index, MishapKind::Spin, 0.0),
        }
    }

    /// Records a mishap. Returns None, since it gives no estimate.
    fn mishap(&mut self, world: &World, index: usize, kind: MishapKind, impact: f64) -> Option<Estimate> {
        let manoeuvre = world.manoeuvre(index);
        let [at, s, d] = {
            let truth = world.truth(index);
            [truth.stamp.as_secs_f64(), truth.track.s, truth.track.d]
        };
        self.measurements.mishap(Mishap {
            at_s: at,
            kind,
            s_m: s,
            d_m: d,
            impact_mps: impact,
            racing: manoeuvre == Manoeuvre::Racing,
            pose_error_m: None,
        });
        None
    }

    /// `map_from_base_link` at the odometry's stamp.
    fn on_odometry(&mut self, odometry: &simulator::Odometry, world: &World, index: usize) -> Option<Pose> {
        match &mut self.pose_source {
            ActivePoseSource::Localizer(localizer, monitor) => {
                monitor.on_odometry(stamp(world.now()));
                let message = Odometry {
                    stamp: stamp(odometry.stamp),
                    pose: odometry.pose,
                    twist: Twist {
                        linear_x: odometry.speed,
                        linear_y: 0.0,
                        angular: odometry.yaw_rate,
                    },
                };
                self.measurements.timed(|| {
                    localizer.on_odometry(&message).ok();
                    localizer.predict(message.stamp)
                })
            }
            ActivePoseSource::Odometry(map_from_odom, start) => {
                let map_from_odom = map_from_odom.get_or_insert(*start * odometry.pose.inverse());
                Some(*map_from_odom * odometry.pose)
            }
            ActivePoseSource::Truth => Some(world.truth(index).pose),
        }
    }

    /// Gives a scan to the localizer and records how good the estimate is. Returns the pose now, if the scan changed it.
    fn on_scan(&mut self, scan: &simulator::Scan, now: Stamp) -> Option<Pose> {
        let message = Scan {
            stamp: stamp(scan.stamp),
            angle_min: scan.angle_min,
            angle_increment: scan.angle_increment,
            time_increment: scan.time_increment,
            scan_time: None,
            angle_max: None,
            range_min: scan.range_min,
            range_max: scan.range_max,
            ranges: scan.ranges.clone(),
        };
        let truth = self.truth_at(message.stamp);
        let ActivePoseSource::Localizer(localizer, monitor) = &mut self.pose_source else {
            // Without a localizer, the scan is judged at the pose by odometry, or at the true pose.
            let pose = match &self.pose_source {
                ActivePoseSource::Odometry(map_from_odom, _) => {
                    let latest = self.latest?;
                    let back = latest.stamp.as_secs_f64() - scan.stamp.as_secs_f64();
                    let moved = [latest.speed, 0.0, latest.yaw_rate].map(|rate| -rate * back);
                    (*map_from_odom)? * latest.pose * Pose::exp(moved)
                }
                _ => truth?,
            };
            let twist = self
                .latest
                .map_or([0.0; 2], |latest| [latest.speed, latest.yaw_rate]);
            self.measurements
                .scanned(&message, pose, twist, truth, None, self.base_link_from_laser);
            return None;
        };
        let update = match self.measurements.timed_update(|| localizer.on_scan(&message)) {
            Ok(update) => update,
            Err(cause) => {
                monitor.on_refused_scan(now, cause);
                return None;
            }
        };
        let state = monitor.on_update(&update, now).state;
        self.measurements.judged(update.stamp, state, update.pose, truth);
        let twist = [update.twist.linear_x, update.twist.angular];
        self.measurements.scanned(
            &message,
            update.pose,
            twist,
            truth,
            Some(update.alignment),
            self.base_link_from_laser,
        );
        localizer.predict(stamp(self.latest?.stamp))
    }

    /// The true pose at `time`, interpolated.
    fn truth_at(&self, time: Stamp) -> Option<Pose> {
        let after = self.truths.partition_point(|(stamp, _)| *stamp < time);
        let (t1, to) = *self.truths.get(after)?;
        let (t0, from) = *self.truths.get(after.checked_sub(1)?)?;
        let share = time.since(t0) / t1.since(t0);
        Some(Pose::new(
            from.x + share * (to.x - from.x),
            from.y + share * (to.y - from.y),
            from.heading + share * wrap_angle(to.heading - from.heading),
        ))
    }
}

/// The simulator's time as a stamp. It starts at zero; a localizer only uses differences.
fn stamp(time: Duration) -> Stamp {
    Stamp(time.as_nanos() as i64)
}

/// Simulated time of one tick.
pub const RACE_TICK: Duration = TICK;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::State;
    use crate::sensors::Incident;
    use simulator::YawSource;

    fn club() -> (Arc<Track>, Arc<TrackMap>) {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../maps/tracks/club");
        let track = Track::load(folder, None).expect("a bundled track");
        let map = TrackMap::new(track.grid.clone()).expect("a map with free space");
        (Arc::new(track), Arc::new(map))
    }

    fn setup(pose_source: PoseSource, laps: u32, cars: usize) -> RaceSetup {
        RaceSetup {
            laps,
            cars,
            quality: Quality::Hq,
            pose_source,
            speed_scale: 1.0,
            seed: 5,
        }
    }

    #[test]
    fn on_the_truth_a_lap_of_club_takes_as_long_as_the_paper_s() {
        let (track, map) = club();
        let results = race(&track, &map, &setup(PoseSource::Truth, 2, 1)).expect("a race");
        let [car] = &results[..] else { panic!("one car") };
        assert!(car.finished && car.crashes == 0);
        for lap in &car.laps {
            assert!((9.0..9.6).contains(&lap.time_s), "{} s", lap.time_s);
        }
        // The only error of the truth is interpolation.
        let errors = car.pose_error.expect("errors");
        assert!(errors.position_error_m.max < 0.005);
    }

    #[test]
    fn a_race_reports_states_and_mishaps_with_their_causes() {
        let (track, map) = club();
        let parameters = LocalizerParameters::named("hq").expect("ships");
        let setup = setup(PoseSource::Localizer(parameters), 1, 1);
        let knock = ScriptedIncident {
            at: Duration::from_secs(6),
            car: 0,
            incident: Incident::Knock(15.0),
        };
        let end = End {
            laps: None,
            time: Duration::from_secs(9),
        };
        let results = run(
            &track,
            &map,
            &field(&setup),
            vec![knock],
            &setup.pose_source,
            end,
            1,
        )
        .expect("a race");
        let [car] = &results[..] else { panic!("one car") };
        let spin = car.mishaps.iter().find(|mishap| mishap.kind == MishapKind::Spin);
        let spin = spin.expect("15 rad/s spin any car");
        assert!((6.0..7.0).contains(&spin.at_s), "{spin:?}");
        // At 15 rad/s the car turns by 16 degrees within one sweep of the laser.
        assert!(spin.pose_error_m.is_some_and(|error| error < 0.5), "{spin:?}");
        assert_eq!(
            car.spins as usize,
            car.mishaps.iter().filter(|m| m.kind == MishapKind::Spin).count()
        );
        let all: f64 = car.states.values().sum();
        assert!(
            (all - 1.0).abs() < 1e-9 && car.states[&State::Localized] > 0.5,
            "{:?}",
            car.states
        );
        let summary = RaceSummary::of(&results);
        assert_eq!(summary.states, car.states);
    }

    #[test]
    fn a_slipping_car_with_yaw_rate_from_steering_finishes_its_race() {
        // In the demo this car spun in every lap: its driver took the commanded yaw rate for the car's own.
        let (track, map) = club();
        let setup = RaceSetup {
            quality: Quality::Lq,
            ..setup(
                PoseSource::Localizer(LocalizerParameters::named("hq").expect("ships")),
                3,
                1,
            )
        };
        let mut cars = field(&setup);
        cars[0].odometry.yaw_source = YawSource::Steering;
        let end = End {
            laps: Some(3),
            time: Duration::from_secs(40),
        };
        let results = run(&track, &map, &cars, Vec::new(), &setup.pose_source, end, 1).expect("a race");
        assert!(
            results[0].finished && results[0].mishaps.is_empty(),
            "{:?}",
            results[0]
        );
    }

    #[test]
    fn the_reference_drives_club_on_grip_without_a_crash() {
        // Real cars race on the reference. An emulation of it that cannot emulates something else.
        let (track, map) = club();
        let baseline = LocalizerParameters::named("synpf-baseline").expect("ships");
        let results = race(&track, &map, &setup(PoseSource::Localizer(baseline), 3, 1)).expect("a race");
        let [car] = &results[..] else { panic!("one car") };
        assert!(car.finished && car.crashes == 0, "{car:?}");
        // 7 to 8 cm over 10 laps with three seeds; lost, it would be metres.
        let errors = car.pose_error.expect("errors");
        assert!(errors.position_error_m.rmse < 0.15, "{errors:?}");
    }

    #[test]
    fn odometry_alone_does_not_last_ten_laps() {
        let (track, map) = club();
        let setup = RaceSetup {
            quality: Quality::Lq,
            ..setup(PoseSource::Odometry, 10, 1)
        };
        let results = race(&track, &map, &setup).expect("a race");
        assert!(results[0].crashes > 0);
    }

    #[test]
    fn the_same_seed_is_the_same_race() {
        let (track, map) = club();
        let parameters = LocalizerParameters::named("hq").expect("ships");
        let run = |seed| {
            let setup = RaceSetup {
                seed,
                ..setup(PoseSource::Localizer(parameters.clone()), 1, 2)
            };
            let results = race(&track, &map, &setup).expect("a race");
            let without_load: Vec<_> = results
                .into_iter()
                .map(|car| CarResult {
                    load: LoadSummary::default(),
                    ..car
                })
                .collect();
            serde_json::to_string(&without_load).expect("numbers")
        };
        assert_eq!(run(1), run(1));
        assert_ne!(run(1), run(2));
    }
}
