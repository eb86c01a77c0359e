//! Whatever is sent to a car, its command handler does it whole or not at all, and its filter runs on.
//!
//! `RUSTC_BOOTSTRAP=1 cargo fuzz run -s none --fuzz-dir car-node/fuzz commands -- -max_total_time=300`
#![no_main]

#[path = "../../tests/any_commands/check.rs"]
mod check;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    check::check(bytes, &mut check::Tally::default());
});
