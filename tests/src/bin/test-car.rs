//! Cars in a process of their own, so that a test can kill one as a power cut does.
//!
//! ```text
//! test-car race NAME START ENDPOINT [STATE]   a real node in a simulated car on the bundled track; STATE is the folder
//!                                             that its sets are kept in
//! test-car rings COUNT ENDPOINT               cars made of nothing but protocol, car-1 to car-COUNT, at full rate
//! ```

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use car_node::node::{Begin, Node, NodeConfig, RaceMap};
use car_node::source::Race;
use protocol::CarName;
use simulator::{CarSetup, Track};
use synpf::TrackMap;
use system_tests::{Behaviour, FakeCar};

/// Nobody is served by a car that outlives a test that was killed.
const LONGEST: Duration = Duration::from_mins(10);

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        ["race", name, start, endpoint] => race(name, start.parse().context("START")?, endpoint, None),
        ["race", name, start, endpoint, state] => race(
            name,
            start.parse().context("START")?,
            endpoint,
            Some(state.into()),
        ),
        ["rings", count, endpoint] => rings(count.parse().context("COUNT")?, endpoint),
        _ => bail!("usage: test-car race NAME START ENDPOINT [STATE] | rings COUNT ENDPOINT"),
    }
}

/// A car that starts at `start` [m] along the raceline.
fn race(name: &str, start: f64, endpoint: &str, state: Option<PathBuf>) -> anyhow::Result<()> {
    let track = Track::find("club")?;
    let map = RaceMap {
        name: track.name.clone(),
        map: Arc::new(TrackMap::new(track.grid.clone())?),
        raceline: Some(Arc::new(track.raceline.clone())),
    };
    let setup = CarSetup {
        start,
        ..CarSetup::default()
    };
    let race = Race::new(track, vec![setup], 1, Vec::new());
    let mut config = NodeConfig::new(CarName::new(name)?, map, Box::new(race.car(0)));
    config.begin = Begin::Source;
    config.connect = vec![endpoint.to_owned()];
    config.state = state;
    let node = Node::start(config)?;
    std::thread::sleep(LONGEST);
    node.shutdown("the test is over");
    Ok(())
}

fn rings(count: u64, endpoint: &str) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        let mut cars = Vec::new();
        for number in 1..=count {
            let behaviour = Behaviour {
                behind: number * 80 / count.max(1),
                ..Behaviour::default()
            };
            cars.push(FakeCar::start(&format!("car-{number:02}"), endpoint, behaviour).await);
        }
        tokio::time::sleep(LONGEST).await;
        drop(cars);
    });
    Ok(())
}
