//! Sensors and operators gone mad.

mod check;

use check::check;
use rand::rngs::SmallRng;
use rand::{Rng, RngExt, SeedableRng};

/// The same dice in every run; `cargo fuzz run update` goes on from here.
#[test]
fn no_input_leads_the_localizer_astray() {
    let mut dice = SmallRng::seed_from_u64(1);
    let mut updates = 0;
    for _ in 0..60 {
        let mut bytes = vec![0; dice.random_range(16..1024)];
        dice.fill_bytes(&mut bytes);
        updates += check(&bytes);
    }
    assert!(updates > 30, "only {updates} updates");
}
