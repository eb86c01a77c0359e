//! The reference's defects, each a switch, so that every gain over it can be attributed.

use serde::{Deserialize, Serialize};

/// What `ForzaETH/particle_filter` (`synPF.py`) does and we do not. All off by default.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "independent switches, flipped one at a time"
)]
pub struct Defects {
    /// The two rotations of a motion lose their sign before they are used as means: right turns predict left.
    pub defect_unsigned_rotation: bool,
    /// The noise on a translation has mean `s_trans / 2`: with `alpha_3_tum` 1 the mean step is 1.5 times odometry.
    pub defect_biased_translation: bool,
    /// Motion under 1 cm per odometry message is thrown away, and its noise with it.
    pub defect_deadband: bool,
    /// `lambda_short` is divided by the cell's size in place of multiplied: nearly all of `z_short` sits at 0 m.
    pub defect_lambda_short: bool,
    /// One update per odometry message, with the latest scan however old, and with odometry one message late.
    pub defect_update_per_odometry: bool,
    /// Noise per message in place of per time, so that a tuning depends on odometry's rate.
    pub defect_noise_per_message: bool,
    /// Ranges come out half a cell long.
    pub defect_long_ranges: bool,
}

impl Defects {
    /// All of them, as the reference has them.
    pub const ALL: Self = Self {
        defect_unsigned_rotation: true,
        defect_biased_translation: true,
        defect_deadband: true,
        defect_lambda_short: true,
        defect_update_per_odometry: true,
        defect_noise_per_message: true,
        defect_long_ranges: true,
    };
}
