//! The grip of the tyres on the floor.

use serde::{Deserialize, Serialize};

/// Gravity \[m/s^2\].
pub(crate) const GRAVITY: f64 = 9.81;

/// Grip, as the paper measures it: the force that slides a standing car sideways.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Grip {
    /// Force at which a car of 3.5 kg slides sideways \[N\].
    pub lateral_pull: f64,
}

impl Grip {
    /// Clean tyres: high-quality odometry (paper, table I).
    pub const HQ: Self = Self { lateral_pull: 26.0 };
    /// Taped tyres: low-quality odometry (paper, table I).
    pub const LQ: Self = Self { lateral_pull: 19.0 };

    /// Friction coefficient.
    pub fn friction(self) -> f64 {
        self.lateral_pull / (3.5 * GRAVITY)
    }
}
