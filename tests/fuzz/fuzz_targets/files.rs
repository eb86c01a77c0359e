//! Damaged recordings, bags, maps and racelines: an error or a part of the content, never a crash.
//!
//! `RUSTC_BOOTSTRAP=1 cargo fuzz run -s none --fuzz-dir tests/fuzz files -- -max_total_time=60 -rss_limit_mb=1000`
#![no_main]

#[path = "../../tests/any_files/check.rs"]
mod check;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| check::check(bytes));
