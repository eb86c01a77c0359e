//! Drives around a track made from nothing but geometry.

use std::f64::consts::{PI, TAU};
use std::sync::{Arc, OnceLock};

use localizer::{Dropped, Localizer, Mode, Odometry, Scan, Stamp, Twist, Update};
use maps::{Cell, DistanceField, OccupancyGrid, Pose};
use pose_graph::{FrozenMap, PoseGraph, PoseGraphParameters};

const BASE_LINK_FROM_LASER: Pose = Pose {
    x: 0.27,
    y: 0.0,
    heading: 0.0,
};

/// Radius of the track's middle at an angle around its centre \[m\]: no place looks like another.
fn radius(angle: f64) -> f64 {
    7.0 + 0.7 * (2.0 * angle).sin() + 0.35 * (5.0 * angle + 1.0).cos() + 0.3 * (3.0 * angle).cos()
}

/// A ring of this half width [m] on a grid of 5 cm whose origin is turned.
fn ring(half_width: f64) -> Arc<OccupancyGrid> {
    let cells = (0..400 * 400).map(|i| {
        let [x, y] = [i % 400, i / 400].map(|v| (f64::from(v) + 0.5) * 0.05 - 10.0);
        let off = x.hypot(y) - radius(y.atan2(x));
        if off.abs() < half_width {
            Cell::Free
        } else {
            Cell::Occupied
        }
    });
    let origin = Pose::new(0.0, 0.0, 0.5) * Pose::new(-10.0, -10.0, 0.0);
    Arc::new(OccupancyGrid::new(400, 400, 0.05, origin, cells.collect()))
}

/// What the laser sees.
fn grid() -> &'static Arc<OccupancyGrid> {
    static GRID: OnceLock<Arc<OccupancyGrid>> = OnceLock::new();
    GRID.get_or_init(|| ring(1.2))
}

fn frozen(grid: &Arc<OccupancyGrid>) -> Arc<FrozenMap> {
    let field = Arc::new(DistanceField::new(grid));
    Arc::new(FrozenMap::new(Arc::clone(grid), field))
}

fn map() -> Arc<FrozenMap> {
    static MAP: OnceLock<Arc<FrozenMap>> = OnceLock::new();
    Arc::clone(MAP.get_or_init(|| frozen(grid())))
}

fn stamp(seconds: f64) -> Stamp {
    Stamp(1_700_000_000_000_000_000).plus(seconds)
}

/// The true pose after so many seconds at 5 m/s.
fn truth(seconds: f64) -> Pose {
    let at = |angle: f64| [radius(angle) * angle.cos(), radius(angle) * angle.sin()];
    let angle = 5.0 * seconds / 7.0;
    let ([x, y], [x2, y2]) = (at(angle), at(angle + 1e-5));
    Pose::new(0.0, 0.0, 0.5) * Pose::new(x, y, (y2 - y).atan2(x2 - x))
}

/// Odometry whose wheels turn farther than the car goes, by this factor.
fn odometry(seconds: f64, slip: f64) -> Odometry {
    let pose = truth(seconds).since(truth(0.0));
    let step = truth(seconds + 1e-3).since(truth(seconds));
    Odometry {
        stamp: stamp(seconds),
        pose: Pose::new(pose.x * slip, pose.y * slip, pose.heading),
        twist: Twist {
            linear_x: step.x * 1e3 * slip,
            linear_y: 0.0,
            angular: step.heading * 1e3,
        },
    }
}

fn scan(seconds: f64) -> Scan {
    let laser = truth(seconds) * BASE_LINK_FROM_LASER;
    let increment = 1.5 * PI / 540.0;
    let beam = |i: i32| laser * Pose::new(0.0, 0.0, -0.75 * PI + increment * f64::from(i));
    Scan {
        stamp: stamp(seconds),
        angle_min: -0.75 * PI,
        angle_increment: increment,
        time_increment: 0.0,
        scan_time: None,
        angle_max: None,
        range_min: 0.02,
        range_max: 30.0,
        ranges: (0..541).map(|i| grid().cast(beam(i), 30.0) as f32).collect(),
    }
}

fn localizer(name: &str) -> PoseGraph {
    on_map(map(), &PoseGraphParameters::named(name).expect("ships"))
}

fn on_map(map: Arc<FrozenMap>, set: &PoseGraphParameters) -> PoseGraph {
    PoseGraph::new(map, BASE_LINK_FROM_LASER, set.clone()).expect("sound")
}

/// Follows the car, with scans at 25 Hz and odometry at 50; calls back after each scan.
fn drive(
    localizer: &mut PoseGraph,
    span: std::ops::Range<f64>,
    slip: f64,
    mut after: impl FnMut(&mut PoseGraph, &Update),
) {
    let [first, last] = [span.start, span.end].map(|at| (at / 0.02).round() as usize);
    for step in first..last {
        let at = 0.02 * step as f64;
        localizer.on_odometry(&odometry(at, slip)).expect("sound");
        if step % 2 == 0 {
            let update = localizer.on_scan(&scan(at)).expect("an update");
            after(localizer, &update);
        }
    }
}

fn error(update: &Update) -> f64 {
    update.pose.distance(truth(update.stamp.since(stamp(0.0))))
}

fn started(name: &str) -> PoseGraph {
    start(localizer(name))
}

fn start(mut localizer: PoseGraph) -> PoseGraph {
    localizer.on_odometry(&odometry(-0.02, 1.0)).expect("sound");
    localizer.initialize(truth(-0.02)).expect("on the map");
    localizer
}

#[test]
fn a_lap_is_followed_and_the_covariance_is_as_large_as_the_error() {
    for (name, slip, within) in [
        ("pose-graph", 1.0, 0.12),
        ("pose-graph-tuned", 1.0, 0.12),
        ("pose-graph-tuned", 1.1, 0.15),
    ] {
        let mut localizer = started(name);
        let (mut worst, mut nees, mut updates) = (0.0f64, 0.0, 0.0);
        drive(&mut localizer, 0.0..TAU * 7.0 / 5.0, slip, |_, update| {
            worst = worst.max(error(update));
            let at = truth(update.stamp.since(stamp(0.0)));
            let off = nalgebra::Vector2::new(update.pose.x - at.x, update.pose.y - at.y);
            let own = update.covariance.fixed_view::<2, 2>(0, 0).into_owned();
            nees += (off.transpose() * own.try_inverse().expect("regular") * off)[0];
            updates += 1.0;
            assert_eq!(update.mode, Mode::Tracking);
        });
        assert!(worst < within, "{name} {slip}: {worst}");
        assert!(nees / updates < 6.0, "{name} {slip}: {}", nees / updates);
    }
}

#[test]
fn the_same_log_gives_the_same_poses_bit_for_bit() {
    let run = || {
        let (mut localizer, mut poses) = (started("pose-graph-tuned"), Vec::new());
        drive(&mut localizer, 0.0..2.0, 1.05, |_, update| {
            poses.push(update.pose);
        });
        poses
    };
    assert_eq!(run(), run());
}

#[test]
fn a_worker_that_is_in_time_changes_no_pose() {
    let run = |worker: bool| {
        let (mut localizer, mut poses) = (started("pose-graph-tuned"), Vec::new());
        drive(&mut localizer, 0.0..2.0, 1.05, |localizer, update| {
            poses.push(update.clone());
            if worker && let Some(job) = localizer.take_job() {
                let outcome = std::thread::spawn(job).join().expect("it ends");
                localizer.finish_job(outcome);
            }
        });
        poses
    };
    assert_eq!(run(true), run(false));
}

#[test]
fn walls_that_are_drawn_too_near_do_not_hold_the_car_back() {
    // A laser that looks ahead takes them for a place farther back.
    let drawn = frozen(&ring(1.13));
    let off = |wall_offset_distance: f64| {
        let set = PoseGraphParameters {
            wall_offset_distance,
            ..PoseGraphParameters::named("pose-graph-tuned").expect("ships")
        };
        let (mut squares, mut count) = (0.0, 0.0);
        let mut localizer = start(on_map(Arc::clone(&drawn), &set));
        drive(&mut localizer, 0.0..6.0, 1.0, |_, update| {
            if update.stamp.since(stamp(2.0)) > 0.0 {
                squares += error(update).powi(2);
                count += 1.0;
            }
        });
        f64::sqrt(squares / count)
    };
    let (taken_as_drawn, learned) = (off(0.0), off(3.0));
    assert!(
        taken_as_drawn > 0.04 && learned < 0.02,
        "{taken_as_drawn} {learned}"
    );
}

#[test]
fn the_back_end_may_run_elsewhere_and_late() {
    let mut localizer = started("pose-graph");
    let (mut worst, mut waiting, mut jobs) = (0.0f64, Vec::new(), 0);
    drive(&mut localizer, 0.0..6.0, 1.0, |localizer, update| {
        worst = worst.max(error(update));
        if let Some(job) = localizer.take_job() {
            // Its outcome comes three scans later.
            waiting.push((update.number + 3, job()));
            jobs += 1;
        }
        if waiting.first().is_some_and(|(due, _)| update.number >= *due) {
            let (_, outcome) = waiting.remove(0);
            localizer.finish_job(outcome);
        }
    });
    assert!(jobs > 5 && worst < 0.15, "{jobs} {worst}");
    // An outcome that nobody asked for changes nothing.
    localizer.finish_job(Box::new(5));
    localizer.initialize(truth(6.0)).expect("on the map");
    for (_, outcome) in waiting {
        localizer.finish_job(outcome);
    }
    drive(&mut localizer, 6.0..7.0, 1.0, |_, update| {
        assert!(error(update) < 0.15);
    });
}

#[test]
fn a_search_finds_the_car_and_a_later_localizer_goes_on() {
    let mut localizer = localizer("pose-graph");
    localizer.on_odometry(&odometry(-0.02, 1.0)).expect("sound");
    assert_eq!(localizer.on_scan(&scan(-0.02)), Err(Dropped::NotInitialized));
    localizer.relocalize();
    let mut tracking = 0;
    drive(&mut localizer, 0.0..3.0, 1.0, |_, update| {
        if update.mode == Mode::Tracking {
            tracking += 1;
            assert!(error(update) < 0.3, "{}", error(update));
        }
    });
    assert!(tracking > 50, "{tracking}");
    let mut next = self::localizer("pose-graph-tuned");
    next.take_over(localizer.hand_over());
    // It used to have no pose before its first scan.
    let handed = next.predict(stamp(2.98)).expect("near the last odometry");
    assert!(handed.distance(truth(2.98)) < 0.2);
    drive(&mut next, 3.0..5.0, 1.0, |_, update| {
        assert!(error(update) < 0.2, "{}", error(update));
    });
}

#[test]
fn sensors_out_of_order_are_refused() {
    let mut localizer = localizer("pose-graph");
    assert_eq!(localizer.on_scan(&scan(0.0)), Err(Dropped::NoOdometry));
    localizer.initialize(truth(0.0)).expect("on the map");
    assert!(localizer.initialize(Pose::new(500.0, 0.0, 0.0)).is_err());
    assert!(localizer.initialize(Pose::new(f64::NAN, 0.0, 0.0)).is_err());
    localizer.on_odometry(&odometry(0.0, 1.0)).expect("sound");
    assert!(localizer.on_scan(&scan(0.0)).is_ok());
    assert_eq!(localizer.on_scan(&scan(0.0)), Err(Dropped::TimeBackwards));
    assert_eq!(localizer.on_scan(&scan(1.0)), Err(Dropped::StaleOdometry));
    assert_eq!(
        localizer.on_odometry(&odometry(0.0, 1.0)),
        Err(Dropped::TimeBackwards)
    );
    let mut broken = scan(0.02);
    broken.ranges.fill(f32::NAN);
    assert_eq!(localizer.on_scan(&broken), Err(Dropped::NoBeams));
    let mut broken = odometry(0.04, 1.0);
    broken.pose.x = f64::INFINITY;
    assert_eq!(localizer.on_odometry(&broken), Err(Dropped::Malformed));
}
