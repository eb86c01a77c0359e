//! Cars on a simulated track. Cars of one race see each other.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use maps::Pose;
use simulator::{CarSetup, Estimate, Message, Output, Track, World};
use synpf::{Odometry, Scan, Stamp, Twist, YawRate};

use super::{Feed, Next, PoseEstimate, Source, TrueMotion};
use crate::sensors::bag::SensorEvent;
use crate::sensors::clock::{SensorClock, wall_now};
use crate::sensors::frames::Mount;

/// Something done to a car from outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Incident {
    /// Its tyres change.
    Grip(simulator::Grip),
    /// It is knocked round [rad/s].
    Knock(f64),
}

/// When, to which car, and what.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScriptedIncident {
    /// Since the start of the race.
    pub at: Duration,
    /// Which car, in the order of the setups.
    pub car: usize,
    /// What.
    pub incident: Incident,
}

/// Incidents that are still to come.
#[derive(Debug)]
pub struct Script {
    /// The next one last.
    rest: Vec<ScriptedIncident>,
}

impl Script {
    /// Incidents in any order.
    pub fn new(mut incidents: Vec<ScriptedIncident>) -> Self {
        incidents.sort_by_key(|incident| std::cmp::Reverse(incident.at));
        Self { rest: incidents }
    }

    /// Lets all happen that is due.
    pub fn play(&mut self, world: &mut World) {
        while let Some(&ScriptedIncident { at, car, incident }) = self.rest.last()
            && at <= world.now()
        {
            match incident {
                Incident::Grip(grip) => world.set_grip(car, grip),
                Incident::Knock(yaw_rate) => world.knock(car, yaw_rate),
            }
            self.rest.pop();
        }
    }
}

/// What the cars share.
#[derive(Debug)]
struct RaceState {
    world: World,
    /// What each car has not yet picked up.
    queues: Vec<VecDeque<(Stamp, Feed)>>,
    script: Script,
}

/// A race of one car or several, in real time.
#[derive(Debug)]
pub struct Race {
    shared: Mutex<RaceState>,
    /// One clock for all, started by the first car that drives.
    clock: OnceLock<SensorClock>,
    /// The start of the race on the sensors' clock.
    epoch: Stamp,
    setups: Vec<CarSetup>,
    track: Arc<Track>,
}

/// A car that does not pick up its messages keeps this many.
const MOST_WAITING: usize = 1024;
/// Messages later than this are of a time before the car joined \[s\].
const TOO_LATE: f64 = 0.5;

impl Race {
    /// A race before its start. `script` may be in any order.
    pub fn new(track: Track, setups: Vec<CarSetup>, seed: u64, script: Vec<ScriptedIncident>) -> Arc<Self> {
        let track = Arc::new(track);
        Arc::new(Self {
            shared: Mutex::new(RaceState {
                world: World::new(Arc::clone(&track), &setups, seed),
                queues: setups.iter().map(|_| VecDeque::new()).collect(),
                script: Script::new(script),
            }),
            clock: OnceLock::new(),
            epoch: wall_now(),
            setups,
            track,
        })
    }

    /// The sensors of one car, in the order of the setups.
    ///
    /// # Panics
    /// When there is no such car.
    pub fn car(self: &Arc<Self>, car: usize) -> SimulatedCar {
        assert!(car < self.setups.len(), "car {car} of {}", self.setups.len());
        SimulatedCar {
            race: Arc::clone(self),
            car,
        }
    }

    fn stamp(&self, time: Duration) -> Stamp {
        self.epoch.plus(time.as_secs_f64())
    }

    fn time(&self, stamp: Stamp) -> Duration {
        Duration::try_from_secs_f64(stamp.since(self.epoch)).unwrap_or(Duration::ZERO)
    }
}

/// One car of a [`Race`].
#[derive(Debug)]
pub struct SimulatedCar {
    race: Arc<Race>,
    car: usize,
}

impl Source for SimulatedCar {
    fn description(&self) -> String {
        format!("simulator, track {}", self.race.track.name)
    }

    fn mount(&self) -> Mount {
        Mount::upright(self.race.setups[self.car].lidar.base_link_from_laser)
    }

    fn clock(&mut self, rate: f64) -> SensorClock {
        self.race
            .clock
            .get_or_init(|| SensorClock::starting_at(self.race.epoch, rate))
            .clone()
    }

    fn start(&self) -> Option<Pose> {
        let shared = self.race.shared.lock().unwrap_or_else(PoisonError::into_inner);
        Some(shared.world.truth(self.car).pose)
    }

    fn next(&mut self, estimate: Option<PoseEstimate>) -> Next {
        let race = Arc::clone(&self.race);
        let mut shared = race.shared.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(estimate) = estimate {
            let estimate = Estimate {
                time: race.time(estimate.stamp),
                pose: estimate.pose,
                speed: estimate.twist.linear_x,
                yaw_rate: estimate.twist.angular,
            };
            shared.world.guide(self.car, estimate);
        }
        loop {
            while let Some((due, feed)) = shared.queues[self.car].pop_front() {
                let late = race.clock.get().map_or(0.0, |clock| clock.now().since(due));
                if late < TOO_LATE {
                    return Next::Due(due, feed);
                }
            }
            let RaceState { world, script, .. } = &mut *shared;
            script.play(world);
            for output in shared.world.step() {
                let due = race.stamp(output.at);
                let queue = &mut shared.queues[output.car];
                if queue.len() >= MOST_WAITING {
                    queue.pop_front();
                }
                if let Some(feed) = feed(&race, output) {
                    queue.push_back((due, feed));
                }
            }
        }
    }
}

/// What a sensor of a simulated car delivers, as a localizer takes it; other messages come back. `stamp` is for a time of the
/// simulation.
pub(crate) fn sensor_event(
    message: Message,
    stamp: impl Fn(Duration) -> Stamp,
) -> Result<SensorEvent, Message> {
    Ok(match message {
        Message::Scan(scan) => SensorEvent::Scan(Scan {
            stamp: stamp(scan.stamp),
            angle_min: scan.angle_min,
            angle_increment: scan.angle_increment,
            time_increment: scan.time_increment,
            scan_time: None,
            angle_max: None,
            range_min: scan.range_min,
            range_max: scan.range_max,
            ranges: scan.ranges,
        }),
        Message::Odometry(odometry) => SensorEvent::Odometry(Odometry {
            stamp: stamp(odometry.stamp),
            pose: odometry.pose,
            twist: Twist {
                linear_x: odometry.speed,
                linear_y: 0.0,
                angular: odometry.yaw_rate,
            },
        }),
        Message::Gyro(gyro) => SensorEvent::YawRate(YawRate {
            stamp: stamp(gyro.stamp),
            rate: gyro.yaw_rate,
        }),
        other => return Err(other),
    })
}

/// A simulator's message as the node takes it. Laps the node counts for itself.
fn feed(race: &Race, output: Output) -> Option<Feed> {
    let message = match sensor_event(output.message, |time| race.stamp(time)) {
        Ok(event) => return Some(Feed::Sensor(event)),
        Err(message) => message,
    };
    Some(match message {
        Message::Truth(truth) => Feed::Truth(TrueMotion {
            stamp: race.stamp(truth.stamp),
            pose: truth.pose,
            twist: Twist {
                linear_x: truth.twist[0],
                linear_y: truth.twist[1],
                angular: truth.twist[2],
            },
        }),
        Message::Crash(crash) => Feed::Log(format!("crash at {:.1} m/s", crash.impact)),
        Message::Scrape(crash) => Feed::Log(format!("scraped a wall at {:.1} m/s", crash.impact)),
        Message::Collision(crash) => Feed::Log(format!("touched another car at {:.1} m/s", crash.impact)),
        Message::Spin => Feed::Log("spin".into()),
        Message::Placed(pose) => Feed::InitialPose {
            pose,
            by: "recovery crew".into(),
        },
        Message::Lap(_) | Message::Scan(_) | Message::Odometry(_) | Message::Gyro(_) => return None,
    })
}
