//! Sensors that lie, on a track made of geometry: each is found, said, and worked around.

mod common;

use common::{BASE_LINK_FROM_LASER, lap, odometry, ring, scan, stamp, truth};
use maps::Pose;
use synpf::{Dropped, Odometry, Parameters, Scan, SensorFinding, SynPf, Twist, Update, YawRate};

/// What happens to a message at a time \[s\].
type Change<T> = Box<dyn Fn(f64, &mut T)>;

/// The changes that a test makes to what the sensors say; times are seconds of the drive.
struct Sensors {
    odometry: Change<Odometry>,
    gyro: Option<Box<dyn Fn(f64) -> f64>>,
    scan: Change<Scan>,
}

impl Default for Sensors {
    fn default() -> Self {
        Self {
            odometry: Box::new(|_, _| {}),
            gyro: None,
            scan: Box::new(|_, _| {}),
        }
    }
}

/// What came of one scan: its time, and the update or why there is none.
type Outcome = (f64, Result<Update, Dropped>);

/// Drives `seconds` with odometry at 50 Hz, a gyroscope at 100 Hz and scans at 40 Hz.
fn drive(sensors: &Sensors, seconds: f64) -> Vec<Outcome> {
    let map = ring();
    let parameters = Parameters::named("hq").expect("ships");
    let mut localizer = SynPf::new(map.clone(), BASE_LINK_FROM_LASER, parameters, 1).expect("sound");
    let mut outcomes = Vec::new();
    // In steps of 5 ms.
    for tick in 0..(seconds / 0.005) as u32 {
        let t = f64::from(tick) * 0.005;
        if tick % 2 == 0
            && let Some(gyro) = &sensors.gyro
        {
            let rate = gyro(odometry(t, 1.0).twist.angular);
            localizer
                .on_yaw_rate(&YawRate {
                    stamp: stamp(t),
                    rate,
                })
                .expect("sound");
        }
        if tick % 4 == 0 {
            let mut message = odometry(t, 1.0);
            (sensors.odometry)(t, &mut message);
            localizer.on_odometry(&message).expect("sound");
        }
        if tick == 0 {
            localizer.initialize(truth(0.0)).expect("on the map");
        } else if tick % 5 == 0 {
            let mut scan = scan(&map, t);
            (sensors.scan)(t, &mut scan);
            outcomes.push((t, localizer.on_scan(&scan)));
        }
    }
    outcomes
}

fn updates(outcomes: &[Outcome]) -> impl Iterator<Item = (f64, &Update)> {
    outcomes
        .iter()
        .filter_map(|(t, result)| Some((*t, result.as_ref().ok()?)))
}

/// Largest distance from the truth after two seconds \[m\].
fn worst(outcomes: &[Outcome]) -> f64 {
    updates(outcomes)
        .filter(|(t, _)| *t > 2.0)
        .map(|(t, update)| update.pose.distance(truth(t)))
        .fold(0.0, f64::max)
}

/// What is found at the end.
fn found(outcomes: &[Outcome], finding: SensorFinding) -> Option<f64> {
    updates(outcomes).last()?.1.sensors.get(finding)
}

fn gyro(reading: impl Fn(f64) -> f64 + 'static) -> Sensors {
    Sensors {
        gyro: Some(Box::new(reading)),
        ..Sensors::default()
    }
}

fn wheels(change: impl Fn(f64, &mut Odometry) + 'static) -> Sensors {
    Sensors {
        odometry: Box::new(change),
        ..Sensors::default()
    }
}

#[test]
fn sound_sensors_are_left_alone() {
    let outcomes = drive(&gyro(|rate| rate), lap());
    assert!(worst(&outcomes) < 0.03, "{}", worst(&outcomes));
    let (_, last) = updates(&outcomes).last().expect("updates");
    assert_eq!(last.sensors.iter().collect::<Vec<_>>(), []);
}

/// A gyroscope in deg/s was believed: the pose was 6 m off on a club track and 30 m on a large one.
#[test]
fn a_gyroscope_in_degrees_is_converted() {
    let outcomes = drive(&gyro(f64::to_degrees), lap());
    assert!(worst(&outcomes) < 0.03, "{}", worst(&outcomes));
    let ratio = found(&outcomes, SensorFinding::GyroInDegrees).expect("found");
    assert!((ratio - 57.3).abs() < 3.0, "{ratio}");
}

#[test]
fn a_gyroscope_that_is_flipped_or_silent_does_no_harm() {
    let flipped = drive(&gyro(|rate| -rate), lap());
    assert!(worst(&flipped) < 0.03, "{}", worst(&flipped));
    assert!(found(&flipped, SensorFinding::GyroFlipped).is_some());
    let silent = drive(&gyro(|_| 0.0), lap());
    assert!(worst(&silent) < 0.03, "{}", worst(&silent));
    assert!(found(&silent, SensorFinding::GyroAlwaysZero).is_some());
}

/// Without a pose the localizer took the car to stand still and lost it.
#[test]
fn a_pose_that_is_missing_is_taken_from_the_twist() {
    for missing in [
        Pose::IDENTITY,
        Pose {
            heading: f64::NAN,
            ..Pose::IDENTITY
        },
    ] {
        let outcomes = drive(&wheels(move |_, message| message.pose = missing), lap());
        assert!(worst(&outcomes) < 0.03, "{}", worst(&outcomes));
        assert!(found(&outcomes, SensorFinding::PoseFromTwist).is_some());
    }
}

/// The speed stayed zero, so that the state stayed CONVERGING for ever.
#[test]
fn a_twist_that_is_missing_is_taken_from_the_pose() {
    let outcomes = drive(&wheels(|_, message| message.twist = Twist::default()), lap());
    assert!(worst(&outcomes) < 0.05, "{}", worst(&outcomes));
    assert!(found(&outcomes, SensorFinding::TwistFromPose).is_some());
    let (_, last) = updates(&outcomes).last().expect("updates");
    assert!(last.twist.linear_x > 3.0, "{:?}", last.twist);
}

#[test]
fn a_wheel_scale_that_is_off_by_two_fifths_is_found_and_corrected() {
    for multiple in [0.6, 1.4] {
        let outcomes = drive(&wheels(move |t, message| *message = odometry(t, multiple)), lap());
        assert!(worst(&outcomes) < 0.05, "{multiple}: {}", worst(&outcomes));
        let scale = found(&outcomes, SensorFinding::WheelScale).expect("found");
        assert!((scale - multiple).abs() < 0.1, "{multiple}: {scale}");
    }
}

/// Wheels that lock for a second left the pose a metre behind, at a sigma of half a centimetre.
#[test]
fn wheels_that_lock_do_not_stop_the_pose() {
    // From 4 s on the car slides to a halt, at 5 m/s^2: as if the drive slowed down.
    let drive_time = |t: f64| {
        let sliding = (t - 4.0).max(0.0);
        t - 0.5 * sliding * sliding
    };
    let sensors = Sensors {
        odometry: Box::new(move |t, message| {
            if t >= 4.0 {
                // Odometry stands, but for the gyroscope.
                let (stopped, turned) = (odometry(4.0, 1.0).pose, odometry(drive_time(t), 1.0));
                message.pose = Pose::new(stopped.x, stopped.y, turned.pose.heading);
                message.twist = Twist {
                    angular: turned.twist.angular * (5.0 - t),
                    ..Twist::default()
                };
            }
        }),
        scan: Box::new(move |t, message| message.ranges = scan(&ring(), drive_time(t)).ranges),
        ..Sensors::default()
    };
    let outcomes = drive(&sensors, 4.9);
    let worst = updates(&outcomes)
        .filter(|(t, _)| *t > 2.0)
        .map(|(t, update)| update.pose.distance(truth(drive_time(t))))
        .fold(0.0, f64::max);
    assert!(worst < 0.1, "{worst}");
    let said = updates(&outcomes).any(|(_, update)| update.sensors.get(SensorFinding::WheelsSlide).is_some());
    assert!(said);
}

/// Scans were taken to stand still like the wheels: 3 m behind, and lost.
#[test]
fn wheels_that_lock_on_a_car_that_rolls_on_do_not_stop_the_pose() {
    let locked = |t: f64| (3.0..4.0).contains(&t) || (5.5..6.5).contains(&t);
    let twist = move |t: f64| {
        let twist = odometry(t, 1.0).twist;
        let wheels = if locked(t) { 0.0 } else { 1.0 };
        Twist {
            linear_x: twist.linear_x * wheels,
            linear_y: twist.linear_y * wheels,
            ..twist
        }
    };
    let sensors = wheels(move |t, message| {
        let mut pose = Pose::IDENTITY;
        for step in 0..(t / 0.02).round() as u32 {
            let Twist {
                linear_x,
                linear_y,
                angular,
            } = twist(f64::from(step) * 0.02);
            pose = pose * Pose::exp([linear_x, linear_y, angular].map(|v| v * 0.02));
        }
        (message.pose, message.twist) = (pose, twist(t));
    });
    let outcomes = drive(&sensors, 7.5);
    assert!(worst(&outcomes) < 0.1, "{}", worst(&outcomes));
    let held = updates(&outcomes).any(|(_, update)| update.sensors.get(SensorFinding::Creep).is_some());
    assert!(!held);
}

/// Never LOCALIZED, and leaps of 12 m: the pose stood with odometry, and each scan asked for another place.
#[test]
fn odometry_that_stands_still_does_not_stop_the_pose() {
    let stands = |from: f64, to: f64| {
        wheels(move |t, message| {
            if (from..to).contains(&t) {
                *message = Odometry {
                    stamp: message.stamp,
                    pose: if from > 0.0 {
                        odometry(from, 1.0).pose
                    } else {
                        Pose::IDENTITY
                    },
                    twist: Twist::default(),
                };
            }
        })
    };
    // From the start, and with a gyroscope that knows the turn.
    let all_along = stands(0.0, f64::INFINITY);
    let with_gyro = Sensors {
        gyro: Some(Box::new(|rate| rate)),
        ..stands(0.0, f64::INFINITY)
    };
    for sensors in [&all_along, &with_gyro] {
        let outcomes = drive(sensors, lap());
        assert!(worst(&outcomes) < 0.05, "{}", worst(&outcomes));
        let speed = found(&outcomes, SensorFinding::OdometryStands).expect("found");
        let driven = odometry(lap(), 1.0).twist.linear_x;
        assert!((speed - driven).abs() < 0.3, "{speed} {driven}");
        assert!(found(&outcomes, SensorFinding::OdometryTurnWrong).is_none());
        let (_, last) = updates(&outcomes).last().expect("updates");
        assert!((last.twist.linear_x - driven).abs() < 0.3, "{:?}", last.twist);
    }
    // A cable that has a loose contact.
    let outcomes = drive(&stands(3.0, 6.0), 8.0);
    assert!(worst(&outcomes) < 0.05, "{}", worst(&outcomes));
    assert!(
        found(&outcomes, SensorFinding::OdometryStands).is_none(),
        "it is back"
    );
}

/// The last message again and again, with new stamps: the pose drove on at its speed.
#[test]
fn a_driver_that_hangs_does_not_move_the_pose() {
    let outcomes = drive(
        &wheels(|t, message| {
            if t > 2.5 {
                *message = Odometry {
                    stamp: message.stamp,
                    ..odometry(2.5, 1.0)
                };
            }
        }),
        lap(),
    );
    // Three messages tell that it hangs: 0.28 m.
    assert!(worst(&outcomes) < 0.28, "{}", worst(&outcomes));
    let late = updates(&outcomes).filter(|(t, _)| *t > 3.0);
    assert!(
        late.fold(0.0, |worst: f64, (t, update)| worst
            .max(update.pose.distance(truth(t))))
            < 0.03
    );
    assert!(found(&outcomes, SensorFinding::OdometryStands).is_some());
}

#[test]
fn a_position_in_steps_is_smoothed_by_the_twist() {
    let coarse = |v: f64| (v / 0.2).round() * 0.2;
    let outcomes = drive(
        &wheels(move |_, message| {
            (message.pose.x, message.pose.y) = (coarse(message.pose.x), coarse(message.pose.y));
        }),
        lap(),
    );
    assert!(worst(&outcomes) < 0.05, "{}", worst(&outcomes));
    assert!(found(&outcomes, SensorFinding::PoseFromTwist).is_some());
}

/// Patches of 2 m in which the barrier is a net, and the laser sees spectators half a metre behind it: the pose leapt to where
/// they stood on walls.
#[test]
fn people_behind_nets_do_not_move_the_pose() {
    // In [0, 1), the same for all of a cell.
    let hash = |x: f64, y: f64, cell: f64| {
        let (i, j) = ((x / cell).floor(), (y / cell).floor());
        ((i * 12.9898 + j * 78.233).sin() * 43_758.547).rem_euclid(1.0)
    };
    let outcomes = drive(
        &Sensors {
            scan: Box::new(move |t, message| {
                let laser = truth(t) * BASE_LINK_FROM_LASER;
                for (i, range) in message.ranges.iter_mut().enumerate() {
                    let angle = message.angle_min + message.angle_increment * i as f64;
                    let (sin, cos) = (laser.heading + angle).sin_cos();
                    let (x, y) = (
                        laser.x + f64::from(*range) * cos,
                        laser.y + f64::from(*range) * sin,
                    );
                    if t > 2.0 && hash(x, y, 2.0) < 0.4 {
                        *range += (0.6 + 0.36 * hash(x, y, 0.3)) as f32;
                    }
                }
            }),
            ..Sensors::default()
        },
        lap(),
    );
    assert!(worst(&outcomes) < 0.1, "{}", worst(&outcomes));
}

/// Frozen scans under new stamps were fitted like any other, and the pose stood still with them.
#[test]
fn scans_that_repeat_are_no_scans() {
    let frozen = |t: f64| (3.0..3.4).contains(&t);
    let outcomes = drive(
        &Sensors {
            scan: Box::new(move |t, message| {
                if frozen(t) {
                    message.ranges = scan(&ring(), 3.0).ranges;
                }
            }),
            ..Sensors::default()
        },
        4.5,
    );
    let refused = outcomes
        .iter()
        .filter(|(_, result)| *result == Err(Dropped::RepeatedScan))
        .count();
    assert!((13..=16).contains(&refused), "{refused}");
    assert!(worst(&outcomes) < 0.05, "{}", worst(&outcomes));
}
