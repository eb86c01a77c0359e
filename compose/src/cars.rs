//! The cars of the demo, their opponent, and the incidents that they meet.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use car_node::control::parameter_sets;
use car_node::localization::Start;
use car_node::node::{Node, NodeConfig, RaceMap};
use car_node::sensors::{Incident, Race, ScriptedIncident};
use protocol::CarName;
use simulator::{CarSetup, DriverParams, Grip, Guidance, OdometryParams, Track, YawSource};
use synpf::{TablePolicy, TrackMap};

use crate::Options;

/// Distance between cars on the grid \[m\]. Each car sees the one ahead.
const GAP: f64 = 4.0;

/// Period after which the incidents repeat.
pub(crate) const ROUND: Duration = Duration::from_mins(2);
/// Start and end of car 1's drive on dust, in each round.
pub(crate) const DUST: [Duration; 2] = [Duration::from_secs(30), Duration::from_mins(1)];
/// Time in each round at which the last car is knocked into a spin.
pub(crate) const KNOCK: Duration = Duration::from_secs(80);

/// Starts every car. The last one connects to the pit wall through the relay at `relay`.
pub(crate) fn start(options: &Options, relay: &str) -> anyhow::Result<Vec<Node>> {
    let track = Track::find(&options.track, None)?;
    let map = RaceMap {
        name: track.name.clone(),
        map: Arc::new(TrackMap::new(track.grid.clone())?.with_table_policy(TablePolicy::Defer)),
        raceline: Some(Arc::new(track.raceline.clone())),
    };
    let count = usize::from(options.cars);
    let mut setups: Vec<CarSetup> = (0..count).map(setup).collect();
    // The last car starts behind an opponent, which does not connect to the pit wall.
    let last = setups.last_mut().expect("one car at least");
    let opponent = CarSetup {
        guidance: Guidance::Truth,
        driver: DriverParams {
            speed_scale: 0.97,
            ..last.driver
        },
        ..*last
    };
    last.start -= GAP;
    setups.push(opponent);
    let race = Race::new(track, setups, options.seed, incidents(count));
    (0..count)
        .map(|index| {
            let car = CarName::new(format!("car-{}", index + 1))?;
            let mut config = NodeConfig::new(car, map.clone(), Box::new(race.car(index)));
            config.set = Some(parameter_sets::load(&options.params)?);
            config.start = Start::Truth;
            config.seed = options.seed.wrapping_add(index as u64);
            let last = index + 1 == count;
            config.connect = vec![if last { relay } else { &options.listen }.to_owned()];
            Ok(Node::start(config)?)
        })
        .collect()
}

/// Shuts all cars down in parallel, because each may wait for its link.
pub(crate) fn shutdown(nodes: Vec<Node>) {
    let ending: Vec<_> = nodes
        .into_iter()
        .map(|node| thread::spawn(move || node.shutdown("the demo is over")))
        .collect();
    for thread in ending {
        if thread.join().is_err() {
            tracing::error!("a car panicked while shutting down");
        }
    }
}

/// Car 2 has taped tyres, and odometry that takes the yaw rate from the steering. The others have good grip.
fn setup(index: usize) -> CarSetup {
    let mut setup = CarSetup {
        start: -GAP * (index + 1) as f64,
        ..CarSetup::default()
    };
    if index == 1 {
        setup.vehicle = setup.vehicle.with_grip(Grip::LQ);
        setup.odometry = OdometryParams {
            yaw_source: YawSource::Steering,
            ..setup.odometry
        };
    }
    setup
}

/// The incidents of two hours. The radio has its own schedule.
fn incidents(cars: usize) -> Vec<ScriptedIncident> {
    (0..60)
        .flat_map(|round| {
            let incident = |at, car, incident| ScriptedIncident {
                at: ROUND * round + at,
                car,
                incident,
            };
            [
                incident(DUST[0], 0, Incident::Grip(Grip::LQ)),
                incident(DUST[1], 0, Incident::Grip(Grip::HQ)),
                incident(KNOCK, cars - 1, Incident::Knock(9.0)),
            ]
        })
        .collect()
}
