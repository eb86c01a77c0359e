//! Damaged files of every kind: an error or a part of the content, never a crash.

mod check;

use check::{Files, Tally};

/// Numbers from a seed.
fn dice(seed: u64) -> impl FnMut(usize) -> usize {
    let mut state = seed;
    move |sides| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (state >> 33) as usize % sides.max(1)
    }
}

/// `PITWALL_DAMAGES` asks for more than the usual number.
fn count(usual: usize) -> usize {
    let more = std::env::var("PITWALL_DAMAGES")
        .ok()
        .and_then(|text| text.parse().ok());
    more.unwrap_or(usual)
}

// One flipped byte in a length once aborted recover, report and evaluate.
#[test]
fn a_flipped_or_a_missing_byte_is_an_error_and_never_a_crash() {
    let files = Files::new();
    let mut roll = dice(7);
    let mut tally = Tally::default();
    for kind in 0..Files::KINDS {
        let whole = files.sample(kind);
        for _ in 0..count(40) {
            let mut bytes = whole.clone();
            let at = roll(bytes.len());
            bytes[at] ^= 1 << roll(8);
            files.read(kind, &bytes, &mut tally);
        }
        for _ in 0..count(40) / 5 {
            files.read(kind, &whole[..roll(whole.len())], &mut tally);
        }
        files.read(kind, &whole, &mut tally);
    }
    assert!(tally.read > 0 && tally.refused > 0, "{tally:?}");
}

/// The same bytes that the fuzzer would make, with a fixed seed.
#[test]
fn any_bytes_are_refused_or_read() {
    let mut roll = dice(11);
    for _ in 0..count(200) {
        let bytes: Vec<u8> = (0..roll(400)).map(|_| roll(256) as u8).collect();
        check::check(&bytes);
    }
}
