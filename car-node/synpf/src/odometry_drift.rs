//! How far odometry drifts, as the fits of usual scans show it.
//!
//! A parameter set allows for odometry that errs by a third; on tyres that grip it errs by a hundredth. Where people or cars fill
//! the view, so that most beams say nothing of the pose, that is the better witness: a robust fit can be led anywhere by more than
//! half of what it sees (Huber, *Robust Statistics*, section 1.4), and odometry cannot.

use maps::Pose;
use nalgebra::{Matrix3, Vector3};

use crate::estimate::rotation;

/// The shares of its way and its turn by which odometry errs.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct OdometryDrift {
    /// Near the limit of the tyres, and while they grip.
    shares: [Shares; 2],
    /// The stretch under way; None where it has to begin with a usual scan.
    stretch: Option<Stretch>,
    /// What was driven since a scan last moved the pose, and since a pose was last believed.
    since: [Driven; 2],
}

/// Mean squares of the shares: of the way, along it and aside, and of the turn.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Shares {
    squares: [f64; 3],
    /// Stretches that they are told from.
    stretches: f64,
}

/// How far the car has driven, and turned to either side \[m\], \[rad\].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Driven {
    way: f64,
    turn: f64,
}

/// A stretch between two poses that usual scans were fitted to.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Stretch {
    from: Pose,
    /// Odometry's motion since, and the time \[s\].
    motion: Pose,
    seconds: f64,
    driven: Driven,
    gripping: bool,
}

/// What a scan came to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fitted {
    pub(crate) pose: Pose,
    /// It was left out, and odometry alone has moved the pose.
    pub(crate) held: bool,
    /// The car is there whatever odometry says.
    pub(crate) believed: bool,
    /// As many end points lie on walls as usual.
    pub(crate) usual: bool,
}

/// Errors are compared over this \[s\]: a bend, a braking. Odometry errs by the same share for so long.
const STRETCH: f64 = 0.5;

/// A share of less is none \[m\], \[rad\].
const LEAST: [f64; 2] = [0.1, 0.1];

/// So many stretches tell a share...
const KNOWN: f64 = 3.0;
/// ...and older ones than so many are forgotten.
const REMEMBERED: f64 = 20.0;

/// Odometry that errs by more is no witness: tyres that slide make it err by a tenth to a third.
const SMALL: f64 = 0.06;

/// Shares differ from bend to bend by so much.
const VARYING: f64 = 1.5;

/// Errors of a fit where the view is bad \[m\], \[rad\].
const FIT: [f64; 2] = [0.005, 0.004];

impl OdometryDrift {
    /// Takes in a fit, whether the tyres grip, and odometry's motion and the time \[s\] since the scan before.
    pub(crate) fn learn(&mut self, fitted: Fitted, grips: bool, (motion, seconds): (Pose, f64)) {
        for (driven, over) in self.since.iter_mut().zip([!fitted.held, fitted.believed]) {
            driven.add(motion);
            if over {
                *driven = Driven::default();
            }
        }
        let usual = fitted.usual && !fitted.held;
        let Some(stretch) = &mut self.stretch else {
            self.stretch = usual.then(|| Stretch::from(fitted.pose));
            return;
        };
        stretch.motion = stretch.motion * motion;
        stretch.seconds += seconds;
        stretch.gripping &= grips;
        stretch.driven.add(motion);
        if stretch.seconds > 2.0 * STRETCH.max(2.0 * seconds) {
            self.stretch = None;
        } else if usual && stretch.seconds >= STRETCH {
            let Driven { way, turn } = stretch.driven;
            let off = fitted.pose.since(stretch.from * stretch.motion);
            let shares = [
                off.x / (way + LEAST[0]),
                off.y / (way + LEAST[0]),
                off.heading / (turn + LEAST[1]),
            ];
            self.shares[usize::from(stretch.gripping)].learn(shares);
            self.stretch = Some(Stretch::from(fitted.pose));
        }
    }

    /// Covariances by which odometry alone, with the next `motion`, may have erred since a scan last moved the pose, now `predicted`,
    /// and since a pose was last believed, now `reckoned`. None while it is not known, or not small.
    pub(crate) fn covariances(
        &self,
        grips: bool,
        motion: Pose,
        [predicted, reckoned]: [Pose; 2],
    ) -> Option<[Matrix3<f64>; 2]> {
        let shares = &self.shares[usize::from(grips)];
        let [along, _, turn] = shares.squares.map(f64::sqrt);
        if shares.stretches < KNOWN || along > SMALL || turn > SMALL {
            return None;
        }
        let of = |mut driven: Driven, pose: Pose| {
            driven.add(motion);
            let turned = rotation(pose.heading);
            turned * shares.covariance(driven) * turned.transpose()
        };
        Some([of(self.since[0], predicted), of(self.since[1], reckoned)])
    }
}

impl Shares {
    fn learn(&mut self, shares: [f64; 3]) {
        self.stretches = (self.stretches + 1.0).min(REMEMBERED);
        for (square, share) in self.squares.iter_mut().zip(shares) {
            *square += (share * share - *square) / self.stretches;
        }
    }

    /// What they come to, along, aside and as a turn.
    fn covariance(&self, Driven { way, turn }: Driven) -> Matrix3<f64> {
        let [along, aside, turning] = self.squares.map(|square| square * VARYING * VARYING);
        let turned = turning * turn * turn;
        let fit = FIT.map(|error| error * error);
        Matrix3::from_diagonal(&Vector3::new(
            along * way * way + fit[0],
            // A turn that was wrong all along the way leads a third of its square aside.
            (aside + turned / 3.0) * way * way + fit[0],
            turned + fit[1],
        ))
    }
}

impl Driven {
    fn add(&mut self, motion: Pose) {
        self.way += motion.x.hypot(motion.y);
        self.turn += motion.heading.abs();
    }
}

impl Stretch {
    fn from(pose: Pose) -> Self {
        Self {
            from: pose,
            motion: Pose::IDENTITY,
            seconds: 0.0,
            driven: Driven::default(),
            gripping: true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A car on a circle of 2 m at 4 m/s, 40 Hz, whose odometry tells too much of the way and of the turn by these shares.
    fn driven(by: [f64; 2], grips: bool, seconds: f64) -> OdometryDrift {
        let mut drift = OdometryDrift::default();
        let mut pose = Pose::IDENTITY;
        let (true_motion, told) = (
            Pose::exp([0.1, 0.0, 0.05]),
            Pose::exp([0.1 * (1.0 + by[0]), 0.0, 0.05 * (1.0 + by[1])]),
        );
        for _ in 0..(seconds * 40.0) as usize {
            pose = pose * true_motion;
            let fitted = Fitted {
                pose,
                held: false,
                believed: true,
                usual: true,
            };
            drift.learn(fitted, grips, (told, 0.025));
        }
        drift
    }

    fn deviations(drift: &OdometryDrift, grips: bool, motion: Pose) -> Option<[f64; 3]> {
        let [own, whole] = drift.covariances(grips, motion, [Pose::IDENTITY; 2])?;
        assert_eq!(own, whole);
        Some([0, 1, 2].map(|i| own[(i, i)].sqrt()))
    }

    #[test]
    fn a_drift_is_known_after_three_stretches_and_grows_with_the_way_and_the_turn() {
        let far = Pose::new(10.0, 0.0, 1.0);
        assert_eq!(deviations(&driven([0.0, 0.02], true, 1.4), true, far), None);
        let drift = driven([0.0, 0.02], true, 6.0);
        let [_, aside, turn] = deviations(&drift, true, far).expect("known");
        assert!((turn - 0.02 * VARYING).abs() < 4e-3, "{turn}");
        assert!(aside > 10.0 * turn / 3.0f64.sqrt(), "{aside}");
        let [along, _, turn] = deviations(&drift, true, Pose::new(0.1, 0.0, 0.0)).expect("known");
        assert!(along < 0.01 && turn < 0.005, "{along} {turn}");
    }

    #[test]
    fn each_kind_of_driving_has_its_own_and_a_large_one_is_no_witness() {
        let motion = Pose::new(0.1, 0.0, 0.05);
        let sliding = driven([0.02, 0.0], false, 6.0);
        assert!(deviations(&sliding, false, motion).is_some());
        assert_eq!(deviations(&sliding, true, motion), None);
        assert_eq!(deviations(&driven([0.15, 0.0], true, 6.0), true, motion), None);
        assert_eq!(deviations(&driven([0.0, 0.2], true, 6.0), true, motion), None);
    }

    #[test]
    fn scans_that_are_left_out_teach_nothing_and_the_doubt_grows() {
        let mut drift = driven([0.02, 0.0], true, 6.0);
        let before = drift.shares;
        let motion = Pose::new(0.1, 0.0, 0.0);
        for i in 0..30 {
            let fitted = Fitted {
                pose: Pose::new(5.0 * f64::from(i), 0.0, 0.0),
                held: true,
                believed: false,
                usual: false,
            };
            drift.learn(fitted, true, (motion, 0.025));
        }
        assert_eq!(drift.shares, before);
        let [along, ..] = deviations(&drift, true, motion).expect("known");
        assert!((along - 0.02 * VARYING * 3.1).abs() < 0.02, "{along}");
    }
}
