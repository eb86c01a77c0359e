//! The pit wall's measurement of a car's link. Only the receiving end can measure how late messages arrive.

use serde::{Deserialize, Serialize};

use crate::{Message, Schema};

/// Sent once a second, so that the car can send less while its link is slow.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LinkReport {
    /// Time from publishing a pose to its arrival: median of the last second, corrected by the clocks' offset \[s\].
    pub transit: f32,
    /// Largest error of `transit`, from the uncertainty of the clocks' offset \[s\].
    pub uncertainty: f32,
    /// Poses that arrived in that second.
    pub poses: u32,
}

impl Message for LinkReport {
    const SCHEMA: Schema = Schema::LinkReport;
    const MAX_LEN: usize = 64;
}
