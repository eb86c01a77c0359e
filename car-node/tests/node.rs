//! A whole car on a simulated track, seen from the network: a router on loopback stands in for the pit wall.

mod common;

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use car_node::node::{Node, NodeConfig, RaceMap};
use car_node::sensors::clock::SensorClock;
use car_node::sensors::frames::Mount;
use car_node::sensors::{Feed, Next, PoseEstimate, Race, SimulatedCar, Source};
use common::router;
use protocol::{
    Action, Answer, CarName, Command, CommandId, Event, EventKind, Health, Key, LinkReport, Message,
    MissingReply, MissingRequest, Outcome, ParameterSet, Params, ParamsAction, Pose, Rates, RatesAction,
    Reply, Shadow, Stamps, State, Topic, Value, Wanted, decode, encode,
};
use simulator::{CarSetup, Track};
use synpf::TrackMap;
use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;
use zenoh::{Config, Session, Wait};

const DEADLINE: Duration = Duration::from_secs(30);

/// The pit wall's end of the network.
struct Wall {
    session: Session,
    endpoint: String,
}

impl Wall {
    fn open() -> Self {
        let (session, endpoint) = router();
        Self { session, endpoint }
    }

    fn subscribe(&self, car: &CarName, topic: Topic) -> Subscriber<FifoChannelHandler<Sample>> {
        self.session
            .declare_subscriber(Key::new(car.clone(), topic).to_string())
            .with(zenoh::handlers::FifoChannel::new(65536))
            .wait()
            .expect("subscribes")
    }

    /// Waits until a car is on the network.
    fn wait_for(&self, car: &CarName) {
        let key = Key::new(car.clone(), Topic::Alive).to_string();
        let until = Instant::now() + DEADLINE;
        loop {
            let tokens = self.session.liveliness().get(&key).wait().expect("asks");
            if tokens.recv().is_ok_and(|reply| reply.result().is_ok()) {
                return;
            }
            assert!(Instant::now() < until, "{car} does not come");
        }
    }

    /// Queries a car. None without a reply, Err for a reply that refuses the query.
    fn ask(&self, key: &str, payload: Vec<u8>) -> Option<Result<Vec<u8>, String>> {
        let replies = self
            .session
            .get(key)
            .payload(payload)
            .timeout(Duration::from_secs(10))
            .wait()
            .expect("asks");
        let reply = replies.recv().ok()?;
        Some(match reply.into_result() {
            Ok(sample) => Ok(sample.payload().to_bytes().to_vec()),
            Err(error) => Err(String::from_utf8_lossy(&error.payload().to_bytes()).into_owned()),
        })
    }

    fn command(&self, car: &CarName, id: u128, expected: Option<u64>, action: Action) -> Answer {
        let topic = action.topic();
        let command = Command {
            id: CommandId(id),
            operator: "anna".into(),
            expected_revision: expected,
            action,
        };
        let stamps = Stamps {
            run_id: 1,
            sequence: 1,
            sensor: 0,
            published: 0,
        };
        let bytes = encode(&command, stamps).expect("encodes");
        let answer = self
            .ask(&Key::new(car.clone(), topic).to_string(), bytes)
            .expect("an answer")
            .expect("a readable command");
        let (_, answer) = decode::<Answer>(&answer).expect("an Answer");
        assert_eq!(answer.id, CommandId(id));
        answer
    }
}

fn next<M: Message>(
    subscriber: &Subscriber<FifoChannelHandler<Sample>>,
    wanted: impl Fn(&M) -> bool,
) -> (protocol::Header, M) {
    let until = Instant::now() + DEADLINE;
    while let Ok(Some(sample)) = subscriber.recv_deadline(until) {
        let (header, message) = decode::<M>(&sample.payload().to_bytes()).expect("a message");
        if wanted(&message) {
            return (header, message);
        }
    }
    panic!("nothing of the kind within {DEADLINE:?}");
}

fn tracks() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../maps/tracks")
}

fn start(name: &str, wall: &Wall, change: impl FnOnce(&mut NodeConfig)) -> (Node, CarName) {
    let track = Track::load(tracks().join("club"), None).expect("bundled");
    let map = RaceMap {
        name: track.name.clone(),
        map: Arc::new(TrackMap::new(track.grid.clone()).expect("free cells")),
        raceline: Some(Arc::new(track.raceline.clone())),
    };
    let race = Race::new(track, vec![CarSetup::default()], 1, Vec::new());
    let car = CarName::new(name).expect("a name");
    let mut config = NodeConfig::new(car.clone(), map, Box::new(race.car(0)));
    config.connect = vec![wall.endpoint.clone()];
    change(&mut config);
    (Node::start(config).expect("starts"), car)
}

/// Starts a car, and waits until it takes commands.
fn start_and_wait(name: &str, wall: &Wall, change: impl FnOnce(&mut NodeConfig)) -> (Node, CarName) {
    let (node, car) = start(name, wall, change);
    wall.wait_for(&car);
    (node, car)
}

fn select(name: &str, revert_after_ms: Option<u32>) -> Action {
    Action::Params(ParamsAction::Select {
        name: name.into(),
        revert_after_ms,
    })
}

fn revision(answer: &Answer) -> u64 {
    answer.set.revision
}

/// A simulated car that gets initial poses and requests from its own network.
struct WithRequests {
    car: SimulatedCar,
    /// Every hundredth message is replaced by one of these.
    requests: VecDeque<Feed>,
    messages: usize,
}

impl Source for WithRequests {
    fn description(&self) -> String {
        self.car.description()
    }

    fn mount(&self) -> Mount {
        self.car.mount()
    }

    fn clock(&mut self, rate: f64) -> SensorClock {
        self.car.clock(rate)
    }

    fn start(&self) -> Option<maps::Pose> {
        self.car.start()
    }

    fn next(&mut self, estimate: Option<PoseEstimate>) -> Next {
        self.messages += 1;
        let next = self.car.next(estimate);
        match next {
            Next::Due(due, _) if self.messages.is_multiple_of(100) => match self.requests.pop_front() {
                Some(request) => Next::Due(due, request),
                None => next,
            },
            _ => next,
        }
    }
}

#[test]
fn initial_poses_and_searches_from_the_car_are_events_at_the_pit_wall() {
    let wall = Wall::open();
    let name = CarName::new("oscar").expect("a name");
    let events = wall.subscribe(&name, Topic::Event);
    let (node, _) = start("oscar", &wall, |config| {
        let track = Track::load(tracks().join("club"), None).expect("bundled");
        let race = Race::new(track, vec![CarSetup::default()], 1, Vec::new());
        let car = race.car(0);
        let on_the_map = car.start().expect("known");
        config.source = Box::new(WithRequests {
            car,
            requests: VecDeque::from([
                Feed::InitialPose {
                    pose: maps::Pose::new(1e4, 0.0, 0.0),
                    by: "/initialpose".into(),
                },
                Feed::InitialPose {
                    pose: on_the_map,
                    by: "/initialpose".into(),
                },
                Feed::GlobalSearch {
                    by: "/clicked_point".into(),
                },
            ]),
            messages: 0,
        });
    });
    // The pose off the map used to be dropped without an event.
    let relevant = |event: &Event| {
        matches!(
            event.kind,
            EventKind::Warning { .. } | EventKind::PoseInitialized { .. } | EventKind::SearchStarted
        )
    };
    let (_, refused) = next::<Event>(&events, relevant);
    assert!(
        matches!(&refused.kind, EventKind::Warning { text } if text.contains("initial pose refused")),
        "{refused:?}"
    );
    assert_eq!(refused.who.as_deref(), Some("/initialpose"));
    let (_, taken) = next::<Event>(&events, relevant);
    assert!(
        matches!(taken.kind, EventKind::PoseInitialized { .. }),
        "{taken:?}"
    );
    assert_eq!(taken.who.as_deref(), Some("/initialpose"));
    let (_, search) = next::<Event>(&events, relevant);
    assert!(matches!(search.kind, EventKind::SearchStarted), "{search:?}");
    assert_eq!(search.who.as_deref(), Some("/clicked_point"));
    node.shutdown("test over");
}

#[test]
fn a_car_publishes_from_its_first_pose_to_its_end() {
    let wall = Wall::open();
    let car = CarName::new("alpha").expect("a name");
    let poses = wall.subscribe(&car, Topic::Pose);
    let health = wall.subscribe(&car, Topic::Health);
    let events = wall.subscribe(&car, Topic::Event);
    let scans = wall.subscribe(&car, Topic::RecordedScan);
    let (node, _) = start("alpha", &wall, |_| ());

    let (first, pose) = next::<Pose>(&poses, |_| true);
    assert!(pose.track.is_some(), "the raceline is known");
    let (later, pose) = next::<Pose>(&poses, |pose| pose.update > 40);
    assert_eq!(later.run_id, first.run_id);
    assert!(pose.pose.x.is_finite());
    assert!(later.sensor > first.sensor && later.published > later.sensor);
    next::<Health>(&health, |health| {
        health.state == State::Localized && health.metrics.is_some()
    });
    next::<Event>(&events, |event| matches!(event.kind, EventKind::Started { .. }));
    next::<protocol::RecordedScan>(&scans, |scan| scan.ranges.len() == 1081);

    let map = wall
        .ask(&Key::new(car.clone(), Topic::Map).to_string(), Vec::new())
        .expect("an answer")
        .expect("a map");
    let (_, map) = decode::<protocol::MapReply>(&map).expect("a map");
    assert_eq!(map.name, "club");
    assert!(map.raceline.is_some());

    let before = Instant::now();
    node.shutdown("test over");
    assert!(before.elapsed() < Duration::from_secs(5), "ends in time");
    next::<Event>(&events, |event| matches!(event.kind, EventKind::Stopping { .. }));
}

#[test]
fn sets_are_switched_on_a_running_car() {
    let wall = Wall::open();
    let (node, car) = start_and_wait("bravo", &wall, |_| ());
    let params = wall.subscribe(&car, Topic::Params);
    // The recorder's stream: the live one skips poses when the machine is busy.
    let poses = wall.subscribe(&car, Topic::RecordedPose);
    next::<Pose>(&poses, |pose| pose.update > 5);

    let answer = wall.command(&car, 1, None, select("lq", None));
    let Outcome::Done {
        update: Some(update), ..
    } = answer.outcome
    else {
        panic!("{answer:?}");
    };
    assert!(update > 5);
    assert_eq!(answer.set.name, "lq");
    let (_, told) = next::<Params>(&params, |params| params.set.name == "lq");
    assert_eq!((told.revision, told.who.as_str()), (revision(&answer), "anna"));

    // A repeated command gets the same answer, and is not executed again.
    assert_eq!(wall.command(&car, 1, None, select("lq", None)), answer);
    // A command with an old revision is refused as stale.
    let stale = wall.command(&car, 2, Some(revision(&answer) - 1), select("hq", None));
    assert!(
        matches!(stale.outcome, Outcome::StaleRevision { .. }),
        "{stale:?}"
    );
    assert_eq!(stale.set, answer.set);
    let unknown = wall.command(&car, 3, None, select("wet", None));
    let Outcome::Refused { faults } = unknown.outcome else {
        panic!("{unknown:?}");
    };
    assert!(
        faults[0].contains("wet") && faults[0].contains("adaptive"),
        "{faults:?}"
    );

    // A trial that nobody confirms is reverted.
    let trial = wall.command(&car, 4, Some(revision(&answer)), select("adaptive", Some(300)));
    assert_eq!(trial.set.name, "adaptive");
    let (_, told) = next::<Params>(&params, |params| params.revision > revision(&trial));
    assert_eq!(told.set.name, "lq");

    // No update was missed through all of this.
    node.shutdown("test over");
    let mut last = None;
    while let Ok(Some(sample)) = poses.try_recv() {
        let (header, pose) = decode::<Pose>(&sample.payload().to_bytes()).expect("a pose");
        if let Some((sequence, update)) = last {
            assert_eq!(header.sequence, sequence + 1);
            assert_eq!(pose.update, update + 1);
        }
        last = Some((header.sequence, pose.update));
    }
    assert!(last.is_some());
}

#[test]
fn a_set_put_on_the_car_survives_a_restart() {
    let wall = Wall::open();
    let folder = tempfile::tempdir().expect("folder");
    let state = |config: &mut NodeConfig| config.state = Some(folder.path().into());
    let (node, car) = start_and_wait("charlie", &wall, state);
    let put = |name: &str, value: Value| {
        Action::Params(ParamsAction::Put {
            set: ParameterSet {
                name: name.into(),
                values: vec![("max_particles".into(), value)],
            },
            revert_after_ms: None,
        })
    };
    let faulty = wall.command(&car, 1, None, put("mine", Value::Text("many".into())));
    assert!(matches!(faulty.outcome, Outcome::Refused { .. }), "{faulty:?}");
    let events = wall.subscribe(&car, Topic::Event);
    let answer = wall.command(&car, 2, None, put("mine", Value::Int(1400)));
    assert!(matches!(answer.outcome, Outcome::Done { .. }), "{answer:?}");
    // The changes: against the set in force, and then against its own earlier values.
    let stored = |expected: &str| {
        let (_, event) = next::<Event>(&events, |event| matches!(event.kind, EventKind::SetStored { .. }));
        assert_eq!(event.kind.to_string(), expected);
    };
    stored("set mine stored from hq with max_particles 1500 -> 1400");
    wall.command(&car, 20, None, put("mine", Value::Int(1300)));
    stored("set mine replaced: max_particles 1400 -> 1300");
    let answer = wall.command(&car, 21, None, put("mine", Value::Int(1500)));
    // A repeated command gets the same answer. Another command with its id is refused.
    assert_eq!(
        wall.command(&car, 21, None, put("mine", Value::Int(1500))),
        answer
    );
    let refused = |answer: Answer| matches!(&answer.outcome, Outcome::Refused { faults } if faults[0].contains("another command"));
    assert!(refused(wall.command(&car, 21, None, select("lq", None))));
    node.shutdown("test over");

    let (node, car) = start_and_wait("charlie", &wall, state);
    let list = wall.command(&car, 3, None, Action::Params(ParamsAction::List));
    assert_eq!(list.set.name, "mine", "what was in force is in force again");
    assert!(revision(&list) > revision(&answer));
    assert!(
        refused(wall.command(&car, 21, None, select("lq", None))),
        "after a restart, too"
    );
    let Outcome::Done {
        reply: Reply::Sets(sets),
        ..
    } = list.outcome
    else {
        panic!("no list");
    };
    let mine = sets
        .iter()
        .find(|stored| stored.set.name == "mine")
        .expect("kept");
    assert!(
        mine.set
            .values
            .contains(&("max_particles".into(), Value::Int(1500)))
    );
    assert_eq!(mine.who.as_deref(), Some("anna"));
    node.shutdown("test over");
}

#[test]
fn malformed_messages_are_refused_and_the_car_drives_on() {
    let wall = Wall::open();
    let (node, car) = start_and_wait("delta", &wall, |_| ());
    let load = wall.subscribe(&car, Topic::Load);
    let key = |topic: Topic| Key::new(car.clone(), topic).to_string();
    let mut rubbish: Vec<Vec<u8>> = vec![vec![], vec![0; 3], vec![0xff; 100_000], b"SYPF".to_vec()];
    // Bytes from a fixed sequence, some of them after a valid header.
    let stamps = Stamps {
        run_id: 1,
        sequence: 1,
        sensor: 0,
        published: 0,
    };
    let header = protocol::Header::new(protocol::Schema::Command, 1, stamps).to_bytes();
    let mut state = 1_u64;
    for length in [1, 17, 40, 64, 300] {
        let noise: Vec<u8> = (0..length)
            .map(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (state >> 56) as u8
            })
            .collect();
        rubbish.push(noise.clone());
        rubbish.push([header.as_slice(), &noise].concat());
    }
    let topics = [
        Topic::CmdParams,
        Topic::CmdPose,
        Topic::CmdRelocalize,
        Topic::CmdRates,
        Topic::CmdAuto,
    ];
    let mut sent = 0;
    for topic in topics {
        for payload in &rubbish {
            let answer = wall.ask(&key(topic), payload.clone()).expect("an answer");
            assert!(answer.is_err(), "{topic} takes {payload:?}");
            sent += 1;
        }
    }
    let (_, seen) = next::<protocol::Load>(&load, |load| load.drops.payloads >= sent);
    assert_eq!(seen.drops.payloads, sent);
    // Its rate is what it was, as soon as the machine has the time.
    next::<protocol::Load>(&load, |load| load.update_rate > 30.0);

    // A command under another command's key, and one for all cars at once.
    let command = Command {
        id: CommandId(1),
        operator: "anna".into(),
        expected_revision: None,
        action: Action::Rates(RatesAction::Set(Rates {
            pose: 0.0,
            cloud: 0.0,
            scan: 0.0,
            health: 0.0,
            recorded: false,
        })),
    };
    let bytes = encode(&command, stamps).expect("encodes");
    for key in [key(Topic::CmdAuto), "synpf/v1/*/cmd/rates".to_owned()] {
        assert!(
            wall.ask(&key, bytes.clone()).expect("an answer").is_err(),
            "{key}"
        );
    }
    let answer = wall.command(&car, 2, None, Action::Rates(RatesAction::Get));
    let Outcome::Done {
        reply: Reply::Rates(rates),
        ..
    } = answer.outcome
    else {
        panic!("{answer:?}");
    };
    assert!(rates.recorded, "nothing has changed");
    node.shutdown("test over");
}

#[test]
fn a_car_without_a_pit_wall_drives_and_ends_in_time() {
    let wall = Wall::open();
    let endpoint = wall.endpoint.clone();
    drop(wall);
    let nobody = Wall {
        session: zenoh::open(client_of_nobody()).wait().expect("a session"),
        endpoint,
    };
    let (node, _) = start("echo", &nobody, |_| ());
    let until = Instant::now() + DEADLINE;
    while node.shared().latest_pose().is_none() {
        assert!(Instant::now() < until, "no pose");
        std::thread::yield_now();
    }
    let before = Instant::now();
    node.shutdown("test over");
    assert!(before.elapsed() < Duration::from_secs(5));
}

fn client_of_nobody() -> Config {
    let mut config = Config::default();
    for (key, value) in [
        ("mode", r#""peer""#),
        ("listen/endpoints", "[]"),
        ("scouting/multicast/enabled", "false"),
    ] {
        config.insert_json5(key, value).expect("a setting");
    }
    config
}

fn shadow(name: Option<&str>) -> Action {
    Action::Params(ParamsAction::Shadow {
        name: name.map(str::to_owned),
    })
}

#[test]
fn a_set_in_the_shadow_is_compared_and_ends_when_it_is_put_in_force() {
    let wall = Wall::open();
    let (node, car) = start_and_wait("foxtrot", &wall, |_| ());
    let shadows = wall.subscribe(&car, Topic::Shadow);
    let events = wall.subscribe(&car, Topic::Event);
    let poses = wall.subscribe(&car, Topic::RecordedPose);
    next::<Pose>(&poses, |pose| pose.update > 5);

    for (id, name, word) in [
        (1, Some("wet"), "no set"),
        (2, Some("hq"), "in force"),
        (3, None, "no shadow set"),
    ] {
        let answer = wall.command(&car, id, None, shadow(name));
        let Outcome::Refused { faults } = answer.outcome else {
            panic!("{answer:?}");
        };
        assert!(faults[0].contains(word), "{faults:?}");
    }
    let mut id = 10;
    let mut begin = || {
        id += 1;
        let answer = wall.command(&car, id, None, shadow(Some("lq")));
        assert!(matches!(answer.outcome, Outcome::Done { .. }), "{answer:?}");
        assert_eq!(answer.set.name, "hq", "nothing else is in force");
    };
    begin();
    next::<Event>(&events, |event| {
        event.kind == EventKind::ShadowStarted { set: "lq".into() }
    });
    // A busy machine may drop the shadow. Then the test requests it again.
    let comparison = loop {
        let (_, told) = next::<Shadow>(&shadows, |shadow| {
            shadow.who == "load" || shadow.comparison.as_ref().is_some_and(|c| c.scans >= 40)
        });
        match told.comparison {
            Some(comparison) => break comparison,
            None => begin(),
        }
    };
    assert_eq!(comparison.in_force.name, "hq");
    assert!(
        comparison.force.alignment > 0.7 && comparison.shadow.alignment > 0.7,
        "{comparison:?}"
    );
    assert!(
        comparison.distance < 0.1 && comparison.distance > 0.0,
        "{comparison:?}"
    );
    assert!(comparison.shadow.update_us.p50 > 0.0);
    assert!(comparison.force_better + comparison.shadow_better <= 1.0);

    wall.command(&car, 100, None, select("lq", None));
    next::<Event>(
        &events,
        |event| matches!(&event.kind, EventKind::ShadowEnded { set } | EventKind::ShadowDropped { set, .. } if set == "lq"),
    );
    let (_, told) = next::<Shadow>(&shadows, |shadow| shadow.set.is_none());
    assert_eq!(told.comparison, None);
    node.shutdown("test over");
    // The set in force has missed no update.
    let mut last = None;
    while let Ok(Some(sample)) = poses.try_recv() {
        let (_, pose) = decode::<Pose>(&sample.payload().to_bytes()).expect("a pose");
        assert!(last.is_none_or(|last| pose.update == last + 1));
        last = Some(pose.update);
    }
}

#[test]
fn missing_messages_are_sent_again_on_request() {
    let wall = Wall::open();
    let (node, car) = start_and_wait("hotel", &wall, |_| ());
    let ask = |run_id: u64, ranges: Vec<[u64; 2]>| {
        let request = MissingRequest {
            run_id,
            streams: vec![Wanted {
                topic: Topic::Event,
                ranges,
            }],
            budget: 1000,
        };
        let bytes = encode(&request, Stamps::default()).expect("encodes");
        let key = Key::new(car.clone(), Topic::Missing).to_string();
        let reply = wall
            .ask(&key, bytes)
            .expect("an answer")
            .expect("a readable question");
        decode::<MissingReply>(&reply).expect("a MissingReply")
    };
    let (header, reply) = ask(0, vec![[1, 1]]);
    assert_eq!(reply.messages, [], "of another run");
    // Every stream that must be complete is kept from its first message on.
    let begun = Instant::now();
    for topic in Topic::all().filter(|topic| topic.recovered()) {
        while !ask(0, Vec::new())
            .1
            .streams
            .iter()
            .any(|kept| kept.topic == topic)
        {
            assert!(begun.elapsed() < DEADLINE, "{topic} is not kept");
        }
    }
    let (_, reply) = ask(header.run_id, vec![[1, 1]]);
    let [first] = &reply.messages[..] else {
        panic!("{reply:?}");
    };
    let (header, event) = decode::<Event>(&first.bytes).expect("as it was sent");
    assert_eq!(header.sequence, 1);
    assert!(matches!(event.kind, EventKind::Started { .. }), "{event:?}");
    node.shutdown("test over");
}

#[test]
fn rates_are_lowered_on_a_slow_link_with_an_event() {
    let wall = Wall::open();
    let (node, car) = start_and_wait("golf", &wall, |_| ());
    let events = wall.subscribe(&car, Topic::Event);
    let key = Key::new(car.clone(), Topic::Link).to_string();
    // A pit wall reports late poses until the car reacts.
    let until = |transit: f32, wanted: fn(&EventKind) -> bool| {
        let begun = Instant::now();
        loop {
            let report = LinkReport {
                transit,
                uncertainty: 0.01,
                poses: 40,
            };
            let bytes = encode(&report, Stamps::default()).expect("encodes");
            wall.session.put(&key, bytes).wait().expect("sends");
            while let Ok(Some(sample)) = events.recv_timeout(Duration::from_millis(100)) {
                let (_, event) = decode::<Event>(&sample.payload().to_bytes()).expect("an event");
                if wanted(&event.kind) {
                    return event.kind;
                }
            }
            assert!(begun.elapsed() < DEADLINE, "nothing happens");
        }
    };
    let lowered = until(0.9, |kind| matches!(kind, EventKind::RatesLowered { .. }));
    assert!(lowered.to_string().contains("slow link"), "{lowered}");
    until(0.01, |kind| *kind == EventKind::RatesRestored);
    // A malformed report is counted.
    let before = node.shared().counters.read().payloads;
    wall.session.put(&key, vec![0xff; 9]).wait().expect("sends");
    let begun = Instant::now();
    while node.shared().counters.read().payloads == before {
        assert!(begun.elapsed() < DEADLINE, "not counted");
        std::thread::yield_now();
    }
    node.shutdown("test over");
}
