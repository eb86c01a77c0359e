//! Odometry that stands still while the scans move: a cable that came off, a driver that hangs.
//!
//! From then on the car is carried on at the twist that the fitted poses have. Scans compared with each other tell that it moves, and
//! its first twist; no more, as noise in the direction of the walls pulls a motion along them towards none.

use localizer::{Scan, SensorFinding, SensorFindings, Stamp};
use maps::Pose;

use super::scan_pair::ScanPair;
use super::{DrivenSums, FASTEST, FASTEST_TURN, ScanGeometry};

/// Compares scans while odometry says that the car stands.
#[derive(Debug, Clone, Default)]
pub(super) struct SilentOdometry {
    /// The scan to compare with: its ranges \[m\], its stamp, and odometry's sums then.
    ranges: Vec<f32>,
    at: Stamp,
    driven: DrivenSums,
    /// The pose of `base_link` that was fitted before the stretches that count.
    from: Option<Pose>,
    /// Its motion by the scans in them.
    motion: Pose,
    /// Twist by the scans in the last of them [m/s], [m/s], [rad/s].
    twist: [f64; 3],
    /// Stretches on end in which the scans moved and odometry did not.
    stretches: u32,
    found: bool,
    /// For how long odometry has stood still and scans have not told where along the track the car is \[s\].
    untold: f64,
    /// For how long they have since \[s\].
    told: f64,
}

/// What is known of the car when odometry has been found to stand still while it moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Silence {
    /// Where `base_link` is by the scans; None where no pose was known before.
    pub(crate) pose: Option<Pose>,
    /// Its twist [m/s], [m/s], [rad/s].
    pub(crate) twist: [f64; 3],
    /// Odometry may have been silent before while scans did not tell so: the pose is not known.
    pub(crate) lost: bool,
}

/// Odometry that stands still is slower than this [m/s]: a speed controller's offset is about a tenth.
pub(crate) const STANDS: f64 = 0.3;

/// A car that moves is faster than this by the scans [m/s]. Slower, fits follow it in steps below the map's cells.
const MOVES: f64 = 2.0 * STANDS;

/// Scans are compared when the car has moved so far \[m\]...
const STRETCH: f64 = 0.05;
/// ...or after so long \[s\].
const LONGEST: f64 = 0.25;

/// By how much the likelihood of the motion by the scans must exceed that of odometry's, as a logarithm.
const SURE: f64 = 24.0;

/// Stretches on end after which odometry is found silent...
const STRETCHES: u32 = 2;
/// ...and messages of it that stood still by then.
const MESSAGES: u32 = 3;

/// No car changes its twist faster [m/s^2], [m/s^2], [rad/s^2]: a coefficient of friction of 1.2; a car that spins...
const HARDEST: [f64; 3] = [12.0, 12.0, 100.0];
/// ...beyond what two scans misjudge it [m/s], [rad/s]. Scans that jump to and fro are none of a car that drives.
const UNSTEADY: f64 = 1.0;

/// Scans that tell the place along the track to this \[m\] would show that the car moves: on tracks with bends in view they tell it to
/// 0.3 to 0.6 cm, and along a wall that is drawn in cells still to 2 cm...
const TELLS: f64 = 0.01;
/// ...had they done so for so long \[s\].
const TOLD: f64 = 1.0;
/// In so long without them a car gets far enough to be lost \[s\].
const UNTOLD: f64 = 0.5;

impl SilentOdometry {
    /// Takes in a scan. `driven` are odometry's sums up to now, `silent` the messages on end that stood still. Returns what has
    /// been found with this scan.
    pub(super) fn compare(
        &mut self,
        scan: &Scan,
        geometry: &ScanGeometry,
        base_link_from_laser: Pose,
        driven: &DrivenSums,
        silent: u32,
    ) -> Option<Silence> {
        let seconds = scan.stamp.since(self.at);
        if silent == 0 {
            (self.found, self.untold, self.told) = (false, 0.0, 0.0);
        }
        if silent == 0 || self.found || !(0.0..2.0 * LONGEST).contains(&seconds) {
            self.begin(scan, driven);
            return None;
        }
        let (base, laser) = (base_link_from_laser, base_link_from_laser.inverse());
        let near = laser * Pose::exp(self.twist.map(|v| v * seconds)) * base;
        let Some(pair) = ScanPair::new(&self.ranges, scan, geometry, near.heading) else {
            self.begin(scan, driven);
            return None;
        };
        let moved = pair.best_motion(near);
        let motion = base * moved * laser;
        let distance = motion.x.hypot(motion.y);
        if distance < STRETCH && seconds < LONGEST {
            return None;
        }
        let claimed = driven.since(&self.driven);
        let claimed = laser * Pose::exp([claimed.distance, 0.0, claimed.turn]) * base;
        let odds = pair.variance(&[claimed, moved]).map_or(0.0, |variance| {
            0.5 * (pair.cost(claimed, variance) - pair.cost(moved, variance))
        });
        let fast = (MOVES * seconds..FASTEST * seconds).contains(&distance);
        if odds < SURE || !fast || motion.heading.abs() > FASTEST_TURN * seconds {
            self.begin(scan, driven);
            return None;
        }
        let twist = motion.log().map(|v| v / seconds);
        let steady = [0, 1, 2].iter().all(|&i| {
            let change = (twist[i] - self.twist[i]).abs();
            change < HARDEST[i] * seconds + UNSTEADY
        });
        if self.stretches > 0 && !steady {
            self.begin(scan, driven);
            return None;
        }
        self.motion = self.motion * motion;
        self.twist = twist;
        self.stretches += 1;
        self.keep(scan, driven);
        self.found = self.stretches >= STRETCHES && silent >= MESSAGES;
        self.found.then(|| Silence {
            pose: self.from.map(|from| from * self.motion),
            twist: self.twist,
            lost: self.untold > UNTOLD,
        })
    }

    /// Takes in the pose that the latest scan was fitted to, `seconds` after the one before, and the information that the scan
    /// gave about the place along the track [1/m^2]. Once the scans move and odometry does not, fits lag behind.
    pub(super) fn note_pose(&mut self, pose: Pose, seconds: f64, information: f64) {
        if self.stretches > 0 {
            return;
        }
        self.from = Some(pose);
        if information * TELLS * TELLS > 1.0 {
            self.told += seconds;
            if self.told > TOLD {
                self.untold = 0.0;
            }
        } else {
            self.untold += seconds;
            self.told = 0.0;
        }
    }

    /// The pose has been set or lost.
    pub(super) fn forget_pose(&mut self) {
        (self.from, self.untold, self.told) = (None, 0.0, 0.0);
    }

    /// Adds the finding; the car drives at `speed` [m/s].
    pub(super) fn report(&self, speed: f64, findings: &mut SensorFindings) {
        if self.found {
            findings.insert(SensorFinding::OdometryStands, speed);
        }
    }

    /// Compares with this scan from now on, as if nothing had been seen before.
    fn begin(&mut self, scan: &Scan, driven: &DrivenSums) {
        (self.motion, self.twist, self.stretches) = (Pose::IDENTITY, [0.0; 3], 0);
        self.keep(scan, driven);
    }

    fn keep(&mut self, scan: &Scan, driven: &DrivenSums) {
        self.ranges.clone_from(&scan.ranges);
        (self.at, self.driven) = (scan.stamp, *driven);
    }
}
