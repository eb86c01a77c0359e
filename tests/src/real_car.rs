//! A whole car on a simulated track, with its localizer.

use std::path::Path;
use std::sync::Arc;

use car_node::localization::Start;
use car_node::node::{Node, NodeConfig, RaceMap};
use car_node::recording::RecordOptions;
use car_node::sensors::Race;
use keys::Protection;
use protocol::CarName;
use simulator::{CarSetup, Track};
use synpf::TrackMap;

/// Starts a car at `start` \[m\] along the line of `club`. It connects to the pit wall at `endpoint` and keeps its state in
/// the folder `state`.
pub fn start_real(name: &CarName, start: f64, endpoint: &str, state: Option<&Path>) -> Node {
    start_with(name, start, endpoint, state, None, Protection::None)
}

/// The same, and the car records on its own disk into the folder `record`.
pub fn start_recording(
    name: &CarName,
    start: f64,
    endpoint: &str,
    state: Option<&Path>,
    record: Option<&Path>,
) -> Node {
    start_with(name, start, endpoint, state, record, Protection::None)
}

/// The same as [`start_real`], with keys or a passphrase.
pub fn start_real_protected(
    name: &CarName,
    start: f64,
    endpoint: &str,
    state: Option<&Path>,
    protection: Protection,
) -> Node {
    start_with(name, start, endpoint, state, None, protection)
}

fn start_with(
    name: &CarName,
    start: f64,
    endpoint: &str,
    state: Option<&Path>,
    record: Option<&Path>,
    protection: Protection,
) -> Node {
    let track = Track::find("club", None).expect("bundled");
    let map = RaceMap {
        name: track.name.clone(),
        map: Arc::new(TrackMap::new(track.grid.clone()).expect("free cells")),
        raceline: Some(Arc::new(track.raceline.clone())),
    };
    let setup = CarSetup {
        start,
        ..CarSetup::default()
    };
    let race = Race::new(track, vec![setup], 1, Vec::new());
    let mut config = NodeConfig::new(name.clone(), map, Box::new(race.car(0)));
    config.start = Start::Truth;
    config.connect = vec![endpoint.to_owned()];
    config.protection = protection;
    config.state = state.map(Path::to_owned);
    config.record = record.map(|folder| RecordOptions::new(folder.to_owned(), true));
    Node::start(config).expect("a car")
}
