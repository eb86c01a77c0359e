//! The health state on a simulated track: a kidnapping is LOST within half a second, and nothing else is LOST. Everything runs on
//! the simulator's clock, so that the load of the machine has no effect.

use std::f64::consts::FRAC_PI_2;
use std::path::Path;
use std::sync::{Arc, OnceLock};

use car_node::evaluate::{self, Fault, FaultReport, Outcome, Truth};
use car_node::health::State;
use car_node::localization::LocalizerParameters;
use car_node::localization::Start;
use car_node::sensors::bag::{Arrival, SensorEvent, SensorLog, Topics};
use car_node::sensors::frames::Mount;
use car_node::sensors::{Feed, Next, PoseEstimate, Race, Source};
use maps::{Cell, OccupancyGrid, Pose};
use simulator::{CarSetup, Guidance, Surface, Track, Wall, Walls};
use synpf::{Localizer, TrackMap};

fn club() -> Track {
    let tracks = Path::new(env!("CARGO_MANIFEST_DIR")).join("../maps/tracks");
    Track::load(tracks.join("club"), None).expect("bundled")
}

/// The log of one car of a race, driven on the filter's estimates for `moving` of `seconds` \[s\]. A driver that never gets
/// one stays where it is.
fn race(track: Track, others: &[CarSetup], moving: f64, seconds: f64) -> SensorLog {
    let map = Arc::new(TrackMap::new(track.grid.clone()).expect("free cells"));
    let setups: Vec<_> = std::iter::once(CarSetup::default())
        .chain(others.iter().copied())
        .collect();
    let mut car = Race::new(track, setups, 1, Vec::new()).car(0);
    let mount = car.mount();
    let mut localizer = localizer(&map, mount);
    localizer
        .initialize(car.start().expect("known"))
        .expect("on the map");
    let mut log = SensorLog {
        notes: Vec::new(),
        arrivals: Vec::new(),
        mount: Some(mount),
        truth: Vec::new(),
        topics: Topics::default(),
    };
    let mut estimate: Option<PoseEstimate> = None;
    let mut begun = None;
    while let Next::Due(due, feed) = car.next(estimate.take()) {
        let elapsed = due.since(*begun.get_or_insert(due));
        if elapsed > seconds {
            break;
        }
        match feed {
            Feed::Sensor(event) => {
                match &event {
                    SensorEvent::Odometry(odometry) => {
                        localizer.on_odometry(odometry).expect("sound odometry");
                        estimate = localizer.predict(odometry.stamp).map(|pose| PoseEstimate {
                            stamp: odometry.stamp,
                            pose,
                            twist: odometry.twist,
                        });
                    }
                    SensorEvent::Scan(scan) => drop(localizer.on_scan(scan)),
                    SensorEvent::YawRate(yaw_rate) => drop(localizer.on_yaw_rate(yaw_rate)),
                    SensorEvent::Pose(pose) => drop(localizer.on_external_pose(pose)),
                }
                estimate = estimate.filter(|_| elapsed < moving);
                log.arrivals.push(Arrival { log_time: due, event });
            }
            Feed::Truth(truth) => log.truth.push((truth.stamp, truth.pose)),
            Feed::Log(word) => panic!("{word}"),
            Feed::InitialPose { .. }
            | Feed::GlobalSearch { .. }
            | Feed::Clock { .. }
            | Feed::Mount { .. } => panic!("the recovery crew had to come"),
        }
    }
    log
}

/// A lap and a half without faults, driven once for all tests.
fn sound() -> SensorLog {
    static LOG: OnceLock<SensorLog> = OnceLock::new();
    LOG.get_or_init(|| race(club(), &[], 20.0, 20.0)).clone()
}

fn localizer(map: &Arc<TrackMap>, mount: Mount) -> Box<dyn Localizer> {
    let hq = LocalizerParameters::named("hq").expect("ships");
    hq.build(map, mount.base_link_from_laser, 7).expect("sound")
}

/// The outcome over a log, started from the true pose moved by `off`.
fn judge(log: &SensorLog, grid: OccupancyGrid, off: Pose) -> Outcome {
    let map = Arc::new(TrackMap::new(grid).expect("free cells"));
    let mut localizer = localizer(&map, log.mount.expect("known"));
    let truth = Truth::new(log.truth.clone());
    let start = Start::Pose(log.truth[0].1 * off);
    evaluate::run(localizer.as_mut(), &log.arrivals, &truth, start, |_, _, _| ()).expect("runs")
}

fn judge_here(log: &SensorLog) -> Outcome {
    judge(log, club().grid, Pose::IDENTITY)
}

fn states(outcome: &Outcome) -> Vec<State> {
    outcome.state_changes.iter().map(|change| change.state).collect()
}

fn never_lost(outcome: &Outcome) {
    let states = states(outcome);
    assert!(
        !states.contains(&State::Lost) && !states.contains(&State::Relocalizing),
        "{:?}",
        outcome.state_changes
    );
    // The pose was right all the time.
    let errors = outcome.errors.as_ref().expect("truth");
    assert!(errors.position_error_m.max < 0.2, "{errors:?}");
}

#[test]
fn a_clean_lap_is_localized_throughout_and_localized_is_right() {
    let outcome = judge_here(&sound());
    assert_eq!(states(&outcome), [State::Converging, State::Localized]);
    let truth = outcome.state_truth.expect("truth");
    assert_eq!(truth.precision, Some(1.0));
    assert!(truth.recall > Some(0.9), "{truth:?}");
}

#[test]
fn a_kidnapped_car_is_lost_at_once_and_localized_again() {
    let sound = sound();
    let mut lost_after = Vec::new();
    for fault in ["kidnap@8+1", "kidnap@8+4", "kidnap@14+2"] {
        let fault: Fault = fault.parse().expect("a fault");
        let mut log = sound.clone();
        fault.apply(&mut log);
        let outcome = judge_here(&log);
        let report = FaultReport::new(&fault, f64::INFINITY, &outcome.state_changes);
        lost_after.push(report.lost_after_s.expect("LOST"));
        assert!(report.localized_after_s.is_some(), "{report:?}");
        // LOST lasts for the update at which the pose jumps to the right place, and no longer.
        let false_lost = outcome.state_truth.expect("truth").false_lost;
        assert!(
            false_lost <= 1,
            "{fault}: {false_lost} {:?}",
            outcome.state_changes
        );
    }
    lost_after.sort_by(f64::total_cmp);
    assert!(lost_after[2] <= 0.5, "{lost_after:?}");
}

#[test]
fn silent_sensors_are_stale_and_no_false_loss() {
    let sound = sound();
    for fault in ["no-scans@8+1.5", "no-odometry@8+1.5"] {
        let fault: Fault = fault.parse().expect("a fault");
        let mut log = sound.clone();
        fault.apply(&mut log);
        let outcome = judge_here(&log);
        let report = FaultReport::new(&fault, f64::INFINITY, &outcome.state_changes);
        assert!(
            report.stale_after_s.is_some_and(|after| after < 0.6),
            "{report:?} {:?}",
            outcome.state_changes
        );
        // 1.5 s without odometry may lose the pose. Only then the car is LOST, until the update that finds it again.
        let false_lost = outcome.state_truth.expect("truth").false_lost;
        assert!(
            false_lost <= 1,
            "{fault}: {false_lost} {:?}",
            outcome.state_changes
        );
        assert!(report.localized_after_s.is_some(), "{report:?}");
    }
}

#[test]
fn opponents_in_view_are_no_loss() {
    // Two cars half a metre and two metres ahead, and one that fills the middle of the view for seconds.
    let ahead = |start: f64| CarSetup {
        guidance: Guidance::Truth,
        start,
        ..CarSetup::default()
    };
    let log = race(club(), &[ahead(-6.9), ahead(-5.4)], 20.0, 20.0);
    never_lost(&judge_here(&log));
    let mut blocked = sound();
    "blocked@6+8"
        .parse::<Fault>()
        .expect("a fault")
        .apply(&mut blocked);
    never_lost(&judge_here(&blocked));
}

#[test]
fn black_tubes_are_no_loss() {
    let mut track = club();
    let walls: Vec<Wall> = track
        .walls
        .polylines()
        .iter()
        .map(|wall| Wall {
            surface: Surface::Black,
            points: wall.points.clone(),
        })
        .collect();
    track.walls = Walls::new(walls);
    let outcome = judge_here(&race(track, &[], 20.0, 20.0));
    never_lost(&outcome);
    let mut tubes = sound();
    "black-tubes@6+8"
        .parse::<Fault>()
        .expect("a fault")
        .apply(&mut tubes);
    never_lost(&judge_here(&tubes));
}

#[test]
fn standing_still_is_no_loss() {
    let standing = judge_here(&race(club(), &[], 0.0, 10.0));
    never_lost(&standing);
    assert_eq!(
        states(&standing),
        [State::Converging],
        "only driving confirms a pose"
    );
}

#[test]
fn a_map_that_is_out_of_date_is_no_loss() {
    // In every third square of 2 m the walls of the map are moved by 0.4 m.
    let mut grid = club().grid;
    let tile = (2.0 / grid.resolution) as usize;
    let shift = (0.4 / grid.resolution) as usize;
    let moved: Vec<(usize, usize)> = (0..grid.width * grid.height)
        .map(|index| (index % grid.width, index / grid.width))
        .filter(|&(column, row)| {
            (column / tile + row / tile).is_multiple_of(3)
                && grid.cell(column as i64, row as i64) == Cell::Occupied
        })
        .collect();
    assert!(moved.len() > 300, "{}", moved.len());
    let width = grid.width;
    for &(column, row) in &moved {
        grid.cells[row * width + column] = Cell::Free;
    }
    for &(column, row) in &moved {
        let column = (column + shift).min(width - 1);
        grid.cells[row * width + column] = Cell::Occupied;
    }
    never_lost(&judge(&sound(), grid, Pose::IDENTITY));
}

#[test]
fn a_car_with_a_wrong_initial_pose_ends_localized_at_the_right_one() {
    let log = sound();
    // Across the track, as an operator may set it on the page.
    let outcome = judge(&log, club().grid, Pose::new(0.0, 0.0, FRAC_PI_2));
    let last = outcome.state_changes.last().expect("changes");
    assert_eq!(last.state, State::Localized, "{:?}", outcome.state_changes);
    let (errors, truth) = (
        outcome.errors.expect("truth"),
        outcome.state_truth.expect("truth"),
    );
    // It may take two seconds.
    assert!(errors.position_error_m.p95 < 0.1, "{errors:?}");
    assert!(truth.precision > Some(0.97), "{truth:?}");
    assert!(last.at_s < 5.0, "{:?}", outcome.state_changes);
}
