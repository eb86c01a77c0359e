//! Whatever sensors and operators send, the localizer neither panics nor gives a pose that is not finite.
//!
//! `RUSTC_BOOTSTRAP=1 cargo fuzz run -s none --fuzz-dir car-node/synpf/fuzz update -- -max_total_time=300`
#![no_main]

#[path = "../../tests/any_input/check.rs"]
mod check;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    check::check(bytes);
});
