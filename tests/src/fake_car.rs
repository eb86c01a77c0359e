//! A car without a localizer: it drives in a circle, publishes messages and executes commands.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use car_node::telemetry::replay_buffer::ReplayBuffer;
use car_node::telemetry::shared_state::DEFAULT_RATES;
use keys::{Protection, Side};
use pitwall::unix_now;
use protocol::{
    Action, Answer, Candidate, CarInfo, CarName, Cell, ClockReply, ClockRequest, Cloud, CloudParticle,
    Command, Covariance, Drops, EndPoint, EndPointKind, Event, EventKind, Health, Key, Latency, Load,
    MapRaceline, MapReply, Message, Metrics, MissingRequest, Outcome, ParameterSet, Params, ParamsAction,
    Pose, Pose2, PoseKind, Rates, RatesAction, RecordedOdometry, RecordedScan, RelocalizeAction, Reply,
    ScanView, SetRef, Stamps, State, Topic, TrackPoint, Truth, Twist2, Value, decode, encode,
};
use tokio::task::JoinHandle;
use zenoh::{Config, Session};

/// The faults of a fake car.
#[derive(Debug, Clone, Copy, Default)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "each is a fault of its own, and they can be combined"
)]
pub struct Behaviour {
    /// It does not answer commands.
    pub ignores_commands: bool,
    /// Its load messages are malformed.
    pub malformed_load: bool,
    /// Its health messages have a version that no pit wall knows.
    pub newer_health: bool,
    /// It sends messages of the full-rate streams only on request, as a car does over a slow link.
    pub withholds_recorded: bool,
    /// Its run; by default the time of its start.
    pub run_id: Option<u64>,
    /// It is of a version without liveliness tokens of runs.
    pub without_run_token: bool,
    /// It sends scans and all that a real car does at full rate, too.
    pub full_rate: bool,
    /// It sends ten poses and two health messages a second, and once a second what it is.
    pub light: bool,
    /// Its distance behind the other cars on the lap, in updates of 25 ms.
    pub updates_behind: u64,
}

/// A running fake car. Dropping it ends it abruptly.
pub struct FakeCar {
    name: CarName,
    state: Arc<Mutex<CarState>>,
    running: Arc<AtomicBool>,
    driver: Option<JoinHandle<()>>,
    session: Session,
}

/// The numbers of the messages sent, and the set in force.
struct CarState {
    published: BTreeMap<Topic, u64>,
    /// The messages of the recovered streams.
    archive: ReplayBuffer,
    set: SetRef,
    who: String,
    run_id: u64,
    rates: Rates,
}

impl CarState {
    fn stamps(&mut self, topic: Topic) -> Stamps {
        let sequence = self.published.entry(topic).or_default();
        *sequence += 1;
        let now = unix_now();
        Stamps {
            run_id: self.run_id,
            sequence: *sequence,
            sensor: now - 2_000_000,
            published: now,
        }
    }
}

/// The sets on the car.
const SETS: [&str; 2] = ["hq", "lq"];

impl FakeCar {
    /// A car with the name `mute` that answers no command.
    pub async fn start_mute(endpoint: &str) -> Self {
        let behaviour = Behaviour {
            ignores_commands: true,
            ..Behaviour::default()
        };
        Self::start("mute", endpoint, behaviour).await
    }

    /// Connects to the pit wall at `endpoint` and starts to drive.
    pub async fn start(name: &str, endpoint: &str, behaviour: Behaviour) -> Self {
        Self::start_protected(name, endpoint, behaviour, &Protection::None).await
    }

    /// The same with keys or a passphrase.
    pub async fn start_protected(
        name: &str,
        endpoint: &str,
        behaviour: Behaviour,
        protection: &Protection,
    ) -> Self {
        let name = CarName::new(name).expect("a good name");
        let mut config = config(endpoint);
        let settings = protection.settings(&Side::Car(name.clone())).expect("settings");
        for (key, value) in &settings.entries {
            config.insert_json5(key, value).expect("a good setting");
        }
        let session = zenoh::open(config).await.expect("a session");
        let run_id = behaviour.run_id.unwrap_or_else(|| unix_now() as u64);
        let state = Arc::new(Mutex::new(CarState {
            published: BTreeMap::new(),
            archive: ReplayBuffer::default(),
            set: SetRef {
                name: "hq".into(),
                revision: 1,
            },
            who: "start".into(),
            run_id,
            rates: DEFAULT_RATES,
        }));
        let running = Arc::new(AtomicBool::new(true));
        let topics = Topics::declare(&session, &name, run_id, behaviour).await;
        declare_queryables(&session, &name, &state, behaviour).await;
        let driver = tokio::spawn(drive(topics, state.clone(), running.clone(), behaviour));
        Self {
            name,
            state,
            running,
            driver: Some(driver),
            session,
        }
    }

    /// Its name.
    pub fn name(&self) -> &CarName {
        &self.name
    }

    /// The number of the last message on each topic.
    pub fn published(&self) -> BTreeMap<Topic, u64> {
        self.state.lock().expect("no panic").published.clone()
    }

    /// The set in force.
    pub fn set(&self) -> SetRef {
        self.state.lock().expect("no panic").set.clone()
    }

    /// The telemetry rates that it was given. It sends at its own, whatever they are.
    pub fn rates(&self) -> Rates {
        self.state.lock().expect("no panic").rates
    }

    /// Stops publishing. Returns the last number of each topic. Lost messages can still be requested.
    pub async fn stop_driving(&mut self) -> BTreeMap<Topic, u64> {
        self.running.store(false, Ordering::Relaxed);
        if let Some(driver) = self.driver.take() {
            driver.await.expect("the driving task did not panic");
        }
        self.published()
    }

    /// Stops driving and disconnects.
    pub async fn leave(mut self) {
        self.stop_driving().await;
        self.session.close().await.expect("closed");
    }
}

impl Drop for FakeCar {
    fn drop(&mut self) {
        self.running.store(false, Ordering::Relaxed);
    }
}

fn config(endpoint: &str) -> Config {
    let mut config = Config::default();
    for (key, value) in [
        ("mode", r#""peer""#.to_owned()),
        ("connect/endpoints", format!(r#"["{endpoint}"]"#)),
        ("connect/exit_on_failure", "false".to_owned()),
        (
            "connect/retry",
            r#"{"period_init_ms":100,"period_max_ms":500,"period_increase_factor":2}"#.to_owned(),
        ),
        ("listen/endpoints", "[]".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        ("timestamping/enabled", "true".to_owned()),
        ("transport/link/tx/lease", "4000".to_owned()),
    ] {
        config.insert_json5(key, &value).expect("a good setting");
    }
    config
}

struct Topics {
    session: Session,
    name: CarName,
    withholds_recorded: bool,
    newer_health: bool,
    _alive: Vec<zenoh::liveliness::LivelinessToken>,
}

impl Topics {
    async fn declare(session: &Session, name: &CarName, run_id: u64, behaviour: Behaviour) -> Self {
        let key = |topic| Key::new(name.clone(), topic).to_string();
        let alive = session
            .liveliness()
            .declare_token(key(Topic::Alive))
            .await
            .expect("a token");
        let mut tokens = vec![alive];
        if !behaviour.without_run_token {
            let token = Key::run_token(name, run_id);
            let token = session.liveliness().declare_token(token).await;
            tokens.push(token.expect("a token"));
        }
        Self {
            session: session.clone(),
            name: name.clone(),
            withholds_recorded: behaviour.withholds_recorded,
            newer_health: behaviour.newer_health,
            _alive: tokens,
        }
    }

    async fn put(&self, topic: Topic, message: &impl Message, state: &Mutex<CarState>) {
        let stamps = state.lock().expect("no panic").stamps(topic);
        let mut bytes = encode(message, stamps).expect("a good message");
        if self.newer_health && topic == Topic::Health {
            // Behind the magic and the schema.
            bytes[6..8].copy_from_slice(&99_u16.to_le_bytes());
        }
        if topic.recovered() {
            let mut state = state.lock().expect("no panic");
            state.archive.keep(topic, stamps.sequence, bytes.clone());
        }
        if topic.recorded() && self.withholds_recorded {
            return;
        }
        let key = Key::new(self.name.clone(), topic).to_string();
        self.session.put(key, bytes).await.expect("sent");
    }
}

/// 40 poses a second, everything else at its rate.
async fn drive(topics: Topics, state: Arc<Mutex<CarState>>, running: Arc<AtomicBool>, behaviour: Behaviour) {
    if behaviour.light {
        return drive_light(&topics, &state, &running, behaviour).await;
    }
    let mut ticks = tokio::time::interval(Duration::from_millis(25));
    let mut update = 0;
    while running.load(Ordering::Relaxed) {
        ticks.tick().await;
        update += 1;
        // A car starts in lap 1. Cars behind it are still in the lap before.
        let way = update + 80 - behaviour.updates_behind % 80;
        let pose = pose(update, way);
        topics.put(Topic::Pose, &pose, &state).await;
        topics.put(Topic::RecordedPose, &pose, &state).await;
        let odometry = RecordedOdometry {
            pose: pose.pose,
            twist: pose.twist,
        };
        topics.put(Topic::RecordedOdometry, &odometry, &state).await;
        if behaviour.full_rate {
            let truth = Truth {
                pose: pose.pose,
                twist: pose.twist,
            };
            topics.put(Topic::RecordedTruth, &truth, &state).await;
            topics
                .put(Topic::RecordedScan, &recorded_scan(update), &state)
                .await;
            topics.put(Topic::RecordedHealth, &health(update), &state).await;
        }
        if update % 4 == 1 {
            topics.put(Topic::Health, &health(update), &state).await;
            topics.put(Topic::Cloud, &cloud(&pose, update), &state).await;
            topics.put(Topic::Scan, &scan_view(&pose), &state).await;
        }
        if update % 40 == 1 {
            let params = params(&state.lock().expect("no panic"));
            topics.put(Topic::Params, &params, &state).await;
            if !behaviour.malformed_load {
                topics.put(Topic::Load, &load(), &state).await;
            }
        }
        if way.is_multiple_of(80) && way > 80 {
            let kind = EventKind::Lap {
                lap: (way / 80 - 1) as u32,
                time: Some(2.0),
                set: "hq".into(),
            };
            let event = Event {
                kind,
                update,
                who: None,
                command: None,
            };
            topics.put(Topic::Event, &event, &state).await;
        }
        if behaviour.malformed_load && update % 40 == 1 {
            let load = Key::new(topics.name.clone(), Topic::Load).to_string();
            topics.session.put(load, vec![0xff; 50]).await.expect("sent");
        }
    }
}

/// The same way with few messages.
async fn drive_light(topics: &Topics, state: &Mutex<CarState>, running: &AtomicBool, behaviour: Behaviour) {
    let mut ticks = tokio::time::interval(Duration::from_millis(100));
    let mut update = 0;
    while running.load(Ordering::Relaxed) {
        ticks.tick().await;
        update += 4;
        let pose = pose(update, update + 80 - behaviour.updates_behind % 80);
        topics.put(Topic::Pose, &pose, state).await;
        if update % 20 == 4 {
            topics.put(Topic::Health, &health(update), state).await;
        }
        if update % 40 == 4 {
            let params = params(&state.lock().expect("no panic"));
            topics.put(Topic::Params, &params, state).await;
            topics.put(Topic::Load, &load(), state).await;
        }
    }
}

/// Radius of the line that it drives \[m\], in a ring of walls a metre to either side.
const RADIUS: f64 = 3.0;

/// The pose at a step of its way. A lap has 80 steps and takes 2 s.
fn pose(update: u64, way: u64) -> Pose {
    let angle = (way % 80) as f64 / 80.0 * TAU;
    Pose {
        pose: Pose2 {
            x: RADIUS * angle.cos(),
            y: RADIUS * angle.sin(),
            heading: (angle + TAU / 4.0 + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0,
        },
        twist: Twist2 {
            linear_x: RADIUS * TAU / 2.0,
            linear_y: 0.0,
            angular: TAU / 2.0,
        },
        covariance: Covariance {
            xx: 0.01,
            yy: 0.01,
            hh: 0.001,
            ..Covariance::default()
        },
        track: Some(TrackPoint {
            s: RADIUS * angle,
            d: 0.0,
        }),
        lap: (way / 80) as u32,
        update,
        kind: PoseKind::Updated,
    }
}

/// The map: a ring.
fn ring() -> MapReply {
    const CELLS: u32 = 200;
    const CELL: f64 = 0.05;
    let half = f64::from(CELLS) * CELL / 2.0;
    let cell = |i: u32| {
        let at = |k: u32| (f64::from(k) + 0.5) * CELL - half;
        let r = at(i % CELLS).hypot(at(i / CELLS));
        match (r - RADIUS).abs() {
            off if off < 0.95 => Cell::Free,
            off if off < 1.05 => Cell::Occupied,
            _ => Cell::Unknown,
        }
    };
    let point = |i: u32| {
        let angle = f64::from(i) / 120.0 * TAU;
        [(RADIUS * angle.cos()) as f32, (RADIUS * angle.sin()) as f32]
    };
    MapReply {
        name: "ring".into(),
        width: CELLS,
        height: CELLS,
        resolution: CELL,
        origin: Pose2 {
            x: -half,
            y: -half,
            heading: 0.0,
        },
        runs: MapReply::pack((0..CELLS * CELLS).map(cell)),
        raceline: Some(MapRaceline {
            length: RADIUS * TAU,
            points: (0..120).map(point).collect(),
        }),
    }
}

/// As many end points as a real car sends, on both walls.
fn scan_view(pose: &Pose) -> ScanView {
    let centre = [pose.pose.x, pose.pose.y];
    let point = |i: usize| {
        let angle = i as f64 / 100.0 * TAU;
        let r = if i.is_multiple_of(2) {
            RADIUS - 1.0
        } else {
            RADIUS + 1.0
        };
        EndPoint::quantise([r * angle.cos(), r * angle.sin()], centre, EndPointKind::OnWall)
    };
    ScanView {
        update: pose.update,
        centre,
        points: (0..100).map(point).collect(),
    }
}

/// A scan of a usual laser between the walls, with a few millimetres of noise.
fn recorded_scan(update: u64) -> RecordedScan {
    const BEAMS: u64 = 1081;
    let mut bits = update.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let range = |beam: u64| {
        bits ^= bits << 13;
        bits ^= bits >> 7;
        bits ^= bits << 17;
        let wave = (beam as f64 / 90.0).sin().abs() * 3000.0;
        1000 + wave as u16 + (bits % 16) as u16
    };
    RecordedScan {
        angle_min: -2.356,
        angle_increment: 0.004_36,
        time_increment: 0.0,
        range_min: 0.06,
        range_max: 30.0,
        ranges: (0..BEAMS).map(range).collect(),
    }
}

/// The load of a car on a machine of its own.
pub(crate) fn load() -> Load {
    let latency = Latency {
        p50: 200.0,
        p99: 400.0,
        max: 900.0,
    };
    Load {
        cpu_process: 0.2,
        cpu_cores: vec![0.3; 4],
        memory_process: 90_000_000,
        memory_used: 900_000_000,
        memory_total: 4_000_000_000,
        temperature: Some(61.0),
        throttled: Some(false),
        update_us: latency,
        scan_age_us: latency,
        publish_lag_us: latency,
        scan_rate: 40.0,
        odometry_rate: 50.0,
        update_rate: 40.0,
        scan_jitter: 0.001,
        queue_depth: 0,
        drops: Drops::default(),
        recorder: None,
    }
}

fn health(update: u64) -> Health {
    Health {
        state: State::Localized,
        since: unix_now(),
        causes: Vec::new(),
        update,
        metrics: Some(Metrics {
            alignment: 0.9,
            ..Metrics::default()
        }),
        proposal: None,
        auto: false,
    }
}

fn cloud(pose: &Pose, update: u64) -> Cloud {
    let centre = [pose.pose.x, pose.pose.y];
    Cloud {
        update,
        count: 3000,
        ess_ratio: 0.5,
        spread_along: 0.1,
        spread_across: 0.1,
        second_mode: 0.0,
        centre,
        particles: vec![CloudParticle::quantise(pose.pose, centre, 1.0); 100],
    }
}

fn parameter_set(name: &str) -> ParameterSet {
    ParameterSet {
        name: name.to_owned(),
        values: vec![("max_particles".into(), Value::Int(3000))],
    }
}

fn params(state: &CarState) -> Params {
    Params {
        set: parameter_set(&state.set.name),
        revision: state.set.revision,
        who: state.who.clone(),
        when: unix_now(),
        since_update: 1,
        pending_revert: None,
        available: SETS.map(str::to_owned).to_vec(),
    }
}

async fn declare_queryables(
    session: &Session,
    name: &CarName,
    state: &Arc<Mutex<CarState>>,
    behaviour: Behaviour,
) {
    let key = |topic| Key::new(name.clone(), topic).to_string();
    let info = CarInfo {
        version: "0.1.0".into(),
        started: 1,
        source: "circle".into(),
        map: "ring".into(),
        lap_length: Some(RADIUS * TAU),
        base_link_from_laser: Pose2::default(),
        host: "test".into(),
    };
    reply_with(
        session,
        key(Topic::Info),
        encode(&info, Stamps::default()).expect("good"),
    )
    .await;
    reply_with(
        session,
        key(Topic::Map),
        encode(&ring(), Stamps::default()).expect("good"),
    )
    .await;
    let clock = key(Topic::Clock);
    let on = clock.clone();
    session
        .declare_queryable(&on)
        .callback(move |query| {
            let received = unix_now();
            let payload = query
                .payload()
                .map(|p| p.to_bytes().into_owned())
                .unwrap_or_default();
            // Like a real car, it does not answer what it cannot read.
            let Ok((_, request)) = decode::<ClockRequest>(&payload) else {
                return;
            };
            let reply = ClockReply {
                sent: request.sent,
                received,
                answered: unix_now(),
            };
            respond(&query, &clock, encode(&reply, Stamps::default()).expect("good"));
        })
        .background()
        .await
        .expect("a queryable");
    let missing = key(Topic::Missing);
    let (on, sent) = (missing.clone(), state.clone());
    session
        .declare_queryable(&on)
        .callback(move |query| {
            let payload = query
                .payload()
                .map(|p| p.to_bytes().into_owned())
                .unwrap_or_default();
            let Ok((_, request)) = decode::<MissingRequest>(&payload) else {
                return;
            };
            let state = sent.lock().expect("no panic");
            let reply = state.archive.find(state.run_id, &request);
            let stamps = Stamps {
                run_id: state.run_id,
                published: unix_now(),
                ..Stamps::default()
            };
            drop(state);
            respond(&query, &missing, encode(&reply, stamps).expect("good"));
        })
        .background()
        .await
        .expect("a queryable");
    for topic in [
        Topic::CmdParams,
        Topic::CmdPose,
        Topic::CmdRelocalize,
        Topic::CmdRates,
    ] {
        execute_on(session, key(topic), state.clone(), behaviour).await;
    }
}

async fn execute_on(session: &Session, commands: String, state: Arc<Mutex<CarState>>, behaviour: Behaviour) {
    let on = commands.clone();
    let unanswered = Mutex::new(Vec::new());
    session
        .declare_queryable(&on)
        .callback(move |query| {
            if behaviour.ignores_commands {
                // Dropping a query ends it without a reply. Keeping it leaves it open.
                unanswered.lock().expect("no panic").push(query);
                return;
            }
            let payload = query
                .payload()
                .map(|p| p.to_bytes().into_owned())
                .unwrap_or_default();
            // Like a real car, it does not execute what it cannot read.
            let Ok((_, command)) = decode::<Command>(&payload) else {
                return;
            };
            let answer = execute(&mut state.lock().expect("no panic"), &command);
            respond(
                &query,
                &commands,
                encode(&answer, Stamps::default()).expect("good"),
            );
        })
        .background()
        .await
        .expect("a queryable");
}

async fn reply_with(session: &Session, key: String, bytes: Vec<u8>) {
    let on = key.clone();
    session
        .declare_queryable(&on)
        .callback(move |query| respond(&query, &key, bytes.clone()))
        .background()
        .await
        .expect("a queryable");
}

fn respond(query: &zenoh::query::Query, key: &str, bytes: Vec<u8>) {
    use zenoh::Wait;
    // The querier may be gone, or the session closing.
    drop(query.reply(key, bytes).wait());
}

fn execute(state: &mut CarState, command: &Command) -> Answer {
    let outcome = match (&command.action, command.expected_revision) {
        (_, Some(expected)) if expected != state.set.revision => Outcome::StaleRevision {
            expected,
            who: state.who.clone(),
        },
        (Action::Params(ParamsAction::Select { name, .. }), _) if SETS.contains(&name.as_str()) => {
            state.set = SetRef {
                name: name.clone(),
                revision: state.set.revision + 1,
            };
            state.who.clone_from(&command.operator);
            Outcome::Done {
                update: Some(1),
                reply: Reply::Nothing,
            }
        }
        (Action::Params(ParamsAction::Select { name, .. }), _) => Outcome::Refused {
            faults: vec![format!("no set {name}")],
        },
        (Action::Relocalize(RelocalizeAction::Search), _) => Outcome::Done {
            update: None,
            reply: Reply::Candidates((1..=3).map(candidate).collect()),
        },
        (Action::Rates(action), _) => {
            if let RatesAction::Set(rates) = action {
                state.rates = *rates;
            }
            Outcome::Done {
                update: None,
                reply: Reply::Rates(state.rates),
            }
        }
        (Action::Pose(_) | Action::Relocalize(_), _) => Outcome::Done {
            update: Some(1),
            reply: Reply::Nothing,
        },
        _ => Outcome::Refused {
            faults: vec!["not on this car".into()],
        },
    };
    Answer {
        id: command.id,
        outcome,
        set: state.set.clone(),
    }
}

/// A possible pose: one of three places of the ring that look alike.
fn candidate(number: u32) -> Candidate {
    let pose = pose(0, u64::from(number) * 26).pose;
    Candidate {
        number,
        pose,
        score: 0.9 - 0.1 * number as f32,
    }
}
