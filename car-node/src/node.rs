//! A car: its threads, how they are wired, and how they end.
//!
//! ```text
//! source --feed--> filter --outbox--> publisher ==zenoh==> pit wall
//!                    ^ orders                               |
//!                  desk <=========== commands ==============+
//! ```

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::{Sender, TrySendError, bounded};
use maps::{Pose, Raceline};
use protocol::{
    CarInfo, CarName, ClockReply, ClockRequest, EventKind, Key, LinkReport, Rates, Stamps, Topic, decode,
    encode,
};
use synpf::{PoseError, SetUpError, SynPf, TrackMap};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::query::{Query, Queryable};
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use crate::archive::Archive;
use crate::clock::{SensorClock, wall_now};
use crate::desk::{self, Desk, FileError, Inquiry, StateFile};
use crate::filter::{self, DEFAULT_RATES, Filter, Shared};
use crate::health::{Monitor, Thresholds};
use crate::keeper::{Keeper, Memory};
use crate::library::Library;
use crate::link::{self, LinkError};
use crate::load;
use crate::publisher::Publisher;
use crate::sets::{self, NamedSet, SetError};
use crate::shadow;
use crate::source::{self, Belief, Source};
use crate::throttle::Change;
use crate::wire;

/// Where a car begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Begin {
    /// Here: `map_from_base_link`.
    Pose(Pose),
    /// Where the source says, as a simulator does and a bag with ground truth.
    Source,
    /// It searches the map.
    Global,
}

/// A map ready to race on.
#[derive(Debug, Clone)]
pub struct RaceMap {
    /// What to call it.
    pub name: String,
    /// The map, shared between the cars of one process.
    pub map: Arc<TrackMap>,
    /// The line to measure progress along.
    pub raceline: Option<Arc<Raceline>>,
}

/// What a car needs to run.
pub struct NodeConfig {
    /// Its name.
    pub car: CarName,
    /// Its map.
    pub map: RaceMap,
    /// Its sensors.
    pub source: Box<dyn Source>,
    /// How many times as fast as real time a recording is played.
    pub rate: f64,
    /// The set to start with; None for the one that was in force when the car last ran, and `hq` for a new car.
    pub set: Option<NamedSet>,
    /// Where it begins.
    pub begin: Begin,
    /// Seed of the filter.
    pub seed: u64,
    /// Endpoints of pit walls, such as `tcp/192.168.1.10:7447`; empty looks for one on this machine and, by
    /// multicast, on the local network.
    pub connect: Vec<String>,
    /// How often to send what.
    pub rates: Rates,
    /// Send poses at odometry rate, predicted, and not only at scan rate.
    pub predict: bool,
    /// What counts as good.
    pub thresholds: Thresholds,
    /// Folder for what survives a restart; None forgets.
    pub state: Option<PathBuf>,
    /// Who on the car gets every belief as it is made, such as its controller.
    pub follower: Option<Sender<Belief>>,
}

impl NodeConfig {
    /// A car with everything else as usual.
    pub fn new(car: CarName, map: RaceMap, source: Box<dyn Source>) -> Self {
        Self {
            car,
            map,
            source,
            rate: 1.0,
            set: None,
            begin: Begin::Source,
            seed: 0,
            connect: Vec::new(),
            rates: DEFAULT_RATES,
            predict: false,
            thresholds: Thresholds::default(),
            state: None,
            follower: None,
        }
    }
}

/// Why a car does not start.
#[derive(Debug, thiserror::Error)]
pub enum NodeError {
    /// The localizer refuses its set-up.
    #[error(transparent)]
    SetUp(#[from] SetUpError),
    /// The pose to start from cannot be.
    #[error(transparent)]
    Pose(#[from] PoseError),
    /// The set that was in force is gone.
    #[error(transparent)]
    Set(#[from] SetError),
    /// There is no link.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The state folder is of no use.
    #[error(transparent)]
    State(#[from] FileError),
    /// A message about the car itself does not encode, such as a map that is too large.
    #[error("{0}")]
    Message(#[from] protocol::CodecError),
    /// A thread does not start.
    #[error("a thread does not start: {0}")]
    Thread(#[from] std::io::Error),
    /// The source does not know where the car begins.
    #[error("the source does not say where the car begins; give --initial-pose x,y,heading")]
    NoStart,
    /// Time must run forwards.
    #[error("the rate {0} is not positive")]
    Rate(f64),
}

/// A running car. Dropping it without [`Node::shutdown`] leaves its threads to end by themselves.
pub struct Node {
    shared: Arc<Shared>,
    clock: SensorClock,
    session: Session,
    /// Dropping these ends the threads that listen to them.
    stop_source: Sender<()>,
    stop_desk: Sender<()>,
    stop_publisher: Sender<()>,
    source: JoinHandle<()>,
    filter: JoinHandle<()>,
    desk: JoinHandle<()>,
    library: JoinHandle<()>,
    load: JoinHandle<()>,
    shadow: JoinHandle<()>,
    publisher: JoinHandle<()>,
    queryables: Vec<Queryable<()>>,
    reports: Subscriber<()>,
    alive: LivelinessToken,
}

/// A link that is dead takes its time; nobody waits longer than this for it.
const CLOSING: Duration = Duration::from_secs(2);
/// Orders and inquiries that wait.
const QUEUE: usize = 64;

impl Node {
    /// Starts a car. It is on the network when this returns, if there is one; else it goes on trying.
    #[expect(
        clippy::too_many_lines,
        reason = "the wiring of the threads, from top to bottom, reads best in one piece"
    )]
    pub fn start(config: NodeConfig) -> Result<Self, NodeError> {
        let NodeConfig {
            car,
            map,
            mut source,
            rate,
            set,
            begin,
            seed,
            connect,
            rates,
            predict,
            thresholds,
            state,
            follower,
        } = config;
        if !(rate.is_finite() && rate > 0.0) {
            return Err(NodeError::Rate(rate));
        }
        let file = state.map(|folder| StateFile::in_folder(&folder)).transpose()?;
        let memory = file.as_ref().map_or(Ok(Memory::default()), StateFile::read)?;
        let set = first_set(set, &memory)?;
        let mount = source.mount();
        let mut localizer = SynPf::new(
            Arc::clone(&map.map),
            mount.base_link_from_laser,
            set.parameters.clone(),
            seed,
        )?;
        let known = match begin {
            Begin::Pose(pose) => Some(pose),
            Begin::Source => source.start(),
            Begin::Global => None,
        };
        map.map.prepare(known, &set.parameters);
        let begins_with_a_pose = begin_at(&mut localizer, begin, source.start())?;

        let session = link::open(&connect)?;
        let started = wall_now();
        let run_id = started.0.unsigned_abs();
        let shared = Arc::new(Shared {
            rates: Mutex::new(rates),
            ..Shared::default()
        });
        let clock = source.clock(rate);
        let (map_message, info) = describe(&map, source.as_ref(), started)?;

        let archive = Arc::<Mutex<Archive>>::default();
        let publisher = Publisher::new(
            &session,
            &car,
            run_id,
            clock,
            Arc::clone(&shared),
            Arc::clone(&archive),
        )?;
        let (stop_publisher, publisher_stops) = bounded(0);
        let (stop_source, source_stops) = bounded(0);
        let (stop_desk, desk_stops) = bounded(0);
        let (feed, fed) = bounded(source::QUEUE);
        let (orders, ordered) = bounded(QUEUE);
        let (inquiries, inquired) = bounded(QUEUE);
        let (look_ups, looked_up) = bounded(QUEUE);
        let (wishes, wished) = bounded(QUEUE);
        let (tap, tapped) = shadow::tap();
        let keeper = Keeper::new(memory, set.name, set.parameters, started);

        shared.event(
            clock.now(),
            0,
            EventKind::Started {
                version: env!("CARGO_PKG_VERSION").into(),
            },
            None,
            None,
        );
        let publisher = publisher.start(publisher_stops)?;
        let mut monitor = Monitor::new(thresholds, clock.now());
        if begins_with_a_pose {
            monitor.on_new_pose(clock.now());
        } else {
            monitor.on_search(clock.now());
        }
        let filter = filter::start(
            Filter {
                localizer,
                monitor,
                base_link_from_laser: mount.base_link_from_laser,
                raceline: map.raceline,
                clock,
                set: keeper.reference(),
                predict,
                shared: Arc::clone(&shared),
                tap,
                follower,
            },
            fed,
            ordered,
        )?;
        let shadow = shadow::start(tapped, wished, Arc::clone(&shared), clock)?;
        let desk = desk::start(
            Desk {
                keeper,
                file,
                orders,
                shadow: wishes,
                base_link_from_laser: mount.base_link_from_laser,
                shared: Arc::clone(&shared),
                clock,
                run_id,
                track_map: map.map,
                search_patience: desk::SEARCH_PATIENCE,
            },
            inquired,
            desk_stops.clone(),
        )?;
        let library = Library {
            map: map_message,
            info,
            archive,
            shared: Arc::clone(&shared),
            run_id,
        };
        let library = library.start(looked_up, desk_stops.clone())?;
        let load = load::start(Arc::clone(&shared), desk_stops)?;
        let queryables = declare_queryables(&session, &car, run_id, &inquiries, &look_ups, &shared)?;
        let reports = declare_reports(&session, &car, &shared, clock)?;
        let alive = link::declare_alive(&session, &car)?;
        // The sensors last: from the first scan on, everybody can watch.
        let source = source::play(
            source,
            clock,
            feed,
            Arc::clone(&shared.belief),
            Arc::clone(&shared.counters),
            source_stops,
        )?;
        Ok(Self {
            shared,
            clock,
            session,
            stop_source,
            stop_desk,
            stop_publisher,
            source,
            filter,
            desk,
            library,
            load,
            shadow,
            publisher,
            queryables,
            reports,
            alive,
        })
    }

    /// True when the source has delivered all it has.
    pub fn source_ended(&self) -> bool {
        self.source.is_finished()
    }

    /// What the threads share: counters, rates, the latest belief.
    pub fn shared(&self) -> &Arc<Shared> {
        &self.shared
    }

    /// Ends the car: sensors first, then whoever could still have something to say, the network last. Takes a
    /// few seconds at most, whatever the link does.
    pub fn shutdown(self, reason: &str) {
        drop(self.stop_source);
        join(self.source);
        self.shared.event(
            self.clock.now(),
            0,
            EventKind::Stopping {
                reason: reason.into(),
            },
            None,
            None,
        );
        drop(self.stop_desk);
        join(self.desk);
        join(self.library);
        // The desk held the only way to give orders.
        join(self.filter);
        join(self.load);
        join(self.shadow);
        drop(self.stop_publisher);
        join(self.publisher);
        drop(self.queryables);
        drop(self.reports);
        drop(self.alive);
        link::close(&self.session, CLOSING);
    }
}

fn join(thread: JoinHandle<()>) {
    let name = thread.thread().name().unwrap_or_default().to_owned();
    if thread.join().is_err() {
        tracing::error!(thread = name, "a thread has panicked");
    }
}

/// The answers to `map` and `info`.
fn describe(
    map: &RaceMap,
    source: &dyn Source,
    started: synpf::Stamp,
) -> Result<(Vec<u8>, Vec<u8>), protocol::CodecError> {
    let run_id = started.0.unsigned_abs();
    let stamps = Stamps {
        run_id,
        sequence: 1,
        sensor: started.0,
        published: started.0,
    };
    let info = CarInfo {
        version: env!("CARGO_PKG_VERSION").into(),
        started: run_id,
        source: source.description(),
        map: map.name.clone(),
        lap_length: map.raceline.as_ref().map(|line| line.length()),
        base_link_from_laser: wire::pose2(source.mount().base_link_from_laser),
        host: sysinfo::System::host_name().unwrap_or_default(),
    };
    let map = wire::map(&map.name, map.map.grid(), map.raceline.as_deref());
    Ok((encode(&map, stamps)?, encode(&info, stamps)?))
}

/// The set to start with.
fn first_set(wanted: Option<NamedSet>, memory: &Memory) -> Result<NamedSet, SetError> {
    if let Some(set) = wanted {
        return Ok(set);
    }
    let name = memory.settled.as_deref().unwrap_or("hq");
    if let Some(stored) = memory.sets.get(name) {
        return Ok(NamedSet {
            name: name.into(),
            parameters: stored.parameters.clone(),
            unknown_keys: Vec::new(),
        });
    }
    // A set from a file is not on the car; without its file, the usual one.
    sets::load(name).or_else(|_| sets::load("hq"))
}

/// Gives the localizer its start. True when that is a pose.
fn begin_at(localizer: &mut SynPf, begin: Begin, start: Option<Pose>) -> Result<bool, NodeError> {
    match begin {
        Begin::Pose(pose) => localizer.initialize(pose)?,
        Begin::Source => localizer.initialize(start.ok_or(NodeError::NoStart)?)?,
        Begin::Global => {
            localizer.relocalize();
            return Ok(false);
        }
    }
    Ok(true)
}

/// Declares every question and command. Answers but the clock's come from the desk and the library: zenoh's threads never
/// wait.
fn declare_queryables(
    session: &Session,
    car: &CarName,
    run_id: u64,
    inquiries: &Sender<Inquiry>,
    look_ups: &Sender<Inquiry>,
    shared: &Arc<Shared>,
) -> Result<Vec<Queryable<()>>, LinkError> {
    let declare = |topic: Topic, callback: Box<dyn Fn(Query) + Send + Sync>| {
        let key = Key::new(car.clone(), topic).to_string();
        session
            .declare_queryable(key.clone())
            .callback(callback)
            .wait()
            .map_err(|error| LinkError::Declare {
                key,
                reason: error.to_string(),
            })
    };
    let mut queryables = vec![declare(Topic::Clock, {
        let shared = Arc::clone(shared);
        Box::new(move |query| answer_clock(&query, run_id, &shared))
    })?];
    for topic in [
        Topic::Map,
        Topic::Info,
        Topic::Missing,
        Topic::CmdParams,
        Topic::CmdPose,
        Topic::CmdRelocalize,
        Topic::CmdRates,
        Topic::CmdAuto,
    ] {
        let inquiries = match topic {
            Topic::Map | Topic::Info | Topic::Missing => look_ups.clone(),
            _ => inquiries.clone(),
        };
        queryables.push(declare(
            topic,
            Box::new(move |query| match inquiries.try_send(Inquiry { topic, query }) {
                Ok(()) | Err(TrySendError::Disconnected(_)) => {}
                Err(TrySendError::Full(inquiry)) => {
                    // Dropping the query ends it without an answer: the asker may try again.
                    tracing::warn!(%topic, "too many questions at once");
                    drop(inquiry);
                }
            }),
        )?);
    }
    Ok(queryables)
}

/// Listens to what pit walls say of the link, and sends less while it is slow.
fn declare_reports(
    session: &Session,
    car: &CarName,
    shared: &Arc<Shared>,
    clock: SensorClock,
) -> Result<Subscriber<()>, LinkError> {
    let key = Key::new(car.clone(), Topic::Link).to_string();
    let shared = Arc::clone(shared);
    let take_in = move |sample: Sample| {
        let Ok((_, report)) = decode::<LinkReport>(&sample.payload().to_bytes()) else {
            let count = shared.counters.bad_payload() + 1;
            if count.is_power_of_two() {
                tracing::warn!(topic = %Topic::Link, count, "a report of the link cannot be read");
            }
            return;
        };
        let change = shared
            .throttle
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .on_report(wall_now(), &report);
        let kind = match change {
            Some(Change::Lowered { transit, rates }) => EventKind::RatesLowered {
                transit: transit as f32,
                pose: rates.pose,
                recorded: rates.recorded,
            },
            Some(Change::Restored) => EventKind::RatesRestored,
            None => return,
        };
        shared.event(clock.now(), 0, kind, None, None);
    };
    session
        .declare_subscriber(key.clone())
        .callback(take_in)
        .wait()
        .map_err(|error| LinkError::Declare {
            key,
            reason: error.to_string(),
        })
}

fn answer_clock(query: &Query, run_id: u64, shared: &Shared) {
    let received = wall_now();
    let request = query
        .payload()
        .and_then(|payload| decode::<ClockRequest>(&payload.to_bytes()).ok());
    let Some((_, request)) = request else {
        let count = shared.counters.bad_payload() + 1;
        if count.is_power_of_two() {
            tracing::warn!(topic = %Topic::Clock, count, "a question for the clock cannot be read");
        }
        return;
    };
    let reply = ClockReply {
        sent: request.sent,
        received: received.0,
        answered: wall_now().0,
    };
    let stamps = Stamps {
        run_id,
        sequence: 1,
        sensor: received.0,
        published: reply.answered,
    };
    if let Ok(bytes) = encode(&reply, stamps)
        && let Err(error) = query.reply(query.key_expr().clone(), bytes).wait()
    {
        tracing::debug!(%error, "nobody to answer");
    }
}
