//! The sensors' clock against this machine's.

use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use synpf::Stamp;

/// Converts between the sensors' time and wall time. A recording has the time at which it was made, a simulator one of its
/// own. On a live car both are about the same.
///
/// All clones are one clock: a live source sets it while the others read it.
#[derive(Debug, Clone)]
pub struct SensorClock(Arc<Mutex<Reading>>);

/// What a clock showed at one instant, and how fast it runs.
#[derive(Debug, Clone, Copy)]
struct Reading {
    at: Instant,
    /// Wall time at `at`.
    wall: Stamp,
    /// Sensor time at `at`.
    sensor: Stamp,
    /// Sensor seconds per second.
    rate: f64,
}

/// Wall time that moves away by more than this from where it should be was set \[s\].
const WALL_SET: f64 = 0.05;

impl Reading {
    fn now(sensor: Stamp, rate: f64) -> Self {
        Self {
            at: Instant::now(),
            wall: wall_now(),
            sensor,
            rate,
        }
    }
}

impl SensorClock {
    /// A clock that shows `sensor` now and runs at `rate`, which must be positive.
    pub fn starting_at(sensor: Stamp, rate: f64) -> Self {
        assert!(rate > 0.0, "a clock must run forwards, not at {rate}");
        Self(Arc::new(Mutex::new(Reading::now(sensor, rate))))
    }

    /// Sets the clock: it shows `sensor` now and runs at `rate`, which must be positive.
    pub fn set(&self, sensor: Stamp, rate: f64) {
        assert!(rate > 0.0, "a clock must run forwards, not at {rate}");
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Reading::now(sensor, rate);
    }

    fn reading(&self) -> Reading {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sensor time now.
    pub fn now(&self) -> Stamp {
        self.at(Instant::now())
    }

    /// Sensor time at an instant.
    pub fn at(&self, instant: Instant) -> Stamp {
        let Reading { at, sensor, rate, .. } = self.reading();
        let later = instant.saturating_duration_since(at).as_secs_f64();
        let earlier = at.saturating_duration_since(instant).as_secs_f64();
        sensor.plus((later - earlier) * rate)
    }

    /// Wall time \[unix\] at which the sensors' clock shows `stamp`. When this machine's wall time is set, so is this.
    pub fn wall(&self, stamp: Stamp) -> Stamp {
        let Reading {
            at,
            wall,
            sensor,
            rate,
        } = self.reading();
        let set = wall_now().since(wall) - at.elapsed().as_secs_f64();
        let set = if set.abs() > WALL_SET { set } else { 0.0 };
        wall.plus(stamp.since(sensor) / rate + set)
    }

    /// Time until the sensors' clock shows `stamp`; zero if that is past.
    pub fn until(&self, stamp: Stamp) -> Duration {
        Duration::try_from_secs_f64(stamp.since(self.now()) / self.reading().rate).unwrap_or(Duration::ZERO)
    }
}

/// How far the filter's stamps are from the sensors' own. It changes when a sensor's clock is set.
#[derive(Debug, Clone, Default)]
pub struct StampShift(Arc<AtomicI64>);

impl StampShift {
    /// Sets what is added to a sensor's stamp \[ns\].
    pub fn set(&self, nanoseconds: i64) {
        self.0.store(nanoseconds, Ordering::Relaxed);
    }

    /// A stamp of the filter as the sensors' clock shows it.
    pub fn to_sensor(&self, stamp: Stamp) -> Stamp {
        Stamp(stamp.0.saturating_sub(self.0.load(Ordering::Relaxed)))
    }
}

/// Wall time now \[unix\].
pub fn wall_now() -> Stamp {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Stamp(i64::try_from(since_epoch.as_nanos()).unwrap_or(i64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fast_clock_reaches_its_stamps_early() {
        let start = Stamp(5_000_000_000);
        let clock = SensorClock::starting_at(start, 4.0);
        let until = clock.until(start.plus(8.0)).as_secs_f64();
        assert!((1.5..=2.0).contains(&until), "{until}");
        assert_eq!(clock.until(start.plus(-1.0)), Duration::ZERO);
        let wall = clock.wall(start.plus(8.0)).since(clock.wall(start));
        assert!((wall - 2.0).abs() < 1e-6);
        assert!(clock.now() >= start);
    }

    #[test]
    fn all_clones_are_set_together() {
        let clock = SensorClock::starting_at(Stamp(0), 1.0);
        let clone = clock.clone();
        clock.set(Stamp(100_000_000_000), 0.5);
        assert!(clone.now() >= Stamp(100_000_000_000));
        let until = clone.until(clone.now().plus(1.0)).as_secs_f64();
        assert!((1.5..=2.0).contains(&until), "{until}");
    }
}
