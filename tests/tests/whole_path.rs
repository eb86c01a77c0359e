//! From a bag to the pit wall, through every part: sensors, filter, health, network, fleet, commands, recording.

use std::path::Path;
use std::sync::Arc;

use car_node::localization::Start;
use car_node::node::{Node, NodeConfig, RaceMap};
use car_node::sensors::BagPlayer;
use car_node::sensors::bag::{Bag, Topics};
use pitwall::{EventPayload, Verdict, read_events};
use protocol::{Action, CarName, ParamsAction, Telemetry, Topic};
use synpf::TrackMap;
use system_tests::{DEADLINE, recording, room, send_command, true_pose, wait_until, write_bag};

/// Starts a car that plays the bag in `folder`.
fn start(name: &str, folder: &Path, endpoint: &str) -> Node {
    let bag = folder.join("drive.mcap");
    let grid = room();
    if !bag.exists() {
        write_bag(&bag, &grid, 8.0);
    }
    let log = Bag::read(&bag)
        .expect("a bag")
        .sensors(&Topics::default(), None)
        .expect("sensors");
    let map = RaceMap {
        name: "room".into(),
        map: Arc::new(TrackMap::new(grid).expect("free cells")),
        raceline: None,
    };
    let car = CarName::new(name).expect("a good name");
    let mut config = NodeConfig::new(car, map, Box::new(BagPlayer::new(bag, log)));
    config.start = Start::Pose(true_pose(0.0));
    config.connect = vec![endpoint.to_owned()];
    Node::start(config).expect("a car")
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bag_becomes_poses_at_the_pit_wall_and_in_the_recording() {
    let (endpoint, service, folder, file) = recording().await;
    let node = start("car-1", folder.path(), &endpoint);
    let car = CarName::new("car-1").expect("a good name");
    assert!(service.wait_for(&car, DEADLINE).await, "the car shows up");

    // A switch in mid-drive: done, at an update that it names, and both sides agree.
    wait_until("two seconds of poses", || {
        service
            .fleet()
            .car(&car)
            .and_then(|car| car.pose)
            .is_some_and(|(_, pose)| pose.update > 80)
    })
    .await;
    let select = Action::Params(ParamsAction::Select {
        name: "lq".into(),
        revert_after_ms: None,
    });
    let verdict = send_command(&service, &car, "ana", None, select).await;
    let Verdict::Answered { answer, .. } = &verdict else {
        panic!("no answer: {verdict:?}");
    };
    assert_eq!(
        (verdict.exit_code(), answer.set.name.as_str()),
        (0, "lq"),
        "{verdict:?}"
    );
    wait_until("the pit wall knows the set in force", || {
        let fleet = service.fleet();
        let params = fleet.car(&car).and_then(|car| car.params.as_ref());
        params.is_some_and(|params| {
            params.set.name == "lq" && params.revision == answer.set.revision && params.who == "ana"
        })
    })
    .await;

    wait_until("the bag has ended", || node.source_ended()).await;
    // The last messages are on their way.
    wait_until("the recording has every update", || {
        let status = service.recording().expect("a recording");
        let updates = status
            .summary
            .streams
            .iter()
            .find(|s| s.topic == Topic::RecordedPose);
        updates.is_some_and(|s| s.gaps.last >= 310 && s.gaps.missing == 0)
    })
    .await;
    let summary = service
        .stop_recording()
        .await
        .expect("a recording")
        .expect("a whole file");
    node.shutdown("test over");
    service.close().await;
    assert_eq!(summary.missing(), 0, "{summary}");

    let (rmse, poses) = position_rmse(&file);
    // Odometry and ranges have no noise: what is left is half a cell at most.
    assert!(
        rmse < 0.025,
        "position is off by {rmse:.3} m (RMSE of {poses} poses)"
    );
}

/// How far the recorded poses are off the drive, each at the stamp that it claims \[m\], and how many there are. Every
/// update must be there.
fn position_rmse(file: &Path) -> (f64, usize) {
    let start = 1_700_000_000_000_000_000_i64;
    let mut offsets = Vec::new();
    let mut errors = Vec::new();
    let mut updates = Vec::new();
    let mut truth = Vec::new();
    for event in read_events(file).expect("a recording") {
        let EventPayload::Message {
            topic,
            header,
            telemetry,
            ..
        } = event.expect("a good event").payload
        else {
            continue;
        };
        match *telemetry {
            Telemetry::Truth(true_motion) => truth.push((header.sensor, true_motion.pose)),
            Telemetry::Pose(pose) if topic == Topic::RecordedPose => {
                updates.push(pose.update);
                offsets.push((header.sensor, pose.pose));
            }
            _ => {}
        }
    }
    assert_eq!(
        updates,
        (updates[0]..=*updates.last().expect("poses")).collect::<Vec<_>>(),
        "no update is missed"
    );
    // The player shifts the bag's stamps to now; truth beside it tells by how much.
    let (stamp, first) = truth.first().copied().expect("truth");
    let begun = (0..400)
        .map(|step| f64::from(step) * 0.02)
        .min_by(|a, b| {
            let off = |s: f64| (true_pose(s).x - first.x).hypot(true_pose(s).y - first.y);
            off(*a).total_cmp(&off(*b))
        })
        .expect("a time");
    let shift = stamp - start - (begun * 1e9) as i64;
    for (sensor, pose) in offsets {
        let seconds = (sensor - shift - start) as f64 * 1e-9;
        let expected = true_pose(seconds);
        errors.push((pose.x - expected.x).hypot(pose.y - expected.y));
    }
    let rmse = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    (rmse, errors.len())
}

#[tokio::test(flavor = "multi_thread")]
async fn three_cars_are_recorded_without_a_gap() {
    let (endpoint, service, folder, _) = recording().await;
    let nodes: Vec<_> = ["car-1", "car-2", "car-3"]
        .map(|name| start(name, folder.path(), &endpoint))
        .into();
    wait_until("all bags have ended", || nodes.iter().all(Node::source_ended)).await;
    wait_until("nothing is missing", || {
        service.recording().is_some_and(|s| s.summary.missing() == 0)
    })
    .await;
    let summary = service
        .stop_recording()
        .await
        .expect("a recording")
        .expect("a whole file");
    for node in nodes {
        node.shutdown("test over");
    }
    service.close().await;
    assert_eq!(summary.missing(), 0, "{summary}");
    for topic in [
        Topic::RecordedPose,
        Topic::RecordedScan,
        Topic::RecordedOdometry,
        Topic::Event,
        Topic::Health,
    ] {
        let streams: Vec<_> = summary.streams.iter().filter(|s| s.topic == topic).collect();
        assert_eq!(streams.len(), 3, "{topic}");
        assert!(
            streams.iter().all(|s| s.gaps.first == 1),
            "{topic} from its first message: {summary}"
        );
    }
}
