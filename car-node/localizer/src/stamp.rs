//! Sensor time.

use serde::{Deserialize, Serialize};

/// A sensor's time: nanoseconds since the Unix epoch (or since any epoch that all sensors share).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
pub struct Stamp(pub i64);

impl Stamp {
    /// Seconds from `earlier` to this stamp; negative when it is the later one \[s\].
    pub fn since(self, earlier: Self) -> f64 {
        self.0.saturating_sub(earlier.0) as f64 * 1e-9
    }

    /// The stamp `seconds` later.
    #[must_use]
    pub fn plus(self, seconds: f64) -> Self {
        Self(self.0.saturating_add((seconds * 1e9).round() as i64))
    }
}
