//! The race: cars on a track, moved on tick by tick.

use std::sync::Arc;
use std::time::Duration;

use maps::{Pose, TrackPosition};
use rand::SeedableRng;
use rand::rngs::StdRng;

use crate::driver::{Ahead, BRAKE_BEHIND};
use crate::vehicle::outline;
use crate::{
    Controls, Driver, DriverParams, Estimate, Grip, Gyro, Lidar, LidarParams, Manoeuvre, Motion, Obstacle,
    Odometry, OdometryParams, OdometrySensor, Scan, Track, Vehicle, VehicleParams, YawSource,
};

/// Length of a tick: divides every sensor's period.
pub const TICK: Duration = Duration::from_micros(2500);

/// Ticks from one truth message to the next: 100 Hz.
const TRUTH_EVERY: u64 = 4;

/// Hitting a wall faster than this [m/s] ends in the marshals' hands; slower, the car scrapes along.
const CRASH_SPEED: f64 = 1.0;

/// A wall or a car that was not touched for this long is touched anew; until then it is the same contact.
const CONTACT: Duration = Duration::from_millis(500);

/// Cars ahead that are nearer than this matter [m]: from full speed to rest behind one that stands.
const IN_VIEW: f64 = 16.0;

/// How long the marshals take to put a crashed car back.
const MARSHALS: Duration = Duration::from_secs(3);

/// How far back along the line they look for a place where no car is or comes to [m], in such steps [m], with so much room
/// before and behind it [m], and for how long before they put the car where it left the line all the same.
const LOOK_BACK: f64 = 5.0;
const LOOK_STEP: f64 = 0.25;
const ROOM: f64 = 0.3;
const PATIENCE: Duration = Duration::from_secs(10);

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
    /// The car touched a wall and goes on: once for each contact.
    Scrape(Crash),
    /// The car and another one touched: told to both, once for each contact.
    Collision(Crash),
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

/// Contact with a wall or a car.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crash {
    /// Where the car was.
    pub pose: Pose,
    /// Speed into what was touched [m/s].
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
    /// When it last touched a wall, and another car.
    wall_contact: Option<Duration>,
    other_contact: Option<Duration>,
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
                let phase =
                    |ticks: u64| TICK * (seed.wrapping_add(index as u64 * 7).wrapping_mul(5) % ticks) as u32;
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
                    wall_contact: None,
                    other_contact: None,
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

    /// Whether a car is past the start line for the first time; what it does before that belongs to no lap.
    pub fn on_a_lap(&self, car: usize) -> bool {
        self.cars[car].lap_start.is_some()
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
        self.collide(times[1]);
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
            .filter(|ahead| (-0.5..IN_VIEW).contains(&ahead.gap))
            .min_by(|a, b| a.gap.total_cmp(&b.gap))
    }

    /// Where along the line the marshals put a car back now; None while they do not have it, or have it still. Not beyond the
    /// start line, which it would cross twice.
    fn place_for(&self, index: usize, now: Duration) -> Option<f64> {
        let car = &self.cars[index];
        let until = car.marshals.filter(|until| now >= *until)?;
        (0..=(LOOK_BACK / LOOK_STEP) as u32)
            .map(|step| car.track.s - LOOK_STEP * f64::from(step))
            .take_while(|s| *s >= 0.0)
            .find(|s| self.is_free(index, *s))
            .or_else(|| (now >= until + PATIENCE).then_some(car.track.s))
    }

    /// Whether a car at rest there has room, and whoever comes from behind can stop.
    fn is_free(&self, index: usize, s: f64) -> bool {
        let room = self.cars[index].vehicle.params().body[0] + ROOM;
        self.cars
            .iter()
            .enumerate()
            .filter(|&(other, _)| other != index)
            .all(|(_, other)| {
                let way = self.track.raceline.advance(other.track.s, s);
                let stopping = other.vehicle.state().vx.max(0.0).powi(2) / (2.0 * BRAKE_BEHIND);
                way < -room || way > room + stopping
            })
    }

    /// Driver, dynamics, walls and lap counting of one car.
    fn move_car(&mut self, index: usize, ahead: Option<Ahead>, [from, to]: [Duration; 2]) {
        let put_back = self.place_for(index, to);
        let line = &self.track.raceline;
        let car = &mut self.cars[index];
        let mut seen = Vec::new();
        if car.marshals.is_some() {
            if let Some(s) = put_back {
                let start = line.at(s);
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
            if let Some(along) = self.track.walls.touching(&shape) {
                let impact = car.bounce(&before, along);
                let contact = Crash {
                    pose: car.vehicle.pose(),
                    impact,
                };
                if impact > CRASH_SPEED {
                    car.crash(to);
                    seen.push(Message::Crash(contact));
                } else if anew(&mut car.wall_contact, to) {
                    seen.push(Message::Scrape(contact));
                }
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

    /// Pushes cars apart that touch. Cars of one weight exchange their speeds towards each other, and lose some of it.
    fn collide(&mut self, now: Duration) {
        for first in 0..self.cars.len() {
            for second in first + 1..self.cars.len() {
                let pair = [first, second];
                let boxes = pair.map(|i| obstacle(&self.cars[i].vehicle));
                let Some((away, depth)) = overlap(&boxes) else {
                    continue;
                };
                let speeds = pair.map(|i| {
                    let velocity = self.cars[i].vehicle.velocity();
                    velocity[0] * away[0] + velocity[1] * away[1]
                });
                let impact = (speeds[0] - speeds[1]).max(0.0);
                for (i, side) in [(first, -1.0), (second, 1.0)] {
                    let car = &mut self.cars[i];
                    // A car that the marshals hold stands like a wall; the other one yields twice.
                    let held = car.marshals.is_some();
                    if !held {
                        car.vehicle.push(
                            away.map(|v| v * side * depth / 2.0),
                            away.map(|v| v * side * 0.6 * impact),
                        );
                    }
                    if anew(&mut car.other_contact, now) {
                        let contact = Crash {
                            pose: car.vehicle.pose(),
                            impact,
                        };
                        self.underway.push(Output {
                            car: i,
                            at: now,
                            message: Message::Collision(contact),
                        });
                    }
                }
            }
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
            // An odometry that knows its turning from the steering alone would have the driver answer his own steering: he
            // reads the gyroscope himself.
            let blind = self.guidance == Guidance::Estimate
                && self.odometry.params().yaw_source == YawSource::Steering;
            let estimate = self.estimate.map(|estimate| Estimate {
                yaw_rate: if blind {
                    self.odometry.turning()
                } else {
                    estimate.yaw_rate
                },
                ..estimate
            });
            let controls = self.driver.drive(now, estimate.as_ref(), ahead, line);
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

/// Notes a contact. Says whether it is a new one.
fn anew(last: &mut Option<Duration>, now: Duration) -> bool {
    let new = last.is_none_or(|last| now > last + CONTACT);
    *last = Some(now);
    new
}

/// Whether two boxes overlap: the direction in which the second is away from the first, and by how much they do [m] (the
/// separating axis theorem).
fn overlap(boxes: &[Obstacle; 2]) -> Option<([f64; 2], f64)> {
    let [a, b] = boxes.map(|o| o.map_from_centre);
    let between = [b.x - a.x, b.y - a.y];
    let mut best: Option<([f64; 2], f64)> = None;
    for turn in [0.0, std::f64::consts::FRAC_PI_2] {
        for heading in [a.heading, b.heading] {
            let (sin, cos) = (heading + turn).sin_cos();
            let reach: f64 = boxes
                .iter()
                .map(|o| {
                    let (s, c) = (o.map_from_centre.heading - heading - turn).sin_cos();
                    o.half[0] * c.abs() + o.half[1] * s.abs()
                })
                .sum();
            let apart = between[0] * cos + between[1] * sin;
            let depth = reach - apart.abs();
            if depth <= 0.0 {
                return None;
            }
            if best.is_none_or(|(_, least)| depth < least) {
                let side = if apart < 0.0 { -1.0 } else { 1.0 };
                best = Some(([side * cos, side * sin], depth));
            }
        }
    }
    best
}

fn obstacle(vehicle: &Vehicle) -> Obstacle {
    let p = vehicle.params();
    let centre = p.body[0] / 2.0 - p.rear_overhang;
    Obstacle {
        map_from_centre: vehicle.pose() * Pose::new(centre, 0.0, 0.0),
        half: [p.body[0] / 2.0, p.body[1] / 2.0],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Surface, Wall, Walls};
    use maps::{Cell, OccupancyGrid, Raceline};

    fn ring() -> Arc<Track> {
        Arc::new(Track::bundled("club").expect("it ships"))
    }

    /// A car that starts there, drives at so much of the line's speed, and knows its true pose.
    fn setup(start: f64, speed_scale: f64) -> CarSetup {
        let setup = CarSetup::default();
        CarSetup {
            start,
            guidance: Guidance::Truth,
            driver: DriverParams {
                speed_scale,
                ..setup.driver
            },
            ..setup
        }
    }

    fn cars(starts: &[f64], speed_scales: &[f64]) -> World {
        let setups: Vec<CarSetup> = starts
            .iter()
            .zip(speed_scales)
            .map(|(&start, &speed_scale)| setup(start, speed_scale))
            .collect();
        World::new(ring(), &setups, 3)
    }

    #[test]
    fn traffic_goes_on_when_a_car_slips_and_another_is_knocked_round() {
        // As in the demo: the second car on taped tyres, the third behind a slower opponent; the first on dust for a while,
        // the third knocked round twice. All know their true pose: what they touch is the driving's fault.
        let mut setups = [(-4.0, 1.0), (-8.0, 1.0), (-16.0, 1.0), (-12.0, 0.97)].map(|(s, v)| setup(s, v));
        setups[1].vehicle = setups[1].vehicle.with_grip(Grip::LQ);
        let mut world = World::new(ring(), &setups, 0);
        let mut laps = [0; 4];
        let events = [
            (20, 0, Some(Grip::LQ)),
            (40, 0, Some(Grip::HQ)),
            (50, 2, None),
            (75, 2, None),
        ];
        let mut events = events.into_iter().peekable();
        while world.now() < Duration::from_secs(110) {
            while let Some((_, car, grip)) =
                events.next_if(|(at, ..)| world.now() >= Duration::from_secs(*at))
            {
                match grip {
                    Some(grip) => world.set_grip(car, grip),
                    None => world.knock(car, 9.0),
                }
            }
            for output in world.step() {
                match output.message {
                    Message::Crash(_) | Message::Collision(_) => panic!("{:?}: {output:?}", world.now()),
                    Message::Lap(lap) => laps[output.car] = lap.number,
                    _ => {}
                }
            }
        }
        assert!(laps.iter().all(|laps| *laps >= 10), "{laps:?}");
    }

    #[test]
    fn cars_that_touch_are_told_once_and_end_apart() {
        // Nose to tail, and into each other by 5 cm: the one behind is faster.
        let mut world = cars(&[0.0, -0.45], &[0.3, 0.6]);
        let mut told = [0, 0];
        while world.now() < Duration::from_secs(2) {
            for output in world.step() {
                if matches!(output.message, Message::Collision(_)) {
                    told[output.car] += 1;
                }
            }
        }
        assert_eq!(told, [1, 1]);
        let boxes = [0, 1].map(|i| obstacle(&world.cars[i].vehicle));
        assert!(overlap(&boxes).is_none());
    }

    /// Cars that stand on the line, the first crashed: when the marshals put it back, and where along the line.
    fn put_back(starts: &[f64]) -> (Duration, f64) {
        let mut world = cars(starts, &vec![1.0; starts.len()]);
        for car in &mut world.cars {
            car.guidance = Guidance::Estimate;
        }
        // Off the line, so that there may be a car beside it.
        let beside = world.truth(0).pose * Pose::new(0.0, 0.5, 0.0);
        world.cars[0].vehicle.place(beside);
        world.cars[0].crash(Duration::ZERO);
        let mut placed = None;
        while world.now() < MARSHALS + PATIENCE + Duration::from_secs(1) {
            for output in world.step() {
                match output.message {
                    Message::Placed(pose) => {
                        let s = world.track.raceline.project([pose.x, pose.y]).s;
                        assert_eq!(placed.replace((output.at, s)), None);
                    }
                    Message::Collision(_) => assert!(output.at >= MARSHALS + PATIENCE, "{output:?}"),
                    _ => {}
                }
            }
        }
        placed.expect("nobody waits for ever")
    }

    #[test]
    fn the_marshals_put_a_car_where_there_is_room() {
        let (at, s) = put_back(&[8.0]);
        assert!(at == MARSHALS && (s - 8.0).abs() < 0.1, "{at:?}, {s} m");
        // Two cars beside it: behind both.
        let (at, s) = put_back(&[8.0, 8.0, 7.0]);
        assert!(at == MARSHALS && (5.9..6.3).contains(&s), "{at:?}, {s} m");
        // A queue of 6 m.
        let queue: Vec<f64> = (0..9).map(|car| 8.0 - 0.7 * f64::from(car)).collect();
        let (at, s) = put_back(&[&[8.0], &queue[..]].concat());
        assert!(
            at == MARSHALS + PATIENCE && (s - 8.0).abs() < 0.1,
            "{at:?}, {s} m"
        );
    }

    #[test]
    fn the_marshals_put_nothing_before_a_car_that_cannot_stop() {
        let mut world = cars(&[8.0, 4.0], &[1.0, 1.0]);
        world.cars[0].marshals = Some(Duration::ZERO);
        let mut place = |speed: f64| {
            world.cars[1].vehicle.state_mut().vx = speed;
            world.place_for(0, TICK)
        };
        assert_eq!(place(0.0), Some(8.0));
        // From 3.5 m/s it takes 3.1 m, from 4 m/s 4 m: then behind it.
        assert_eq!(place(3.5), Some(8.0));
        assert!(place(4.0) < Some(4.0 - ROOM));
    }

    #[test]
    fn traffic_is_not_hit_by_cars_that_the_marshals_put_back() {
        let starts: Vec<f64> = (0..8).map(|car| -4.0 - 3.0 * f64::from(car)).collect();
        let mut world = cars(&starts, &[1.0; 8]);
        let (mut crashed, mut placed) = (0, 0);
        while crashed < 8 || placed < 8 {
            let now = world.now();
            assert!(now < Duration::from_mins(1), "{placed} of {crashed} put back");
            // Every other second another one leaves the line, to the left or to the right.
            if crashed < 8 && now >= Duration::from_secs(10 + 2 * crashed) {
                let car = &mut world.cars[crashed as usize * 3 % 8];
                let side = if crashed.is_multiple_of(2) { 0.4 } else { -0.4 };
                car.vehicle.place(car.vehicle.pose() * Pose::new(0.0, side, 0.3));
                car.crash(now);
                crashed += 1;
            }
            for output in world.step() {
                match output.message {
                    Message::Placed(_) => placed += 1,
                    Message::Collision(_) => panic!("{now:?}: {output:?}"),
                    _ => {}
                }
            }
        }
    }

    #[test]
    fn sensors_arrive_as_late_as_on_a_real_car() {
        let mut world = World::new(ring(), &[CarSetup::default()], 3);
        let ms = Duration::from_millis;
        let (mut scans, mut odometry) = (0, 0);
        while world.now() < Duration::from_secs(2) {
            let before = world.now();
            for output in world.step() {
                assert!(before < output.at && output.at <= world.now());
                // Real cars log a scan 17 to 22 ms after its stamp.
                match output.message {
                    Message::Scan(scan) => {
                        assert!((ms(17)..ms(22)).contains(&(output.at.saturating_sub(scan.stamp))));
                        scans += 1;
                    }
                    Message::Odometry(message) => {
                        assert_eq!(output.at.saturating_sub(message.stamp), ms(1));
                        odometry += 1;
                    }
                    _ => {}
                }
            }
        }
        assert!((78..=80).contains(&scans) && (99..=100).contains(&odometry));
    }

    #[test]
    fn a_command_takes_effect_after_the_driver_s_delay() {
        let mut world = cars(&[0.0], &[1.0]);
        let delay = world.cars[0].driver.params().delay;
        while world.now() < delay {
            world.step();
            assert_eq!(world.cars[0].controls, Controls::default());
        }
        world.step();
        assert!(world.cars[0].controls.speed > 0.0);
    }

    /// The first scan of a car that stands on a circle of 4 m in a hall of 20 m, with a flawless laser; further cars stand
    /// on the line, and further walls in the hall.
    fn first_scan(others: &[f64], screens: &[Wall]) -> (World, Scan) {
        let circle: Vec<_> = (0..60)
            .map(|i| std::f64::consts::TAU * f64::from(i) / 60.0)
            .map(|a| [4.0 * a.cos(), 4.0 * a.sin()])
            .collect();
        let hall = Wall {
            surface: Surface::Plain,
            points: vec![
                [-10.0, -10.0],
                [10.0, -10.0],
                [10.0, 10.0],
                [-10.0, 10.0],
                [-10.0, -10.0],
            ],
        };
        let track = Track {
            name: "hall".into(),
            grid: OccupancyGrid::new(1, 1, 0.05, Pose::IDENTITY, vec![Cell::Free]),
            raceline: Raceline::through(&circle, 3.0).expect("a valid line"),
            walls: Walls::new(screens.iter().cloned().chain([hall]).collect()),
        };
        // Without an estimate a car stands where it is.
        let car = CarSetup {
            start: 0.0,
            lidar: LidarParams {
                noise: 0.0,
                jitter: 0.0,
                dropout: 0.0,
                half_power: 1e-12,
                ..LidarParams::default()
            },
            ..CarSetup::default()
        };
        let others = others.iter().map(|&start| CarSetup { start, ..car });
        let setups: Vec<CarSetup> = [car].into_iter().chain(others).collect();
        let mut world = World::new(Arc::new(track), &setups, 3);
        while world.now() < Duration::from_secs(1) {
            for output in world.step() {
                if let (0, Message::Scan(scan)) = (output.car, output.message) {
                    return (world, scan);
                }
            }
        }
        panic!("no scan in a second");
    }

    #[test]
    fn a_car_ahead_stands_in_the_scan_exactly_where_it_is() {
        let (_, alone) = first_scan(&[], &[]);
        let (world, followed) = first_scan(&[2.0], &[]);
        // The other car's outline as four walls: another way to meet it than the laser's.
        let mut points = outline(world.cars[1].vehicle.params(), world.truth(1).pose).to_vec();
        points.push(points[0]);
        let body = Wall {
            surface: Surface::Plain,
            points,
        };
        let hall = world.track.walls.polylines().iter().cloned();
        let walls = Walls::new(hall.chain([body]).collect());
        let laser = world.truth(0).pose * world.cars[0].lidar.params().base_link_from_laser;
        let mut shorter = 0;
        for (beam, (&before, &after)) in alone.ranges.iter().zip(&followed.ranges).enumerate() {
            let angle = laser.heading + alone.angle_min + beam as f64 * alone.angle_increment;
            let hit = walls.cast([laser.x, laser.y], [angle.cos(), angle.sin()], 30.0);
            let expected = hit.expect("a hall is closed").range;
            // The device rounds to a millimetre.
            assert!(
                (f64::from(after) - expected).abs() < 0.001,
                "beam {beam}: {before} m alone, {after} m, not {expected} m"
            );
            shorter += usize::from(after < before - 1.0);
        }
        // 0.28 m of bumper and a bit of its side, some 1.6 m away: 11 to 16 degrees of four beams each.
        assert!((44..64).contains(&shorter), "{shorter} beams");
    }

    #[test]
    fn a_car_behind_a_wall_is_not_in_the_scan() {
        // Across the line, between the two cars, and higher than what the laser could pass.
        let screen = [Wall {
            surface: Surface::Plain,
            points: vec![[0.0, 1.2], [9.0, 1.2]],
        }];
        let (_, alone) = first_scan(&[], &screen);
        let (_, followed) = first_scan(&[2.0], &screen);
        assert_eq!(alone.ranges, followed.ranges);
        assert!(alone.ranges[540] < 1.5, "the wall is in view");
    }

    #[test]
    fn boxes_overlap_where_they_do() {
        let at = |x: f64, heading: f64| Obstacle {
            map_from_centre: Pose::new(x, 0.0, heading),
            half: [0.25, 0.14],
        };
        assert!(overlap(&[at(0.0, 0.0), at(0.51, 0.0)]).is_none());
        let (away, depth) = overlap(&[at(0.0, 0.0), at(0.49, 0.0)]).expect("by a centimetre");
        assert!((depth - 0.01).abs() < 1e-9 && (away[0] - 1.0).abs() < 1e-9);
        assert!(overlap(&[at(0.0, 0.0), at(0.38, std::f64::consts::FRAC_PI_2)]).is_some());
        assert!(overlap(&[at(0.0, 0.0), at(0.40, std::f64::consts::FRAC_PI_2)]).is_none());
    }

    #[test]
    fn a_wall_that_is_scraped_along_is_one_contact() {
        let mut last = None;
        let ms = Duration::from_millis;
        let told: Vec<bool> = [0, 10, 400, 800, 1400]
            .into_iter()
            .map(|at| anew(&mut last, ms(at)))
            .collect();
        assert_eq!(told, [true, false, false, false, true]);
    }

    #[test]
    fn taped_tyres_hold_the_line_as_clean_ones_do() {
        let off = |grip: Grip| {
            let setup = CarSetup::default();
            let setup = CarSetup {
                vehicle: setup.vehicle.with_grip(grip),
                guidance: Guidance::Truth,
                ..setup
            };
            let mut world = World::new(ring(), &[setup], 1);
            let (mut sum, mut count) = (0.0, 0.0);
            while world.truth(0).laps < 3 && world.now() < Duration::from_secs(50) {
                world.step();
                if world.truth(0).laps > 0 {
                    sum += world.truth(0).track.d.abs();
                    count += 1.0;
                }
            }
            assert_eq!(world.truth(0).laps, 3);
            sum / count
        };
        // Half a centimetre, once the driver knows the servo's centre; without a model of slip it is 5 and 8 cm.
        let (hq, lq) = (off(Grip::HQ), off(Grip::LQ));
        assert!(hq < 0.008 && lq < 0.008, "{hq} m, {lq} m");
    }
}
