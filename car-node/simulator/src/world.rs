//! The race: cars on a track, moved on tick by tick.

use std::sync::Arc;
use std::time::Duration;

use maps::Pose;

use crate::car::Car;
use crate::obstacle::overlap;
use crate::recovery_crew::{self, RECOVERY_TIME};
use crate::tick::TICK;
use crate::{
    Ahead, CarSetup, Contact, Estimate, Grip, Guidance, Manoeuvre, Message, Obstacle, Output, Track, Truth,
};

/// Ticks from one truth message to the next: 100 Hz.
const TRUTH_EVERY: u64 = 4;

/// A car that hits a wall faster than this stops and waits for the recovery crew \[m/s\]. A slower one scrapes along.
const CRASH_SPEED: f64 = 1.0;

/// A driver reacts to cars ahead within this distance \[m\]: enough to stop from full speed behind one that stands.
const IN_VIEW: f64 = 16.0;

/// A race in progress. [`World::step`] moves it on; it has no other clock.
#[derive(Debug)]
pub struct World {
    track: Arc<Track>,
    cars: Vec<Car>,
    ticks: u64,
    /// Messages that were sent and have not arrived.
    in_transit: Vec<Output>,
}

impl World {
    /// Cars at rest at their starts. The seed decides the noise of every sensor. Each sensor has its own stream of
    /// random numbers, so a change to one leaves the noise of the others as it was.
    pub fn new(track: Arc<Track>, setups: &[CarSetup], seed: u64) -> Self {
        let cars = setups
            .iter()
            .enumerate()
            .map(|(index, setup)| Car::new(&track.raceline, setup, index, seed))
            .collect();
        Self {
            track,
            cars,
            ticks: 0,
            in_transit: Vec::new(),
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

    /// The true state of a car now.
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

    /// True once the car has crossed the start line. What it does before belongs to no lap.
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

    /// Changes a car's grip, as tape on its tyres or dust on the floor do.
    pub fn set_grip(&mut self, car: usize, grip: Grip) {
        self.cars[car].vehicle.set_grip(grip);
    }

    /// Knocks a car round: adds to its yaw rate \[rad/s\].
    pub fn knock(&mut self, car: usize, yaw_rate: f64) {
        self.cars[car].vehicle.state_mut().yaw_rate += yaw_rate;
    }

    /// Moves the race on by one tick. Returns the messages that arrive in it, in order of arrival.
    pub fn step(&mut self) -> Vec<Output> {
        let from = self.now();
        self.ticks += 1;
        let times = [from, self.now()];
        let before: Vec<Pose> = self.cars.iter().map(|car| car.vehicle.pose()).collect();
        for index in 0..self.cars.len() {
            self.move_car(index, times);
        }
        self.collide(times[1]);
        let outlines: Vec<Obstacle> = self.cars.iter().map(|car| Obstacle::of(&car.vehicle)).collect();
        for (index, &before) in before.iter().enumerate() {
            self.sense(index, before, &outlines, times);
        }
        let [_, now] = times;
        // A stable sort: messages of equal times keep the order of cars and sensors.
        self.in_transit.sort_by_key(|output| output.at);
        let arrived = self.in_transit.partition_point(|output| output.at <= now);
        self.in_transit.drain(..arrived).collect()
    }

    /// The nearest car in front on the line, within [`IN_VIEW`].
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

    /// Driver, dynamics, walls and lap count of one car.
    fn move_car(&mut self, index: usize, [from, now]: [Duration; 2]) {
        let ahead = self.ahead(index);
        let line = &self.track.raceline;
        let place = recovery_crew::place_for(&self.cars, index, line, now);
        let car = &mut self.cars[index];
        let mut events = Vec::new();
        if car.recovery_ready.is_some() {
            if let Some(pose) = place {
                car.put_back(pose);
                events.push(Message::Placed(pose));
            }
        } else {
            car.command(from, ahead, line);
            if let Some(contact) = car.drive(TICK, &self.track.walls) {
                if contact.impact > CRASH_SPEED {
                    car.crash(now + RECOVERY_TIME);
                    events.push(Message::Crash(contact));
                } else if car.wall_contact.begins(now) {
                    events.push(Message::Scrape(contact));
                }
            }
        }
        events.extend(car.update_lap(line, now, TICK).map(Message::Lap));
        if car.spins() {
            events.push(Message::Spin);
        }
        if self.ticks.is_multiple_of(TRUTH_EVERY) {
            events.push(Message::Truth(self.truth(index)));
        }
        self.send(index, events.into_iter().map(|message| (now, message)));
    }

    /// Pushes apart cars that touch. They have equal masses: they exchange their speeds towards each other, and lose
    /// some of it.
    fn collide(&mut self, now: Duration) {
        for first in 0..self.cars.len() {
            for second in first + 1..self.cars.len() {
                let pair = [first, second];
                let outlines = pair.map(|i| Obstacle::of(&self.cars[i].vehicle));
                let Some((away, depth)) = overlap(&outlines) else {
                    continue;
                };
                let speeds = pair.map(|i| {
                    let velocity = self.cars[i].vehicle.velocity();
                    velocity[0] * away[0] + velocity[1] * away[1]
                });
                let impact = (speeds[0] - speeds[1]).max(0.0);
                for (i, side) in [(first, -1.0), (second, 1.0)] {
                    let car = &mut self.cars[i];
                    // A car in recovery does not move.
                    if car.recovery_ready.is_none() {
                        car.vehicle.push(
                            away.map(|v| v * side * depth / 2.0),
                            away.map(|v| v * side * 0.6 * impact),
                        );
                    }
                    if car.opponent_contact.begins(now) {
                        let contact = Contact {
                            pose: car.vehicle.pose(),
                            impact,
                        };
                        self.send(i, [(now, Message::Collision(contact))]);
                    }
                }
            }
        }
    }

    /// Everything that one car's sensors deliver in this tick.
    fn sense(&mut self, index: usize, before: Pose, outlines: &[Obstacle], times: [Duration; 2]) {
        let car = &mut self.cars[index];
        if car.guidance == Guidance::Truth {
            return;
        }
        let others: Vec<Obstacle> = outlines
            .iter()
            .enumerate()
            .filter(|&(other, _)| other != index)
            .map(|(_, outline)| *outline)
            .collect();
        let sent = car.sense(before, times, &self.track.walls, &others);
        self.send(index, sent);
    }

    /// Puts a car's messages in transit, each with its time of arrival.
    fn send(&mut self, car: usize, messages: impl IntoIterator<Item = (Duration, Message)>) {
        let outputs = messages
            .into_iter()
            .map(|(at, message)| Output { car, at, message });
        self.in_transit.extend(outputs);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recovery_crew::PATIENCE;
    use crate::{Controls, DriverParams, LidarParams, Scan, Surface, Wall, Walls, outline};
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
        let boxes = [0, 1].map(|i| Obstacle::of(&world.cars[i].vehicle));
        assert!(overlap(&boxes).is_none());
    }

    /// Cars that stand on the line, the first crashed: when the recovery crew puts it back, and where along the line.
    fn put_back(starts: &[f64]) -> (Duration, f64) {
        let mut world = cars(starts, &vec![1.0; starts.len()]);
        for car in &mut world.cars {
            car.guidance = Guidance::Estimate;
        }
        // Off the line, so that there may be a car beside it.
        let beside = world.truth(0).pose * Pose::new(0.0, 0.5, 0.0);
        world.cars[0].vehicle.place(beside);
        world.cars[0].crash(RECOVERY_TIME);
        let mut placed = None;
        while world.now() < RECOVERY_TIME + PATIENCE + Duration::from_secs(1) {
            for output in world.step() {
                match output.message {
                    Message::Placed(pose) => {
                        let s = world.track.raceline.project([pose.x, pose.y]).s;
                        assert_eq!(placed.replace((output.at, s)), None);
                    }
                    Message::Collision(_) => assert!(output.at >= RECOVERY_TIME + PATIENCE, "{output:?}"),
                    _ => {}
                }
            }
        }
        placed.expect("nobody waits for ever")
    }

    #[test]
    fn the_recovery_crew_puts_a_car_where_there_is_room() {
        let (at, s) = put_back(&[8.0]);
        assert!(at == RECOVERY_TIME && (s - 8.0).abs() < 0.1, "{at:?}, {s} m");
        // Two cars beside it: behind both.
        let (at, s) = put_back(&[8.0, 8.0, 7.0]);
        assert!(at == RECOVERY_TIME && (5.9..6.3).contains(&s), "{at:?}, {s} m");
        // A queue of 6 m.
        let queue: Vec<f64> = (0..9).map(|car| 8.0 - 0.7 * f64::from(car)).collect();
        let (at, s) = put_back(&[&[8.0], &queue[..]].concat());
        assert!(
            at == RECOVERY_TIME + PATIENCE && (s - 8.0).abs() < 0.1,
            "{at:?}, {s} m"
        );
    }

    #[test]
    fn traffic_is_not_hit_by_cars_that_the_recovery_crew_puts_back() {
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
                car.crash(now + RECOVERY_TIME);
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
