//! What the pit wall sees of a car's link, told to the car: only the far end knows how late messages arrive.

use serde::{Deserialize, Serialize};

use crate::{Message, Schema};

/// Put once a second, for the car to send less while its link is slow.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LinkReport {
    /// From publishing a pose to its arrival, the median of the last second, the clocks' offset taken out [s].
    pub transit: f32,
    /// How far that may be wrong, for what is not known of the clocks' offset [s].
    pub uncertainty: f32,
    /// Poses that arrived in that second.
    pub poses: u32,
}

impl Message for LinkReport {
    const SCHEMA: Schema = Schema::LinkReport;
    const MAX_LEN: usize = 64;
}
