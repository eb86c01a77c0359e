//! The race: cars on a track, moved on tick by tick.

use std::sync::Arc;
use std::time::Duration;

use maps::{Pose, TrackPosition};
use rand::SeedableRng;
use rand::rngs::StdRng;

use crate::driver::Ahead;
use crate::vehicle::outline;
use crate::{
    Controls, Driver, DriverParams, Estimate, Grip, Gyro, Lidar, LidarParams, Manoeuvre, Motion, Obstacle,
    Odometry, OdometryParams, OdometrySensor, Scan, Track, Vehicle, VehicleParams,
};

/// Length of a tick: divides every sensor's period.
pub const TICK: Duration = Duration::from_micros(2500);

/// Ticks from one truth message to the next: 100 Hz.
const TRUTH_EVERY: u64 = 4;

/// Hitting a wall faster than this [m/s] ends in the marshals' hands; slower, the car scrapes along.
const CRASH_SPEED: f64 = 1.0;

/// How long the marshals take to put a crashed car back.
const MARSHALS: Duration = Duration::from_secs(3);

/// A car as it comes to the track.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CarSetup {
    /// The car.
    pub vehicle: VehicleParams,
    /// Its laser.
    pub lidar: LidarParams,
    /// Its odometry.
    pub odometry: OdometryParams,
    /// Who drives.
    pub driver: DriverParams,
    /// What the driver goes by.
    pub guidance: Guidance,
    /// Start position along the raceline [m]; may be negative.
    pub start: f64,
}

impl Default for CarSetup {
    fn default() -> Self {
        Self {
            vehicle: VehicleParams {
                steering_offset: 0.01,
                ..VehicleParams::default()
            },
            lidar: LidarParams::default(),
            odometry: OdometryParams::default(),
            driver: DriverParams::default(),
            guidance: Guidance::Estimate,
            // The first lap is a flying one.
            start: -8.0,
        }
    }
}

/// What a driver goes by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Guidance {
    /// The estimates that the caller passes on ([`World::guide`]).
    Estimate,
    /// The true pose: for opponents, and for the best that a localizer could do. Such cars have no sensors.
    Truth,
}

/// What left a car.
#[derive(Debug, Clone, PartialEq)]
pub struct Output {
    /// Which car, in the order of the setups.
    pub car: usize,
    /// When it arrives where it is used, since the start of the race: a sensor's latency after its stamp.
    pub at: Duration,
    /// What it is.
    pub message: Message,
}

/// A sensor's message, or what the race director saw.
#[derive(Debug, Clone, PartialEq)]
pub enum Message {
    /// A sweep of the laser.
    Scan(Scan),
    /// Wheel odometry.
    Odometry(Odometry),
    /// The gyroscope.
    Gyro(Gyro),
    /// What is true, at 100 Hz.
    Truth(Truth),
    /// A lap is over.
    Lap(Lap),
    /// The car hit a wall and stands.
    Crash(Crash),
    /// The car touched a wall and goes on.
    Scrape(Crash),
    /// The car turned by more than a quarter away from the line.
    Spin,
    /// The marshals put the car here, at rest.
    Placed(Pose),
}

/// The true state of a car.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Truth {
    /// When, since the start of the race.
    pub stamp: Duration,
    /// `map_from_base_link`.
    pub pose: Pose,
    /// Velocity of `base_link` in its own frame: forwards [m/s], to the left [m/s], yaw rate [rad/s].
    pub twist: [f64; 3],
    /// Speed of the wheels' circumference [m/s].
    pub wheel_speed: f64,
    /// Where the car is relative to the raceline.
    pub track: TrackPosition,
    /// Laps finished.
    pub laps: u32,
}

/// A finished lap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lap {
    /// Counted from 1.
    pub number: u32,
    /// From line to line.
    pub time: Duration,
}

/// Contact with a wall.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crash {
    /// Where the car was.
    pub pose: Pose,
    /// Speed into the wall [m/s].
    pub impact: f64,
}

#[derive(Debug)]
struct Car {
    vehicle: Vehicle,
    lidar: Lidar,
    odometry: OdometrySensor,
    driver: Driver,
    guidance: Guidance,
    estimate: Option<Estimate>,
    controls: Controls,
    /// Commands on their way, oldest first, and when each takes effect.
    pending: Vec<(Duration, Controls)>,
    next_command: Duration,
    track: TrackPosition,
    /// When the car last crossed the line.
    lap_start: Option<Duration>,
    laps: u32,
    /// Until when the marshals have the car.
    marshals: Option<Duration>,
    spun: bool,
    touching: bool,
}

/// A race in progress. It is moved on by [`World::step`] and knows no other clock.
#[derive(Debug)]
pub struct World {
    track: Arc<Track>,
    cars: Vec<Car>,
    ticks: u64,
    /// Sent but not arrived.
    underway: Vec<Output>,
}

impl World {
    /// Cars at rest at their starts. The seed decides every sensor's noise; each sensor has its own stream, so a change
    /// to one leaves the others' noise alone.
    pub fn new(track: Arc<Track>, setups: &[CarSetup], seed: u64) -> Self {
        let cars = setups
            .iter()
            .enumerate()
            .map(|(index, setup)| {
                let start = track.raceline.at(setup.start);
                let pose = Pose::new(start.x, start.y, start.heading);
                let stream = |sensor: u64| {
                    StdRng::seed_from_u64(seed.wrapping_mul(1_000_003) ^ ((index as u64) << 8) ^ sensor)
                };
                // Sensors are not synchronised: their phases come from the seed, too.
                let phase = |ticks: u64| TICK * ((seed.wrapping_add(index as u64 * 7) * 5) % ticks) as u32;
                Car {
                    vehicle: Vehicle::at_rest(setup.vehicle, pose),
                    lidar: Lidar::new(setup.lidar, phase(10), stream(1)),
                    odometry: OdometrySensor::new(
                        setup.odometry,
                        setup.vehicle.wheelbase(),
                        phase(8),
                        stream(2),
                    ),
                    driver: Driver::new(setup.driver, setup.vehicle),
                    guidance: setup.guidance,
                    estimate: None,
                    controls: Controls::default(),
                    pending: Vec::new(),
                    next_command: Duration::ZERO,
                    track: track.raceline.project([pose.x, pose.y]),
                    lap_start: None,
                    laps: 0,
                    marshals: None,
                    spun: false,
                    touching: false,
                }
            })
            .collect();
        Self {
            track,
            cars,
            ticks: 0,
            underway: Vec::new(),
        }
    }

    /// Time since the start of the race.
    pub fn now(&self) -> Duration {
        Duration::from_nanos(self.ticks * TICK.as_nanos() as u64)
    }

    /// The track.
    pub fn track(&self) -> &Arc<Track> {
        &self.track
    }

    /// Number of cars.
    pub fn cars(&self) -> usize {
        self.cars.len()
    }

    /// What is true of a car now.
    pub fn truth(&self, car: usize) -> Truth {
        let Car {
            vehicle, track, laps, ..
        } = &self.cars[car];
        Truth {
            stamp: self.now(),
            pose: vehicle.pose(),
            twist: vehicle.twist(),
            wheel_speed: vehicle.state().wheel_speed,
            track: *track,
            laps: *laps,
        }
    }

    /// What a car's driver is doing.
    pub fn manoeuvre(&self, car: usize) -> Manoeuvre {
        self.cars[car].driver.manoeuvre()
    }

    /// Gives a car's driver the localizer's newest estimate.
    pub fn guide(&mut self, car: usize, estimate: Estimate) {
        self.cars[car].estimate = Some(estimate);
    }

    /// Changes a car's grip: tape on its tyres, dust on the floor.
    pub fn set_grip(&mut self, car: usize, grip: Grip) {
        self.cars[car].vehicle.set_grip(grip);
    }

    /// Knocks a car round: adds to its yaw rate [rad/s].
    pub fn knock(&mut self, car: usize, yaw_rate: f64) {
        self.cars[car].vehicle.state_mut().yaw_rate += yaw_rate;
    }

    /// Lets one tick pass. Returns what has arrived by its end, in order of arrival.
    pub fn step(&mut self) -> Vec<Output> {
        let from = self.now();
        self.ticks += 1;
        let times = [from, self.now()];
        let before: Vec<Pose> = self.cars.iter().map(|car| car.vehicle.pose()).collect();
        for index in 0..self.cars.len() {
            let ahead = self.ahead(index);
            self.move_car(index, ahead, times);
        }
        let boxes: Vec<Obstacle> = self.cars.iter().map(|car| obstacle(&car.vehicle)).collect();
        for (index, &before) in before.iter().enumerate() {
            self.sense(index, before, &boxes, times);
        }
        let [_, now] = times;
        // A stable sort: equal times stay in the order of cars and sensors.
        self.underway.sort_by_key(|output| output.at);
        let arrived = self.underway.partition_point(|output| output.at <= now);
        self.underway.drain(..arrived).collect()
    }

    /// The nearest car in front on the line, near enough to matter.
    fn ahead(&self, index: usize) -> Option<Ahead> {
        let own = &self.cars[index];
        let line = &self.track.raceline;
        self.cars
            .iter()
            .enumerate()
            .filter(|&(other, _)| other != index)
            .map(|(_, other)| Ahead {
                gap: line.advance(own.track.s, other.track.s) - own.vehicle.params().body[0],
                speed: other.vehicle.state().vx,
            })
            .filter(|ahead| (-0.5..6.0).contains(&ahead.gap))
            .min_by(|a, b| a.gap.total_cmp(&b.gap))
    }

    /// Driver, dynamics, walls and lap counting of one car.
    fn move_car(&mut self, index: usize, ahead: Option<Ahead>, [from, to]: [Duration; 2]) {
        let line = &self.track.raceline;
        let car = &mut self.cars[index];
        let mut seen = Vec::new();
        if let Some(until) = car.marshals {
            if to >= until {
                let start = line.at(car.track.s);
                let pose = Pose::new(start.x, start.y, start.heading);
                car.vehicle.place(pose);
                car.driver.reset();
                car.marshals = None;
                seen.push(Message::Placed(pose));
            }
        } else {
            car.command(from, ahead, line);
            let before = *car.vehicle.state();
            car.vehicle.drive(car.controls, TICK.as_secs_f64());
            let shape = outline(car.vehicle.params(), car.vehicle.pose());
            match self.track.walls.touching(&shape) {
                Some(along) => {
                    let impact = car.bounce(&before, along);
                    let contact = Crash {
                        pose: car.vehicle.pose(),
                        impact,
                    };
                    if impact > CRASH_SPEED {
                        car.crash(to);
                        seen.push(Message::Crash(contact));
                    } else if !car.touching {
                        seen.push(Message::Scrape(contact));
                    }
                    car.touching = true;
                }
                None => car.touching = false,
            }
        }

        let pose = car.vehicle.pose();
        let previous = car.track;
        car.track = line.project([pose.x, pose.y]);
        let step = line.advance(previous.s, car.track.s);
        // Across the line forwards, and not by a jump to another part of the track.
        if car.track.s < previous.s && step > 0.0 && step < 1.0 {
            let beyond = (car.track.s / step).clamp(0.0, 1.0);
            let crossing = to.saturating_sub(TICK.mul_f64(beyond));
            if let Some(start) = car.lap_start {
                car.laps += 1;
                seen.push(Message::Lap(Lap {
                    number: car.laps,
                    time: crossing.saturating_sub(start),
                }));
            }
            car.lap_start = Some(crossing);
        }
        let off = maps::wrap_angle(pose.heading - car.track.heading).abs();
        if off > std::f64::consts::FRAC_PI_2 && !car.spun {
            seen.push(Message::Spin);
        }
        // Spun until it is straight again.
        car.spun = off
            > if car.spun {
                0.3
            } else {
                std::f64::consts::FRAC_PI_2
            };

        self.underway.extend(seen.into_iter().map(|message| Output {
            car: index,
            at: to,
            message,
        }));
        if self.ticks.is_multiple_of(TRUTH_EVERY) {
            let truth = Message::Truth(self.truth(index));
            self.underway.push(Output {
                car: index,
                at: to,
                message: truth,
            });
        }
    }

    /// Everything that one car's sensors deliver in this tick.
    fn sense(&mut self, index: usize, before: Pose, boxes: &[Obstacle], times: [Duration; 2]) {
        let car = &mut self.cars[index];
        if car.guidance == Guidance::Truth {
            return;
        }
        let [_, now] = times;
        let state = car.vehicle.state();
        let motion = Motion {
            wheel_speed: state.wheel_speed,
            yaw_rate: state.yaw_rate,
            steering: car.controls.steering,
        };
        let underway = &mut self.underway;
        let mut send = |at, message| {
            underway.push(Output {
                car: index,
                at,
                message,
            });
        };
        if let Some(gyro) = car.odometry.gyro(now, motion) {
            send(now + car.odometry.params().transport, Message::Gyro(gyro));
        }
        if let Some(odometry) = car.odometry.odometry(now, motion) {
            send(now + car.odometry.params().transport, Message::Odometry(odometry));
        }
        let others: Vec<Obstacle> = boxes
            .iter()
            .enumerate()
            .filter(|&(other, _)| other != index)
            .map(|(_, obstacle)| *obstacle)
            .collect();
        let poses = [before, car.vehicle.pose()];
        if let Some((at, scan)) = car.lidar.sense(times, poses, &self.track.walls, &others) {
            send(at, Message::Scan(scan));
        }
    }
}

impl Car {
    /// Lets the driver command, and lets commands take effect after their delay.
    fn command(&mut self, now: Duration, ahead: Option<Ahead>, line: &maps::Raceline) {
        if now >= self.next_command {
            let params = *self.driver.params();
            self.next_command += params.period;
            if self.guidance == Guidance::Truth {
                let [speed, _, yaw_rate] = self.vehicle.twist();
                self.estimate = Some(Estimate {
                    time: now,
                    pose: self.vehicle.pose(),
                    speed,
                    yaw_rate,
                });
            }
            let controls = self.driver.drive(now, self.estimate.as_ref(), ahead, line);
            self.pending.push((now + params.delay, controls));
        }
        let due = self.pending.partition_point(|&(at, _)| at <= now);
        if let Some((_, controls)) = self.pending.drain(..due).next_back() {
            self.controls = controls;
        }
    }

    /// Takes the car back to where it did not touch the wall, with the speed into the wall turned round and mostly lost.
    /// Returns that speed [m/s].
    fn bounce(&mut self, before: &crate::VehicleState, along: [f64; 2]) -> f64 {
        let (sin, cos) = before.heading.sin_cos();
        let velocity = [
            before.vx * cos - before.vy * sin,
            before.vx * sin + before.vy * cos,
        ];
        let sliding = velocity[0] * along[0] + velocity[1] * along[1];
        let into = [velocity[0] - sliding * along[0], velocity[1] - sliding * along[1]];
        let after = [0, 1].map(|axis| 0.7 * sliding * along[axis] - 0.2 * into[axis]);
        let state = self.vehicle.state_mut();
        *state = *before;
        state.vx = after[0] * cos + after[1] * sin;
        state.vy = after[1] * cos - after[0] * sin;
        state.yaw_rate *= -0.2;
        state.wheel_speed = state.vx;
        (state.front_slip, state.rear_slip) = ([0.0; 2], [0.0; 2]);
        into[0].hypot(into[1])
    }

    /// Stops the car where it is until the marshals come.
    fn crash(&mut self, now: Duration) {
        let pose = self.vehicle.pose();
        self.vehicle.place(pose);
        self.marshals = Some(now + MARSHALS);
        self.pending.clear();
        self.controls = Controls::default();
    }
}

fn obstacle(vehicle: &Vehicle) -> Obstacle {
    let p = vehicle.params();
    let centre = p.body[0] / 2.0 - p.rear_overhang;
    Obstacle {
        map_from_centre: vehicle.pose() * Pose::new(centre, 0.0, 0.0),
        half: [p.body[0] / 2.0, p.body[1] / 2.0],
    }
}
