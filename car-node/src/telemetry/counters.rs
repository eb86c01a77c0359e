//! Counters: numbers and durations that the threads of a node record for the load meter.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use synpf::Dropped;

use crate::sensors::bag::SensorEvent;
use crate::statistics::{MeanSigma, percentile};

/// Median, 99th percentile and maximum of a duration \[s\].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Spread {
    /// Median \[s\].
    pub p50: f64,
    /// 99th percentile \[s\].
    pub p99: f64,
    /// Maximum \[s\].
    pub max: f64,
}

impl Spread {
    pub(crate) fn of(values: &[f64]) -> Self {
        let at = |share| percentile(values, share).unwrap_or_default();
        Self {
            p50: at(0.5),
            p99: at(0.99),
            max: at(1.0),
        }
    }
}

/// Recorded since the meter last read.
#[derive(Debug, Default)]
struct MeterInterval {
    update_times: Vec<f64>,
    scan_ages: Vec<f64>,
    publish_lags: Vec<f64>,
    /// Arrivals of scans, on the sensors' clock \[s\].
    scans: Vec<f64>,
    odometry: usize,
    dropped: BTreeMap<Dropped, u64>,
}

/// The counters as the meter reads them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Reading {
    /// Time of a whole update.
    pub update_time: Spread,
    /// Age of a scan when it reached the filter.
    pub scan_age: Spread,
    /// From the time of a pose to its hand-over to the network.
    pub publish_lag: Spread,
    /// Scans since the last reading.
    pub scans: usize,
    /// Odometry messages since the last reading.
    pub odometry: usize,
    /// Updates since the last reading.
    pub updates: usize,
    /// Standard deviation of the time between scans \[s\].
    pub scan_jitter: f64,
    /// Messages waiting for the filter.
    pub queued: usize,
    /// Refused by the filter since the start.
    pub dropped: BTreeMap<Dropped, u64>,
    /// Dropped since the start because the filter was too slow.
    pub overrun: u64,
    /// Payloads from the network that did not decode, since the start.
    pub payloads: u64,
}

/// Shared by all threads of a node. Every call is short.
#[derive(Debug, Default)]
pub struct Counters {
    interval: Mutex<MeterInterval>,
    queued: AtomicUsize,
    overrun: AtomicU64,
    payloads: AtomicU64,
}

/// At most this many values per interval: more than a second of anything. So a meter that has stopped costs no memory.
const MOST: usize = 4096;

impl Counters {
    fn with(&self, change: impl FnOnce(&mut MeterInterval)) {
        change(&mut self.interval.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// A message reached the filter at `now` \[s\], `age` \[s\] after its stamp. `queued` more are waiting.
    pub fn arrived(&self, event: &SensorEvent, age: f64, now: f64, queued: usize) {
        self.queued.store(queued, Ordering::Relaxed);
        self.with(|interval| match event {
            SensorEvent::Scan(_) => {
                push(&mut interval.scans, now);
                push(&mut interval.scan_ages, age);
            }
            SensorEvent::Odometry(_) => interval.odometry += 1,
            SensorEvent::YawRate(_) | SensorEvent::Pose(_) => {}
        });
    }

    /// The localizer refused a message.
    pub fn dropped(&self, cause: Dropped) {
        self.with(|interval| *interval.dropped.entry(cause).or_default() += 1);
    }

    /// A whole update took this long \[s\].
    pub fn updated(&self, time: f64) {
        self.with(|interval| push(&mut interval.update_times, time));
    }

    /// A pose was handed to the network this long after its time \[s\].
    pub fn published(&self, lag: f64) {
        self.with(|interval| push(&mut interval.publish_lags, lag));
    }

    /// A message was dropped because the filter was too slow.
    pub fn overrun(&self) {
        self.overrun.fetch_add(1, Ordering::Relaxed);
    }

    /// A payload from the network did not decode. Returns the number of those before it.
    pub fn bad_payload(&self) -> u64 {
        self.payloads.fetch_add(1, Ordering::Relaxed)
    }

    /// Reads the counters, and starts a new interval.
    pub fn read(&self) -> Reading {
        let mut interval = self.interval.lock().unwrap_or_else(PoisonError::into_inner);
        let fresh = MeterInterval {
            dropped: interval.dropped.clone(),
            ..MeterInterval::default()
        };
        let interval = std::mem::replace(&mut *interval, fresh);
        let gaps: Vec<f64> = interval.scans.windows(2).map(|pair| pair[1] - pair[0]).collect();
        Reading {
            update_time: Spread::of(&interval.update_times),
            scan_age: Spread::of(&interval.scan_ages),
            publish_lag: Spread::of(&interval.publish_lags),
            scans: interval.scans.len(),
            odometry: interval.odometry,
            updates: interval.update_times.len(),
            scan_jitter: MeanSigma::of(&gaps).map_or(0.0, |gap| gap.sigma),
            queued: self.queued.load(Ordering::Relaxed),
            dropped: interval.dropped,
            overrun: self.overrun.load(Ordering::Relaxed),
            payloads: self.payloads.load(Ordering::Relaxed),
        }
    }
}

fn push(values: &mut Vec<f64>, value: f64) {
    if values.len() < MOST {
        values.push(value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use synpf::{Odometry, Stamp, Twist};

    #[test]
    fn intervals_start_at_zero_and_drops_add_up() {
        let counters = Counters::default();
        let odometry = SensorEvent::Odometry(Odometry {
            stamp: Stamp(0),
            pose: maps::Pose::IDENTITY,
            twist: Twist::default(),
        });
        for _ in 0..3 {
            counters.arrived(&odometry, 0.001, 0.0, 2);
            counters.updated(0.002);
            counters.dropped(Dropped::NoBeams);
        }
        let reading = counters.read();
        assert_eq!((reading.odometry, reading.updates, reading.queued), (3, 3, 2));
        assert!((reading.update_time.p99 - 0.002).abs() < 1e-12);
        counters.dropped(Dropped::NoBeams);
        let reading = counters.read();
        assert_eq!(reading.odometry, 0);
        assert_eq!(reading.dropped[&Dropped::NoBeams], 4);
        assert_eq!(reading.update_time, Spread::default());
    }
}
