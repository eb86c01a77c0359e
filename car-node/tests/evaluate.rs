//! `car-node evaluate` and `car-node stress` as a user calls them, on a bag and a map written here.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use car_node::ros2::messages::{
    self, Header, LaserScan, Orientation, RosOdometry, RosPose, TfMessage, TransformStamped, Vector3,
};
use maps::Pose;
use serde::Serialize;
use synpf::Stamp;

/// A room of 8 m x 4 m with walls one cell thick, and a recess that makes its ends different.
const WIDTH: usize = 160;
const HEIGHT: usize = 80;
const RESOLUTION: f64 = 0.05;

fn occupied(column: usize, row: usize) -> bool {
    let border = column == 0 || row == 0 || column == WIDTH - 1 || row == HEIGHT - 1;
    border || (column > 110 && row > 60)
}

fn write_map(folder: &Path) -> PathBuf {
    let mut pgm = format!("P5\n{WIDTH} {HEIGHT}\n255\n").into_bytes();
    for row in (0..HEIGHT).rev() {
        pgm.extend((0..WIDTH).map(|column| if occupied(column, row) { 0 } else { 255 }));
    }
    fs::write(folder.join("map.pgm"), pgm).expect("writes");
    let yaml = format!(
        "image: map.pgm\nresolution: {RESOLUTION}\norigin: [0.0, 0.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\n\
         free_thresh: 0.196\n"
    );
    let path = folder.join("map.yaml");
    fs::write(&path, yaml).expect("writes");
    path
}

/// Range by stepping 2 mm at a time: independent of the ray casting under test.
fn range(laser: Pose, angle: f64) -> f32 {
    let (sin, cos) = (laser.heading + angle).sin_cos();
    let mut distance = 0.0;
    loop {
        let (x, y) = (laser.x + cos * distance, laser.y + sin * distance);
        if occupied((x / RESOLUTION) as usize, (y / RESOLUTION) as usize) {
            return distance as f32;
        }
        distance += 0.002;
    }
}

/// A circle of 0.8 m radius about the middle of the room's left half, at 1 m/s.
fn true_pose(seconds: f64) -> Pose {
    let (sin, cos) = (seconds / 0.8).sin_cos();
    Pose::new(
        2.2 + 0.8 * cos,
        2.0 + 0.8 * sin,
        seconds / 0.8 + std::f64::consts::FRAC_PI_2,
    )
}

struct BagWriter {
    writer: mcap::Writer<std::io::BufWriter<fs::File>>,
}

impl BagWriter {
    fn create(path: &Path) -> Self {
        let file = std::io::BufWriter::new(fs::File::create(path).expect("creates"));
        Self {
            writer: mcap::Writer::new(file).expect("starts"),
        }
    }

    fn channel(&mut self, topic: &str, schema: &str) -> u16 {
        let schema = self.writer.add_schema(schema, "ros2msg", b"").expect("schema");
        self.writer
            .add_channel(schema, topic, "cdr", &std::collections::BTreeMap::new())
            .expect("channel")
    }

    fn write<T: Serialize>(&mut self, channel: u16, log_time: Stamp, message: &T) {
        let header = mcap::records::MessageHeader {
            channel_id: channel,
            sequence: 0,
            log_time: log_time.0 as u64,
            publish_time: log_time.0 as u64,
        };
        self.writer
            .write_to_known_channel(&header, &messages::encode(message).expect("encodes"))
            .expect("writes");
    }
}

fn header(stamp: Stamp, frame: &str) -> Header {
    Header {
        stamp: stamp.into(),
        frame_id: frame.into(),
    }
}

/// Four seconds: 40 Hz scans that arrive 20 ms late, 50 Hz odometry, truth, and the mount; another scanner and
/// another odometry beside them.
fn write_bag(folder: &Path) -> PathBuf {
    write_bag_with_truth(folder, "/ground_truth/odom")
}

/// The same, with the truth under another topic.
fn write_bag_with_truth(folder: &Path, truth_topic: &str) -> PathBuf {
    let path = folder.join("drive.mcap");
    let mut bag = BagWriter::create(&path);
    let scan = bag.channel("/scan", "sensor_msgs/msg/LaserScan");
    let odometry = bag.channel("/vesc/odom", "nav_msgs/msg/Odometry");
    let truth = bag.channel(truth_topic, "nav_msgs/msg/Odometry");
    let tf = bag.channel("/tf_static", "tf2_msgs/msg/TFMessage");
    let chatter = bag.channel("/chatter", "std_msgs/msg/String");
    let start = Stamp(1_700_000_000_000_000_000);
    let base_link_from_laser = Pose::new(0.27, 0.0, 0.0);

    bag.write(chatter, start, &"not for us".to_owned());
    let mount = TransformStamped {
        header: header(start, "base_link"),
        child_frame_id: "laser".into(),
        transform: RosPose {
            position: Vector3 {
                x: 0.27,
                y: 0.0,
                z: 0.1,
            },
            orientation: Orientation::default(),
        },
    };
    bag.write(
        tf,
        start,
        &TfMessage {
            transforms: vec![mount],
        },
    );
    let first = true_pose(0.0);
    for tick in 0..200 {
        let seconds = f64::from(tick) * 0.02;
        let stamp = start.plus(seconds);
        let pose = true_pose(seconds);
        let mut message = RosOdometry {
            header: header(stamp, "odom"),
            child_frame_id: "base_link".into(),
            pose: pose.since(first).into(),
            ..RosOdometry::default()
        };
        message.linear.x = 1.0;
        message.angular.z = 1.0 / 0.8;
        bag.write(odometry, stamp.plus(0.001), &message);
        message.header.frame_id = "map".into();
        message.pose = pose.into();
        bag.write(truth, stamp, &message);
    }
    for tick in 0..160 {
        let seconds = f64::from(tick) * 0.025;
        let laser = true_pose(seconds) * base_link_from_laser;
        let message = LaserScan {
            header: header(start.plus(seconds), "laser"),
            angle_min: -2.35,
            angle_max: 2.35,
            angle_increment: 0.01,
            scan_time: 0.025,
            range_min: 0.02,
            range_max: 30.0,
            ranges: (0..471)
                .map(|beam| range(laser, -2.35 + 0.01 * f64::from(beam)))
                .collect(),
            ..LaserScan::default()
        };
        bag.write(scan, start.plus(seconds + 0.02), &message);
    }
    bag.writer.finish().expect("finishes");
    path
}

fn evaluate(map: &Path, bag: &Path, more: &[&str]) -> Output {
    car_node("evaluate", map, bag, more)
}

fn car_node(command: &str, map: &Path, bag: &Path, more: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_car-node"))
        .arg(command)
        .arg("--map")
        .arg(map)
        .arg("--bag")
        .arg(bag)
        .args(more)
        .output()
        .expect("starts")
}

#[test]
fn a_drive_is_localized_measured_and_repeatable() {
    let folder = tempfile::tempdir().expect("folder");
    let (map, bag) = (write_map(folder.path()), write_bag(folder.path()));
    let poses = folder.path().join("poses.csv");
    let run = |poses: &Path| {
        let poses = poses.to_str().expect("UTF-8");
        let output = evaluate(
            &map,
            &bag,
            &["--initial-pose", "truth", "--json", "--poses", poses],
        );
        assert!(
            output.status.success(),
            "{}",
            String::from_utf8_lossy(&output.stderr)
        );
        serde_json::from_slice::<serde_json::Value>(&output.stdout).expect("one JSON object")
    };
    let report = run(&poses);
    assert_eq!(report["scans"], 160);
    let updates = report["updates"].as_u64().expect("a count");
    assert!(updates >= 158, "{report}");
    // 5 cm cells and 2 mm steps of the ray: a filter that works is well inside one cell.
    let rmse = report["position_error_m"]["rmse"]
        .as_f64()
        .expect("truth is there");
    assert!(rmse < 0.05, "{report}");
    assert!(report["heading_error_rad"]["rmse"].as_f64().expect("truth") < 0.03);
    assert_eq!(report["excursions"], 0);
    assert!(
        report["alignment"]["p05"].as_f64().expect("updates") > 0.8,
        "{report}"
    );
    assert!(report["update_us"]["p50"].is_number());
    assert!(report["range_table"]["build_ms"].is_number());

    let text = fs::read_to_string(&poses).expect("written");
    let mut lines = text.lines();
    assert_eq!(
        lines.next(),
        Some("stamp_s,x_m,y_m,heading_rad,xx,xy,yy,xh,yh,hh,state,mode,align,short,long")
    );
    assert_eq!(lines.count() as u64, updates);
    assert!(text.contains("\n1700000000.050000000,"), "stamps are the scans'");

    // Its own poses serve as truth and as the start.
    let own = poses.to_str().expect("UTF-8");
    let output = evaluate(&map, &bag, &["--truth", own, "--initial-pose", "truth", "--json"]);
    let held: serde_json::Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    assert!(
        held["position_error_m"]["max"].as_f64().expect("truth") < 0.02,
        "{held}"
    );

    let again = folder.path().join("again.csv");
    run(&again);
    assert_eq!(
        text,
        fs::read_to_string(&again).expect("written"),
        "same seed, same poses"
    );
}

#[test]
fn a_part_of_a_bag_can_be_evaluated() {
    let folder = tempfile::tempdir().expect("folder");
    let (map, bag) = (write_map(folder.path()), write_bag(folder.path()));
    let part = ["--initial-pose", "truth", "--from", "1.5", "--for", "2", "--json"];
    let output = evaluate(&map, &bag, &part);
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    assert_eq!(report["scans"], 80, "40 a second");
    assert_eq!(report["updates"], 80, "odometry leads up to the first: {report}");
    let first = &report["state_changes"][0];
    assert_eq!(
        first["right"], true,
        "it starts from the truth at that time: {report}"
    );
}

#[test]
fn another_localizer_is_judged_beside_ours() {
    let folder = tempfile::tempdir().expect("folder");
    let (map, bag) = (write_map(folder.path()), write_bag(folder.path()));
    // The truth stands in for a very good localizer.
    let start = ["--initial-pose", "truth", "--beside", "external", "--json"];
    let topic = ["--pose-topic", "/ground_truth/odom"];
    let output = evaluate(&map, &bag, &[&start[..], &topic[..]].concat());
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let rows: Vec<serde_json::Value> = serde_json::from_slice(&output.stdout).expect("an array");
    let [ours, theirs] = &rows[..] else {
        panic!("two rows: {rows:?}");
    };
    assert_eq!(
        (&ours["params"], &theirs["params"]),
        (&"hq".into(), &"external".into())
    );
    let rmse = theirs["position_error_m"]["rmse"].as_f64().expect("truth");
    assert!(rmse < 0.005, "{theirs}");
    assert!(
        theirs["state_share"]["localized"].as_f64().expect("judged") > 0.5,
        "{theirs}"
    );
    assert!(theirs["updates"].as_u64().expect("a count") >= 150, "{theirs}");

    // Alone, and with what is missing.
    let output = evaluate(
        &map,
        &bag,
        &[&["--localizer", "external", "--json"][..], &topic[..]].concat(),
    );
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    for (more, code, words) in [
        (&["--localizer", "external"][..], 2, "--pose-topic"),
        (
            &["--localizer", "external", "--pose-topic", "/amcl_pose"],
            1,
            "no topic /amcl_pose",
        ),
        (
            &[
                "--localizer",
                "external",
                "--pose-topic",
                "/vesc/odom",
                "--odom-topic",
                "/vesc/odom",
            ],
            1,
            "frame is \"odom\"",
        ),
        (
            &["--localizer", "external", "--pose-topic", "/tf_static"],
            1,
            "no transform from map",
        ),
        (&["--beside", "hq"], 2, "the same set"),
    ] {
        let output = evaluate(&map, &bag, more);
        let text = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{text}");
        assert!(text.contains(words), "{text} should say {words}");
    }
}

#[test]
fn faults_are_named_with_their_file() {
    let folder = tempfile::tempdir().expect("folder");
    let here = folder.path();
    let (map, bag) = (write_map(here), write_bag(here));
    // A bag that was cut off in the middle, as by a full disk.
    let bytes = fs::read(&bag).expect("reads");
    let cut = here.join("cut.mcap");
    fs::write(&cut, &bytes[..bytes.len() / 2]).expect("writes");
    let fails = |code: i32, map: &Path, bag: &Path, more: &[&str], words: &[&str]| {
        let output = evaluate(map, bag, more);
        let text = String::from_utf8(output.stderr).expect("UTF-8");
        assert_eq!(output.status.code(), Some(code), "{text}");
        assert!(output.stdout.is_empty(), "nothing on stdout but results");
        for word in words {
            assert!(text.contains(word), "{text} should say {word}");
        }
    };
    // Faulty files.
    fails(
        1,
        &map,
        &bag,
        &["--scan-topic", "/scan_2"],
        &["/scan_2", "/vesc/odom"],
    );
    fails(1, &map, &map, &[], &["map.yaml: ", "MCAP", "ROS 1"]);
    fails(1, &map, here, &[], &["metadata.yaml", "cut.mcap, drive.mcap"]);
    fails(1, &map, &cut, &[], &["cut.mcap: ", "mcap recover"]);
    fails(1, &bag, &bag, &[], &["not a text file"]);
    let poses = here.join("truth.csv");
    fs::write(&poses, "stamp_s,x,y,heading_rad\n").expect("writes");
    let truth = ["--truth", poses.to_str().expect("UTF-8")];
    fails(1, &map, &bag, &truth, &["truth.csv: no columns", "laser_x_m"]);
    // Wrong usage.
    fails(
        2,
        &map,
        &bag,
        &["--params", "no-such-set"],
        &["no-such-set", "synpf-baseline"],
    );
    for fault in ["no-scans@4+1", "kidnap@3+1"] {
        fails(2, &map, &bag, &["--fault", fault], &[fault, "ends 4.0 s"]);
    }
    fails(
        2,
        &map,
        &bag,
        &["--from", "9"],
        &["drive.mcap: no scan", "--from"],
    );
    fails(2, &map, &bag, &["--for", "-1"], &["--for", "from 0"]);
    fails(2, &map, &bag, &["--fault", "flood@1+1"], &["--fault", "splice"]);
    fails(
        2,
        &map,
        &bag,
        &["--poses", "p.csv", "--seed", "0,1"],
        &["--poses", "one --seed"],
    );
    fails(2, &map, &bag, &["--laser", "270,0,0"], &["--laser", "10 m"]);
}

#[test]
fn a_drive_is_damaged_and_the_report_says_where_the_set_holds() {
    let folder = tempfile::tempdir().expect("folder");
    let (map, bag) = (write_map(folder.path()), write_bag(folder.path()));
    let page = folder.path().join("stress.html");
    let only =
        "wall-missing:mild,range-noise:mild,dropout:mild,late-stamps:mild,twist-zero,gyro-none,kidnap:mild";
    let html = page.to_str().expect("UTF-8");
    let run = || car_node("stress", &map, &bag, &["--only", only, "--json", "--html", html]);
    let output = run();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    let set = &report["sets"][0];
    assert_eq!((&set["set"], &set["truth"]), (&"hq".into(), &"bag".into()));
    let rows = set["rows"].as_array().expect("rows");
    let names: Vec<_> = rows
        .iter()
        .map(|row| row["defect"].as_str().expect("a name"))
        .collect();
    // In the order of the catalogue.
    let expected = [
        "wall-missing",
        "range-noise",
        "dropout",
        "twist-zero",
        "gyro-none",
        "late-stamps",
        "kidnap",
    ];
    assert_eq!(names, expected);
    for row in rows {
        let defect = row["defect"].as_str();
        match (defect, row["not_applicable"].as_str()) {
            (Some("gyro-none"), reason) => assert_eq!(reason, Some("the log has no gyroscope")),
            (Some("kidnap"), reason) => assert_eq!(reason, Some("the log is too short: it needs 17 s")),
            (_, reason) => {
                assert_eq!(reason, None, "{row}");
                // In a small room, these do little.
                assert!(row["max_m"].as_f64().expect("updates") < 0.15, "{row}");
            }
        }
    }
    assert!(
        fs::read_to_string(&page)
            .expect("written")
            .contains("does not apply")
    );
    assert_eq!(run().stdout, output.stdout, "the same seed, the same report");
}

#[test]
fn a_bag_without_truth_is_compared_with_its_undamaged_run() {
    let folder = tempfile::tempdir().expect("folder");
    let map = write_map(folder.path());
    let bag = write_bag_with_truth(folder.path(), "/mocap");
    let more = ["--initial-pose", "3.0,2.0,1.571", "--only", "range-noise:mild"];
    let output = car_node("stress", &map, &bag, &more);
    let table = String::from_utf8_lossy(&output.stdout);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    assert!(table.contains("the set's own undamaged run"), "{table}");
    assert!(table.contains("undamaged: position RMSE 0.0 cm"), "{table}");
    // In a pipe there are no colours.
    assert!(
        table.contains("range-noise") && !table.contains('\u{1b}'),
        "{table}"
    );
}

#[test]
fn wrong_calls_of_stress_are_refused_with_the_reason() {
    let folder = tempfile::tempdir().expect("folder");
    let (map, bag) = (write_map(folder.path()), write_bag(folder.path()));
    for (more, words) in [
        (&["--only", "flood"][..], "no defect"),
        (&["--only", "people:awful"], "mild, medium, severe"),
        (&["--params", "no-such-set"], "no-such-set"),
        (&["--initial-pose", "here"], "--initial-pose"),
    ] {
        let output = car_node("stress", &map, &bag, more);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains(words), "{said}");
    }
}
