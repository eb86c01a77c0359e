//! Cars in a process of their own, which a test can kill as a power cut does.
//!
//! ```text
//! test-car race NAME START ENDPOINT [STATE [RECORDINGS]]   a real node in a simulated car on the bundled track; STATE is the folder
//!                                             that its sets are kept in, RECORDINGS that of the recordings on the car
//! test-car rings COUNT ENDPOINT [full]        fake cars, car-01 to car-COUNT; `full` with scans and all else at full rate
//! test-car light COUNT ENDPOINT PREFIX        fake cars, PREFIX-01 to PREFIX-COUNT, that send ten poses a second
//! ```
//!
//! Fake cars end after fifteen minutes, or after `TEST_CAR_MINUTES`.

use std::path::Path;
use std::time::Duration;

use anyhow::{Context, bail};
use protocol::CarName;
use system_tests::{Behaviour, FakeCar, start_recording};

/// The process ends after this time, in case the test was killed.
const LONGEST: Duration = Duration::from_mins(15);

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        ["race", name, start, endpoint] => race(name, start.parse().context("START")?, endpoint, None, None),
        ["race", name, start, endpoint, state, ref record @ ..] if record.len() <= 1 => race(
            name,
            start.parse().context("START")?,
            endpoint,
            Some(Path::new(state)),
            record.first().map(Path::new),
        ),
        ["rings", count, endpoint, ref full @ ..] if full.is_empty() || full == ["full"] => {
            let behaviour = Behaviour {
                full_rate: !full.is_empty(),
                ..Behaviour::default()
            };
            rings(count.parse().context("COUNT")?, endpoint, "car", behaviour)
        }
        ["light", count, endpoint, prefix] => {
            let behaviour = Behaviour {
                light: true,
                ..Behaviour::default()
            };
            rings(count.parse().context("COUNT")?, endpoint, prefix, behaviour)
        }
        _ => bail!(
            "usage: test-car race NAME START ENDPOINT [STATE [RECORDINGS]] | rings COUNT ENDPOINT [full] | \
             light COUNT ENDPOINT PREFIX"
        ),
    }
}

/// A car that starts at `start` \[m\] along the raceline.
fn race(
    name: &str,
    start: f64,
    endpoint: &str,
    state: Option<&Path>,
    record: Option<&Path>,
) -> anyhow::Result<()> {
    let node = start_recording(&CarName::new(name)?, start, endpoint, state, record);
    std::thread::sleep(LONGEST);
    node.shutdown("the test is over");
    Ok(())
}

fn rings(count: u64, endpoint: &str, prefix: &str, behaviour: Behaviour) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        let mut cars = Vec::new();
        for number in 1..=count {
            let behaviour = Behaviour {
                updates_behind: number * 80 / count.max(1),
                ..behaviour
            };
            cars.push(FakeCar::start(&format!("{prefix}-{number:02}"), endpoint, behaviour).await);
        }
        let minutes = std::env::var("TEST_CAR_MINUTES").ok();
        let minutes = minutes.and_then(|minutes| minutes.parse().ok());
        tokio::time::sleep(minutes.map_or(LONGEST, Duration::from_mins)).await;
        drop(cars);
    });
    Ok(())
}
