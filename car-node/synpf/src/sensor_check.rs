//! Sensors are checked before they are believed.
//!
//! The pose by the scans is the reference. What the wheels and the gyroscope say of a stretch of road is held against it,
//! and what differs by a fixed rule, such as a unit, a sign, a bias or a scale, is corrected. What follows no rule is left
//! out. One file per check:
//!
//! - [`scan_geometry`]: numbers of a scan's header that cannot be.
//! - [`sweep_check`]: whether a scan without `time_increment` is a sweep.
//! - [`repeated_scan`]: a scanner that hangs.
//! - [`standstill`]: odometry that creeps while the scans stand still.
//! - [`silent_odometry`]: odometry that stands still while the scans move.
//! - [`odometry_fields`]: odometry without twist, pose or orientation.
//! - [`wheel_grip`]: wheels that lock or spin.
//! - [`turn_check`]: unit, sign and bias of yaw rates.
//! - [`wheel_scale`]: the scale of the wheels' distance.
//! - [`scan_lag`]: the lag between the scanner's stamps and odometry's.

mod linear_fit;
mod odometry_fields;
mod repeated_scan;
mod scan_geometry;
mod scan_lag;
mod scan_pair;
mod silent_odometry;
mod standstill;
mod sweep_check;
mod turn_check;
mod wheel_grip;
mod wheel_scale;

use std::collections::VecDeque;

use localizer::{Scan, SensorFinding, SensorFindings, Stamp};
use maps::Pose;

pub(crate) use self::odometry_fields::OdometryFields;
use self::repeated_scan::RepeatedScan;
pub(crate) use self::scan_geometry::ScanGeometry;
use self::scan_lag::ScanLag;
use self::silent_odometry::SilentOdometry;
pub(crate) use self::silent_odometry::{STANDS, Silence};
use self::standstill::Standstill;
pub(crate) use self::sweep_check::SweepCheck;
pub(crate) use self::turn_check::TurnCorrection;
use self::turn_check::{GyroCheck, OdometryTurnCheck};
pub(crate) use self::wheel_grip::WheelGrip;
use self::wheel_scale::WheelScale;

/// What the sensors have said since the start, summed up, without corrections.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct DrivenSums {
    /// Distance by the wheels, backwards negative \[m\].
    pub(crate) distance: f64,
    /// Turn by odometry \[rad\].
    pub(crate) turn: f64,
    /// Turn by the gyroscope, while it spoke, in its own unit.
    pub(crate) gyro_turn: f64,
    /// For how long it spoke \[s\].
    pub(crate) gyro_time: f64,
    /// For how long the wheels slid, or odometry was silent \[s\].
    pub(crate) sliding: f64,
}

impl DrivenSums {
    /// What was added since `earlier`.
    pub(crate) fn since(&self, earlier: &Self) -> Self {
        Self {
            distance: self.distance - earlier.distance,
            turn: self.turn - earlier.turn,
            gyro_turn: self.gyro_turn - earlier.gyro_turn,
            gyro_time: self.gyro_time - earlier.gyro_time,
            sliding: self.sliding - earlier.sliding,
        }
    }

    /// Between these and `later`.
    pub(crate) fn interpolate(&self, later: &Self, fraction: f64) -> Self {
        let mix = |from: f64, to: f64| from + (to - from) * fraction;
        Self {
            distance: mix(self.distance, later.distance),
            turn: mix(self.turn, later.turn),
            gyro_turn: mix(self.gyro_turn, later.gyro_turn),
            gyro_time: mix(self.gyro_time, later.gyro_time),
            sliding: mix(self.sliding, later.sliding),
        }
    }
}

/// How odometry is corrected, as messages come in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Corrections {
    /// For the gyroscope; None while it is not known to be of use.
    pub(crate) gyro: Option<TurnCorrection>,
    /// For odometry's turn.
    pub(crate) turn: TurnCorrection,
    /// Distance driven over the wheels' distance.
    pub(crate) wheel_scale: f64,
    /// The scans stand still: slow motion of the wheels is none of the car.
    pub(crate) standing: bool,
}

impl Default for Corrections {
    fn default() -> Self {
        Self {
            gyro: None,
            turn: TurnCorrection::default(),
            wheel_scale: 1.0,
            standing: false,
        }
    }
}

/// A pose by the scans.
#[derive(Debug, Clone, Copy)]
struct FittedPose {
    stamp: Stamp,
    pose: Pose,
    /// Share of the prediction's variance along the track that the scan took away, in [0, 1].
    information: f64,
}

/// A stretch of road by the scans and by the other sensors.
#[derive(Debug, Clone, Copy)]
struct Stretch {
    seconds: f64,
    /// By the scans: distance along the arc \[m\], turn \[rad\].
    distance: f64,
    turn: f64,
    /// See [`FittedPose::information`].
    information: f64,
    driven: DrivenSums,
}

/// Stretches are at least so long [s]: in less, the heading by the scans is too coarse for a yaw rate.
const STRETCH: f64 = 0.1;

/// Longer ones, over a gap between scans, are no reference \[s\].
const LONGEST_STRETCH: f64 = 0.5;

/// Fitted poses that are kept: enough for the longest lag and a stretch at 400 scans a second.
const KEPT: usize = 128;

/// No car of this kind drives faster [m/s]...
pub(crate) const FASTEST: f64 = 30.0;
/// ...or turns faster [rad/s].
const FASTEST_TURN: f64 = 12.0;

/// Every check that needs scans, and what they have found.
#[derive(Debug, Clone, Default)]
pub(crate) struct SensorCheck {
    pub(crate) sweep: SweepCheck,
    pub(crate) lag: ScanLag,
    fitted: VecDeque<FittedPose>,
    repeated: RepeatedScan,
    standstill: Standstill,
    silent: SilentOdometry,
    gyro: GyroCheck,
    turn: OdometryTurnCheck,
    scale: WheelScale,
    /// Findings of the latest scan's header.
    header: SensorFindings,
}

impl SensorCheck {
    /// Whether the scan repeats the one before although the car has moved by `driven`, the sums up to now.
    pub(crate) fn repeats(&mut self, scan: &Scan, driven: &DrivenSums) -> bool {
        self.repeated.is_repeated(scan, driven)
    }

    /// The geometry by which a scan is to be read.
    pub(crate) fn geometry(&mut self, scan: &Scan) -> ScanGeometry {
        self.header = SensorFindings::default();
        ScanGeometry::of(scan, &mut self.sweep, &mut self.header)
    }

    /// Whether the car stands although the wheels turn slowly at `speed` [m/s]; `driven` are the sums up to now.
    pub(crate) fn stands(
        &mut self,
        scan: &Scan,
        geometry: &ScanGeometry,
        base_link_from_laser: Pose,
        driven: &DrivenSums,
        speed: f64,
    ) -> bool {
        self.standstill
            .stands(scan, geometry, base_link_from_laser, driven, speed)
    }

    /// Whether odometry, of which `silent` messages on end stood still, has just been found to do so while the car moves.
    pub(crate) fn silence(
        &mut self,
        scan: &Scan,
        geometry: &ScanGeometry,
        base_link_from_laser: Pose,
        driven: &DrivenSums,
        silent: u32,
    ) -> Option<Silence> {
        self.silent
            .compare(scan, geometry, base_link_from_laser, driven, silent)
    }

    /// The pose has been set or lost: what was fitted before is no reference.
    pub(crate) fn forget_pose(&mut self) {
        self.fitted.clear();
        self.silent.forget_pose();
        self.sweep.forget_pose();
    }

    /// Takes in the same pose for the check of silent odometry; see there.
    pub(crate) fn note_pose(&mut self, pose: Pose, seconds: f64, information: f64) {
        self.silent.note_pose(pose, seconds, information);
    }

    /// Takes in a pose that a scan was fitted to. `driven` gives the sums at a stamp, `latest` is odometry's latest. Returns true
    /// when the wheels' scale has changed.
    pub(crate) fn learn(
        &mut self,
        stamp: Stamp,
        pose: Pose,
        information: f64,
        latest: Stamp,
        driven: impl Fn(Stamp) -> Option<DrivenSums>,
        corrections: &mut Corrections,
    ) -> bool {
        self.fitted.reserve(KEPT + 1);
        if self.fitted.len() == KEPT {
            self.fitted.pop_front();
        }
        self.fitted.push_back(FittedPose {
            stamp,
            pose,
            information: information.clamp(0.0, 1.0),
        });
        let mut rescaled = false;
        while let Some(end) = self.stretch_end() {
            let (from, to) = (self.fitted[0], self.fitted[end]);
            // Scans may be late or early against odometry: both sides must be covered.
            if latest.since(to.stamp) < ScanLag::LONGEST {
                break;
            }
            let seconds = to.stamp.since(from.stamp);
            let information = self
                .fitted
                .range(1..=end)
                .map(|fitted| fitted.information)
                .sum::<f64>()
                / end as f64;
            let [distance, _, turn] = to.pose.since(from.pose).log();
            let possible = distance.abs() < FASTEST * seconds && turn.abs() < FASTEST_TURN * seconds;
            if seconds < LONGEST_STRETCH && possible {
                let lag = self.lag.lag();
                let between = |lag: f64| {
                    let (from, to) = (driven(from.stamp.plus(-lag))?, driven(to.stamp.plus(-lag))?);
                    Some(to.since(&from))
                };
                if let Some(driven) = between(lag) {
                    let stretch = Stretch {
                        seconds,
                        distance,
                        turn,
                        information,
                        driven,
                    };
                    self.gyro.learn(&stretch);
                    self.lag.learn(seconds, turn, between);
                    if driven.sliding <= 0.0 {
                        self.turn.learn(&stretch);
                        rescaled |= self.scale.learn(&stretch, corrections.wheel_scale);
                    }
                }
            }
            self.fitted.drain(..end);
        }
        corrections.gyro = self.gyro.correction();
        corrections.turn = self.turn.correction();
        corrections.wheel_scale = self.scale.scale();
        rescaled
    }

    /// The first fitted pose that ends a stretch from the oldest one.
    fn stretch_end(&self) -> Option<usize> {
        let from = self.fitted.front()?.stamp;
        self.fitted
            .iter()
            .position(|fitted| fitted.stamp.since(from) >= STRETCH)
    }

    /// Adds what has been found; the car drives at `speed` [m/s].
    pub(crate) fn report(&self, speed: f64, findings: &mut SensorFindings) {
        for (finding, value) in self.header.iter() {
            findings.insert(finding, value);
        }
        self.gyro.report(findings);
        self.turn.report(findings);
        self.scale.report(findings);
        self.standstill.report(findings);
        self.silent.report(speed, findings);
        if self.lag.lag() != 0.0 {
            findings.insert(SensorFinding::ScanLag, self.lag.lag());
        }
    }
}
