//! A ROS 2 bag of a drive through a small synthetic room.

use std::f64::consts::{FRAC_PI_2, TAU};
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use car_node::ros2::messages::{
    self, Header, LaserScan, Orientation, RosOdometry, RosPose, TfMessage, TransformStamped, Vector3,
};
use maps::{Cell, OccupancyGrid, Pose};
use synpf::Stamp;

/// Edge of a cell \[m\].
const RESOLUTION: f64 = 0.05;
/// Radius of the drive \[m\].
const RADIUS: f64 = 0.8;
/// Speed of the drive \[m/s\].
const SPEED: f64 = 1.0;
const BASE_LINK_FROM_LASER: Pose = Pose {
    x: 0.27,
    y: 0.0,
    heading: 0.0,
};
const BEAMS: u32 = 361;

/// A room of 8 m x 4 m. A recess at one end makes it asymmetric.
pub fn room() -> OccupancyGrid {
    let (width, height) = (160, 80);
    let wall = |column: usize, row: usize| {
        column == 0 || row == 0 || column == width - 1 || row == height - 1 || (column > 110 && row > 60)
    };
    let cell = |column, row| {
        if wall(column, row) {
            Cell::Occupied
        } else {
            Cell::Free
        }
    };
    OccupancyGrid::from_fn(width, height, RESOLUTION, Pose::IDENTITY, cell)
}

/// The car's pose at a time after the start \[s\]. It drives on a circle in the left half of the room.
pub fn true_pose(seconds: f64) -> Pose {
    let angle = seconds * SPEED / RADIUS;
    Pose::new(
        2.2 + RADIUS * angle.cos(),
        2.0 + RADIUS * angle.sin(),
        angle + FRAC_PI_2,
    )
}

/// Writes a bag of the given duration \[s\], with scans at 40 Hz, odometry and ground truth at 50 Hz, and the laser's
/// transform.
pub fn write_bag(path: &Path, room: &OccupancyGrid, seconds: f64) {
    let file = BufWriter::new(File::create(path).expect("a new file"));
    let mut bag = mcap::Writer::new(file).expect("a bag");
    let mut channel = |topic: &str, schema: &str| {
        let schema = bag.add_schema(schema, "ros2msg", b"").expect("a schema");
        let none = std::collections::BTreeMap::new();
        bag.add_channel(schema, topic, "cdr", &none).expect("a channel")
    };
    let scans = channel("/scan", "sensor_msgs/msg/LaserScan");
    let odometry = channel("/odom", "nav_msgs/msg/Odometry");
    let truth = channel("/ground_truth/odom", "nav_msgs/msg/Odometry");
    let tf = channel("/tf_static", "tf2_msgs/msg/TFMessage");
    let start = Stamp(1_700_000_000_000_000_000);
    let mut write = |channel_id: u16, seconds: f64, payload: Vec<u8>| {
        let at = start.plus(seconds).0 as u64;
        let header = mcap::records::MessageHeader {
            channel_id,
            sequence: 0,
            log_time: at,
            publish_time: at,
        };
        bag.write_to_known_channel(&header, &payload).expect("written");
    };
    let header = |seconds: f64, frame: &str| Header {
        stamp: start.plus(seconds).into(),
        frame_id: frame.into(),
    };
    let mount = TransformStamped {
        header: header(0.0, "base_link"),
        child_frame_id: "laser".into(),
        transform: RosPose {
            position: Vector3 {
                x: BASE_LINK_FROM_LASER.x,
                y: 0.0,
                z: 0.1,
            },
            orientation: Orientation::default(),
        },
    };
    let transforms = vec![mount];
    write(
        tf,
        0.0,
        messages::encode(&TfMessage { transforms }).expect("encoded"),
    );
    let first = true_pose(0.0);
    // One loop of 5 ms keeps the messages in order of time.
    for tick in 0..(seconds * 200.0) as u32 {
        let now = f64::from(tick) * 0.005;
        let pose = true_pose(now);
        if tick % 4 == 0 {
            let mut message = RosOdometry {
                header: header(now, "odom"),
                child_frame_id: "base_link".into(),
                pose: pose.since(first).into(),
                ..RosOdometry::default()
            };
            message.linear.x = SPEED;
            message.angular.z = SPEED / RADIUS;
            write(odometry, now, messages::encode(&message).expect("encoded"));
            message.header.frame_id = "map".into();
            message.pose = pose.into();
            write(truth, now, messages::encode(&message).expect("encoded"));
        }
        if tick % 5 == 0 {
            let laser = pose * BASE_LINK_FROM_LASER;
            let increment = 0.75 * TAU / f64::from(BEAMS - 1);
            let angle = |beam: u32| f64::from(beam).mul_add(increment, -0.375 * TAU);
            let message = LaserScan {
                header: header(now, "laser"),
                angle_min: angle(0) as f32,
                angle_max: angle(BEAMS - 1) as f32,
                angle_increment: increment as f32,
                scan_time: 0.025,
                range_min: 0.02,
                range_max: 30.0,
                ranges: (0..BEAMS).map(|beam| range(room, laser, angle(beam))).collect(),
                ..LaserScan::default()
            };
            write(scans, now, messages::encode(&message).expect("encoded"));
        }
    }
    bag.finish().expect("a whole file");
}

/// Range of a beam \[m\]. It is found in steps of 5 mm, without the code under test.
fn range(room: &OccupancyGrid, laser: Pose, angle: f64) -> f32 {
    let (sin, cos) = (laser.heading + angle).sin_cos();
    let steps = (0..).map(|step| f64::from(step) * 0.005);
    let at_wall = |&range: &f64| room.at([laser.x + cos * range, laser.y + sin * range]) != Cell::Free;
    steps.take(4000).find(at_wall).unwrap_or(f64::INFINITY) as f32
}
