//! A car: its threads, the channels between them, and how they end.
//!
//! ```text
//! source --feed--> filter --telemetry queue--> publisher ==zenoh==> pit wall
//!                    ^ filter commands                                 |
//!              command server <=============== commands ==============+
//! ```

mod namesake;
mod queryables;
mod run_id;

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, bounded};
use keys::Protection;
use maps::{Pose, Raceline};
use protocol::{CarInfo, CarName, EventKind, Rates, Stamps, encode};
use synpf::{Localizer, PoseError, SetUpError, TrackMap};
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::query::Queryable;

use crate::control::parameter_sets::{self, NamedSet, SetError};
use crate::control::parameter_store::ParameterStore;
use crate::control::persisted_state::PersistedState;
use crate::control::query_server::QueryServer;
use crate::control::{
    CommandHandlerConfig, LocalCommands, SEARCH_PATIENCE, StateFile, StateFileError, command_server,
};
use crate::health::{Monitor, Thresholds};
use crate::localization::EXTERNAL;
use crate::localization::Start;
use crate::localization::filter_worker::{self, FilterConfig};
use crate::localization::shadow::{self, ShadowCommand};
use crate::localization::shadow_channel::shadow_channel;
use crate::network::{self, NetworkError};
use crate::recording::{FileHead, FileServer, RecordError, RecordOptions, RecorderThread};
use crate::ros2::output::RosSink;
use crate::sensors::clock::{SensorClock, wall_now};
use crate::sensors::{self, Source};
use crate::telemetry::load;
use crate::telemetry::publisher::Publisher;
use crate::telemetry::replay_buffer::ReplayBuffer;
use crate::telemetry::shared_state::{DEFAULT_RATES, SharedState};
use crate::wire;

/// A map ready to race on.
#[derive(Debug, Clone)]
pub struct RaceMap {
    /// Its name.
    pub name: String,
    /// The map, shared between the cars of one process.
    pub map: Arc<TrackMap>,
    /// The line along which progress is measured.
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
    /// Speed at which a recording is played; 1 is real time.
    pub rate: f64,
    /// The set to start with; None for the one that was in force when the car last ran, and `hq` for a new car.
    pub set: Option<NamedSet>,
    /// A set to run beside it on the same scans, and to compare with it.
    pub beside: Option<NamedSet>,
    /// Where the localizer starts.
    pub start: Start,
    /// Seed of the filter.
    pub seed: u64,
    /// Endpoints of pit walls, such as `tcp/192.168.1.10:7447`. Without one, the car looks for a pit wall on this machine.
    pub connect: Vec<String>,
    /// How the network is protected.
    pub protection: Protection,
    /// Without an endpoint, look for a pit wall by multicast, too.
    pub search: bool,
    /// How often each topic is sent.
    pub rates: Rates,
    /// Send predicted poses at odometry rate, and not only poses at scan rate.
    pub predict: bool,
    /// Limits of the health state.
    pub thresholds: Thresholds,
    /// Folder for what survives a restart; without one, nothing does.
    pub state: Option<PathBuf>,
    /// Receives poses, health and messages for the car's own nodes.
    pub ros: Option<RosSink>,
    /// Where to record on the car's own disk; without it, the car does not record.
    pub record: Option<RecordOptions>,
}

impl NodeConfig {
    /// A car with the default of everything else.
    pub fn new(car: CarName, map: RaceMap, source: Box<dyn Source>) -> Self {
        Self {
            car,
            map,
            source,
            rate: 1.0,
            set: None,
            beside: None,
            start: Start::Truth,
            seed: 0,
            connect: Vec::new(),
            protection: Protection::None,
            search: false,
            rates: DEFAULT_RATES,
            predict: false,
            thresholds: Thresholds::default(),
            state: None,
            ros: None,
            record: None,
        }
    }
}

/// Why a car does not start.
#[derive(Debug, thiserror::Error)]
pub enum NodeError {
    /// The localizer refuses its set-up.
    #[error(transparent)]
    SetUp(#[from] SetUpError),
    /// The initial pose is refused.
    #[error(transparent)]
    Pose(#[from] PoseError),
    /// The parameter set does not load.
    #[error(transparent)]
    Set(#[from] SetError),
    /// The network does not start.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// The state folder does not work.
    #[error(transparent)]
    State(#[from] StateFileError),
    /// A message about the car itself does not encode, such as a map that is too large.
    #[error("{0}")]
    Message(#[from] protocol::CodecError),
    /// The recording on the car does not start.
    #[error("recording on the car: {0}")]
    Record(#[from] RecordError),
    /// A thread does not start.
    #[error("cannot start a thread: {0}")]
    Thread(#[from] std::io::Error),
    /// The car should start at its true pose, which the source does not know.
    #[error("the source does not know the first pose; give --initial-pose x,y,heading")]
    NoTruth,
    /// The playback rate is not positive.
    #[error("the rate {0} is not positive")]
    Rate(f64),
}

/// A running car. Dropping it without [`Node::shutdown`] leaves its threads to end by themselves.
pub struct Node {
    shared: Arc<SharedState>,
    clock: SensorClock,
    session: Session,
    /// Dropping these ends the threads that listen to them.
    stop_source: Sender<()>,
    stop_control: Sender<()>,
    stop_queries: Sender<()>,
    stop_publisher: Sender<()>,
    asked: Receiver<()>,
    source: JoinHandle<()>,
    filter: JoinHandle<()>,
    command_server: JoinHandle<()>,
    query_server: JoinHandle<()>,
    file_server: JoinHandle<()>,
    load: JoinHandle<()>,
    local_commands: LocalCommands,
    shadow: JoinHandle<()>,
    publisher: JoinHandle<bool>,
    recorder: Option<RecorderThread>,
    queryables: Vec<Queryable<()>>,
    link_reports: Subscriber<()>,
    namesakes: Subscriber<()>,
    alive: [LivelinessToken; 2],
}

/// Closing the zenoh session on a dead link takes long; the node waits this long at most.
const CLOSING: Duration = Duration::from_secs(2);
/// After a car's last message, a pit wall that listens has this long to ask for what it lacks, ...
const FIRST_QUERY: Duration = Duration::from_secs(1);
/// ... then this long for each further query, ...
const NEXT_QUERY: Duration = Duration::from_millis(400);
/// ... and this long in all.
const LAST_QUERIES: Duration = Duration::from_secs(5);
/// Commands and queries that wait.
const QUEUE: usize = 64;
/// Requests for recordings that wait. A pit wall asks for one piece at a time.
const FILE_REQUESTS: usize = 8;

impl Node {
    /// Starts a car. It is on the network when this returns, or goes on trying to join it.
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
            beside,
            start,
            seed,
            connect,
            protection,
            search,
            rates,
            predict,
            thresholds,
            state,
            ros,
            record,
        } = config;
        if !(rate.is_finite() && rate > 0.0) {
            return Err(NodeError::Rate(rate));
        }
        let file = state.as_deref().map(StateFile::in_folder).transpose()?;
        let persisted = file
            .as_ref()
            .map_or(Ok(PersistedState::default()), StateFile::read)?;
        let external = source.pose_topic().is_some();
        let set = first_set(set, &persisted, external)?;
        let mount = source.mount();
        let mut localizer = set.parameters.build(&map.map, mount.base_link_from_laser, seed)?;
        let known = match start {
            Start::Pose(pose) => Some(pose),
            Start::Truth => source.start(),
            Start::Global => None,
        };
        let table_note = set.parameters.table_note(&map.map);
        set.parameters.prepare_tables(&map.map, known);
        let starts_with_a_pose = start_at(localizer.as_mut(), start, source.start())?;

        let verifier = protection
            .verifier()
            .map_err(|error| NodeError::Network(NetworkError::Keys(error)))?;
        let session = network::open(&car, &connect, &protection, search)?;
        let started = wall_now();
        let run_id = run_id::next(state.as_deref(), started);
        let clock = source.clock(rate);
        let (map_message, info, info_message) = describe(&map, source.as_ref(), started, run_id)?;
        let recorder = record
            .map(|options| {
                let head = FileHead {
                    car: car.clone(),
                    run_id,
                    map: map_message.clone(),
                    info,
                };
                let asked_for = options.start;
                match RecorderThread::prepare(options, head) {
                    Err(error) if !asked_for => {
                        // A car that was not told to record runs without a place for it.
                        tracing::warn!(%error, "this car cannot record");
                        Ok(None)
                    }
                    outcome => outcome.map(Some),
                }
            })
            .transpose()?
            .flatten();
        let (recorder, launch) = recorder.unzip();
        let shared = Arc::new(SharedState {
            rates: Mutex::new(rates),
            recorder,
            ..SharedState::default()
        });
        let recorder = launch.map(|launch| {
            let (shared, clock) = (Arc::clone(&shared), clock.clone());
            launch.run(move |kind| shared.event(clock.now(), 0, kind, None, None))
        });
        let recorder = recorder.transpose()?;

        let replay_buffer = Arc::<Mutex<ReplayBuffer>>::default();
        let publisher = Publisher::new(
            &session,
            &car,
            run_id,
            clock.clone(),
            Arc::clone(&shared),
            Arc::clone(&replay_buffer),
        )?;
        let (stop_publisher, publisher_stops) = bounded(0);
        let (stop_source, source_stops) = bounded(0);
        let (stop_control, control_stops) = bounded(0);
        let (stop_queries, queries_stop) = bounded(0);
        let (on_asked, asked) = bounded(1);
        let (feed, filter_feed) = bounded(sensors::QUEUE);
        let (local_commands, local_requests) = LocalCommands::new(run_id);
        let (to_filter, filter_commands) = bounded(QUEUE);
        let (to_command_server, command_requests) = bounded(QUEUE);
        let (to_query_server, query_requests) = bounded(QUEUE);
        let (to_file_server, file_requests) = bounded(FILE_REQUESTS);
        let (to_shadow, shadow_commands) = bounded(QUEUE);
        let (shadow_sender, shadow_receiver) = shadow_channel();
        let store = ParameterStore::new(persisted, set.name, set.parameters, started).with_external(external);

        shared.event(
            clock.now(),
            0,
            EventKind::Started {
                version: env!("CARGO_PKG_VERSION").into(),
            },
            None,
            None,
        );
        if let Some(text) = &table_note {
            tracing::warn!("{text}");
        }
        for text in exposure(&connect, &protection, search)
            .into_iter()
            .chain(table_note)
        {
            shared.event(clock.now(), 0, EventKind::Warning { text }, None, None);
        }
        let publisher = publisher.start(publisher_stops)?;
        let mut monitor = Monitor::new(thresholds, clock.now());
        if starts_with_a_pose {
            monitor.on_new_pose(clock.now());
        } else {
            monitor.on_search(clock.now());
        }
        let filter = filter_worker::start(
            FilterConfig {
                localizer,
                map: Arc::clone(&map.map),
                monitor,
                base_link_from_laser: mount.base_link_from_laser,
                raceline: map.raceline,
                clock: clock.clone(),
                set: store.reference(),
                predict,
                shared: Arc::clone(&shared),
                shadow: shadow_sender,
                ros,
            },
            filter_feed,
            filter_commands,
        )?;
        let shadow = shadow::start(
            shadow_receiver,
            shadow_commands,
            Arc::clone(&shared),
            clock.clone(),
        )?;
        if let Some(set) = beside {
            set.parameters.prepare_tables(&map.map, known);
            let localizer = set.parameters.build(&map.map, mount.base_link_from_laser, seed)?;
            shared.set_shadow(Some(set.name.clone()));
            let run = ShadowCommand::Run {
                name: set.name.clone(),
                who: "start".into(),
                localizer,
            };
            // The thread lives as long as this sender.
            to_shadow.send(run).ok();
            shared.event(
                clock.now(),
                0,
                EventKind::ShadowStarted { set: set.name },
                None,
                None,
            );
        }
        let command_server = command_server::start(
            CommandHandlerConfig {
                store,
                file,
                filter_commands: to_filter,
                shadow_commands: to_shadow,
                base_link_from_laser: mount.base_link_from_laser,
                shared: Arc::clone(&shared),
                clock: clock.clone(),
                run_id,
                track_map: map.map,
                search_patience: SEARCH_PATIENCE,
            },
            verifier,
            command_requests,
            local_requests,
            control_stops.clone(),
        )?;
        let query_server = QueryServer {
            map: map_message,
            info: info_message,
            replay_buffer,
            shared: Arc::clone(&shared),
            clock: clock.clone(),
            run_id,
            asked: on_asked,
        };
        let query_server = query_server.start(query_requests, queries_stop)?;
        let file_server = FileServer {
            recorder: shared.recorder.clone(),
            shared: Arc::clone(&shared),
            run_id,
        };
        let file_server = file_server.start(file_requests, control_stops.clone())?;
        let load = load::start(Arc::clone(&shared), control_stops)?;
        let queryables = queryables::declare(
            &session,
            &car,
            run_id,
            &to_command_server,
            &to_query_server,
            &to_file_server,
            &shared,
        )?;
        let link_reports = queryables::subscribe_to_link_reports(&session, &car, &shared, clock.clone())?;
        let namesakes = namesake::watch(&session, &car, run_id, &shared, clock.clone())?;
        let alive = network::declare_alive(&session, &car, run_id)?;
        // The sensors start last: the pit wall can then see the first scan.
        let counters = Arc::clone(&shared.counters);
        let source = sensors::play(
            source,
            clock.clone(),
            feed,
            Arc::clone(&shared.pose),
            move || counters.overrun(),
            source_stops,
        )?;
        Ok(Self {
            shared,
            clock,
            session,
            stop_source,
            stop_control,
            stop_queries,
            stop_publisher,
            asked,
            source,
            filter,
            command_server,
            query_server,
            file_server,
            load,
            local_commands,
            shadow,
            publisher,
            recorder,
            queryables,
            link_reports,
            namesakes,
            alive,
        })
    }

    /// True when the source has delivered everything.
    pub fn source_ended(&self) -> bool {
        self.source.is_finished()
    }

    /// The state that the threads share: counters, rates, the latest pose.
    pub fn shared(&self) -> &Arc<SharedState> {
        &self.shared
    }

    /// Gives commands from inside the node, such as from a ROS service.
    pub fn local_commands(&self) -> &LocalCommands {
        &self.local_commands
    }

    /// Ends the car: the sensors first, the network last, so that the last events are still sent. Takes a few seconds at most,
    /// even on a dead link.
    pub fn shutdown(self, reason: &str) {
        drop(self.stop_source);
        join(self.source);
        drop(self.stop_control);
        join(self.command_server);
        join(self.file_server);
        // The filter ends with the last sender of commands, which the command server held.
        join(self.filter);
        join(self.load);
        join(self.shadow);
        // The last message of the run: nothing can follow.
        self.shared.event(
            self.clock.now(),
            0,
            EventKind::Stopping {
                reason: reason.into(),
            },
            None,
            None,
        );
        drop(self.stop_publisher);
        self.asked.try_recv().ok();
        let heard = join(self.publisher).unwrap_or(false);
        if heard {
            await_last_queries(&self.asked);
        }
        drop(self.stop_queries);
        join(self.query_server);
        if let Some(recorder) = self.recorder {
            recorder.shutdown();
        }
        drop(self.queryables);
        drop(self.link_reports);
        drop(self.namesakes);
        drop(self.alive);
        network::close(&self.session, CLOSING);
    }
}

/// What everybody must know about the car's network; None when it is protected or stays on this machine.
pub fn exposure(connect: &[String], protection: &Protection, search: bool) -> Option<String> {
    if protection.protects() {
        return None;
    }
    let remote = network::remote_endpoint(connect);
    let anywhere = (search && connect.is_empty()).then_some("a pit wall found by multicast");
    let wall = remote.or(anywhere)?;
    Some(format!(
        "the link to {wall} is unprotected: others on the network can read this car's telemetry and command it"
    ))
}

/// Waits for a thread and returns what it returned; None when it has panicked.
fn join<T>(thread: JoinHandle<T>) -> Option<T> {
    let name = thread.thread().name().unwrap_or_default().to_owned();
    let outcome = thread.join();
    if outcome.is_err() {
        tracing::error!(thread = name, "a thread has panicked");
    }
    outcome.ok()
}

/// Waits, after the last message, while pit walls ask for what they lack.
fn await_last_queries(asked: &Receiver<()>) {
    let until = Instant::now() + LAST_QUERIES;
    let mut patience = FIRST_QUERY;
    while asked
        .recv_timeout(patience.min(until.saturating_duration_since(Instant::now())))
        .is_ok()
    {
        patience = NEXT_QUERY;
    }
}

/// The answer to `map`, and that to `info` as it is and encoded.
fn describe(
    map: &RaceMap,
    source: &dyn Source,
    started: synpf::Stamp,
    run_id: u64,
) -> Result<(Vec<u8>, CarInfo, Vec<u8>), protocol::CodecError> {
    let stamps = Stamps {
        run_id,
        sequence: 1,
        sensor: started.0,
        published: started.0,
    };
    let info = CarInfo {
        version: env!("CARGO_PKG_VERSION").into(),
        started: started.0.unsigned_abs(),
        source: source.description(),
        map: map.name.clone(),
        lap_length: map.raceline.as_ref().map(|line| line.length()),
        base_link_from_laser: wire::pose2(source.mount().base_link_from_laser),
        host: sysinfo::System::host_name().unwrap_or_default(),
    };
    let map = wire::map(&map.name, map.map.grid(), map.raceline.as_deref());
    let encoded = encode(&info, stamps)?;
    Ok((encode(&map, stamps)?, info, encoded))
}

/// The set to start with.
fn first_set(
    wanted: Option<NamedSet>,
    persisted: &PersistedState,
    external: bool,
) -> Result<NamedSet, SetError> {
    if let Some(set) = wanted {
        return Ok(set);
    }
    let settled = persisted.settled.as_deref();
    // Without the topic of another localizer there is nothing to follow.
    let name = settled
        .filter(|name| external || *name != EXTERNAL)
        .unwrap_or("hq");
    if let Some(stored) = persisted.sets.get(name) {
        return Ok(NamedSet {
            name: name.into(),
            parameters: stored.parameters.clone(),
            unknown_keys: Vec::new(),
        });
    }
    // A set from a file is not on the car; without its file, the usual one.
    parameter_sets::load(name).or_else(|_| parameter_sets::load("hq"))
}

/// Gives the localizer its initial pose, and returns true; or starts the search of the map, and returns false.
fn start_at(localizer: &mut dyn Localizer, start: Start, truth: Option<Pose>) -> Result<bool, NodeError> {
    match start {
        // A localizer that follows another one has its pose from there.
        Start::Pose(pose) => match localizer.initialize(pose) {
            Ok(()) | Err(PoseError::Elsewhere) => {}
            Err(error) => return Err(error.into()),
        },
        Start::Truth => {
            let pose = truth.ok_or(NodeError::NoTruth)?;
            start_at(localizer, Start::Pose(pose), truth)?;
        }
        Start::Global => {
            localizer.relocalize();
            return Ok(false);
        }
    }
    Ok(true)
}
