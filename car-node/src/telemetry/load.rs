//! The load of the car, once a second: from the operating system and the node's own counters.

use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError};
use protocol::{Drops, Load};
use synpf::Dropped;
use sysinfo::{Components, MemoryRefreshKind, Pid, ProcessRefreshKind, ProcessesToUpdate, System};

use crate::telemetry::counters::Reading;
use crate::telemetry::queue::Record;
use crate::telemetry::shared_state::SharedState;
use crate::wire;

/// Starts the thread. It ends when `stop` is dropped.
pub fn start(shared: Arc<SharedState>, stop: Receiver<()>) -> std::io::Result<JoinHandle<()>> {
    thread::Builder::new().name("load".into()).spawn(move || {
        let mut meter = Meter::new();
        while stop.recv_timeout(Duration::from_secs(1)) == Err(RecvTimeoutError::Timeout) {
            let load = meter.read(&shared);
            shared.telemetry.record(Record::Load(Box::new(load)));
        }
    })
}

/// Reads the load of the machine.
struct Meter {
    system: System,
    components: Components,
    pid: Option<Pid>,
    last: Instant,
}

impl Meter {
    fn new() -> Self {
        let mut meter = Self {
            system: System::new(),
            components: Components::new_with_refreshed_list(),
            pid: sysinfo::get_current_pid().ok(),
            last: Instant::now(),
        };
        // CPU usage is a difference: the first reading is its reference.
        meter.refresh();
        meter
    }

    fn refresh(&mut self) {
        self.system.refresh_cpu_usage();
        self.system
            .refresh_memory_specifics(MemoryRefreshKind::nothing().with_ram());
        if let Some(pid) = self.pid {
            self.system.refresh_processes_specifics(
                ProcessesToUpdate::Some(&[pid]),
                false,
                ProcessRefreshKind::nothing().with_cpu().with_memory(),
            );
        }
        self.components.refresh(false);
    }

    fn read(&mut self, shared: &SharedState) -> Load {
        self.refresh();
        let seconds = self.last.elapsed().as_secs_f64();
        self.last = Instant::now();
        let reading = shared.counters.read();
        let process = self.pid.and_then(|pid| self.system.process(pid));
        let rate = |count: usize| (count as f64 / seconds) as f32;
        Load {
            cpu_process: process.map_or(0.0, |process| process.cpu_usage() / 100.0),
            cpu_cores: self
                .system
                .cpus()
                .iter()
                .take(Load::MAX_CORES)
                .map(|cpu| (cpu.cpu_usage() / 100.0).clamp(0.0, 1.0))
                .collect(),
            memory_process: process.map_or(0, sysinfo::Process::memory),
            memory_used: self.system.used_memory(),
            memory_total: self.system.total_memory(),
            temperature: self
                .components
                .iter()
                .filter_map(sysinfo::Component::temperature)
                .filter(|temperature| temperature.is_finite())
                .reduce(f32::max),
            throttled: throttled(),
            update_us: wire::latency(reading.update_time),
            scan_age_us: wire::latency(reading.scan_age),
            publish_lag_us: wire::latency(reading.publish_lag),
            scan_rate: rate(reading.scans),
            odometry_rate: rate(reading.odometry),
            update_rate: rate(reading.updates),
            scan_jitter: reading.scan_jitter as f32,
            queue_depth: u32::try_from(reading.queued).unwrap_or(u32::MAX),
            drops: drops(&reading, shared.telemetry.dropped()),
            recorder: shared.recorder.as_ref().map(|recorder| recorder.state()),
        }
    }
}

fn drops(reading: &Reading, telemetry: u64) -> Drops {
    let of = |cause| reading.dropped.get(&cause).copied().unwrap_or(0);
    Drops {
        malformed: of(Dropped::Malformed) + of(Dropped::RepeatedScan),
        time_backwards: of(Dropped::TimeBackwards),
        no_odometry: of(Dropped::NoOdometry),
        stale_odometry: of(Dropped::StaleOdometry),
        no_beams: of(Dropped::NoBeams),
        not_initialized: of(Dropped::NotInitialized),
        overrun: reading.overrun,
        telemetry,
        payloads: reading.payloads,
    }
}

/// True when a Raspberry Pi is throttled: bits 1 to 3 of its firmware's report (capped frequency, throttled, soft temperature
/// limit). None on other machines.
fn throttled() -> Option<bool> {
    let text = std::fs::read_to_string("/sys/devices/platform/soc/soc:firmware/get_throttled").ok()?;
    let bits = u32::from_str_radix(text.trim().trim_start_matches("0x"), 16).ok()?;
    Some(bits & 0b1110 != 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::shared_state::SharedState;

    #[test]
    fn a_busy_process_has_a_load() {
        let shared = SharedState::default();
        let mut meter = Meter::new();
        let until = Instant::now() + Duration::from_millis(400);
        while Instant::now() < until {
            shared.counters.updated(0.001);
        }
        shared.counters.dropped(Dropped::NoBeams);
        let load = meter.read(&shared);
        // The share of the CPU depends on what else runs.
        assert!(load.cpu_process > 0.0, "{load:?}");
        assert!(load.memory_process > 0 && load.memory_total >= load.memory_used);
        assert!(!load.cpu_cores.is_empty());
        assert_eq!(load.drops.no_beams, 1);
        assert!((load.update_us.p50 - 1000.0).abs() < 1.0);
    }
}
