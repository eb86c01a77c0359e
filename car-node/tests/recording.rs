//! A car that records on its own disk: its files are bags, and hold what it sends and what it does not.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use car_node::node::{Node, NodeConfig, RaceMap};
use car_node::recording::RecordOptions;
use car_node::sensors::Race;
use car_node::sensors::bag::{Bag, SensorEvent, Topics};
use protocol::{Key, RecordedScan, Topic, decode};
use simulator::{CarSetup, Track};
use synpf::TrackMap;

fn files(folder: &Path) -> Vec<std::path::PathBuf> {
    let entries = std::fs::read_dir(folder).expect("a folder");
    let mut files: Vec<_> = entries.map(|entry| entry.expect("an entry").path()).collect();
    files.retain(|file| file.extension().is_some_and(|extension| extension == "mcap"));
    files.sort();
    files
}

#[test]
fn a_recording_on_the_car_is_a_bag_with_every_message() {
    let folder = tempfile::tempdir().expect("a folder");
    let track = Track::find("club", None).expect("bundled");
    let map = RaceMap {
        name: track.name.clone(),
        map: Arc::new(TrackMap::new(track.grid.clone()).expect("free cells")),
        raceline: Some(Arc::new(track.raceline.clone())),
    };
    let race = Race::new(track, vec![CarSetup::default()], 1, Vec::new());
    let car: protocol::CarName = "on-car".parse().expect("a name");
    let mut config = NodeConfig::new(car.clone(), map, Box::new(race.car(0)));
    // Nobody listens, and the full-rate streams are not sent: they are recorded all the same.
    config.connect = vec!["tcp/127.0.0.1:1".into()];
    config.rates.recorded = false;
    config.record = Some(RecordOptions::new(folder.path().join("recordings"), true));
    let node = Node::start(config).expect("starts");
    let recorder = node.shared().recorder.clone().expect("a recorder");
    let until = Instant::now() + Duration::from_mins(1);
    while recorder.state().bytes < 300_000 {
        assert!(Instant::now() < until, "{:?}", recorder.state());
        std::thread::sleep(Duration::from_millis(20));
    }
    node.shutdown("the test ends");
    assert_eq!(recorder.state().dropped, 0);

    let files = files(&folder.path().join("recordings"));
    assert_eq!(files.len(), 1);
    let bag = Bag::read(&files[0]).expect("a bag");
    let log = bag.sensors(&Topics::default(), None).expect("sensors");
    let scans: Vec<_> = log
        .arrivals
        .iter()
        .filter_map(|arrival| match &arrival.event {
            SensorEvent::Scan(scan) => Some(scan.clone()),
            _ => None,
        })
        .collect();
    assert!(log.mount.is_some() && !log.truth.is_empty());

    // The same scans as on the wire, and their numbers without a gap.
    let bytes = std::fs::read(&files[0]).expect("read");
    let key = Key::new(car, Topic::RecordedScan).to_string();
    let sent: Vec<_> = mcap::MessageStream::new(&bytes)
        .expect("complete")
        .map(|message| message.expect("intact"))
        .filter(|message| message.channel.topic == key)
        .map(|message| {
            assert_eq!(message.channel.message_encoding, Key::RECORDED_ENCODING);
            decode::<RecordedScan>(&message.data).expect("a scan")
        })
        .collect();
    let numbers: Vec<_> = sent.iter().map(|(header, _)| header.sequence).collect();
    assert_eq!(numbers, (1..=sent.len() as u64).collect::<Vec<_>>());
    assert_eq!(scans.len(), sent.len());
    for (scan, (header, sent)) in scans.iter().zip(&sent) {
        assert_eq!(scan.stamp.0, header.sensor);
        assert_eq!(scan.ranges.len(), sent.ranges.len());
    }
}
