//! Where the map is wrong, found from the scans of simulated cars.

use std::sync::Arc;
use std::time::Duration;

use car_node::localization::LocalizerParameters;
use car_node::wire;
use maps::{Cell, OccupancyGrid, Pose};
use pitwall::{Disagreement, MapCheck, MapFinding, TrackLine};
use protocol::{EndPoint, EndPointKind, ScanView};
use simulator::{CarSetup, Estimate, Message, Track, World};
use synpf::{Odometry, Scan, Stamp, TrackMap, Twist, YawRate};

/// Length of a changed stretch \[m\].
const STRETCH: f64 = 3.0;

/// The map of a track with the wall on one side changed from `s` on: moved away from the line by `by` \[m\], or removed.
fn changed(grid: &OccupancyGrid, track: &Track, left: bool, s: f64, by: Option<f64>) -> OccupancyGrid {
    let mut cells = grid.cells.clone();
    let (mut between, mut moved) = (Vec::new(), Vec::new());
    for row in 0..grid.height {
        for column in 0..grid.width {
            let index = row * grid.width + column;
            let centre = grid.to_map([column as f64 + 0.5, row as f64 + 0.5]);
            let place = track.raceline.project(centre);
            let here = (s..s + STRETCH).contains(&place.s) && (place.d > 0.0) == left && place.d.abs() < 3.0;
            if grid.cells[index] == Cell::Occupied && here {
                cells[index] = Cell::Free;
                if let Some(by) = by {
                    let (sin, cos) = (place.heading + std::f64::consts::FRAC_PI_2).sin_cos();
                    let away = by.copysign(place.d);
                    // What lies between has been seen to be free.
                    let step = grid.resolution / 2.0;
                    let steps = (by.abs() / step) as usize;
                    let at = |way: f64| grid.to_grid([centre[0] + way * cos, centre[1] + way * sin]);
                    between.extend((0..steps).map(|i| at(away * i as f64 / steps as f64)));
                    moved.push(at(away));
                }
            }
        }
    }
    for (places, cell) in [(between, Cell::Free), (moved, Cell::Occupied)] {
        for [u, v] in places {
            let (column, row) = (u as usize, v as usize);
            if column < grid.width && row < grid.height {
                cells[row * grid.width + column] = cell;
            }
        }
    }
    OccupancyGrid::new(grid.width, grid.height, grid.resolution, grid.origin, cells)
}

fn stamp(time: Duration) -> Stamp {
    Stamp(time.as_nanos() as i64)
}

/// Every ninth end point, at the estimated pose, as a car publishes them.
fn view(scan: &Scan, map_from_laser: Pose, map: &TrackMap) -> ScanView {
    let centre = [map_from_laser.x, map_from_laser.y];
    let points = scan
        .ranges
        .iter()
        .enumerate()
        .step_by(scan.ranges.len().div_ceil(ScanView::MAX_POINTS))
        .map(|(beam, range)| {
            (
                scan.angle_min + scan.angle_increment * beam as f64,
                f64::from(*range),
            )
        })
        .filter(|(_, range)| (scan.range_min..scan.range_max).contains(range))
        .map(|(angle, range)| {
            let (sin, cos) = angle.sin_cos();
            let point = map_from_laser.transform([range * cos, range * sin]);
            let longer = range - map.range(map_from_laser * Pose::new(0.0, 0.0, angle), scan.range_max);
            let kind = match map.distance(point).abs() {
                near if near < 0.10 => EndPointKind::OnWall,
                _ if longer > 0.3 => EndPointKind::Long,
                _ if longer < -0.3 => EndPointKind::Short,
                _ => EndPointKind::OffWall,
            };
            EndPoint::quantise(point, centre, kind)
        })
        .collect();
    ScanView {
        update: 1,
        centre,
        points,
    }
}

/// Two cars drive `laps` laps on `track`, localized on `grid`; what their scans say about the map.
fn drive(track: &Arc<Track>, grid: &OccupancyGrid, laps: u32) -> Vec<MapFinding> {
    let map = Arc::new(TrackMap::new(grid.clone()).expect("free cells"));
    let reply = wire::map(&track.name, grid, Some(&track.raceline));
    let line = Arc::new(TrackLine::of(&reply).expect("a line"));
    let setups = [-4.0, -10.0].map(|start| CarSetup {
        start,
        ..CarSetup::default()
    });
    let mut world = World::new(track.clone(), &setups, 1);
    let parameters = LocalizerParameters::named("hq").expect("a set that ships");
    parameters.prepare_tables(&map, None);
    let mut cars: Vec<_> = (0..setups.len())
        .map(|car| {
            let laser = setups[car].lidar.base_link_from_laser;
            let mut localizer = parameters.build(&map, laser, car as u64).expect("a localizer");
            localizer.initialize(world.truth(car).pose).expect("on the map");
            (localizer, MapCheck::new(line.clone()), laser, 0_u32)
        })
        .collect();
    let end = track.lap_time() * f64::from(laps) + 4.0;
    while world.now().as_secs_f64() < end {
        for output in world.step() {
            let (localizer, check, laser, scans) = &mut cars[output.car];
            match &output.message {
                Message::Odometry(odometry) => {
                    let twist = Twist {
                        linear_x: odometry.speed,
                        linear_y: 0.0,
                        angular: odometry.yaw_rate,
                    };
                    let (stamp, pose) = (stamp(odometry.stamp), odometry.pose);
                    localizer
                        .on_odometry(&Odometry { stamp, pose, twist })
                        .expect("good");
                    if let Some(pose) = localizer.predict(stamp) {
                        let (time, speed, yaw_rate) = (odometry.stamp, odometry.speed, odometry.yaw_rate);
                        let estimate = Estimate {
                            time,
                            pose,
                            speed,
                            yaw_rate,
                        };
                        world.guide(output.car, estimate);
                    }
                }
                Message::Gyro(gyro) => {
                    let (stamp, rate) = (stamp(gyro.stamp), gyro.yaw_rate);
                    localizer.on_yaw_rate(&YawRate { stamp, rate }).expect("good");
                }
                Message::Scan(scan) => {
                    let scan = Scan {
                        stamp: stamp(scan.stamp),
                        angle_min: scan.angle_min,
                        angle_increment: scan.angle_increment,
                        time_increment: scan.time_increment,
                        scan_time: None,
                        angle_max: None,
                        range_min: scan.range_min,
                        range_max: scan.range_max,
                        ranges: scan.ranges.clone(),
                    };
                    let Ok(update) = localizer.on_scan(&scan) else {
                        continue;
                    };
                    let at = track.raceline.project([update.pose.x, update.pose.y]);
                    check.on_pose(at.s, update.stamp.0);
                    // Ten views a second.
                    if scans.is_multiple_of(4) {
                        check.on_scan(&view(&scan, update.pose * *laser, &map));
                    }
                    *scans += 1;
                }
                _ => {}
            }
        }
    }
    MapCheck::findings(cars.iter().map(|(_, check, ..)| check))
}

#[test]
fn a_moved_and_a_removed_stretch_are_listed_within_20_cm_and_nothing_else() {
    let track = Arc::new(Track::find("club", None).expect("bundled"));
    assert_eq!(drive(&track, &track.grid, 3), [], "the map as it ships");

    let (moved, removed) = (8.0, 24.0);
    let grid = changed(&track.grid, &track, false, moved, Some(0.2));
    let grid = changed(&grid, &track, true, removed, None);
    let mut found = drive(&track, &grid, 3);
    found.sort_by(|a, b| a.from_s.total_cmp(&b.from_s));
    assert_eq!(found.len(), 2, "{found:#?}");
    for (finding, from, kind) in [
        (&found[0], moved, Disagreement::Moved),
        (&found[1], removed, Disagreement::NotDrawn),
    ] {
        assert_eq!(finding.disagreement, kind, "{finding:#?}");
        for (found, true_s) in [(finding.from_s, from), (finding.to_s, from + STRETCH)] {
            assert!(
                (found - true_s).abs() < 0.2,
                "{found:.2} m is not {true_s} m: {finding:#?}"
            );
        }
        assert_eq!(finding.cars, 2);
    }
    assert!((found[0].offset_m - 0.2).abs() < 0.06, "{}", found[0].offset_m);
}
