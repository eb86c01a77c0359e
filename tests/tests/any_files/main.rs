//! Damaged files of every kind: an error or a part of the content, never a crash.

mod check;

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

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

/// Damages files of every kind for `PITWALL_FUZZ_SECONDS`, each time others.
#[test]
#[expect(clippy::print_stderr, reason = "the seed is the result of the run")]
fn files_are_damaged_for_a_while() {
    let seconds = std::env::var("PITWALL_FUZZ_SECONDS").ok();
    let Some(seconds) = seconds.and_then(|text| text.parse().ok()) else {
        return;
    };
    let until = Instant::now() + Duration::from_secs(seconds);
    let seed = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |now| now.as_nanos() as u64);
    let (mut roll, mut count) = (dice(seed), [0_u64; Files::KINDS]);
    while Instant::now() < until {
        // Recordings are large and slow to read: the others come more often.
        let kind = if roll(20) == 0 { 0 } else { roll(Files::KINDS) };
        let mut bytes = vec![kind as u8, 1 + 2 * roll(2) as u8];
        for _ in 0..=roll(4) {
            bytes.extend([roll(256), roll(256), roll(2), roll(256)].map(|byte| byte as u8));
        }
        let outcome = std::panic::catch_unwind(|| check::check(&bytes));
        assert!(outcome.is_ok(), "seed {seed}: {bytes:?}");
        count[kind] += 1;
    }
    eprintln!("seed {seed}: damaged files of each kind: {count:?}");
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
