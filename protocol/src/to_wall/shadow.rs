//! A second parameter set that runs beside the one in force, on the same scans, so that a switch is decided on
//! evidence.

use serde::{Deserialize, Serialize};

use super::set_name;
use crate::{Invalid, Latency, Message, Schema, SetRef};

/// Which set runs in the shadow, and how it compares. Told once a second and when the set changes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Shadow {
    /// The set in the shadow; None while there is none.
    pub set: Option<String>,
    /// Who set it, or ended it: an operator's name, `start`, or `load` where the car has dropped it.
    pub who: String,
    /// Since when [unix ns].
    pub since: i64,
    /// The last seconds compared; None without a shadow, and until both sets have taken the same scans.
    pub comparison: Option<Comparison>,
}

/// Two sets over the same scans. The better fit on a scan is the one with the smaller residual, where they differ by
/// more than [`Comparison::MARGIN`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// The set in force.
    pub in_force: SetRef,
    /// Time that it covers [s].
    pub window: f32,
    /// Scans that both sets have taken.
    pub scans: u32,
    /// Scans in the same time that the shadow has left out, because it must never hold up the set in force.
    pub skipped: u32,
    /// The set in force, over these scans.
    pub force: Fitness,
    /// The set in the shadow, over these scans.
    pub shadow: Fitness,
    /// Mean distance between the two poses [m].
    pub distance: f32,
    /// Greatest distance between the two poses [m].
    pub distance_max: f32,
    /// Mean angle between the two headings [rad].
    pub angle: f32,
    /// Share of the scans that fit better under the set in force, in `[0, 1]`.
    pub force_better: f32,
    /// Share of the scans that fit better in the shadow, in `[0, 1]`.
    pub shadow_better: f32,
}

impl Comparison {
    /// Residuals closer than this are equal [m].
    pub const MARGIN: f64 = 0.002;
}

/// How well one set has done: means over the scans compared.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Fitness {
    /// See [`Metrics::alignment`](crate::Metrics::alignment), in `[0, 1]`.
    pub alignment: f32,
    /// See [`Metrics::residual`](crate::Metrics::residual) [m].
    pub residual: f32,
    /// Distance by which a scan corrected the pose [m].
    pub innovation: f32,
    /// Standard deviation of the particles along the track [m].
    pub spread_along: f32,
    /// Standard deviation of the particles across the track [m].
    pub spread_across: f32,
    /// Time of a whole update.
    pub update_us: Latency,
}

impl Message for Shadow {
    const SCHEMA: Schema = Schema::Shadow;
    const MAX_LEN: usize = 1024;

    fn validate(&self) -> Result<(), Invalid> {
        if let Some(set) = &self.set {
            set_name("set", set)?;
        }
        if let Some(comparison) = &self.comparison {
            for (field, share) in [
                ("force_better", comparison.force_better),
                ("shadow_better", comparison.shadow_better),
                ("alignment", comparison.force.alignment),
                ("alignment", comparison.shadow.alignment),
            ] {
                Invalid::unless_share(field, share)?;
            }
        }
        Ok(())
    }
}
