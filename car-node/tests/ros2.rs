//! A car with live ROS 2 sensors: a simulated car publishes as `rmw_zenoh` or a bridge does, and a node finds its topics,
//! localizes on them, and survives faulty messages.

mod common;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use car_node::localization::Start;
use car_node::node::{Node, NodeConfig, RaceMap};
use car_node::ros2::messages::{
    self, Header, LaserScan, Orientation, PointStamped, PoseStamped, PoseWithCovarianceStamped, RosOdometry,
    RosPose, TfMessage, TransformStamped, Vector3,
};
use car_node::ros2::output_publisher;
use car_node::ros2::output_publisher::OutputOptions;
use car_node::sensors::bag::{SensorEvent, Topics};
use car_node::sensors::clock::wall_now;
use car_node::sensors::{Feed, Next, PoseEstimate, Race, Ros2, Ros2Error, Ros2Options, Source};
use common::router;
use maps::Pose;
use serde::Serialize;
use simulator::{CarSetup, Track};
use synpf::{PoseOf, Stamp, TrackMap};
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig};

const DEADLINE: Duration = Duration::from_mins(1);

/// How the ROS side names its topics.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Naming {
    RmwZenoh,
    Bridge,
}

impl Naming {
    fn key(self, topic: &str, dds_type: &str) -> String {
        match self {
            Self::RmwZenoh => format!("0/{topic}/{dds_type}/RIHS01_0123"),
            Self::Bridge => topic.to_owned(),
        }
    }
}

/// The sensors of a simulated car, published as ROS does.
struct RosCar {
    router: Session,
    naming: Naming,
    _static_transforms: AdvancedPublisher<'static>,
}

impl RosCar {
    fn new(router: &Session, naming: Naming, base_link_from_laser: Pose) -> Self {
        let key = naming.key("tf_static", "tf2_msgs::msg::dds_::TFMessage_");
        let transforms = router
            .declare_publisher(key)
            .cache(CacheConfig::default().max_samples(1))
            .publisher_detection()
            .wait()
            .expect("a publisher");
        let mount = TransformStamped {
            header: header("base_link", wall_now()),
            child_frame_id: "laser".into(),
            transform: RosPose::from(base_link_from_laser),
        };
        transforms
            .put(bytes(&TfMessage {
                transforms: vec![mount],
            }))
            .wait()
            .expect("published before anybody listens");
        Self {
            router: router.clone(),
            naming,
            _static_transforms: transforms,
        }
    }

    fn publish(&self, topic: &str, dds_type: &str, payload: Vec<u8>) {
        let key = self.naming.key(topic, dds_type);
        self.router.put(key, payload).wait().expect("published");
    }

    fn send(&self, event: &SensorEvent) {
        match event {
            SensorEvent::Scan(scan) => self.publish(
                "scan",
                "sensor_msgs::msg::dds_::LaserScan_",
                bytes(&LaserScan {
                    header: header("laser", scan.stamp),
                    angle_min: scan.angle_min as f32,
                    angle_increment: scan.angle_increment as f32,
                    time_increment: scan.time_increment as f32,
                    range_min: scan.range_min as f32,
                    range_max: scan.range_max as f32,
                    ranges: scan.ranges.clone(),
                    ..LaserScan::default()
                }),
            ),
            SensorEvent::Odometry(odometry) => self.publish(
                "vesc/odom",
                "nav_msgs::msg::dds_::Odometry_",
                bytes(&RosOdometry {
                    header: header("odom", odometry.stamp),
                    child_frame_id: "base_link".into(),
                    pose: RosPose::from(odometry.pose),
                    linear: Vector3 {
                        x: odometry.twist.linear_x,
                        ..Vector3::default()
                    },
                    angular: Vector3 {
                        z: odometry.twist.angular,
                        ..Vector3::default()
                    },
                    ..RosOdometry::default()
                }),
            ),
            SensorEvent::YawRate(_) | SensorEvent::Pose(_) => {}
        }
    }
}

fn header(frame: &str, stamp: Stamp) -> Header {
    Header {
        stamp: stamp.into(),
        frame_id: frame.into(),
    }
}

fn bytes<T: Serialize>(message: &T) -> Vec<u8> {
    messages::encode(message).expect("encodes")
}

/// A drive in real time, published until `stop` is set. The driver steers by the node's estimate.
struct Drive {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<()>,
    estimate: Arc<Mutex<Option<PoseEstimate>>>,
    truth: Arc<Mutex<Vec<(Stamp, Pose)>>>,
}

fn drive(router: &Session, naming: Naming, track: &Track) -> (Drive, Pose) {
    let race = Race::new(track.clone(), vec![CarSetup::default()], 1, Vec::new());
    let mut car = race.car(0);
    let start = car.start().expect("known");
    let ros = RosCar::new(router, naming, car.mount().base_link_from_laser);
    let stop = Arc::<AtomicBool>::default();
    let estimate = Arc::<Mutex<Option<PoseEstimate>>>::default();
    let truth = Arc::<Mutex<Vec<(Stamp, Pose)>>>::default();
    let thread = thread::spawn({
        let (stop, estimate, truth) = (Arc::clone(&stop), Arc::clone(&estimate), Arc::clone(&truth));
        let clock = car.clock(1.0);
        move || {
            while !stop.load(Ordering::Relaxed) {
                let latest = *estimate.lock().expect("sound");
                let Next::Due(due, feed) = car.next(latest) else {
                    panic!("a simulator always has something")
                };
                thread::sleep(clock.until(due));
                match feed {
                    Feed::Sensor(event) => ros.send(&event),
                    Feed::Truth(motion) => truth.lock().expect("sound").push((motion.stamp, motion.pose)),
                    _ => {}
                }
            }
        }
    });
    let drive = Drive {
        stop,
        thread,
        estimate,
        truth,
    };
    (drive, start)
}

fn options(endpoint: &str) -> Ros2Options {
    Ros2Options::new(endpoint)
}

/// Localizes on a car's topics, with some faulty messages, and compares with the truth.
fn localizes(naming: Naming) {
    let (ros_router, ros_endpoint) = router();
    let (_wall, wall_endpoint) = router();
    let track = Track::find("club", None).expect("bundled");
    let (drive, start) = drive(&ros_router, naming, &track);

    let until = Instant::now() + DEADLINE;
    let source = Ros2::find(&options(&ros_endpoint), |_| Instant::now() < until).expect("finds the sensors");
    assert!(
        !source.mount_is_a_guess(),
        "/tf_static was sent before the node subscribed"
    );
    assert!(
        source.description().contains("/scan, /vesc/odom"),
        "{}",
        source.description()
    );
    let mount = source.mount().base_link_from_laser;
    assert!(
        (mount.x - CarSetup::default().lidar.base_link_from_laser.x).abs() < 1e-9,
        "{mount:?}"
    );

    let map = RaceMap {
        name: "club".into(),
        map: Arc::new(TrackMap::new(track.grid.clone()).expect("free")),
        raceline: None,
    };
    let key = naming.key("pf/pose/odom", "nav_msgs::msg::dds_::Odometry_");
    let poses = ros_router.declare_subscriber(key).wait().expect("subscribes");
    let connection = source.ros_connection();
    let announced = connection.announce().expect("announced");
    let started = output_publisher::start(
        connection,
        &announced,
        &OutputOptions::default(),
        "car-1",
        map.map.grid(),
    );
    let ros = started.expect("starts").0;
    let mut config = NodeConfig::new("car-1".parse().expect("a name"), map, Box::new(source));
    config.start = Start::Pose(start);
    config.ros = Some(ros);
    config.connect = vec![wall_endpoint];
    let node = Node::start(config).expect("starts");
    let mut compared = 0;
    let mut moved: f64 = 0.0;
    while compared < 200 {
        assert!(Instant::now() < until, "{compared} estimates compared");
        thread::sleep(Duration::from_millis(5));
        let Some(estimate) = node.shared().latest_pose() else {
            continue;
        };
        *drive.estimate.lock().expect("sound") = Some(estimate);
        let truth = drive.truth.lock().expect("sound");
        let Some(pair) = truth
            .windows(2)
            .rev()
            .find(|pair| pair[0].0 <= estimate.stamp && estimate.stamp < pair[1].0)
        else {
            continue;
        };
        let [(before, from), (after, to)] = [pair[0], pair[1]];
        let true_pose = from.interpolate(to, estimate.stamp.since(before) / after.since(before));
        moved = moved.max(true_pose.distance(start));
        let off = estimate.pose.distance(true_pose);
        assert!(off < 0.2, "{off} m off after {compared}");
        compared += 1;
        drop(truth);
        if compared == 50 {
            // Neither of these decodes as a scan.
            let key = naming.key("scan", "sensor_msgs::msg::dds_::LaserScan_");
            ros_router
                .put(&key, vec![0, 1, 0, 0, 9])
                .wait()
                .expect("published");
            ros_router.put(&key, Vec::new()).wait().expect("published");
        }
    }
    assert!(moved > 0.5, "the car has driven {moved} m");
    // The controller gets the estimates at odometry rate, with the stamps of the sensors, which never go back.
    let poses: Vec<RosOdometry> = poses
        .drain()
        .map(|sample| messages::decode(&sample.payload().to_bytes()).expect("a pose"))
        .collect();
    assert!(poses.len() > 50, "{}", poses.len());
    let stamps = poses.iter().map(|pose| Stamp::from(pose.header.stamp));
    assert!(stamps.is_sorted_by(|a, b| a < b));
    let last = poses.last().expect("many");
    assert_eq!(
        (last.header.frame_id.as_str(), last.child_frame_id.as_str()),
        ("map", "base_link")
    );
    assert!(wall_now().since(last.header.stamp.into()) < 5.0);
    assert!(last.pose.planar().distance(start) > 0.5);
    drive.stop.store(true, Ordering::Relaxed);
    drive.thread.join().expect("drives");
    // A car without sensor data ends as quickly as any other.
    let begun = Instant::now();
    node.shutdown("test over");
    assert!(begun.elapsed() < Duration::from_secs(20));
}

#[test]
fn a_node_localizes_on_a_car_with_rmw_zenoh() {
    localizes(Naming::RmwZenoh);
}

#[test]
fn a_node_localizes_on_a_car_behind_a_bridge() {
    localizes(Naming::Bridge);
}

#[test]
fn missing_topics_are_named_while_waiting() {
    let (ros_router, endpoint) = router();
    let mut missing_topics = Vec::new();
    let nobody = options("tcp/127.0.0.1:1");
    let error = Ros2::find(&nobody, |missing| {
        missing_topics.push(missing.to_owned());
        false
    })
    .err();
    assert!(matches!(error, Some(Ros2Error::Stopped { .. })), "{error:?}");
    assert!(
        missing_topics[0].contains("no zenoh router or bridge answers at tcp/127.0.0.1:1"),
        "{missing_topics:?}"
    );

    missing_topics.clear();
    let ros = RosCar::new(&ros_router, Naming::RmwZenoh, Pose::new(0.27, 0.0, 0.0));
    let error = Ros2::find(&options(&endpoint), |missing| {
        missing_topics.push(missing.to_owned());
        // From now on there are scans, on another topic, and still no odometry.
        ros.publish(
            "front/scan",
            "sensor_msgs::msg::dds_::LaserScan_",
            bytes(&LaserScan {
                header: header("laser", wall_now()),
                ranges: vec![1.0; 10],
                ..LaserScan::default()
            }),
        );
        missing_topics.len() < 4
    })
    .err();
    assert!(matches!(error, Some(Ros2Error::Stopped { .. })), "{error:?}");
    assert!(
        missing_topics[0].contains("/scan (sensor_msgs/msg/LaserScan) and"),
        "{missing_topics:?}"
    );
    let last = missing_topics.last().expect("several");
    assert!(
        !last.contains("LaserScan") && last.contains("/odom (nav_msgs/msg/Odometry)"),
        "{missing_topics:?}"
    );
}

/// Publishes one scan and one odometry message, as a car in this namespace does.
fn send_sensors(router: &Session, namespace: &str, odometry: &str) {
    let now = wall_now();
    let scan = LaserScan {
        header: header("laser", now),
        ranges: vec![1.0; 10],
        ..LaserScan::default()
    };
    let pose = RosOdometry {
        header: header("odom", now),
        child_frame_id: "base_link".into(),
        ..RosOdometry::default()
    };
    let messages = [
        (
            format!("{namespace}scan"),
            "sensor_msgs::msg::dds_::LaserScan_",
            bytes(&scan),
        ),
        (
            format!("{namespace}{odometry}"),
            "nav_msgs::msg::dds_::Odometry_",
            bytes(&pose),
        ),
    ];
    for (topic, dds_type, payload) in messages {
        let key = Naming::RmwZenoh.key(&topic, dds_type);
        router.put(key, payload).wait().expect("published");
    }
}

/// Finds the sensors of a car in this namespace, which sends until they are found.
fn find_in(router: &Session, namespace: &str, options: &Ros2Options) -> Ros2 {
    let found = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            while !found.load(Ordering::Relaxed) {
                send_sensors(router, namespace, "odom");
                thread::sleep(Duration::from_millis(20));
            }
        });
        let until = Instant::now() + DEADLINE;
        let source = Ros2::find(options, |_| Instant::now() < until);
        found.store(true, Ordering::Relaxed);
        source.expect("finds the sensors")
    })
}

/// Publishes a pose at this x on a topic, with `rmw_zenoh` and behind a bridge.
fn send_pose(router: &Session, topic: &str, frame: &str, x: f64) {
    let message = PoseWithCovarianceStamped {
        header: header(frame, wall_now()),
        pose: RosPose::from(Pose::new(x, 0.0, 0.0)),
        ..PoseWithCovarianceStamped::default()
    };
    for naming in [Naming::RmwZenoh, Naming::Bridge] {
        let key = naming.key(topic, "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_");
        router.put(key, bytes(&message)).wait().expect("published");
    }
}

/// What the source delivers besides sensor data, while `send` is called again and again.
fn next_request(source: &mut Ros2, mut send: impl FnMut()) -> Feed {
    let until = Instant::now() + DEADLINE;
    while Instant::now() < until {
        send();
        while let Next::Due(_, feed) = source.next(None) {
            if !matches!(feed, Feed::Sensor(_)) {
                return feed;
            }
        }
    }
    panic!("nothing within {DEADLINE:?}");
}

/// AMCL publishes its estimate on `/amcl_pose`, `slam_toolbox` on `/pose`. Such a message used to move the car there.
#[test]
fn an_initial_pose_is_taken_from_its_own_topic_only() {
    let other_topics = [
        "amcl_pose",
        "pose",
        "tracked_pose/with_covariance",
        "car2/initialpose",
    ];
    let cases = [
        ("", None, "/initialpose"),
        ("car1/", None, "/car1/initialpose"),
        ("car1/", Some("/start"), "/start"),
    ];
    for (namespace, asked, expected) in cases {
        let (router, endpoint) = router();
        let options = Ros2Options {
            initial_pose_topic: asked.map(str::to_owned),
            ..options(&endpoint)
        };
        let mut source = find_in(&router, namespace, &options);
        assert!(
            source
                .description()
                .ends_with(&format!("initial poses from {expected}")),
            "{}",
            source.description()
        );
        let others = ["initialpose", "car1/initialpose"]
            .into_iter()
            .chain(other_topics)
            .filter(|topic| format!("/{topic}") != expected);
        // Every round sends all of them, so that the one that is taken cannot come before the others were seen.
        for _ in 0..2 {
            let feed = next_request(&mut source, || {
                for topic in others.clone() {
                    send_pose(&router, topic, "map", 50.0);
                }
                send_pose(&router, expected.trim_start_matches('/'), "map", 3.0);
            });
            let Feed::InitialPose { pose, by } = feed else {
                panic!("{feed:?}")
            };
            assert_eq!(by, expected);
            assert!((pose.x - 3.0).abs() < 1e-9, "{pose:?} of {by}");
        }
    }
}

/// A type, what its poses are of, and a message of it.
type Sends<'a> = (&'static str, PoseOf, &'a dyn Fn() -> Vec<u8>);

#[test]
fn the_poses_of_another_localizer_are_taken_on_request_whatever_their_type() {
    let (router, endpoint) = router();
    let at = |x: f64| RosPose::from(Pose::new(x, 0.0, 0.0));
    let odometry = |x| RosOdometry {
        header: header("map", wall_now()),
        child_frame_id: "laser".into(),
        pose: at(x),
        ..RosOdometry::default()
    };
    let stamped = |x| PoseStamped {
        header: header("map", wall_now()),
        pose: at(x),
    };
    let transform = |x| TfMessage {
        transforms: vec![TransformStamped {
            header: header("map", wall_now()),
            child_frame_id: "odom".into(),
            transform: at(x),
        }],
    };
    let sends: [Sends; 3] = [
        ("nav_msgs::msg::dds_::Odometry_", PoseOf::Laser, &|| {
            bytes(&odometry(2.0))
        }),
        (
            "geometry_msgs::msg::dds_::PoseStamped_",
            PoseOf::BaseLink,
            &|| bytes(&stamped(3.0)),
        ),
        ("tf2_msgs::msg::dds_::TFMessage_", PoseOf::Odometry, &|| {
            bytes(&transform(4.0))
        }),
    ];
    for naming in [Naming::RmwZenoh, Naming::Bridge] {
        for (dds_type, of, payload) in sends {
            let options = Ros2Options {
                topics: Topics {
                    pose: Some("their/pose".into()),
                    ..Topics::default()
                },
                ..options(&endpoint)
            };
            let mut source = find_in(&router, "", &options);
            assert_eq!(source.pose_topic(), Some("/their/pose"));
            let until = Instant::now() + DEADLINE;
            let taken = 'taken: loop {
                assert!(Instant::now() < until, "no pose of type {dds_type}");
                let key = naming.key("their/pose", dds_type);
                router.put(key, payload()).wait().expect("published");
                while let Next::Due(_, feed) = source.next(None) {
                    if let Feed::Sensor(SensorEvent::Pose(pose)) = feed {
                        break 'taken pose;
                    }
                }
            };
            assert_eq!(taken.of, of, "{dds_type}");
            assert!(
                taken.pose.x > 1.5 && taken.stamp.since(wall_now()).abs() < 10.0,
                "{taken:?}"
            );
        }
    }
}

#[test]
fn an_initial_pose_in_another_frame_is_refused_with_the_frame_named() {
    let (router, endpoint) = router();
    let mut source = find_in(&router, "", &options(&endpoint));
    let feed = next_request(&mut source, || send_pose(&router, "initialpose", "odom", 3.0));
    assert!(
        matches!(&feed, Feed::Log(text) if text.contains("/initialpose") && text.contains("\"odom\"")),
        "{feed:?}"
    );
}

#[test]
fn a_clicked_point_asks_for_a_global_search() {
    let (router, endpoint) = router();
    let mut source = find_in(&router, "car1/", &options(&endpoint));
    let send = |topic: &str| {
        let key = Naming::RmwZenoh.key(topic, "geometry_msgs::msg::dds_::PointStamped_");
        let message = PointStamped {
            header: header("map", wall_now()),
            point: Vector3::default(),
        };
        router.put(key, bytes(&message)).wait().expect("published");
    };
    let feed = next_request(&mut source, || {
        send("car2/clicked_point");
        send("car1/clicked_point");
    });
    let expected = Feed::GlobalSearch {
        by: "/car1/clicked_point".into(),
    };
    assert_eq!(feed, expected);
}

#[test]
fn what_the_node_publishes_is_no_input() {
    let (router, endpoint) = router();
    // The only odometry is the output of a localizer.
    let mut rounds = 0;
    let error = Ros2::find(&options(&endpoint), |_| {
        send_sensors(&router, "", "pf/pose/odom");
        rounds += 1;
        rounds < 4
    })
    .err();
    let Some(Ros2Error::Stopped { missing }) = error else {
        panic!("{error:?}")
    };
    assert!(missing.contains("/odom (nav_msgs/msg/Odometry)"), "{missing}");

    let topics = Topics {
        odometry: Some("pf/pose/odom".into()),
        ..Topics::default()
    };
    let asked = Ros2Options {
        topics,
        ..options(&endpoint)
    };
    let error = Ros2::find(&asked, |_| false).err();
    assert!(matches!(error, Some(Ros2Error::OwnOutput(_))), "{error:?}");
}

/// A namespaced car beside another one used to get the first topics of each kind, whoever's they were.
#[test]
fn the_topics_of_one_car_are_taken_together() {
    let (router, endpoint) = router();
    let asked = Ros2Options {
        namespace: Some("car2".into()),
        ..options(&endpoint)
    };
    let found = AtomicBool::new(false);
    let source = thread::scope(|scope| {
        scope.spawn(|| {
            while !found.load(Ordering::Relaxed) {
                send_sensors(&router, "car1/", "odom");
                send_sensors(&router, "car2/", "vesc/odom");
                thread::sleep(Duration::from_millis(20));
            }
        });
        let until = Instant::now() + DEADLINE;
        let source = Ros2::find(&asked, |_| Instant::now() < until);
        found.store(true, Ordering::Relaxed);
        source.expect("finds the sensors")
    });
    let description = source.description();
    assert!(
        description.ends_with("/car2/scan, /car2/vesc/odom; initial poses from /car2/initialpose"),
        "{description}"
    );
    assert_eq!(source.ros_connection().namespace, "/car2");
    assert_eq!(
        source.notes(),
        ["taken are /car2/scan and /car2/vesc/odom; not taken: scans /car1/scan; odometry /car1/odom"]
    );
}

#[test]
fn topics_of_another_domain_are_a_hint() {
    let (router, endpoint) = router();
    let token =
        "@ros2_lv/7/aa11/0/3/MP/%/%/lidar/%scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_0123/2::,5:,:,:,,";
    let _token = router.liveliness().declare_token(token).wait().expect("declared");
    let mut last = String::new();
    let until = Instant::now() + DEADLINE;
    let stopped = Ros2::find(&options(&endpoint), |missing| {
        missing.clone_into(&mut last);
        !missing.contains("domain 7") && Instant::now() < until
    });
    assert!(stopped.is_err());
    assert!(last.contains("domain 7 has /scan (--ros-domain 7)"), "{last}");
}

/// A publisher that waits for a subscriber finds one announced, as `rmw_zenoh` announces it.
#[test]
fn announced_sensors_get_a_subscriber() {
    let (router, endpoint) = router();
    let tokens = router
        .liveliness()
        .declare_subscriber("@ros2_lv/0/*/*/*/MS/**")
        .wait()
        .expect("subscribed");
    let token = "@ros2_lv/0/aa11/0/3/MP/%/%/lidar/%car1%scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_0123/2::,5:,:,:,,";
    let _token = router.liveliness().declare_token(token).wait().expect("declared");
    let mut announced = None;
    let until = Instant::now() + DEADLINE;
    let stopped = Ros2::find(&options(&endpoint), |missing| {
        assert!(
            missing.contains("announced and silent: sensor_msgs/msg/LaserScan on /car1/scan"),
            "{missing}"
        );
        announced = tokens.try_recv().ok().flatten();
        announced.is_none() && Instant::now() < until
    });
    assert!(stopped.is_err());
    let token = announced.expect("a subscriber").key_expr().to_string();
    assert!(
        token.contains("/synpf/%car1%scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_0123/"),
        "{token}"
    );
}

/// The transform of a laser that is upside down, as a static broadcaster sends it.
fn upside_down_laser(x: f64) -> TfMessage {
    let mut transform = RosPose::from(Pose::new(x, 0.0, 0.0));
    transform.orientation = Orientation {
        x: 1.0,
        y: 0.0,
        z: 0.0,
        w: 0.0,
    };
    TfMessage {
        transforms: vec![TransformStamped {
            header: header("base_link", wall_now()),
            child_frame_id: "laser".into(),
            transform,
        }],
    }
}

/// A transform after the start used to be ignored: the laser stayed where it was assumed.
#[test]
fn a_late_transform_replaces_the_guess() {
    let (router, endpoint) = router();
    let mut source = find_in(&router, "", &options(&endpoint));
    assert!(source.mount_is_a_guess());
    let feed = next_request(&mut source, || {
        let key = Naming::RmwZenoh.key("tf_static", "tf2_msgs::msg::dds_::TFMessage_");
        router
            .put(key, bytes(&upside_down_laser(0.2)))
            .wait()
            .expect("published");
    });
    let Feed::Mount {
        mount,
        turned: true,
        text,
    } = feed
    else {
        panic!("{feed:?}")
    };
    assert!(
        mount.upside_down && (mount.base_link_from_laser.x - 0.2).abs() < 1e-9,
        "{mount:?}"
    );
    assert!(
        text.contains("/tf_static") && text.ends_with("upside down"),
        "{text}"
    );
    assert!(!source.mount_is_a_guess());
}

/// Odometry whose stamps went back used to be refused for as long as the node ran.
#[test]
fn a_clock_that_is_set_back_is_followed() {
    let (router, endpoint) = router();
    let mut source = find_in(&router, "", &options(&endpoint));
    let key = Naming::RmwZenoh.key("odom", "nav_msgs::msg::dds_::Odometry_");
    let (mut stamps, mut step) = (Vec::new(), None);
    let until = Instant::now() + DEADLINE;
    for number in 0.. {
        // Half of them before the clock is set back by an hour.
        let set_back = if number < 50 { 0.0 } else { -3600.0 };
        let message = RosOdometry {
            header: header("odom", wall_now().plus(set_back)),
            child_frame_id: "base_link".into(),
            ..RosOdometry::default()
        };
        router.put(&key, bytes(&message)).wait().expect("published");
        thread::sleep(Duration::from_millis(10));
        if let Next::Due(_, feed) = source.next(None) {
            match feed {
                Feed::Sensor(event) => stamps.push(event.stamp()),
                Feed::Clock {
                    step: Some(by), text, ..
                } => {
                    assert!(text.is_some_and(|text| text.contains("/odom was set back by 3600")));
                    assert_eq!(step.replace(by), None);
                }
                _ => {}
            }
        }
        if stamps.len() >= 100 || Instant::now() > until {
            break;
        }
    }
    assert!(stamps.len() >= 100, "{}", stamps.len());
    assert!(stamps.is_sorted_by(|a, b| a < b), "{stamps:?}");
    let seconds = stamps[stamps.len() - 1].since(stamps[0]);
    assert!(seconds < 60.0, "{seconds}");
    assert!((step.expect("a step") + 3600.0).abs() < 1.0, "{step:?}");
    // What is published for the car's nodes is on their clock.
    let shown = source.ros_connection().shift.to_sensor(stamps[stamps.len() - 1]);
    assert!((wall_now().since(shown) - 3600.0).abs() < 60.0);
}
