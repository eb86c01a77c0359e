//! The laptop's clock.

use std::time::{SystemTime, UNIX_EPOCH};

/// The present time \[unix ns\].
pub fn unix_now() -> i64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |since| since.as_nanos() as i64)
}
