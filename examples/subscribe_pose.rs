//! Prints the poses of all cars, with plain zenoh: a client of a pit wall, or of any zenoh router that the cars dial.
//!
//! ```sh
//! cargo run --release -p examples --bin subscribe-pose -- tcp/127.0.0.1:7447
//! ```
#![allow(clippy::print_stdout, reason = "poses are what it prints")]

use std::env;

use protocol::{Key, Pose, Topic, decode};
use zenoh::{Config, Wait};

fn main() -> anyhow::Result<()> {
    let endpoint = env::args().nth(1).unwrap_or_else(|| "tcp/127.0.0.1:7447".into());
    let mut config = Config::default();
    for (key, value) in [
        ("mode", r#""client""#),
        ("connect/endpoints", &format!("[{endpoint:?}]")),
        ("scouting/multicast/enabled", "false"),
    ] {
        config
            .insert_json5(key, value)
            .map_err(anyhow::Error::from_boxed)?;
    }
    let session = zenoh::open(config).wait().map_err(anyhow::Error::from_boxed)?;
    let samples = session
        .declare_subscriber(Topic::Pose.of_all_cars())
        .wait()
        .map_err(anyhow::Error::from_boxed)?;
    while let Ok(sample) = samples.recv() {
        let key: Key = sample.key_expr().as_str().parse()?;
        match decode::<Pose>(&sample.payload().to_bytes()) {
            Ok((header, Pose { pose, twist, .. })) => println!(
                "{} #{}: {:.3} {:.3} m {:.1} deg {:.2} m/s",
                key.car,
                header.sequence,
                pose.x,
                pose.y,
                pose.heading.to_degrees(),
                twist.linear_x
            ),
            Err(error) => println!("{}: {error}", key.car),
        }
    }
    Ok(())
}
