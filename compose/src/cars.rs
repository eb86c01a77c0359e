//! The cars of the demo: of different grip, one behind another, and what happens to them.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use car_node::node::{Begin, Node, NodeConfig, RaceMap};
use car_node::sets;
use car_node::source::{Incident, Race, ScriptedIncident};
use protocol::CarName;
use simulator::{CarSetup, Grip, OdometryParams, Track, YawSource};
use synpf::TrackMap;

use crate::Options;

/// From one car to the next on the grid [m]: near enough for the one behind to have the other in view.
const GAP: f64 = 4.0;

/// Starts every car.
pub(crate) fn start(options: &Options) -> anyhow::Result<Vec<Node>> {
    let track = Track::find(&options.track)?;
    let map = RaceMap {
        name: track.name.clone(),
        map: Arc::new(TrackMap::new(track.grid.clone())?),
        raceline: Some(Arc::new(track.raceline.clone())),
    };
    let count = usize::from(options.cars);
    let setups: Vec<CarSetup> = (0..count).map(setup).collect();
    let race = Race::new(track, setups, options.seed, script(count));
    (0..count)
        .map(|index| {
            let car = CarName::new(format!("car-{}", index + 1))?;
            let mut config = NodeConfig::new(car, map.clone(), Box::new(race.car(index)));
            config.set = Some(sets::load(&options.params)?);
            config.begin = Begin::Source;
            config.seed = options.seed.wrapping_add(index as u64);
            config.connect = vec![options.listen.clone()];
            Ok(Node::start(config)?)
        })
        .collect()
}

/// Ends every car, all at once: each may have to wait for its link.
pub(crate) fn shutdown(nodes: Vec<Node>) {
    let ending: Vec<_> = nodes
        .into_iter()
        .map(|node| thread::spawn(move || node.shutdown("the demo is over")))
        .collect();
    for thread in ending {
        if thread.join().is_err() {
            tracing::error!("a car did not end well");
        }
    }
}

/// Car 2 has taped tyres and an odometry that knows its turning from the steering alone; the others grip.
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

/// What happens: every two minutes car 1 drives onto dust for half a minute, and the last car is knocked round.
fn script(cars: usize) -> Vec<ScriptedIncident> {
    let rounds: u64 = 60;
    (0..rounds)
        .flat_map(|round| {
            let at = |seconds: u64| Duration::from_secs(round * 120 + seconds);
            let incident = |at, car, incident| ScriptedIncident { at, car, incident };
            [
                incident(at(30), 0, Incident::Grip(Grip::LQ)),
                incident(at(60), 0, Incident::Grip(Grip::HQ)),
                incident(at(80), cars - 1, Incident::Knock(9.0)),
            ]
        })
        .collect()
}
