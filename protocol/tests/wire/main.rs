//! The wire format: round trips, refusals, and the bytes themselves.

mod any_bytes;
mod golden;
mod round_trip;
mod samples;
