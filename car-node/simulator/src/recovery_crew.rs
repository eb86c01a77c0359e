//! The recovery crew: puts a crashed car back on the raceline, where it has room.

use std::time::Duration;

use maps::{Pose, Raceline};

use crate::car::Car;
use crate::pursuit::BRAKE_BEHIND;

/// From a crash until the crew is ready to put the car back.
pub(crate) const RECOVERY_TIME: Duration = Duration::from_secs(3);

/// The crew looks this far back along the line for a free place \[m\], in steps of `LOOK_STEP` \[m\].
const LOOK_BACK: f64 = 5.0;
const LOOK_STEP: f64 = 0.25;
/// Room that a car needs before and behind it \[m\].
const ROOM: f64 = 0.3;
/// After waiting this long for a free place, the crew puts the car where it left the line.
pub(crate) const PATIENCE: Duration = Duration::from_secs(10);

/// The pose at which the crew puts car `index` back at `now`. None while the car is not in recovery, while the crew is
/// on its way, and while no place is free.
pub(crate) fn place_for(cars: &[Car], index: usize, line: &Raceline, now: Duration) -> Option<Pose> {
    let s = arc_length_for(cars, index, line, now)?;
    let point = line.at(s);
    Some(Pose::new(point.x, point.y, point.heading))
}

/// The place as arc length \[m\]. Never behind the start line: the car would cross it twice.
fn arc_length_for(cars: &[Car], index: usize, line: &Raceline, now: Duration) -> Option<f64> {
    let car = &cars[index];
    let ready = car.recovery_ready.filter(|ready| now >= *ready)?;
    (0..=(LOOK_BACK / LOOK_STEP) as u32)
        .map(|step| car.track.s - LOOK_STEP * f64::from(step))
        .take_while(|s| *s >= 0.0)
        .find(|s| is_free(cars, index, line, *s))
        .or_else(|| (now >= ready + PATIENCE).then_some(car.track.s))
}

/// True if car `index` has room at rest at `s` and every car that comes from behind can stop.
fn is_free(cars: &[Car], index: usize, line: &Raceline, s: f64) -> bool {
    let room = cars[index].vehicle.params().body[0] + ROOM;
    cars.iter()
        .enumerate()
        .filter(|&(other, _)| other != index)
        .all(|(_, other)| {
            let way = line.advance(other.track.s, s);
            let stopping = other.vehicle.state().vx.max(0.0).powi(2) / (2.0 * BRAKE_BEHIND);
            way < -room || way > room + stopping
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CarSetup, Track};

    #[test]
    fn no_car_is_put_in_front_of_one_that_cannot_stop() {
        let track = Track::bundled("club").expect("it ships");
        let line = &track.raceline;
        let mut cars = [8.0, 4.0].map(|start| {
            let setup = CarSetup {
                start,
                ..CarSetup::default()
            };
            Car::new(line, &setup, 0, 3)
        });
        cars[0].recovery_ready = Some(Duration::ZERO);
        let mut place = |speed: f64| {
            cars[1].vehicle.state_mut().vx = speed;
            arc_length_for(&cars, 0, line, Duration::ZERO)
        };
        assert_eq!(place(0.0), Some(8.0));
        // From 3.5 m/s it takes 3.1 m, from 4 m/s 4 m: then behind it.
        assert_eq!(place(3.5), Some(8.0));
        assert!(place(4.0) < Some(4.0 - ROOM));
    }
}
