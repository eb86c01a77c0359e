//! One car in the race: vehicle, sensors, driver and lap count.

use std::f64::consts::FRAC_PI_2;
use std::time::Duration;

use maps::{Pose, Raceline, TrackPosition};
use rand::SeedableRng;
use rand::rngs::StdRng;

use crate::contact_timer::ContactTimer;
use crate::tick::TICK;
use crate::{
    Ahead, CarSetup, Contact, Controls, Driver, Estimate, Guidance, Lap, Lidar, Message, Motion, Obstacle,
    OdometrySensor, Vehicle, VehicleState, Walls, YawSource, outline,
};

/// Heading error at which a car has spun, and below which it is straight again \[rad\].
const SPUN: f64 = FRAC_PI_2;
const STRAIGHT: f64 = 0.3;

#[derive(Debug)]
pub(crate) struct Car {
    pub(crate) vehicle: Vehicle,
    pub(crate) lidar: Lidar,
    odometry: OdometrySensor,
    pub(crate) driver: Driver,
    pub(crate) guidance: Guidance,
    pub(crate) estimate: Option<Estimate>,
    pub(crate) controls: Controls,
    /// Commands that have no effect yet, oldest first, and when each takes effect.
    pending: Vec<(Duration, Controls)>,
    next_command: Duration,
    pub(crate) track: TrackPosition,
    /// When the car last crossed the start line.
    pub(crate) lap_start: Option<Duration>,
    pub(crate) laps: u32,
    /// Set from a crash until the recovery crew has put the car back: when the crew is ready.
    pub(crate) recovery_ready: Option<Duration>,
    spun: bool,
    pub(crate) wall_contact: ContactTimer,
    pub(crate) opponent_contact: ContactTimer,
}

impl Car {
    /// A car at rest at its start. `seed` and `index` decide its sensors' noise and phases. Each sensor has its own
    /// stream of random numbers, so a change to one sensor leaves the noise of the others as it was.
    pub(crate) fn new(line: &Raceline, setup: &CarSetup, index: usize, seed: u64) -> Self {
        let start = line.at(setup.start);
        let pose = Pose::new(start.x, start.y, start.heading);
        let stream = |sensor: u64| {
            StdRng::seed_from_u64(seed.wrapping_mul(1_000_003) ^ ((index as u64) << 8) ^ sensor)
        };
        // Real sensors are not synchronised.
        let phase = |ticks: u64| TICK * (seed.wrapping_add(index as u64 * 7).wrapping_mul(5) % ticks) as u32;
        Self {
            vehicle: Vehicle::at_rest(setup.vehicle, pose),
            lidar: Lidar::new(setup.lidar, phase(10), stream(1)),
            odometry: OdometrySensor::new(setup.odometry, setup.vehicle.wheelbase(), phase(8), stream(2)),
            driver: Driver::new(setup.driver, setup.vehicle),
            guidance: setup.guidance,
            estimate: None,
            controls: Controls::default(),
            pending: Vec::new(),
            next_command: Duration::ZERO,
            track: line.project([pose.x, pose.y]),
            lap_start: None,
            laps: 0,
            recovery_ready: None,
            spun: false,
            wall_contact: ContactTimer::default(),
            opponent_contact: ContactTimer::default(),
        }
    }

    /// Runs the driver when a command is due, and lets earlier commands take effect after their delay.
    pub(crate) fn command(&mut self, now: Duration, ahead: Option<Ahead>, line: &Raceline) {
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
            // With a yaw rate computed from the steering, the driver would react to its own commands. It reads the
            // gyroscope instead.
            let from_steering = self.guidance == Guidance::Estimate
                && self.odometry.params().yaw_source == YawSource::Steering;
            let estimate = self.estimate.map(|estimate| Estimate {
                yaw_rate: if from_steering {
                    self.odometry.gyro_yaw_rate()
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

    /// Moves the vehicle on by `duration` and off a wall that it runs into. Returns the contact with the wall.
    pub(crate) fn drive(&mut self, duration: Duration, walls: &Walls) -> Option<Contact> {
        let before = *self.vehicle.state();
        self.vehicle.drive(self.controls, duration.as_secs_f64());
        let along = walls.touching(&outline(self.vehicle.params(), self.vehicle.pose()))?;
        let impact = self.bounce(&before, along);
        Some(Contact {
            pose: self.vehicle.pose(),
            impact,
        })
    }

    /// Puts the car back to where it did not touch the wall. The speed into the wall is reversed and mostly lost.
    /// Returns that speed \[m/s\].
    fn bounce(&mut self, before: &VehicleState, along: [f64; 2]) -> f64 {
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

    /// Stops the car where it is, until the recovery crew puts it back. The crew is ready at `ready`.
    pub(crate) fn crash(&mut self, ready: Duration) {
        let pose = self.vehicle.pose();
        self.vehicle.place(pose);
        self.recovery_ready = Some(ready);
        self.pending.clear();
        self.controls = Controls::default();
    }

    /// The recovery crew puts the car at `pose`, at rest.
    pub(crate) fn put_back(&mut self, pose: Pose) {
        self.vehicle.place(pose);
        self.driver.reset();
        self.recovery_ready = None;
    }

    /// Updates the position on the raceline at the end of a tick of length `tick`. Returns a lap that ended in it.
    pub(crate) fn update_lap(&mut self, line: &Raceline, now: Duration, tick: Duration) -> Option<Lap> {
        let pose = self.vehicle.pose();
        let previous = self.track;
        self.track = line.project([pose.x, pose.y]);
        let step = line.advance(previous.s, self.track.s);
        // Forwards across the start line, and not by a jump to another part of the track.
        let crossed = self.track.s < previous.s && step > 0.0 && step < 1.0;
        if !crossed {
            return None;
        }
        let beyond = (self.track.s / step).clamp(0.0, 1.0);
        let crossing = now.saturating_sub(tick.mul_f64(beyond));
        let start = self.lap_start.replace(crossing)?;
        self.laps += 1;
        Some(Lap {
            number: self.laps,
            time: crossing.saturating_sub(start),
        })
    }

    /// True in the tick in which the car spins. It can spin again after it was straight.
    pub(crate) fn spins(&mut self) -> bool {
        let off = maps::wrap_angle(self.vehicle.pose().heading - self.track.heading).abs();
        let begins = off > SPUN && !self.spun;
        self.spun = off > if self.spun { STRAIGHT } else { SPUN };
        begins
    }

    /// The sensors' messages of one tick, each with its time of arrival. The car was at `before` when the tick began.
    pub(crate) fn sense(
        &mut self,
        before: Pose,
        times: [Duration; 2],
        walls: &Walls,
        others: &[Obstacle],
    ) -> Vec<(Duration, Message)> {
        let [_, now] = times;
        let state = self.vehicle.state();
        let motion = Motion {
            wheel_speed: state.wheel_speed,
            yaw_rate: state.yaw_rate,
            steering: self.controls.steering,
        };
        let mut sent = Vec::new();
        let arrival = now + self.odometry.params().transport;
        sent.extend(
            self.odometry
                .gyro(now, motion)
                .map(|gyro| (arrival, Message::Gyro(gyro))),
        );
        let odometry = self.odometry.odometry(now, motion);
        sent.extend(odometry.map(|odometry| (arrival, Message::Odometry(odometry))));
        let scan = self
            .lidar
            .sense(times, [before, self.vehicle.pose()], walls, others);
        sent.extend(scan.map(|(arrival, scan)| (arrival, Message::Scan(scan))));
        sent
    }
}
