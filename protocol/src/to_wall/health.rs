//! How well the car is localized, with the causes.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::codec::Payload;
use crate::{CodecError, Invalid, Message, Schema};

/// The state, its causes and the metrics behind it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Health {
    /// The state.
    pub state: State,
    /// When this state was entered \[unix ns\].
    pub since: i64,
    /// The causes, the worst first. Empty when all is well. At most [`Health::MAX_CAUSES`].
    pub causes: Vec<Cause>,
    /// The last filter update; 0 before the first.
    pub update: u64,
    /// What was measured at that update; None before the first.
    pub metrics: Option<Metrics>,
    /// The set that the car proposes; None while it is the set in force.
    pub proposal: Option<Proposal>,
    /// True while the car switches sets by itself.
    pub auto: bool,
}

impl Health {
    /// Most causes in one message.
    pub const MAX_CAUSES: usize = 64;
}

/// How far the car can rely on its pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// No pose yet.
    Init,
    /// A pose, not yet confirmed.
    Converging,
    /// The pose is good enough to race on.
    Localized,
    /// The pose is probably right; something is wrong.
    Degraded,
    /// The pose is wrong.
    Lost,
    /// Searching the whole map.
    Relocalizing,
    /// No sensor data.
    Stale,
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Init => "INIT",
            Self::Converging => "CONVERGING",
            Self::Localized => "LOCALIZED",
            Self::Degraded => "DEGRADED",
            Self::Lost => "LOST",
            Self::Relocalizing => "RELOCALIZING",
            Self::Stale => "STALE",
        })
    }
}

/// One reason for a state.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Cause {
    /// What is wrong.
    pub kind: CauseKind,
    /// How severe it is.
    pub severity: Severity,
    /// The value measured, in the unit of the metric.
    pub value: Option<f32>,
    /// The threshold that the value crossed.
    pub limit: Option<f32>,
}

/// What can be wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CauseKind {
    /// No initial pose was given.
    NoInitialPose,
    /// A new pose was given or found and is not yet confirmed by motion.
    NewPose,
    /// Too few end points lie on walls.
    Alignment,
    /// End points lie far from walls.
    Residual,
    /// Beams are longer than in the map.
    LongBeams,
    /// Beams are shorter than in the map: something stands in view.
    Occluded,
    /// Many beams have no return.
    NoReturn,
    /// Few particles carry the weight.
    EffectiveSampleSize,
    /// Scans fit worse than they used to.
    Likelihood,
    /// Large spread along the track.
    SpreadAlong,
    /// Large spread across the track.
    SpreadAcross,
    /// A second place fits nearly as well.
    SecondMode,
    /// The wheels spin or lock.
    Slip,
    /// Odometry's yaw rate is wrong.
    YawRate,
    /// A scan moved the pose far.
    Innovation,
    /// Poses come late.
    Age,
    /// No scans come in.
    NoScan,
    /// No odometry comes in.
    NoOdometry,
    /// Sensor data comes in and is refused.
    BadSensorData,
    /// A search of the whole map is running.
    Searching,
    /// Odometry has jumped: it restarted, or the car was carried.
    OdometryJump,
    /// The gyroscope reports deg/s and is converted.
    GyroInDegrees,
    /// The gyroscope turns the wrong way and is corrected.
    GyroFlipped,
    /// The gyroscope has a bias, which is taken out.
    GyroBias,
    /// The gyroscope does not follow the turn of the scans and is left out.
    GyroIgnored,
    /// The gyroscope reads zero while the car turns and is left out.
    GyroAlwaysZero,
    /// Odometry turns too far or too little and is corrected.
    OdometryTurnScale,
    /// Odometry's yaw rate has a bias, which is taken out.
    OdometryTurnBias,
    /// Odometry's turn does not follow the turn of the scans.
    OdometryTurnWrong,
    /// Odometry's twist is missing or wrong and derived from its pose.
    TwistFromPose,
    /// Odometry's pose is missing or coarse and integrated from its twist.
    PoseFromTwist,
    /// Odometry's distance is off by a factor and corrected.
    WheelScale,
    /// Odometry moves while the scans stand still and is held.
    Creep,
    /// Wheels lock or spin beyond what tyres can do.
    WheelsSlide,
    /// The scan has no time increment; it is taken from its scan time.
    SweepFromScanTime,
    /// The scan's time increment is as long as a scan and is corrected.
    TimeIncrementWrong,
    /// The scan's largest range is no range and is replaced.
    RangeMaxWrong,
    /// The scan has no angle increment; it is taken from its first and last beam.
    AngleIncrementMissing,
    /// The scans' stamps are late against odometry's; it is corrected.
    ScanLag,
    /// Scans repeat under new stamps: the scanner or its driver hangs.
    RepeatedScans,
    /// The sensors' clock was set, back if negative; its stamps are followed.
    ClockStep,
    /// On several passes the laser has seen walls elsewhere than the map draws them; over this length.
    MapDiffers,
    /// Odometry stands still while the scans move; the car is carried on by the scans.
    OdometryStands,
}

impl CauseKind {
    /// In words, without the numbers.
    pub fn words(self) -> &'static str {
        match self {
            Self::NoInitialPose => "no initial pose",
            Self::NewPose => "new pose not yet confirmed by motion",
            Self::Alignment => "end points off the walls: alignment",
            Self::Residual => "end points off the walls: residual",
            Self::LongBeams => "beams longer than in the map",
            Self::Occluded => "beams shorter than in the map",
            Self::NoReturn => "beams without return",
            Self::EffectiveSampleSize => "low effective sample size",
            Self::Likelihood => "scan likelihood lower than usual",
            Self::SpreadAlong => "pose uncertain along the track",
            Self::SpreadAcross => "pose uncertain across the track",
            Self::SecondMode => "second pose hypothesis",
            Self::Slip => "wheels slip",
            Self::YawRate => "wrong odometry yaw rate",
            Self::Innovation => "large pose correction",
            Self::Age => "poses published late",
            Self::NoScan => "no scans",
            Self::NoOdometry => "no odometry",
            Self::BadSensorData => "bad sensor data",
            Self::Searching => "searching the whole map",
            Self::OdometryJump => "odometry jump",
            Self::GyroInDegrees => "gyroscope in deg/s, converted: readings per rad/s",
            Self::GyroFlipped => "gyroscope flipped, corrected: readings per rad/s",
            Self::GyroBias => "gyroscope's bias, taken out",
            Self::GyroIgnored => "gyroscope left out, fits the turn neither way: share explained",
            Self::GyroAlwaysZero => "gyroscope left out, always zero",
            Self::OdometryTurnScale => "odometry's turn scaled, corrected: times",
            Self::OdometryTurnBias => "odometry's yaw rate has a bias, taken out",
            Self::OdometryTurnWrong => "odometry's turn fits the scans neither way: share explained",
            Self::TwistFromPose => "odometry's twist is zero or wrong, taken from its pose: times",
            Self::PoseFromTwist => "odometry's pose is missing or coarse, taken from its twist after",
            Self::WheelScale => "odometry's distance scaled, corrected: times",
            Self::Creep => "odometry creeps at standstill, held",
            Self::WheelsSlide => "wheels lock or spin, off by",
            Self::SweepFromScanTime => "time_increment missing, taken from scan_time: sweep",
            Self::TimeIncrementWrong => "time_increment is as long as a scan, corrected",
            Self::RangeMaxWrong => "range_max is no range, replaced",
            Self::AngleIncrementMissing => "angle_increment missing, taken from angle_min and angle_max",
            Self::ScanLag => "scan stamps late against odometry, corrected",
            Self::RepeatedScans => "scans repeat: scanner hangs, for",
            Self::ClockStep => "sensors' clock was set, followed: by",
            Self::MapDiffers => "the map differs from what the laser sees, over",
            Self::OdometryStands => "odometry stands still, carried on by the scans: car at",
        }
    }

    /// Whether it names a fault of a sensor that the car has found and works around.
    pub fn is_sensor_fault(self) -> bool {
        self as u32 >= Self::GyroInDegrees as u32 && self as u32 <= Self::RepeatedScans as u32
            || self == Self::OdometryStands
    }

    /// The unit of its value.
    pub fn unit(self) -> &'static str {
        match self {
            Self::Residual
            | Self::SpreadAlong
            | Self::SpreadAcross
            | Self::Innovation
            | Self::OdometryJump
            | Self::PoseFromTwist
            | Self::RangeMaxWrong
            | Self::MapDiffers => "m",
            Self::YawRate | Self::GyroBias | Self::OdometryTurnBias => "rad/s",
            Self::Creep | Self::WheelsSlide | Self::OdometryStands => "m/s",
            Self::AngleIncrementMissing => "rad",
            Self::Age
            | Self::NoScan
            | Self::NoOdometry
            | Self::SweepFromScanTime
            | Self::TimeIncrementWrong
            | Self::ScanLag
            | Self::RepeatedScans
            | Self::ClockStep => "s",
            _ => "",
        }
    }
}

impl fmt::Display for Cause {
    /// `end points off the walls: alignment 0.41 (limit 0.45)`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.kind.words())?;
        let unit = self.kind.unit();
        let space = if unit.is_empty() { "" } else { " " };
        if let Some(value) = self.value {
            write!(f, " {value:.2}{space}{unit}")?;
        }
        if let Some(limit) = self.limit {
            write!(f, " (limit {limit:.2}{space}{unit})")?;
        }
        Ok(())
    }
}

/// How severe something is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Information; the state does not depend on it.
    Info,
    /// Makes the state DEGRADED if it concerns the pose.
    Warning,
    /// Evidence that the pose is wrong, or that there is none.
    Critical,
}

/// What was measured at an update.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Metrics {
    /// Share of the valid beams that end within 0.10 m of a wall (0.05 m and a cell where cells are larger), smoothed, in `[0, 1]`.
    pub alignment: f32,
    /// Mean over the same beams of min(distance to the nearest wall, 1 m) \[m\].
    pub residual: f32,
    /// Share of the valid beams more than 0.3 m shorter than in the map, in `[0, 1]`.
    pub short_beams: f32,
    /// Share of the valid beams more than 0.3 m longer than in the map, in `[0, 1]`.
    pub long_beams: f32,
    /// Share of the beams without a return, in `[0, 1]`.
    pub no_return: f32,
    /// Effective sample size over the number of particles, before resampling, in `[0, 1]`.
    pub ess_ratio: f32,
    /// Short-term over long-term average of how well the scan fits the map at the estimate; 1 when all is as usual.
    pub w_ratio: f32,
    /// Standard deviation of the particles along the track \[m\].
    pub spread_along: f32,
    /// Standard deviation of the particles across the track \[m\].
    pub spread_across: f32,
    /// Mass of the second cluster of particles over that of the first, in `[0, 1]`.
    pub second_mode: f32,
    /// Share of odometry's distance that was not driven. Positive when the wheels spin, negative when they lock.
    pub slip: f32,
    /// Odometry's yaw rate less the posterior's \[rad/s\].
    pub yaw_rate_residual: f32,
    /// Distance by which the last scan corrected the pose \[m\].
    pub innovation: f32,
    /// Angle by which the last scan corrected the pose \[rad\].
    pub innovation_angle: f32,
    /// Age of a pose when it was published: median over the last second \[s\].
    pub age_p50: f32,
    /// Age of a pose when it was published: 99th percentile over the last second \[s\].
    pub age_p99: f32,
    /// Particles in use.
    pub particles: u32,
}

/// A set that the car proposes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Proposal {
    /// The set's name.
    pub set: String,
    /// The reason, with numbers.
    pub evidence: String,
    /// Since when \[unix ns\].
    pub since: i64,
}

impl Message for Health {
    const SCHEMA: Schema = Schema::Health;
    const MAX_LEN: usize = 4096;

    /// Versions 2 and 3 added causes.
    const VERSION: u16 = 3;

    fn older(version: u16, payload: &Payload<'_>) -> Option<Result<Self, CodecError>> {
        (1..=2).contains(&version).then(|| payload.read())
    }

    fn validate(&self) -> Result<(), Invalid> {
        Invalid::unless_at_most("causes", self.causes.len(), Self::MAX_CAUSES)?;
        if let Some(m) = &self.metrics {
            for (field, share) in [
                ("alignment", m.alignment),
                ("short_beams", m.short_beams),
                ("long_beams", m.long_beams),
                ("no_return", m.no_return),
                ("ess_ratio", m.ess_ratio),
                ("second_mode", m.second_mode),
            ] {
                Invalid::unless_share(field, share)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cause_shows_value_and_limit() {
        let cause = |kind, value, limit| {
            let severity = Severity::Warning;
            Cause {
                kind,
                severity,
                value,
                limit,
            }
            .to_string()
        };
        assert_eq!(
            cause(CauseKind::SpreadAlong, Some(0.52), Some(0.4)),
            "pose uncertain along the track 0.52 m (limit 0.40 m)"
        );
        assert_eq!(cause(CauseKind::NoInitialPose, None, None), "no initial pose");
    }
}
