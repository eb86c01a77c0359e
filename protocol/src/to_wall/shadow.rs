//! The shadow set: a second parameter set that runs on the same scans as the set in force, to compare the two before a
//! switch.

use serde::{Deserialize, Serialize};

use super::set_name;
use crate::{Invalid, Latency, Message, Schema, SetRef};

/// The shadow set and its comparison with the set in force. Sent once a second and when the set changes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Shadow {
    /// The shadow set; None while there is none.
    pub set: Option<String>,
    /// Who started or ended it: an operator's name, `start`, or `load` where the car ended it for lack of CPU.
    pub who: String,
    /// Since when \[unix ns\].
    pub since: i64,
    /// Comparison over the last seconds. None without a shadow set, and until both sets have processed the same scans.
    pub comparison: Option<Comparison>,
}

/// Two sets over the same scans. On each scan, the set with the smaller residual fits better if the residuals differ by
/// more than [`Comparison::MARGIN`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// The set in force.
    pub in_force: SetRef,
    /// Time that it covers \[s\].
    pub window: f32,
    /// Scans that both sets have processed.
    pub scans: u32,
    /// Scans in the same time that the shadow set skipped, because it must never delay the set in force.
    pub skipped: u32,
    /// Metrics of the set in force over these scans.
    pub force: Fitness,
    /// Metrics of the shadow set over these scans.
    pub shadow: Fitness,
    /// Mean distance between the two poses \[m\].
    pub distance: f32,
    /// Greatest distance between the two poses \[m\].
    pub distance_max: f32,
    /// Mean angle between the two headings \[rad\].
    pub angle: f32,
    /// Share of the scans that fit better under the set in force, in `[0, 1]`.
    pub force_better: f32,
    /// Share of the scans that fit better under the shadow set, in `[0, 1]`.
    pub shadow_better: f32,
}

impl Comparison {
    /// Residuals that differ by less than this count as equal \[m\].
    pub const MARGIN: f64 = 0.002;
}

/// Metrics of one set: means over the scans compared.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Fitness {
    /// See [`Metrics::alignment`](crate::Metrics::alignment), in `[0, 1]`.
    pub alignment: f32,
    /// See [`Metrics::residual`](crate::Metrics::residual) \[m\].
    pub residual: f32,
    /// Distance by which a scan corrected the pose \[m\].
    pub innovation: f32,
    /// Standard deviation of the particles along the track \[m\].
    pub spread_along: f32,
    /// Standard deviation of the particles across the track \[m\].
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
