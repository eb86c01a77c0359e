//! Any bytes, as any message: refused or read, and what was read is written again as it came.
//!
//! `RUSTC_BOOTSTRAP=1 cargo fuzz run -s none --fuzz-dir protocol/fuzz decode -- -max_total_time=300`
#![no_main]

#[path = "../../tests/wire/any_bytes.rs"]
mod any_bytes;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| any_bytes::check(data));
