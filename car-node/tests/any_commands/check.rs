//! A car's command handler, on a running filter, with any input from a network.
//!
//! Shared by the test, whose input is random, and by the fuzz target, whose input is guided by coverage.

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::Duration;

use arbitrary::{Arbitrary, Unstructured};
use car_node::control::parameter_store::ParameterStore;
use car_node::control::persisted_state::PersistedState;
use car_node::control::{CachedAnswer, CommandHandler, CommandHandlerConfig, PayloadHash};
use car_node::health::{Monitor, Thresholds};
use car_node::localization::LocalizerParameters;
use car_node::localization::filter_command::FilterCommand;
use car_node::localization::filter_worker::{self, FilterConfig};
use car_node::localization::shadow;
use car_node::localization::shadow_channel::shadow_channel;
use car_node::sensors::Feed;
use car_node::sensors::bag::SensorEvent;
use car_node::sensors::clock::SensorClock;
use car_node::telemetry::queue::Record;
use car_node::telemetry::shared_state::SharedState;
use crossbeam_channel::{Receiver, Sender, bounded};
use maps::{Cell, OccupancyGrid, Pose};
use protocol::{
    Action, Answer, Command, CommandId, Event, EventKind, Header, LinkReport, Message, Outcome, ParameterSet,
    Params, ParamsAction, Pose2, Rates, RatesAction, RelocalizeAction, Stamps, Topic, Value, decode, encode,
};
use synpf::{Odometry, Scan, Stamp, TrackMap, Twist};

/// What can happen to a car. Numbers have any bits: NaN, infinities, subnormals.
#[derive(Debug, Arbitrary)]
enum Step {
    /// Any bytes under any topic.
    Bytes(u8, Vec<u8>),
    /// Any bytes after a valid header.
    Payload(u8, Vec<u8>),
    /// An empty payload under a topic.
    NoPayload(u8),
    /// A well-formed command.
    Command(Given),
    /// A pit wall's report on the link.
    Report(f32, f32, u32),
    /// Some scans and odometry.
    Drive(u8),
    /// Time passes, so that deadlines end.
    Clock,
    /// The car restarts.
    Restart,
}

/// A command, under its own topic or another.
#[derive(Debug, Arbitrary)]
struct Given {
    who: Who,
    id: u8,
    expect: Expect,
    action: Any,
    astray: Astray,
}

/// The topic of a command: mostly its own.
#[derive(Debug, Arbitrary)]
enum Astray {
    Not,
    NorHere,
    NorHereEither,
    Under(u8),
}

/// Who gives a command.
#[derive(Debug, Arbitrary)]
enum Who {
    Ana,
    Ben,
    Nobody,
    Other(String),
}

/// The revision that a command expects.
#[derive(Debug, Arbitrary)]
enum Expect {
    Nothing,
    Right,
    Off(i8),
    Any(u64),
}

/// The name of a set.
#[derive(Debug, Arbitrary)]
enum Name {
    Shipped(u8),
    Mine,
    Wet,
    Other(String),
}

/// A parameter's value.
#[derive(Debug, Arbitrary)]
enum AnyValue {
    Bool(bool),
    Int(i64),
    Small(i8),
    Float(f64),
    /// In units of 0.25.
    Sane(u8),
    Text(String),
    Word(u8),
}

/// What to do.
#[derive(Debug, Arbitrary)]
enum Any {
    Select(Name, Option<u32>),
    Trial(Name),
    Put(Name, Vec<(u16, AnyValue)>, Option<u32>),
    PutUnknown(Name, Vec<(String, AnyValue)>),
    /// A number of values of some length, none of them valid.
    Flood(u16, u16),
    Confirm,
    Revert,
    Delete(Name),
    List,
    Shadow(Option<Name>),
    Pose([f64; 3]),
    /// Somewhere on the map.
    Place(u8, u8, i8),
    Search,
    Pick(u32),
    Rates([f32; 4], bool),
    GetRates,
    Auto(bool),
}

/// A car that takes commands, without a network.
struct Car {
    handler: CommandHandler,
    shared: Arc<SharedState>,
    feed: Sender<Feed>,
    filter: JoinHandle<()>,
    shadow: JoinHandle<()>,
    revisions: u64,
    /// Its earlier answers, which it must repeat.
    given: BTreeMap<CommandId, CachedAnswer>,
}

/// What a refused command must not change.
#[derive(Debug, PartialEq)]
struct State {
    memory: PersistedState,
    params: Params,
    rates: Rates,
    auto: bool,
    shadow: Option<String>,
}

const TOPICS: [Topic; 8] = [
    Topic::CmdParams,
    Topic::CmdPose,
    Topic::CmdRelocalize,
    Topic::CmdRates,
    Topic::CmdAuto,
    Topic::Map,
    Topic::Info,
    Topic::Clock,
];

fn topic(pick: u8) -> Topic {
    TOPICS[usize::from(pick) % TOPICS.len()]
}

/// A ring of 6 m x 4 m in cells of 10 cm.
fn map() -> &'static Arc<TrackMap> {
    static MAP: OnceLock<Arc<TrackMap>> = OnceLock::new();
    MAP.get_or_init(|| {
        let origin = Pose::new(-1.0, 2.0, 0.3);
        let grid = OccupancyGrid::from_fn(60, 40, 0.1, origin, |column, row| match (column, row) {
            (0 | 59, _) | (_, 0 | 39) | (20..=40, 15..=25) => Cell::Occupied,
            _ => Cell::Free,
        });
        Arc::new(TrackMap::new(grid).expect("has free cells"))
    })
}

/// Most steps of one try: what needs more is found by trying more often.
const MOST_STEPS: usize = 32;

/// What became of commands.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    pub(crate) done: usize,
    pub(crate) refused: usize,
    pub(crate) stale: usize,
    pub(crate) unreadable: usize,
}

/// Lets all that these bytes stand for happen to a new car, and checks that nothing comes of it that may not.
pub(crate) fn check(bytes: &[u8], tally: &mut Tally) {
    let mut dice = Unstructured::new(bytes);
    let mut car = Car::start(PersistedState::default());
    let mut sensors = Stamp(1_000_000_000);
    let mut steps = 0;
    while !dice.is_empty() && steps < MOST_STEPS {
        let command = dice.ratio(3, 4).unwrap_or_default();
        let step = if command {
            dice.arbitrary().map(Step::Command)
        } else {
            dice.arbitrary()
        };
        let Ok(step) = step else { break };
        steps += 1;
        match step {
            Step::Bytes(pick, bytes) => car.take(topic(pick), Some(&bytes), tally),
            Step::Payload(pick, payload) => {
                let mut bytes = Header::new(Command::SCHEMA, Command::VERSION, Stamps::default())
                    .to_bytes()
                    .to_vec();
                bytes.extend_from_slice(&payload);
                car.take(topic(pick), Some(&bytes), tally);
            }
            Step::NoPayload(pick) => car.take(topic(pick), None, tally),
            Step::Command(given) => {
                let under = match given.astray {
                    Astray::Under(pick) => Some(topic(pick)),
                    Astray::Not | Astray::NorHere | Astray::NorHereEither => None,
                };
                let command = car.command(given);
                car.give(under.unwrap_or_else(|| command.action.topic()), &command, tally);
            }
            Step::Report(transit, uncertainty, poses) => {
                let report = LinkReport {
                    transit,
                    uncertainty,
                    poses,
                };
                if let Ok((_, report)) = decode::<LinkReport>(&bytes_of(&report)) {
                    let mut throttle = car.shared.throttle.lock().expect("sound");
                    throttle.on_report(sensors, &report);
                }
            }
            Step::Drive(scans) => {
                for _ in 0..scans % 4 {
                    sensors = sensors.plus(0.025);
                    car.drive(sensors);
                }
            }
            Step::Clock => car.handler.tick(),
            Step::Restart => {
                let memory = car.stop();
                car = Car::start(memory);
            }
        }
        car.is_sound();
    }
    car.stop();
}

impl Car {
    fn start(memory: PersistedState) -> Self {
        let revisions = memory.revision;
        let given = memory
            .answers
            .iter()
            .map(|given| (given.answer.id, given.clone()));
        let given = given.collect();
        let shared = Arc::new(SharedState::default());
        let clock = SensorClock::starting_at(Stamp(1_000_000_000), 1.0);
        let name = memory.settled.clone().unwrap_or_else(|| "hq".into());
        let parameters = match memory.sets.get(&name) {
            Some(stored) => stored.parameters.clone(),
            None => LocalizerParameters::named(&name).expect("ships, or was stored"),
        };
        let mount = Pose::new(0.27, 0.0, 0.0);
        let mut localizer = parameters.build(map(), mount, 1).expect("a sound set");
        localizer
            .initialize(map().grid().origin * Pose::new(1.0, 1.0, 0.0))
            .expect("on the map");
        let store = ParameterStore::new(memory, name, parameters, Stamp(0));
        let (to_filter, filter_commands): (Sender<FilterCommand>, Receiver<FilterCommand>) = bounded(8);
        let (feed, filter_feed) = bounded(64);
        let (to_shadow, shadow_commands) = bounded(8);
        let (shadow_sender, shadow_receiver) = shadow_channel();
        let filter = FilterConfig {
            localizer,
            map: Arc::clone(map()),
            monitor: Monitor::new(Thresholds::default(), clock.now()),
            base_link_from_laser: mount,
            raceline: None,
            clock: clock.clone(),
            set: store.reference(),
            predict: true,
            shared: Arc::clone(&shared),
            shadow: shadow_sender,
            ros: None,
        };
        let filter = filter_worker::start(filter, filter_feed, filter_commands).expect("a thread");
        let shadow = shadow::start(
            shadow_receiver,
            shadow_commands,
            Arc::clone(&shared),
            clock.clone(),
        )
        .expect("a thread");
        let handler = CommandHandler::new(CommandHandlerConfig {
            store,
            file: None,
            filter_commands: to_filter,
            shadow_commands: to_shadow,
            base_link_from_laser: mount,
            shared: Arc::clone(&shared),
            clock,
            run_id: 7,
            track_map: Arc::clone(map()),
            search_patience: Duration::ZERO,
        });
        Self {
            handler,
            shared,
            feed,
            filter,
            shadow,
            revisions,
            given,
        }
    }

    /// Ends it; what survives comes back through the text that it is kept as.
    fn stop(self) -> PersistedState {
        let memory = self.handler.store().persisted().clone();
        drop(self.handler);
        drop(self.feed);
        self.filter.join().expect("the filter did not panic");
        self.shadow.join().expect("the shadow did not panic");
        let text = serde_json::to_string(&memory).expect("can be written");
        let read: PersistedState = serde_json::from_str(&text).expect("can be read");
        assert_eq!(read, memory);
        read
    }

    fn state(&self) -> State {
        let store = self.handler.store();
        State {
            memory: store.persisted().clone(),
            params: store.params(),
            rates: *self.shared.rates.lock().expect("sound"),
            auto: self.shared.advice.lock().expect("sound").auto,
            shadow: self.shared.shadow.lock().expect("sound").clone(),
        }
    }

    fn command(&self, given: Given) -> Command {
        let Given {
            who,
            id,
            expect,
            action,
            ..
        } = given;
        let revision = self.handler.store().reference().revision;
        Command {
            id: CommandId(id.into()),
            operator: match who {
                Who::Ana => "ana".into(),
                Who::Ben => "ben".into(),
                Who::Nobody => String::new(),
                Who::Other(name) => name,
            },
            expected_revision: match expect {
                Expect::Nothing => None,
                Expect::Right => Some(revision),
                Expect::Off(by) => Some(revision.wrapping_add_signed(by.into())),
                Expect::Any(revision) => Some(revision),
            },
            action: action.into(),
        }
    }

    /// Any payload: an answer that can be read, or nothing has changed but for the counter.
    fn take(&mut self, topic: Topic, payload: Option<&[u8]>, tally: &mut Tally) {
        let before = self.state();
        let bad = self.shared.counters.read().payloads;
        match self.handler.answer(topic, payload) {
            Ok(answer) => {
                let (_, command) = decode::<Command>(payload.expect("was read")).expect("was read");
                self.has_answered(&command, &answer, &before, tally);
            }
            Err(error) => {
                tally.unreadable += 1;
                assert!(!error.is_empty());
                assert_eq!(self.state(), before);
                assert_eq!(self.shared.counters.read().payloads, bad + 1);
            }
        }
    }

    /// A command of the right shape: read if and only if it is one that a pit wall could have sent.
    fn give(&mut self, under: Topic, command: &Command, tally: &mut Tally) {
        let before = self.state();
        let sound = encode(command, Stamps::default()).is_ok();
        match self.handler.answer(under, Some(&bytes_of(command))) {
            Ok(answer) => {
                assert!(
                    sound && under == command.action.topic(),
                    "{command:?} under {under}"
                );
                self.has_answered(command, &answer, &before, tally);
                // Given again, it is answered again, and nothing more is done.
                let done = self.state();
                let again = self
                    .handler
                    .answer(under, Some(&bytes_of(command)))
                    .expect("as before");
                assert_eq!(again[Header::LEN..], answer[Header::LEN..]);
                assert_eq!(self.state(), done);
            }
            Err(error) => {
                tally.unreadable += 1;
                assert!(!sound || under != command.action.topic(), "{command:?}: {error}");
                assert_eq!(self.state(), before);
            }
        }
    }

    /// An answer says what is so.
    fn has_answered(&mut self, command: &Command, answer: &[u8], before: &State, tally: &mut Tally) {
        let (_, answer) = decode::<Answer>(answer).expect("can be read");
        assert_eq!(answer.id, command.id);
        let after = self.state();
        let events = self.told();
        // The same command under the same id was done, or not, and is not done now; another one under it is refused.
        let payload_hash = Some(PayloadHash::of(&bytes_of(command)[Header::LEN..]));
        if let Some(known) = self.given.get(&command.id) {
            if known.payload_hash == payload_hash {
                assert_eq!(answer, known.answer);
            } else {
                assert!(matches!(answer.outcome, Outcome::Refused { .. }), "{answer:?}");
            }
            assert_eq!(after, *before, "{command:?} came again");
            return;
        }
        let given = CachedAnswer {
            answer: answer.clone(),
            payload_hash,
        };
        self.given.insert(command.id, given);
        assert_eq!(answer.set, self.handler.store().reference());
        match &answer.outcome {
            Outcome::Done { .. } => {
                tally.done += 1;
                let step = after.params.revision - before.params.revision;
                assert!(step <= 1, "{before:?} became {after:?}");
                if step == 1 {
                    let told = events.iter().any(|event| {
                        matches!(&event.kind, EventKind::ParametersChanged { from, to, .. }
                            if from.revision + 1 == to.revision && *to == answer.set)
                            && event.who.as_deref() == Some(&command.operator)
                            && event.command == Some(command.id)
                    });
                    assert!(told, "nobody was told of {command:?}");
                }
            }
            Outcome::Refused { faults } => {
                tally.refused += 1;
                assert!(!faults.is_empty() && faults.iter().all(|fault| !fault.is_empty()));
                assert_eq!(after, *before, "{command:?} was refused");
            }
            Outcome::StaleRevision { expected, .. } => {
                tally.stale += 1;
                assert_eq!(Some(*expected), command.expected_revision);
                assert_eq!(after, *before, "{command:?} was stale");
            }
        }
    }

    /// The events that would have gone out since. Each of them could have.
    fn told(&self) -> Vec<Event> {
        let mut events = Vec::new();
        while let Some(record) = self.shared.telemetry.next_record() {
            match record {
                Record::Event(event) => {
                    let event = Event {
                        kind: event.kind,
                        update: event.update,
                        who: event.who,
                        command: event.command,
                    };
                    encode(&event, Stamps::default()).expect("an event fits its message");
                    events.push(event);
                }
                Record::Params(params) => {
                    encode(params.as_ref(), Stamps::default()).expect("a set fits its message");
                }
                Record::Shadow(shadow) => {
                    encode(shadow.as_ref(), Stamps::default()).expect("the shadow fits its message");
                }
                _ => {}
            }
        }
        events
    }

    fn drive(&self, now: Stamp) {
        let sound = Twist {
            linear_x: 1.0,
            ..Twist::default()
        };
        let odometry = Odometry {
            stamp: now,
            pose: Pose::new(now.since(Stamp(0)), 0.0, 0.0),
            twist: sound,
        };
        let scan = Scan {
            stamp: now,
            angle_min: -2.3,
            angle_increment: 0.023,
            time_increment: 0.0,
            scan_time: None,
            angle_max: None,
            range_min: 0.05,
            range_max: 30.0,
            ranges: vec![1.0; 200],
        };
        for event in [SensorEvent::Odometry(odometry), SensorEvent::Scan(scan)] {
            self.feed
                .send_timeout(Feed::Sensor(event), Duration::from_mins(1))
                .expect("the filter takes it");
        }
    }

    /// What is in force, and what could be, is sound; the threads run.
    fn is_sound(&mut self) {
        assert!(!self.filter.is_finished() && !self.shadow.is_finished());
        self.told();
        let state = self.state();
        assert!(state.params.revision >= self.revisions, "{state:?}");
        self.revisions = state.params.revision;
        assert!(encode(&state.params, Stamps::default()).is_ok());
        let store = self.handler.store();
        store.in_force().parameters.validate().expect("in force");
        for stored in state.memory.sets.values() {
            stored.parameters.validate().expect("on the car");
        }
        let mut rates = vec![state.rates];
        rates.push(self.shared.throttle.lock().expect("sound").rates(state.rates));
        for rates in rates {
            for rate in [rates.pose, rates.cloud, rates.scan, rates.health] {
                assert!((0.0..=Rates::MAX).contains(&rate), "{rates:?}");
            }
        }
        if let Some(estimate) = self.shared.latest_pose() {
            assert!(estimate.pose.is_finite(), "{estimate:?}");
        }
    }
}

/// The bytes of a message, checked or not: what a faulty or hostile sender would put.
fn bytes_of<M: Message>(message: &M) -> Vec<u8> {
    let mut bytes = Header::new(M::SCHEMA, M::VERSION, Stamps::default())
        .to_bytes()
        .to_vec();
    let config = bincode::config::standard().with_fixed_int_encoding();
    bytes.extend(bincode::serde::encode_to_vec(message, config).expect("can be written"));
    bytes
}

impl From<Name> for String {
    fn from(name: Name) -> Self {
        match name {
            Name::Shipped(pick) => {
                LocalizerParameters::NAMES[usize::from(pick) % LocalizerParameters::NAMES.len()].into()
            }
            Name::Mine => "mine".into(),
            Name::Wet => "wet".into(),
            Name::Other(name) => name,
        }
    }
}

impl From<AnyValue> for Value {
    fn from(value: AnyValue) -> Self {
        const WORDS: [&str; 8] = [
            "tum",
            "amcl",
            "arc",
            "mit",
            "beam",
            "likelihood_field",
            "cddt",
            "uniform",
        ];
        match value {
            AnyValue::Bool(value) => Self::Bool(value),
            AnyValue::Int(value) => Self::Int(value),
            AnyValue::Small(value) => Self::Int(value.into()),
            AnyValue::Float(value) => Self::Float(value),
            AnyValue::Sane(quarters) => Self::Float(f64::from(quarters) * 0.25),
            AnyValue::Text(value) => Self::Text(value),
            AnyValue::Word(pick) => Self::Text(WORDS[usize::from(pick) % WORDS.len()].into()),
        }
    }
}

impl From<Any> for Action {
    fn from(any: Any) -> Self {
        let known = |pick: u16| {
            static KEYS: OnceLock<Vec<String>> = OnceLock::new();
            let keys = KEYS.get_or_init(|| LocalizerParameters::default().to_values().into_keys().collect());
            keys[usize::from(pick) % keys.len()].clone()
        };
        let put = |name: Name, values, revert_after_ms| {
            let set = ParameterSet {
                name: name.into(),
                values,
            };
            Self::Params(ParamsAction::Put { set, revert_after_ms })
        };
        match any {
            Any::Select(name, revert_after_ms) => Self::Params(ParamsAction::Select {
                name: name.into(),
                revert_after_ms,
            }),
            // Over almost at once, so that the car falls back.
            Any::Trial(name) => Self::Params(ParamsAction::Select {
                name: name.into(),
                revert_after_ms: Some(100),
            }),
            Any::Put(name, values, revert_after_ms) => put(
                name,
                values
                    .into_iter()
                    .map(|(key, value)| (known(key), value.into()))
                    .collect(),
                revert_after_ms,
            ),
            Any::PutUnknown(name, values) => put(
                name,
                values
                    .into_iter()
                    .map(|(key, value)| (key, value.into()))
                    .collect(),
                None,
            ),
            Any::Flood(words, length) => put(
                Name::Wet,
                (0..words % 256)
                    .map(|word| {
                        // Control characters take six bytes each where they are quoted.
                        let text = "\u{1}".repeat(usize::from(length % 1024));
                        let key = if length < 32_768 {
                            known(word)
                        } else {
                            format!("{word}{text}")
                        };
                        (key, Value::Text(text))
                    })
                    .collect(),
                None,
            ),
            Any::Confirm => Self::Params(ParamsAction::Confirm),
            Any::Revert => Self::Params(ParamsAction::Revert),
            Any::Delete(name) => Self::Params(ParamsAction::Delete { name: name.into() }),
            Any::List => Self::Params(ParamsAction::List),
            Any::Shadow(name) => Self::Params(ParamsAction::Shadow {
                name: name.map(String::from),
            }),
            Any::Pose([x, y, heading]) => Self::Pose(Pose2 { x, y, heading }),
            Any::Place(x, y, heading) => {
                let at = Pose::new(
                    f64::from(x) * 0.02,
                    f64::from(y) * 0.015,
                    f64::from(heading) * 0.025,
                );
                let Pose { x, y, heading } = map().grid().origin * at;
                Self::Pose(Pose2 { x, y, heading })
            }
            Any::Search => Self::Relocalize(RelocalizeAction::Search),
            Any::Pick(candidate) => Self::Relocalize(RelocalizeAction::Pick { candidate }),
            Any::Rates([pose, cloud, scan, health], recorded) => Self::Rates(RatesAction::Set(Rates {
                pose,
                cloud,
                scan,
                health,
                recorded,
            })),
            Any::GetRates => Self::Rates(RatesAction::Get),
            Any::Auto(on) => Self::Auto(on),
        }
    }
}
