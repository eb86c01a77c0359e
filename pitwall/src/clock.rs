//! The laptop's clock, without its steps.
//!
//! The operating system's clock may be set while the pit wall runs, by an operator or by the network. Times here go on
//! regardless: they are the time of the first call plus the time that has passed since. How far the operating system's clock
//! has moved away is known, so that it can be noted.

use std::sync::OnceLock;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

static START: OnceLock<(Instant, i64)> = OnceLock::new();

/// The present time \[unix ns\]. It never steps.
pub fn unix_now() -> i64 {
    let (begun, at) = START.get_or_init(|| (Instant::now(), system_now()));
    at.saturating_add(i64::try_from(begun.elapsed().as_nanos()).unwrap_or(i64::MAX))
}

/// How far the operating system's clock is ahead of [`unix_now`], because it has been set \[ns\].
pub(crate) fn stepped() -> i64 {
    system_now().saturating_sub(unix_now())
}

/// The operating system's clock \[unix ns\].
pub(crate) fn system_now() -> i64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |since| since.as_nanos() as i64)
}
