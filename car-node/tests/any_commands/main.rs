//! Commands without rhyme or reason: refused whole, or done whole, and never a panic.

mod check;

use check::{Tally, check};
use rand::rngs::SmallRng;
use rand::{Rng, RngExt, SeedableRng};

/// The same dice in every run; `cargo fuzz run commands` goes on from here.
#[test]
fn no_sequence_of_commands_breaks_a_car() {
    let mut dice = SmallRng::seed_from_u64(1);
    let mut tally = Tally::default();
    for _ in 0..150 {
        let mut bytes = vec![0; dice.random_range(16..1024)];
        dice.fill_bytes(&mut bytes);
        check(&bytes, &mut tally);
    }
    let Tally {
        done,
        refused,
        stale,
        unreadable,
    } = tally;
    let enough = [done, refused, stale, unreadable].iter().all(|count| *count > 50);
    assert!(enough, "{tally:?}");
}
