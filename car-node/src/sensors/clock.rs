//! The sensors' clock against this machine's.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use synpf::Stamp;

/// Converts between the sensors' time and wall time. A recording has the time at which it was made, a simulator one of its
/// own. On a live car both are the same.
#[derive(Debug, Clone, Copy)]
pub struct SensorClock {
    started: Instant,
    /// Wall time at `started`.
    wall: Stamp,
    /// Sensor time at `started`.
    sensor: Stamp,
    /// Sensor seconds per second.
    rate: f64,
}

impl SensorClock {
    /// A clock that shows `sensor` now and runs at `rate`, which must be positive.
    pub fn starting_at(sensor: Stamp, rate: f64) -> Self {
        assert!(rate > 0.0, "a clock must run forwards, not at {rate}");
        Self {
            started: Instant::now(),
            wall: wall_now(),
            sensor,
            rate,
        }
    }

    /// Sensor time now.
    pub fn now(&self) -> Stamp {
        self.sensor.plus(self.started.elapsed().as_secs_f64() * self.rate)
    }

    /// Wall time \[unix\] at which the sensors' clock shows `stamp`.
    pub fn wall(&self, stamp: Stamp) -> Stamp {
        self.wall.plus(stamp.since(self.sensor) / self.rate)
    }

    /// Time until the sensors' clock shows `stamp`; zero if that is past.
    pub fn until(&self, stamp: Stamp) -> Duration {
        Duration::try_from_secs_f64(stamp.since(self.now()) / self.rate).unwrap_or(Duration::ZERO)
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
}
