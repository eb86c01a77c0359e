//! Reads damaged files with every reader of the workspace. The tests and the fuzz target share it.

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use car_node::evaluate::read_poses;
use car_node::sensors::bag::{Bag, Topics};
use maps::{OccupancyGrid, PbStream, Pose as MapPose, Raceline, TrajectoryNode, write_pbstream};
use pitwall::{
    EventPayload, Fleet, FleetEvent, Recorder, Replay, Report, SessionIndex, read_events, read_in_order,
};
use protocol::{
    Covariance, Event, EventKind, Header, Pose, Pose2, PoseKind, Stamps, Telemetry, Topic, Twist2, encode,
    ros,
};
use rusqlite::{Connection, params};
use simulator::TrackSpec;
use system_tests::{room, write_bag};

/// A file that is read completely is counted as read, any other one as refused.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    pub(crate) read: u64,
    pub(crate) refused: u64,
}

impl Tally {
    fn add(&mut self, read: bool) {
        *(if read { &mut self.read } else { &mut self.refused }) += 1;
    }
}

/// A sound file of each kind, and a place for damaged ones.
pub(crate) struct Files {
    folder: tempfile::TempDir,
    samples: [Vec<u8>; Self::KINDS],
}

const YAML: &str = "image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\n\
                    occupied_thresh: 0.65\nfree_thresh: 0.196\n";
const RACELINE: &str = "# x_m, y_m, vx_mps\n0.0, 0.0, 1.0\n1.0, 0.0, 2.0\n1.0, 1.0, 3.0\n0.0, 1.0, 2.0\n";
const RACELINE_JSON: &str = r#"{"global_traj_wpnts_iqp": {"wpnts": [{"x_m": 0.0, "y_m": 0.0, "vx_mps": 1.0}, {"x_m": 1.0, "y_m": 0.0, "vx_mps": 1.0},
    {"x_m": 1.0, "y_m": 1.0, "vx_mps": 2.0}, {"x_m": 0.0, "y_m": 1.0, "vx_mps": 2.0}]}}"#;
const METADATA: &str = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  message_count: 1\n  \
                        topics_with_message_count:\n    - topic_metadata:\n        name: /scan\n        type: \
                        sensor_msgs/msg/LaserScan\n        serialization_format: cdr\n      message_count: 1\n  \
                        relative_file_paths:\n    - bag_0.mcap\n";
const PARAMETERS: &str = "particle_filter:\n  ros__parameters:\n    max_particles: 4000\n    sigma_hit: 0.1\n    z_hit: 0.8\n    \
                          range_method: rmgpu\n    max_range: 30.0\n    squash_factor: 2.2\n";
const TRACK: &str = "name: club\nseed: 3\nlength: 60.0\n";
const POSES: &str = "# stamp_s, x_m, y_m, heading_rad\n1.0, 0.0, 0.0, 0.0\n1.1, 0.1, 0.0, 0.01\n";
const KEYS: &str = r#"{"format": 1, "role": "car", "name": "blue", "authority": "-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n",
    "certificate": "-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n", "key": "-----BEGIN PRIVATE KEY-----\nMIIB\n-----END PRIVATE KEY-----\n", "members": []}"#;
/// Walls around a free place.
const PGM: &str = "P2 5 4 255\n0 0 0 0 0\n0 254 254 254 0\n0 254 205 254 0\n0 0 0 0 0\n";
/// A grey PNG of one pixel.
const PNG: [u8; 67] = [
    0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a, 0x00, 0x00, 0x00, 0x0d, 0x49, 0x48, 0x44, 0x52, 0x00,
    0x00, 0x00, 0x01, 0x00, 0x00, 0x00, 0x01, 0x08, 0x00, 0x00, 0x00, 0x00, 0x3a, 0x7e, 0x9b, 0x55, 0x00,
    0x00, 0x00, 0x0a, 0x49, 0x44, 0x41, 0x54, 0x78, 0x9c, 0x63, 0x60, 0x00, 0x00, 0x00, 0x02, 0x00, 0x01,
    0x48, 0xaf, 0xa4, 0x71, 0x00, 0x00, 0x00, 0x00, 0x49, 0x45, 0x4e, 0x44, 0xae, 0x42, 0x60, 0x82,
];

impl Files {
    /// Recording; bags of ROS 2 in MCAP and SQLite, and of ROS 1; map as YAML, PGM, PNG; raceline as CSV and JSON; a bag's
    /// metadata, parameters, track, poses, keys, index of sessions; a Cartographer state.
    pub(crate) const KINDS: usize = 16;

    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        write_bag(&path("bag.mcap"), &room(), 0.5);
        let samples = [
            recording(&path("session.mcap")),
            std::fs::read(path("bag.mcap")).expect("written"),
            sqlite_bag(&path("bag.db3")),
            ros1_bag(),
            YAML.into(),
            PGM.into(),
            PNG.to_vec(),
            RACELINE.into(),
            RACELINE_JSON.into(),
            METADATA.into(),
            PARAMETERS.into(),
            TRACK.into(),
            POSES.into(),
            KEYS.into(),
            index_of_sessions(folder.path()),
            pbstream(),
        ];
        Self { folder, samples }
    }

    /// A sound file of a kind.
    pub(crate) fn sample(&self, kind: usize) -> Vec<u8> {
        self.samples[kind].clone()
    }

    /// Reads a file of a kind in every way that there is.
    pub(crate) fn read(&self, kind: usize, bytes: &[u8], tally: &mut Tally) {
        let text = || String::from_utf8_lossy(bytes);
        match kind {
            0 => self.read_recording(bytes, tally),
            1 => tally.add(self.reads_bag("damaged-bag.mcap", bytes)),
            2 => tally.add(self.reads_bag("damaged-bag.db3", bytes)),
            3 => tally.add(self.reads_bag("damaged.bag", bytes)),
            4 => tally.add(OccupancyGrid::from_parts(&text(), PGM.as_bytes()).is_ok()),
            5 | 6 => tally.add(OccupancyGrid::from_parts(YAML, bytes).is_ok()),
            7 => tally.add(Raceline::parse("raceline.csv", &text()).is_ok()),
            8 => tally.add(Raceline::parse("raceline.json", &text()).is_ok()),
            9 => tally.add(self.reads_bag_folder(bytes)),
            10 => {
                tally.add(synpf::parameter_table(&text()).is_ok());
                tally.add(car_node::import::import(&text(), 0.05).is_ok());
            }
            11 => tally.add(TrackSpec::parse("track.yaml", &text()).is_ok()),
            12 => {
                let file = self.write("damaged.csv", bytes);
                tally.add(read_poses(&file, maps::Pose::IDENTITY).is_ok());
            }
            13 => tally.add(keys::Bundle::read(&self.write("damaged.keys", bytes)).is_ok()),
            14 => self.read_index(bytes, tally),
            _ => {
                let state = PbStream::read("drive.pbstream", bytes);
                tally.add(state.and_then(|state| state.paint()).is_ok());
            }
        }
    }

    fn reads_bag(&self, name: &str, bytes: &[u8]) -> bool {
        let file = self.write(name, bytes);
        let sensors = Bag::read(&file).and_then(|bag| bag.sensors(&Topics::default(), None));
        sensors.is_ok()
    }

    /// A bag as rosbag2 leaves it, with this metadata.
    fn reads_bag_folder(&self, metadata: &[u8]) -> bool {
        let folder = self.folder.path().join("folder");
        std::fs::create_dir_all(&folder).expect("made");
        std::fs::write(folder.join("bag_0.mcap"), &self.samples[1]).expect("written");
        std::fs::write(folder.join("metadata.yaml"), metadata).expect("written");
        Bag::read(&folder).is_ok()
    }

    /// The index of a folder without recordings.
    fn read_index(&self, bytes: &[u8], tally: &mut Tally) {
        let folder = self.folder.path().join("sessions");
        std::fs::create_dir_all(&folder).expect("made");
        std::fs::write(folder.join(INDEX), bytes).expect("written");
        let found = SessionIndex::open(&folder).and_then(|mut index| {
            index.refresh(None, |_| {})?;
            index.search("club")
        });
        tally.add(found.is_ok());
    }

    fn write(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let file = self.folder.path().join(name);
        std::fs::write(&file, bytes).expect("written");
        file
    }

    fn read_recording(&self, bytes: &[u8], tally: &mut Tally) {
        let file = self.write("damaged.mcap", bytes);
        read_all(&file, tally);
        let repaired = self.folder.path().join("repaired.mcap");
        let recovered = pitwall::recover(&file, &repaired);
        if recovered.is_ok() {
            let mut whole = Tally::default();
            read_all(&repaired, &mut whole);
            let read = read_events(&repaired).expect("opens").all(|event| event.is_ok());
            assert!(read, "a repaired file is whole");
            std::fs::remove_file(&repaired).expect("removed");
        }
    }
}

/// Name of the index of sessions.
const INDEX: &str = ".sessions.sqlite";

fn index_of_sessions(folder: &Path) -> Vec<u8> {
    let sessions = folder.join("indexed");
    std::fs::create_dir(&sessions).expect("made");
    std::fs::copy(folder.join("session.mcap"), sessions.join("session.mcap")).expect("copied");
    let mut index = SessionIndex::open(&sessions).expect("made");
    index.refresh(None, |_| {}).expect("indexed");
    drop(index);
    std::fs::read(sessions.join(INDEX)).expect("written")
}

/// A scan and an odometry message of a bag.
fn scan_and_odometry(at: i64) -> [Vec<u8>; 2] {
    let scan = ros::laser_scan(&ros::LaserScan {
        stamp: at,
        angle_min: -1.0,
        angle_max: 1.0,
        angle_increment: 0.1,
        time_increment: 0.0,
        scan_time: 0.025,
        range_min: 0.05,
        range_max: 30.0,
        ranges: &[2.0; 21],
    });
    [
        scan,
        ros::odometry(at, ros::ODOM, Pose2::default(), Twist2::default()),
    ]
}

fn sqlite_bag(path: &Path) -> Vec<u8> {
    let bag = Connection::open(path).expect("made");
    bag.execute_batch(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
             serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
         CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
             data BLOB NOT NULL);
         INSERT INTO topics VALUES(1, '/scan', 'sensor_msgs/msg/LaserScan', 'cdr', '');
         INSERT INTO topics VALUES(2, '/odom', 'nav_msgs/msg/Odometry', 'cdr', '');",
    )
    .expect("written");
    for number in 1..=20_i64 {
        let at = 1_700_000_000_000_000_000 + number * 25_000_000;
        for (topic, data) in (1..).zip(scan_and_odometry(at)) {
            bag.execute(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES(?1, ?2, ?3)",
                params![topic, at, data],
            )
            .expect("written");
        }
    }
    drop(bag);
    std::fs::read(path).expect("written")
}

/// A bag of ROS 1 with one chunk: a connection for odometry, and a message.
fn ros1_bag() -> Vec<u8> {
    let text = |name: &str, value: &[u8]| [name.as_bytes(), b"=", value].concat();
    let record = |fields: &[Vec<u8>], data: &[u8]| {
        let header: Vec<u8> = fields
            .iter()
            .flat_map(|field| [&(field.len() as u32).to_le_bytes()[..], field].concat())
            .collect();
        let (header_len, data_len) = (header.len() as u32, data.len() as u32);
        [
            &header_len.to_le_bytes()[..],
            &header,
            &data_len.to_le_bytes(),
            data,
        ]
        .concat()
    };
    let fields = |fields: &[Vec<u8>]| {
        let field = |field: &Vec<u8>| [&(field.len() as u32).to_le_bytes()[..], field].concat();
        fields.iter().flat_map(field).collect::<Vec<u8>>()
    };
    let head = [
        text("op", &[3]),
        text("index_pos", &0_u64.to_le_bytes()),
        text("conn_count", &1_u32.to_le_bytes()),
        text("chunk_count", &1_u32.to_le_bytes()),
    ];
    let connection = record(
        &[text("op", &[7]), text("conn", &[0; 4]), text("topic", b"/odom")],
        &fields(&[
            text("topic", b"/odom"),
            text("type", b"nav_msgs/Odometry"),
            text("md5sum", b"cd5e73d190d741a2f92e81eda573aca7"),
            text("message_definition", b""),
        ]),
    );
    let mut odometry = [1_u32, 5, 6].map(u32::to_le_bytes).concat();
    for name in [&b"odom"[..], b"base_link"] {
        odometry.extend((name.len() as u32).to_le_bytes());
        odometry.extend(name);
    }
    odometry.extend([0; 8 * (7 + 36 + 6 + 36)]);
    let message = record(
        &[
            text("op", &[2]),
            text("conn", &[0; 4]),
            text("time", &5_u64.to_le_bytes()),
        ],
        &odometry,
    );
    let content = [connection, message].concat();
    let chunk = record(
        &[
            text("op", &[5]),
            text("compression", b"none"),
            text("size", &(content.len() as u32).to_le_bytes()),
        ],
        &content,
    );
    [b"#ROSBAG V2.0\n".to_vec(), record(&head, &[b' '; 64]), chunk].concat()
}

/// A state with two submaps and a few nodes.
fn pbstream() -> Vec<u8> {
    let map = OccupancyGrid::from_parts(YAML, PGM.as_bytes()).expect("a map");
    let node = |k: i64| TrajectoryNode {
        stamp: k * 50_000_000,
        pose: MapPose::new(0.1 * k as f64, 0.0, 0.0),
    };
    let nodes: Vec<TrajectoryNode> = (0..4).map(node).collect();
    write_pbstream(&map, &[MapPose::IDENTITY, MapPose::new(1.0, 0.0, 0.5)], &nodes)
}

/// What report, check, export, merge and replay read of a recording.
fn read_all(file: &Path, tally: &mut Tally) {
    tally.add(read_events(file).is_ok_and(|mut events| events.all(|event| event.is_ok())));
    tally.add(pitwall::check(file).is_ok());
    tally.add(Report::of(file).map(|report| report.to_html()).is_ok());
    if let Ok(events) = read_in_order(file, |_| true) {
        let mut fleet = Fleet::default();
        events.prepare(&mut fleet);
        events.map_while(Result::ok).for_each(|event| fleet.apply(&event));
    }
    let merged = file.with_extension("merged");
    if pitwall::merge(&[file.to_owned()], &merged).is_ok() {
        std::fs::remove_file(&merged).expect("removed");
    }
    if let Ok(replay) = Replay::start(file) {
        replay.stop();
    }
}

/// A recording of a car that drives, with an event among the poses.
fn recording(path: &Path) -> Vec<u8> {
    let recorder = Recorder::start(path).expect("begun");
    let car: protocol::CarName = "car-1".parse().expect("a name");
    let message = |topic: Topic, number: u64, at: i64, bytes: Vec<u8>, telemetry| FleetEvent {
        at,
        car: car.clone(),
        payload: EventPayload::Message {
            topic,
            delivery: pitwall::Delivery::InOrder,
            header: Header::read(&bytes).unwrap_or_else(|error| panic!("message {number}: {error}")),
            telemetry: Box::new(telemetry),
            bytes: bytes.into(),
        },
    };
    let appeared = FleetEvent {
        at: 1_000_000_000,
        car: car.clone(),
        payload: EventPayload::Appeared,
    };
    recorder.record(&Arc::new(appeared));
    for number in 1..=120_u64 {
        let at = 1_000_000_000 + number as i64 * 25_000_000;
        let stamps = Stamps {
            run_id: 1,
            sequence: number,
            sensor: at,
            published: at,
        };
        let pose = Pose {
            pose: Pose2 {
                x: number as f64 * 0.1,
                ..Pose2::default()
            },
            twist: Twist2 {
                linear_x: 4.0,
                linear_y: 0.0,
                angular: 0.0,
            },
            covariance: Covariance::default(),
            track: None,
            lap: 0,
            update: number,
            kind: PoseKind::Updated,
        };
        let event = Event {
            kind: EventKind::SearchStarted,
            update: number,
            who: None,
            command: None,
        };
        for topic in [Topic::Pose, Topic::RecordedPose] {
            let bytes = encode(&pose, stamps).expect("a good message");
            recorder.record(&Arc::new(message(
                topic,
                number,
                at,
                bytes,
                Telemetry::Pose(pose),
            )));
        }
        let bytes = encode(&event, stamps).expect("a good message");
        recorder.record(&Arc::new(message(
            Topic::Event,
            number,
            at,
            bytes,
            Telemetry::Event(event),
        )));
        // Several chunks: each sync closes one.
        if number % 40 == 0 {
            let (deadline, written) = (Instant::now() + Duration::from_mins(1), 3 * number);
            while recorder.progress().messages < written && Instant::now() < deadline {
                std::thread::sleep(Duration::from_millis(5));
            }
        }
    }
    recorder.finish().expect("ended");
    std::fs::read(path).expect("written")
}

/// Reads the bytes as a file of the kind that the first byte names. The second byte decides whether they are the file, or the
/// damage of a sound one: places and bits.
pub(crate) fn check(bytes: &[u8]) {
    static FILES: OnceLock<Files> = OnceLock::new();
    let files = FILES.get_or_init(Files::new);
    let [kind, how, rest @ ..] = bytes else {
        return;
    };
    let kind = usize::from(*kind) % Files::KINDS;
    let mut tally = Tally::default();
    if how % 2 == 0 {
        return files.read(kind, rest, &mut tally);
    }
    let mut damaged = files.sample(kind);
    for damage in rest.chunks_exact(4) {
        let at = u32::from_le_bytes([damage[0], damage[1], damage[2], 0]) as usize;
        if damage[3] == 0 {
            damaged.truncate(at.max(1));
        }
        let at = at % damaged.len();
        damaged[at] ^= damage[3];
    }
    files.read(kind, &damaged, &mut tally);
}
