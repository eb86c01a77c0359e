//! Bags in every form: the same drive gives the same sensor data, and damage is named.

use std::collections::BTreeMap;
use std::fs;
use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use car_node::ros2::messages::{
    self, Header, LaserScan, Orientation, RosOdometry, RosPose, TfMessage, TransformStamped, Vector3,
};
use car_node::sensors::bag::{Bag, SensorEvent, SensorLog, Topics};
use maps::Pose;
use mcap::{Compression, WriteOptions};
use synpf::Stamp;
use tempfile::TempDir;

const START: Stamp = Stamp(1_700_000_000_000_000_000);

/// A message of any of the types that this test writes.
#[derive(Debug, Clone)]
enum Content {
    Scan(LaserScan),
    Odometry(Box<RosOdometry>),
    Tf(TfMessage),
}

#[derive(Debug, Clone)]
struct Message {
    topic: String,
    at: Stamp,
    content: Content,
}

fn header(seconds: f64, frame: &str) -> Header {
    Header {
        stamp: START.plus(seconds).into(),
        frame_id: frame.into(),
    }
}

fn tf(parent: &str, child: &str, x: f64) -> Content {
    Content::Tf(TfMessage {
        transforms: vec![TransformStamped {
            header: header(0.0, parent),
            child_frame_id: child.into(),
            transform: RosPose {
                position: Vector3 { x, y: 0.0, z: 0.1 },
                orientation: Orientation::from_yaw(0.0),
            },
        }],
    })
}

fn odometry(seconds: f64, child: &str) -> Content {
    let mut message = RosOdometry {
        header: header(seconds, "odom"),
        child_frame_id: child.into(),
        pose: Pose::new(seconds, 0.5, 0.1).into(),
        ..RosOdometry::default()
    };
    message.linear.x = 1.0;
    message.angular.z = 0.5;
    Content::Odometry(Box::new(message))
}

fn scan(seconds: f64, frame: &str, view: f32) -> Content {
    let beams = 40_u8;
    Content::Scan(LaserScan {
        header: header(seconds, frame),
        angle_min: -view / 2.0,
        angle_max: view / 2.0,
        angle_increment: view / f32::from(beams - 1),
        scan_time: 0.025,
        range_min: 0.02,
        range_max: 30.0,
        ranges: (0..beams)
            .map(|beam| 1.0 + f32::from(beam) * 0.1 + seconds as f32)
            .collect(),
        intensities: vec![7.0; usize::from(beams)],
        ..LaserScan::default()
    })
}

fn message(topic: &str, seconds: f64, content: Content) -> Message {
    Message {
        topic: topic.into(),
        at: START.plus(seconds),
        content,
    }
}

/// Half a second of a drive.
fn drive() -> Vec<Message> {
    let mut drive = vec![message("/tf_static", 0.0, tf("base_link", "laser", 0.27))];
    for tick in 0..20 {
        let now = f64::from(tick) * 0.025;
        drive.push(message("/odom", now, odometry(now, "base_link")));
        drive.push(message("/scan", now + 0.02, scan(now, "laser", 4.7)));
        drive.push(message("/ground_truth/odom", now, odometry(now, "base_link")));
    }
    drive
}

impl Content {
    fn ros2_type(&self) -> &'static str {
        match self {
            Self::Scan(_) => "sensor_msgs/msg/LaserScan",
            Self::Odometry(_) => "nav_msgs/msg/Odometry",
            Self::Tf(_) => "tf2_msgs/msg/TFMessage",
        }
    }

    fn cdr(&self) -> Vec<u8> {
        match self {
            Self::Scan(message) => messages::encode(message),
            Self::Odometry(message) => messages::encode(&**message),
            Self::Tf(message) => messages::encode(message),
        }
        .expect("encodes")
    }

    /// As ROS 1 writes it: packed, and a number in front of each header.
    fn ros1(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        match self {
            Self::Scan(message) => {
                put_header(&mut bytes, &message.header);
                for value in [
                    message.angle_min,
                    message.angle_max,
                    message.angle_increment,
                    message.time_increment,
                    message.scan_time,
                    message.range_min,
                    message.range_max,
                ] {
                    bytes.extend(value.to_le_bytes());
                }
                for list in [&message.ranges, &message.intensities] {
                    bytes.extend((list.len() as u32).to_le_bytes());
                    bytes.extend(list.iter().flat_map(|value| value.to_le_bytes()));
                }
            }
            Self::Odometry(message) => {
                put_header(&mut bytes, &message.header);
                put_text(&mut bytes, &message.child_frame_id);
                put_pose(&mut bytes, &message.pose);
                put(&mut bytes, message.pose_covariance.as_flattened());
                let (linear, angular) = (message.linear, message.angular);
                put(
                    &mut bytes,
                    &[linear.x, linear.y, linear.z, angular.x, angular.y, angular.z],
                );
                put(&mut bytes, message.twist_covariance.as_flattened());
            }
            Self::Tf(message) => {
                bytes.extend((message.transforms.len() as u32).to_le_bytes());
                for transform in &message.transforms {
                    put_header(&mut bytes, &transform.header);
                    put_text(&mut bytes, &transform.child_frame_id);
                    put_pose(&mut bytes, &transform.transform);
                }
            }
        }
        bytes
    }
}

fn put(bytes: &mut Vec<u8>, values: &[f64]) {
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
}

fn put_text(bytes: &mut Vec<u8>, text: &str) {
    bytes.extend((text.len() as u32).to_le_bytes());
    bytes.extend(text.as_bytes());
}

fn put_header(bytes: &mut Vec<u8>, header: &Header) {
    bytes.extend(9_u32.to_le_bytes());
    bytes.extend(header.stamp.sec.to_le_bytes());
    bytes.extend(header.stamp.nanosec.to_le_bytes());
    put_text(bytes, &header.frame_id);
}

fn put_pose(bytes: &mut Vec<u8>, pose: &RosPose) {
    let (at, turn) = (pose.position, pose.orientation);
    put(bytes, &[at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]);
}

fn zstd_of(bytes: &[u8]) -> Vec<u8> {
    zstd::encode_all(bytes, 1).expect("compresses")
}

/// How MCAP and SQLite files contain a message.
type Payload = fn(&Content) -> Vec<u8>;

fn compressed(content: &Content) -> Vec<u8> {
    zstd_of(&content.cdr())
}

/// MCAP; `empty` are topics of odometry without messages.
fn mcap(
    messages: &[Message],
    options: WriteOptions,
    encoding: &str,
    payload: Payload,
    empty: &[&str],
) -> Vec<u8> {
    let mut writer = options.create(Cursor::new(Vec::new())).expect("begun");
    let mut channels = BTreeMap::new();
    let mut add = |writer: &mut mcap::Writer<_>, topic: &str, schema: &str| {
        let schema = writer.add_schema(schema, "ros2msg", b"").expect("a schema");
        let none = BTreeMap::new();
        *channels.entry(topic.to_owned()).or_insert_with(|| {
            writer
                .add_channel(schema, topic, encoding, &none)
                .expect("a channel")
        })
    };
    for topic in empty {
        add(&mut writer, topic, "nav_msgs/msg/Odometry");
    }
    for message in messages {
        let channel_id = add(&mut writer, &message.topic, message.content.ros2_type());
        let header = mcap::records::MessageHeader {
            channel_id,
            sequence: 0,
            log_time: message.at.0 as u64,
            publish_time: message.at.0 as u64,
        };
        writer
            .write_to_known_channel(&header, &payload(&message.content))
            .expect("written");
    }
    writer.finish().expect("ended");
    writer.into_inner().into_inner()
}

fn plain_mcap(messages: &[Message]) -> Vec<u8> {
    mcap(messages, WriteOptions::new(), "cdr", Content::cdr, &[])
}

/// rosbag2's tables.
fn write_db3(path: &Path, messages: &[Message], payload: Payload) {
    let database = rusqlite::Connection::open(path).expect("a database");
    database
        .execute_batch(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, \
             serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);\
             CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, \
             data BLOB NOT NULL); CREATE INDEX timestamp_idx ON messages (timestamp ASC); BEGIN;",
        )
        .expect("tables");
    let mut ids = BTreeMap::new();
    for message in messages {
        let next = ids.len() as i64 + 1;
        let id = *ids.entry(&message.topic).or_insert_with(|| {
            let row = (next, &message.topic, message.content.ros2_type());
            database
                .execute("INSERT INTO topics VALUES (?1, ?2, ?3, 'cdr', '')", row)
                .expect("a topic");
            next
        });
        let row = (id, message.at.0, payload(&message.content));
        database
            .execute(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (?1, ?2, ?3)",
                row,
            )
            .expect("a message");
    }
    database.execute_batch("COMMIT").expect("written");
}

/// A record of a ROS 1 bag.
fn record(fields: &[(&str, &[u8])], data: &[u8]) -> Vec<u8> {
    let fields: Vec<u8> = fields
        .iter()
        .flat_map(|(name, value)| {
            let field = [name.as_bytes(), b"=", value].concat();
            [&(field.len() as u32).to_le_bytes()[..], &field].concat()
        })
        .collect();
    let length = |bytes: &[u8]| (bytes.len() as u32).to_le_bytes();
    [&length(&fields)[..], &fields, &length(data), data].concat()
}

/// A ROS 1 bag, with a chunk for every ten messages.
fn ros1(messages: &[Message], compression: &str) -> Vec<u8> {
    let mut bag = b"#ROSBAG V2.0\n".to_vec();
    let none = 0_u64.to_le_bytes();
    bag.extend(record(&[("op", &[3]), ("index_pos", &none)], &[b' '; 64]));
    let mut topics: Vec<&str> = Vec::new();
    for messages in messages.chunks(10) {
        let mut chunk = Vec::new();
        for message in messages {
            let known = topics.iter().position(|topic| *topic == message.topic);
            let number = (known.unwrap_or(topics.len()) as u32).to_le_bytes();
            if known.is_none() {
                topics.push(&message.topic);
                let message_type = message.content.ros2_type().replace("/msg/", "/");
                let field = format!("type={message_type}");
                let data = [&(field.len() as u32).to_le_bytes()[..], field.as_bytes()].concat();
                let fields: [(&str, &[u8]); 3] = [
                    ("op", &[7]),
                    ("conn", &number),
                    ("topic", message.topic.as_bytes()),
                ];
                chunk.extend(record(&fields, &data));
            }
            let (seconds, rest) = (message.at.0 / 1_000_000_000, message.at.0 % 1_000_000_000);
            let time = [(seconds as u32).to_le_bytes(), (rest as u32).to_le_bytes()].concat();
            let fields: [(&str, &[u8]); 3] = [("op", &[2]), ("conn", &number), ("time", &time)];
            chunk.extend(record(&fields, &message.content.ros1()));
        }
        let data = match compression {
            "bz2" => {
                let mut encoder = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::fast());
                encoder.write_all(&chunk).expect("compresses");
                encoder.finish().expect("compresses")
            }
            "lz4" => {
                let mut encoder = lz4::EncoderBuilder::new().build(Vec::new()).expect("compresses");
                encoder.write_all(&chunk).expect("compresses");
                let (data, result) = encoder.finish();
                result.expect("compresses");
                data
            }
            _ => chunk.clone(),
        };
        let size = (chunk.len() as u32).to_le_bytes();
        let fields: [(&str, &[u8]); 3] = [
            ("op", &[5]),
            ("compression", compression.as_bytes()),
            ("size", &size),
        ];
        bag.extend(record(&fields, &data));
        bag.extend(record(
            &[("op", &[4]), ("ver", &1_u32.to_le_bytes())],
            b"an index",
        ));
    }
    bag
}

/// A folder for the files of one test.
struct Bench(TempDir);

impl Bench {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a folder"))
    }

    fn file(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.path().join(name);
        fs::write(&path, bytes).expect("written");
        path
    }

    /// A folder as rosbag2 leaves it.
    fn folder(&self, name: &str, files: &[&str], write: impl Fn(&str, &Path)) -> PathBuf {
        let folder = self.0.path().join(name);
        fs::create_dir(&folder).expect("a folder");
        for file in files {
            write(file, &folder.join(file));
        }
        let text = format!(
            "rosbag2_bagfile_information:\n  version: 8\n  relative_file_paths: [{}]\n  topics_with_message_count: []\n",
            files.join(", ")
        );
        fs::write(folder.join("metadata.yaml"), text).expect("written");
        folder
    }
}

fn sensors(path: &Path) -> SensorLog {
    let bag = Bag::read(path).unwrap_or_else(|error| panic!("{error}"));
    bag.sensors(&Topics::default(), None)
        .unwrap_or_else(|error| panic!("{error}"))
}

fn fault(path: &Path) -> String {
    match Bag::read(path) {
        Err(error) => error.to_string(),
        Ok(bag) => bag
            .sensors(&Topics::default(), None)
            .expect_err("faulty")
            .to_string(),
    }
}

/// Scans, odometry.
fn counts(log: &SensorLog) -> [usize; 2] {
    let scans = log
        .arrivals
        .iter()
        .filter(|arrival| matches!(arrival.event, SensorEvent::Scan(_)));
    let scans = scans.count();
    [scans, log.arrivals.len() - scans]
}

#[test]
fn every_form_of_a_drive_gives_the_same_sensor_data() {
    let bench = Bench::new();
    let drive = drive();
    let expected = sensors(&bench.file("drive.mcap", &plain_mcap(&drive)));
    assert_eq!((counts(&expected), expected.truth.len()), ([20, 20], 20));
    assert!(expected.notes.is_empty(), "{:?}", expected.notes);

    let (first, second) = drive.split_at(drive.len() / 2);
    let unindexed = WriteOptions::new()
        .emit_summary_records(false)
        .emit_summary_offsets(false)
        .emit_message_indexes(false)
        .emit_chunk_indexes(false)
        .emit_statistics(false);
    let lz4 = WriteOptions::new().compression(Some(Compression::Lz4));
    let whole = plain_mcap(&drive);
    let db3 = bench.0.path().join("drive.db3");
    write_db3(&db3, &drive, Content::cdr);
    let forms = [
        bench.file(
            "unindexed.mcap",
            &mcap(&drive, unindexed, "cdr", Content::cdr, &[]),
        ),
        bench.file("chunks-lz4.mcap", &mcap(&drive, lz4, "cdr", Content::cdr, &[])),
        bench.file(
            "messages.mcap",
            &mcap(&drive, WriteOptions::new(), "cdr", compressed, &[]),
        ),
        bench.file(
            "ros1.mcap",
            &mcap(&drive, WriteOptions::new(), "ros1", Content::ros1, &[]),
        ),
        bench.file("whole.mcap.zstd", &zstd_of(&whole)),
        bench.file("none.bag", &ros1(&drive, "none")),
        bench.file("bz2.bag", &ros1(&drive, "bz2")),
        bench.file("lz4.bag", &ros1(&drive, "lz4")),
        bench.file("drive.db3.zstd", &zstd_of(&fs::read(&db3).expect("reads"))),
        db3,
        bench.folder("split", &["s_0.mcap", "s_1.mcap"], |name, path| {
            let part = if name == "s_0.mcap" { first } else { second };
            fs::write(path, plain_mcap(part)).expect("written");
        }),
        bench.folder("files", &["f_0.mcap.zstd", "f_1.mcap.zstd"], |name, path| {
            let part = if name == "f_0.mcap.zstd" { first } else { second };
            fs::write(path, zstd_of(&plain_mcap(part))).expect("written");
        }),
        bench.folder("db3", &["d_0.db3", "d_1.db3"], |name, path| {
            let part = if name == "d_0.db3" { first } else { second };
            write_db3(path, part, compressed);
        }),
    ];
    for form in forms {
        let log = sensors(&form);
        assert_eq!(log.arrivals, expected.arrivals, "{}", form.display());
        assert_eq!(log.truth, expected.truth, "{}", form.display());
        assert_eq!(log.mount, expected.mount, "{}", form.display());
        assert!(log.notes.is_empty(), "{}: {:?}", form.display(), log.notes);
    }
}

// A recorder that lost its power used to leave a bag that nothing could be made of.
#[test]
fn a_bag_that_is_cut_off_is_read_as_far_as_it_goes_and_says_so() {
    let bench = Bench::new();
    let drive = drive();
    let chunks = WriteOptions::new().chunk_size(Some(4000));
    let mcap = mcap(&drive, chunks, "cdr", Content::cdr, &[]);
    let ros1 = ros1(&drive, "lz4");
    for (name, bytes, advice) in [
        ("cut.mcap", mcap, "mcap recover"),
        ("cut.bag", ros1, "rosbag reindex"),
    ] {
        let cut = bench.file(name, &bytes[..bytes.len() * 6 / 10]);
        let log = sensors(&cut);
        let [scans, _] = counts(&log);
        assert!((5..20).contains(&scans), "{name}: {scans} scans");
        let [note] = &log.notes[..] else {
            panic!("{name}: {:?}", log.notes);
        };
        for word in [name, "cut off", advice] {
            assert!(note.contains(word), "{note} should say {word}");
        }
        // Before the first message there is nothing to use.
        let text = fault(&bench.file(name, &bytes[..100]));
        assert!(text.contains(name) && text.contains(advice), "{text}");
    }
}

#[test]
fn damage_anywhere_is_named_and_never_a_panic() {
    let bench = Bench::new();
    let drive = &drive()[..12];
    let db3 = bench.0.path().join("drive.db3");
    write_db3(&db3, drive, Content::cdr);
    let forms = [
        ("drive.mcap", plain_mcap(drive)),
        ("drive.bag", ros1(drive, "none")),
        ("bz2.bag", ros1(drive, "bz2")),
        ("lz4.bag", ros1(drive, "lz4")),
        ("damaged.db3", fs::read(&db3).expect("reads")),
    ];
    for (name, bytes) in forms {
        let mut faults = 0;
        for at in (0..bytes.len()).step_by(37) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0xff;
            if let Err(error) = Bag::read(&bench.file(name, &damaged)) {
                faults += 1;
                let text = error.to_string();
                assert!(text.contains(name), "byte {at}: {text}");
            }
            // Cut off, too.
            Bag::read(&bench.file(name, &bytes[..at])).ok();
        }
        assert!(faults > 3, "{name}: {faults}");
    }
    let text = fault(&bench.file("notes.txt", b"a wet track"));
    assert!(text.contains("notes.txt") && text.contains("MCAP"), "{text}");
    assert!(fault(&bench.file("empty.mcap", b"")).contains("it is empty"));
    let mut old = ros1(drive, "none");
    old[9] = b'1';
    assert!(fault(&bench.file("old.bag", &old)).contains("rosbag fix"));
}

#[test]
fn a_topic_without_messages_is_named() {
    let bench = Bench::new();
    let drive: Vec<_> = drive()
        .into_iter()
        .filter(|message| message.topic != "/odom")
        .collect();
    let bag = mcap(&drive, WriteOptions::new(), "cdr", Content::cdr, &["/odom"]);
    let text = fault(&bench.file("drive.mcap", &bag));
    assert!(text.contains("drive.mcap: /odom has no messages"), "{text}");
    // Without the topic there is another fault.
    let text = fault(&bench.file("drive.mcap", &plain_mcap(&drive)));
    assert!(text.contains("no topic of type nav_msgs/Odometry"), "{text}");
}

fn log_of(messages: &[Message]) -> SensorLog {
    let bench = Bench::new();
    sensors(&bench.file("drive.mcap", &plain_mcap(messages)))
}

/// The drive with one topic changed.
fn with(change: impl Fn(&mut Message)) -> Vec<Message> {
    let mut drive = drive();
    drive.iter_mut().for_each(change);
    drive
}

fn says(log: &SensorLog, words: &[&str]) {
    for word in words {
        assert!(
            log.notes.iter().any(|note| note.contains(word)),
            "{:?} should say {word}",
            log.notes
        );
    }
}

#[test]
fn the_topics_of_one_car_are_taken_together() {
    // The scans of a first car without odometry.
    let mut two_cars = with(|message| message.topic = format!("/car2{}", message.topic));
    two_cars.extend((0..20).map(|i| {
        let now = f64::from(i) * 0.025;
        message("/car1/scan", now, scan(now, "laser", 4.7))
    }));
    let log = log_of(&two_cars);
    assert_eq!(log.topics.scan.as_deref(), Some("/car2/scan"));
    assert_eq!(log.topics.odometry.as_deref(), Some("/car2/odom"));
    says(&log, &["/car1/scan"]);

    // A depth camera beside the lidar, with transforms and without.
    for with_frames in [true, false] {
        let mut two_scanners = with(|message| {
            if message.topic == "/scan" {
                message.topic = "/lidar/scan".into();
            }
        });
        two_scanners.retain(|message| with_frames || message.topic != "/tf_static");
        two_scanners.extend((0..20).map(|i| {
            let now = f64::from(i) * 0.025;
            message("/camera/scan", now, scan(now, "camera", 1.0))
        }));
        let log = log_of(&two_scanners);
        assert_eq!(log.topics.scan.as_deref(), Some("/lidar/scan"));
        says(&log, &["/camera/scan"]);
    }
}

#[test]
fn frames_are_used_as_they_are_meant() {
    let expected = sensors_of_drive();
    // The laser's frame on /tf alone, again and again.
    let mut on_tf = with(|message| {
        if message.topic == "/tf_static" {
            message.topic = "/tf".into();
        }
    });
    on_tf.push(message("/tf", 0.4, tf("base_link", "laser", 0.27)));
    on_tf.push(message("/tf", 0.1, tf("odom", "base_link", 1.0)));
    on_tf.push(message("/tf", 0.2, tf("odom", "base_link", 2.0)));
    assert_eq!(log_of(&on_tf).mount, expected.mount);

    // Odometry of the centre of gravity, 0.15 m ahead of the rear axle.
    let mut of_cog = with(|message| {
        if let Content::Odometry(odometry) = &mut message.content {
            odometry.child_frame_id = "cog".into();
        }
    });
    of_cog.push(message("/tf_static", 0.0, tf("base_link", "cog", 0.15)));
    let log = log_of(&of_cog);
    assert_eq!(log.mount, expected.mount);
    says(&log, &["cog", "base_link"]);
    let SensorEvent::Odometry(odometry) = log.arrivals[0].event else {
        panic!("odometry first");
    };
    assert!(
        (odometry.twist.linear_y + 0.15 * 0.5).abs() < 1e-9,
        "{odometry:?}"
    );

    // No frame at all.
    let nameless = with(|message| {
        if let Content::Odometry(odometry) = &mut message.content {
            odometry.child_frame_id.clear();
        }
    });
    let log = log_of(&nameless);
    assert_eq!(log.mount, expected.mount);
    says(&log, &["/odom names no frame"]);
}

fn sensors_of_drive() -> SensorLog {
    log_of(&drive())
}

#[test]
fn sensors_of_another_clock_are_put_on_one() {
    let expected = sensors_of_drive();
    let stamps = |log: &SensorLog| -> Vec<Stamp> {
        log.arrivals
            .iter()
            .filter(|arrival| matches!(arrival.event, SensorEvent::Scan(_)))
            .map(|arrival| arrival.event.stamp())
            .collect()
    };
    let since_boot = with(|message| {
        if let Content::Scan(scan) = &mut message.content {
            let stamp = Stamp::from(scan.header.stamp);
            scan.header.stamp = Stamp(stamp.0 - START.0 + 77_000_000_000).into();
        }
    });
    let log = log_of(&since_boot);
    says(&log, &["/scan: its stamps are 1699999923.020 s behind"]);
    for (found, expected) in stamps(&log).iter().zip(stamps(&expected)) {
        // Up to the latency of the scans, which nobody knows.
        assert!((found.since(expected) - 0.02).abs() < 1e-3);
    }
    // Some drivers stamp a scan when its sweep has ended.
    let swept = |late: f64| {
        let mut drive = with(|message| {
            if let Content::Scan(scan) = &mut message.content {
                scan.time_increment = 0.01875 / 39.0;
            }
        });
        for message in &mut drive {
            if let Content::Scan(scan) = &mut message.content {
                scan.header.stamp = message.at.plus(-late).into();
            }
        }
        log_of(&drive)
    };
    let log = swept(0.001);
    says(&log, &["/scan: scans arrive 1.0 ms after", "last beam"]);
    for (found, expected) in stamps(&log).iter().zip(stamps(&expected)) {
        // Sent 20 ms after the first beam, 1 ms after the last.
        assert!((found.since(expected) - 0.00025).abs() < 1e-6);
    }
    assert!(swept(0.02).notes.is_empty(), "as a scanner should");

    let zero = with(|message| {
        if let Content::Scan(scan) = &mut message.content {
            scan.header.stamp = Stamp(0).into();
        }
    });
    let log = log_of(&zero);
    says(&log, &["/scan: every stamp is 0 s"]);
    assert!(stamps(&log)[0].since(START).abs() < 0.1);

    // `run` waited for a time of arrival in 1970.
    let truth = with(|message| {
        if let ("/ground_truth/odom", Content::Odometry(odometry)) =
            (&message.topic[..], &mut message.content)
        {
            odometry.header.stamp = Stamp(0).into();
        }
    });
    let log = log_of(&truth);
    assert!(log.truth.is_empty());
    says(&log, &["/ground_truth/odom", "it is not used"]);
}
