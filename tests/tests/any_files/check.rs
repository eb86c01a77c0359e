//! Reads damaged files with every reader of the workspace. The tests and the fuzz target share it.

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use car_node::sensors::bag::{Bag, Topics};
use maps::{OccupancyGrid, Raceline};
use pitwall::{EventPayload, Fleet, FleetEvent, Recorder, Replay, Report, read_events, read_in_order};
use protocol::{
    Covariance, Event, EventKind, Header, Pose, Pose2, PoseKind, Stamps, Telemetry, Topic, Twist2, encode,
};
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
    recording: Vec<u8>,
    bag: Vec<u8>,
}

const YAML: &str = "image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\n\
                    occupied_thresh: 0.65\nfree_thresh: 0.196\n";
const RACELINE: &str = "# x_m, y_m, vx_mps\n0.0, 0.0, 1.0\n1.0, 0.0, 2.0\n1.0, 1.0, 3.0\n0.0, 1.0, 2.0\n";
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
    /// Recording, bag, YAML, PGM, PNG, raceline.
    pub(crate) const KINDS: usize = 6;

    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let bag = folder.path().join("bag.mcap");
        write_bag(&bag, &room(), 0.5);
        Self {
            recording: recording(&folder.path().join("session.mcap")),
            bag: std::fs::read(&bag).expect("written"),
            folder,
        }
    }

    /// A sound file of a kind.
    pub(crate) fn sample(&self, kind: usize) -> Vec<u8> {
        match kind {
            0 => self.recording.clone(),
            1 => self.bag.clone(),
            2 => YAML.into(),
            3 => PGM.into(),
            4 => PNG.to_vec(),
            _ => RACELINE.into(),
        }
    }

    /// Reads a file of a kind in every way that there is.
    pub(crate) fn read(&self, kind: usize, bytes: &[u8], tally: &mut Tally) {
        let text = || String::from_utf8_lossy(bytes);
        match kind {
            0 => self.read_recording(bytes, tally),
            1 => {
                let file = self.write("damaged-bag.mcap", bytes);
                let sensors = Bag::read(&file).and_then(|bag| bag.sensors(&Topics::default(), None));
                tally.add(sensors.is_ok());
            }
            2 => tally.add(OccupancyGrid::from_parts(&text(), PGM.as_bytes()).is_ok()),
            3 | 4 => tally.add(OccupancyGrid::from_parts(YAML, bytes).is_ok()),
            _ => tally.add(Raceline::parse("raceline.csv", &text()).is_ok()),
        }
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

/// What report, check, export and replay read of a recording.
fn read_all(file: &Path, tally: &mut Tally) {
    tally.add(read_events(file).is_ok_and(|mut events| events.all(|event| event.is_ok())));
    tally.add(pitwall::check(file).is_ok());
    tally.add(Report::of(file).map(|report| report.to_html()).is_ok());
    if let Ok(events) = read_in_order(file, |_| true) {
        let mut fleet = Fleet::default();
        events.prepare(&mut fleet);
        events.map_while(Result::ok).for_each(|event| fleet.apply(&event));
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
