//! The list of causes that goes with a state.

use synpf::{SensorFinding, SensorFindings};

use super::rules::Finding;
use super::{Cause, CauseKind, Severity, State, Thresholds};
use crate::statistics::finite;

/// What the causes are made from, at one time.
pub(super) struct CauseSources<'a> {
    pub(super) state: State,
    pub(super) thresholds: &'a Thresholds,
    /// The sensors that have stopped sending, each with how long ago \[s\].
    pub(super) silent: Vec<(CauseKind, f64)>,
    /// The localizer refuses every scan.
    pub(super) scans_refused: bool,
    /// A recent jump of the odometry \[m\].
    pub(super) odometry_jump: Option<f64>,
    /// A recent jump of a pose that was trusted \[m\].
    pub(super) pose_jump: Option<f64>,
    /// A recent step of the sensors' clock \[s\].
    pub(super) clock_step: Option<f64>,
    /// Length over which the map differs from what is seen \[m\].
    pub(super) map_differs: f64,
    /// The localizer has given its pose up.
    pub(super) gave_up: bool,
    /// For how long scans have repeated \[s\]; None while they do not.
    pub(super) repeating: Option<f64>,
    /// What the localizer has found to be wrong with its sensors.
    pub(super) sensors: SensorFindings,
    /// The metrics that are over their limits.
    pub(super) findings: Vec<&'a Finding>,
}

/// A cause without a number.
fn plain(kind: CauseKind, severity: Severity) -> Cause {
    Cause {
        kind,
        severity,
        value: None,
        limit: None,
    }
}

/// A cause with its value and the limit of that value.
fn measured(kind: CauseKind, severity: Severity, value: f64, limit: f64) -> Cause {
    Cause {
        value: Some(finite(value)),
        limit: Some(finite(limit)),
        ..plain(kind, severity)
    }
}

impl CauseSources<'_> {
    /// The causes, the worst first.
    pub(super) fn causes(&self) -> Vec<Cause> {
        let limits = self.thresholds;
        let silent = self
            .silent
            .iter()
            .map(|(kind, silence)| measured(*kind, Severity::Critical, *silence, limits.stale_after));
        let refused = (self.scans_refused && self.state != State::Init)
            .then(|| plain(CauseKind::BadSensorData, Severity::Warning));
        let odometry_jump = self.odometry_jump.map(|distance| Cause {
            value: Some(finite(distance)),
            ..plain(CauseKind::OdometryJump, Severity::Warning)
        });
        let pose_jump = self
            .pose_jump
            .map(|distance| measured(CauseKind::Innovation, Severity::Critical, distance, limits.leap));
        let clock_step = self.clock_step.map(|by| Cause {
            value: Some(finite(by)),
            ..plain(CauseKind::ClockStep, Severity::Info)
        });
        let map_differs = (self.map_differs > 0.0).then(|| Cause {
            value: Some(finite(self.map_differs)),
            ..plain(CauseKind::MapDiffers, Severity::Info)
        });
        let findings = self
            .findings
            .iter()
            // The jump of the pose is in the list with its own limit.
            .filter(|finding| pose_jump.is_none() || finding.kind != CauseKind::Innovation)
            .map(|f| measured(f.kind, f.severity, f.value, f.limit));
        let repeating = self.repeating.map(|seconds| Cause {
            value: Some(finite(seconds)),
            ..plain(CauseKind::RepeatedScans, Severity::Warning)
        });
        let sensors = self.sensors.iter().map(|(finding, value)| {
            let (kind, severity) = of_sensor(finding);
            Cause {
                value: Some(finite(value)),
                ..plain(kind, severity)
            }
        });
        let mut causes: Vec<Cause> = silent
            .chain(of_state(self.state, self.gave_up))
            .chain(refused)
            .chain(odometry_jump)
            .chain(pose_jump)
            .chain(findings)
            .chain(repeating)
            .chain(clock_step)
            .chain(map_differs)
            .chain(sensors)
            .collect();
        causes.sort_by_key(|cause| std::cmp::Reverse(cause.severity));
        causes
    }
}

/// The cause that a state has by itself. `gave_up`: the localizer has given its pose up.
fn of_state(state: State, gave_up: bool) -> Option<Cause> {
    match state {
        State::Init => Some(plain(CauseKind::NoInitialPose, Severity::Warning)),
        State::Converging => Some(plain(CauseKind::NewPose, Severity::Info)),
        State::Relocalizing => Some(plain(CauseKind::Searching, Severity::Warning)),
        State::Lost if gave_up => Some(plain(CauseKind::Searching, Severity::Warning)),
        State::Localized | State::Degraded | State::Lost | State::Stale => None,
    }
}

/// The cause that a finding of the localizer is, and how severe: what it corrects is information.
fn of_sensor(finding: SensorFinding) -> (CauseKind, Severity) {
    use Severity::{Info, Warning};
    match finding {
        SensorFinding::GyroInDegrees => (CauseKind::GyroInDegrees, Info),
        SensorFinding::GyroFlipped => (CauseKind::GyroFlipped, Info),
        SensorFinding::GyroBias => (CauseKind::GyroBias, Info),
        SensorFinding::GyroIgnored => (CauseKind::GyroIgnored, Warning),
        SensorFinding::GyroAlwaysZero => (CauseKind::GyroAlwaysZero, Warning),
        SensorFinding::OdometryTurnScale => (CauseKind::OdometryTurnScale, Info),
        SensorFinding::OdometryTurnBias => (CauseKind::OdometryTurnBias, Info),
        SensorFinding::OdometryTurnWrong => (CauseKind::OdometryTurnWrong, Warning),
        SensorFinding::TwistFromPose => (CauseKind::TwistFromPose, Info),
        SensorFinding::PoseFromTwist => (CauseKind::PoseFromTwist, Info),
        SensorFinding::WheelScale => (CauseKind::WheelScale, Info),
        SensorFinding::Creep => (CauseKind::Creep, Info),
        SensorFinding::OdometryStands => (CauseKind::OdometryStands, Warning),
        SensorFinding::WheelsSlide => (CauseKind::WheelsSlide, Warning),
        SensorFinding::SweepFromScanTime => (CauseKind::SweepFromScanTime, Info),
        SensorFinding::TimeIncrementWrong => (CauseKind::TimeIncrementWrong, Info),
        SensorFinding::RangeMaxWrong => (CauseKind::RangeMaxWrong, Info),
        SensorFinding::AngleIncrementMissing => (CauseKind::AngleIncrementMissing, Info),
        SensorFinding::ScanLag => (CauseKind::ScanLag, Info),
    }
}
