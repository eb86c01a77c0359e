//! CPU, memory, latencies and rates of the car's node.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::codec::Payload;
use crate::{CodecError, Invalid, Message, Schema};

/// Load over the last second.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Load {
    /// CPU of this process; 1 is one core.
    pub cpu_process: f32,
    /// Use of each core, in `[0, 1]`. At most [`Load::MAX_CORES`].
    pub cpu_cores: Vec<f32>,
    /// Memory of this process \[bytes\].
    pub memory_process: u64,
    /// Memory in use on the machine \[bytes\].
    pub memory_used: u64,
    /// Memory of the machine \[bytes\].
    pub memory_total: u64,
    /// Temperature of the machine's hottest sensor \[deg C\]; None where there is no sensor.
    pub temperature: Option<f32>,
    /// True while the machine slows down for heat or lack of power; None where that is not known.
    pub throttled: Option<bool>,
    /// Time of a whole filter update, from the scan to the estimate \[us\].
    pub update_us: Latency,
    /// Age of a scan when it reached the filter \[us\].
    pub scan_age_us: Latency,
    /// Time from a pose leaving the filter until the network has accepted it \[us\].
    pub publish_lag_us: Latency,
    /// Scans per second.
    pub scan_rate: f32,
    /// Odometry messages per second.
    pub odometry_rate: f32,
    /// Filter updates per second.
    pub update_rate: f32,
    /// Standard deviation of the time between scans \[s\].
    pub scan_jitter: f32,
    /// Messages waiting for the filter.
    pub queue_depth: u32,
    /// Messages dropped since the node started.
    pub drops: Drops,
    /// The recording on the car; None on a car without a folder for it.
    pub recorder: Option<RecorderState>,
}

/// State of the recording on the car.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct RecorderState {
    /// True while the car records. It may fail for a while: see [`RecorderState::error`].
    pub recording: bool,
    /// Number of the file being written; 0 when there is none.
    pub file: u64,
    /// Size of all recordings on the car \[bytes\].
    pub bytes: u64,
    /// Most that they may have; then the oldest are deleted \[bytes\].
    pub limit: u64,
    /// Free space on their disk \[bytes\].
    pub free: u64,
    /// Messages not recorded since the node started, because the disk or the CPU was too slow.
    pub dropped: u64,
    /// Why nothing can be written at present; None when all is well.
    pub error: Option<String>,
}

impl fmt::Display for RecorderState {
    /// `recording, file 12; 3.4 of 8.6 GB used, 23.0 GB free`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let gigabytes = |bytes: u64| bytes as f64 / 1e9;
        match (self.recording, &self.error) {
            (true, Some(error)) => write!(f, "recording FAILS: {error}")?,
            (true, None) => write!(f, "recording, file {}", self.file)?,
            (false, _) => f.write_str("not recording")?,
        }
        let (used, limit, free) = (gigabytes(self.bytes), gigabytes(self.limit), gigabytes(self.free));
        write!(f, "; {used:.2} of {limit:.1} GB used, {free:.1} GB free")?;
        match self.dropped {
            0 => Ok(()),
            dropped => write!(f, "; {dropped} messages not recorded"),
        }
    }
}

impl RecorderState {
    /// Longest error \[bytes\].
    pub const MAX_ERROR: usize = 300;
}

impl Load {
    /// Most cores in one message.
    pub const MAX_CORES: usize = 256;
}

/// Spread of a duration \[us\].
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Latency {
    /// Median \[us\].
    pub p50: f32,
    /// 99th percentile \[us\].
    pub p99: f32,
    /// Maximum \[us\].
    pub max: f32,
}

/// Messages dropped since the node started, by cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Drops {
    /// Sensor messages with NaN, infinities or an impossible geometry, and scans that repeat the one before.
    pub malformed: u64,
    /// Sensor messages not later than the last one of their kind.
    pub time_backwards: u64,
    /// Scans before the first odometry.
    pub no_odometry: u64,
    /// Scans too long after the last odometry.
    pub stale_odometry: u64,
    /// Scans without a usable beam.
    pub no_beams: u64,
    /// Scans before the first pose.
    pub not_initialized: u64,
    /// Sensor messages that the filter was too slow for.
    pub overrun: u64,
    /// Telemetry that the publisher was too slow for.
    pub telemetry: u64,
    /// Payloads from the network that could not be read.
    pub payloads: u64,
}

impl Drops {
    /// The sum of all causes.
    pub fn total(&self) -> u64 {
        self.named().into_iter().map(|(_, count)| count).sum()
    }

    /// Each count with the name of its cause.
    pub fn named(&self) -> [(&'static str, u64); 9] {
        [
            ("malformed", self.malformed),
            ("time backwards", self.time_backwards),
            ("no odometry", self.no_odometry),
            ("stale odometry", self.stale_odometry),
            ("no beams", self.no_beams),
            ("not initialized", self.not_initialized),
            ("overrun", self.overrun),
            ("telemetry", self.telemetry),
            ("payloads", self.payloads),
        ]
    }
}

impl Message for Load {
    const SCHEMA: Schema = Schema::Load;
    const VERSION: u16 = 2;
    const MAX_LEN: usize = 4096;

    fn older(version: u16, payload: &Payload<'_>) -> Option<Result<Self, CodecError>> {
        (version == 1).then(|| payload.read::<LoadV1>().map(Self::from))
    }

    fn validate(&self) -> Result<(), Invalid> {
        if let Some(error) = self
            .recorder
            .as_ref()
            .and_then(|recorder| recorder.error.as_ref())
        {
            Invalid::unless_at_most("error", error.len(), RecorderState::MAX_ERROR)?;
        }
        Invalid::unless_at_most("cpu_cores", self.cpu_cores.len(), Self::MAX_CORES)
    }
}

/// Version 1, which never changes.
#[derive(Deserialize)]
struct LoadV1 {
    cpu_process: f32,
    cpu_cores: Vec<f32>,
    memory_process: u64,
    memory_used: u64,
    memory_total: u64,
    temperature: Option<f32>,
    throttled: Option<bool>,
    update_us: Latency,
    scan_age_us: Latency,
    publish_lag_us: Latency,
    scan_rate: f32,
    odometry_rate: f32,
    update_rate: f32,
    scan_jitter: f32,
    queue_depth: u32,
    drops: Drops,
}

impl From<LoadV1> for Load {
    fn from(older: LoadV1) -> Self {
        Self {
            cpu_process: older.cpu_process,
            cpu_cores: older.cpu_cores,
            memory_process: older.memory_process,
            memory_used: older.memory_used,
            memory_total: older.memory_total,
            temperature: older.temperature,
            throttled: older.throttled,
            update_us: older.update_us,
            scan_age_us: older.scan_age_us,
            publish_lag_us: older.publish_lag_us,
            scan_rate: older.scan_rate,
            odometry_rate: older.odometry_rate,
            update_rate: older.update_rate,
            scan_jitter: older.scan_jitter,
            queue_depth: older.queue_depth,
            drops: older.drops,
            recorder: None,
        }
    }
}
