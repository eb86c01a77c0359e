//! The localizer as a whole, on a track made of geometry.

mod common;

use std::sync::Arc;

use common::{BASE_LINK_FROM_LASER, new_ring, odometry, ring, scan, truth};
use maps::{Pose, wrap_angle};
use proptest::prelude::*;
use synpf::{
    Dropped, Localizer, Mode, Odometry, Parameters, RangeMethod, Scan, SensorModelKind, Stamp, SynPf,
    TablePolicy, TrackMap, Twist, Update, YawRate,
};

fn localizer(map: &Arc<TrackMap>, parameters: Parameters, seed: u64) -> SynPf {
    SynPf::new(Arc::clone(map), BASE_LINK_FROM_LASER, parameters, seed).expect("sound")
}

fn named(name: &str) -> Parameters {
    Parameters::named(name).expect("ships")
}

/// Drives from `from` to `to` \[s\] with odometry at 50 Hz and scans at 40 Hz; the updates in order.
fn drive(localizer: &mut SynPf, map: &TrackMap, from: f64, to: f64, scale: f64) -> Vec<Update> {
    let (mut odom, mut next, mut updates) = (from, from, Vec::new());
    while next < to {
        while odom <= next {
            localizer.on_odometry(&odometry(odom, scale)).expect("sound");
            odom += 0.02;
        }
        updates.push(localizer.on_scan(&scan(map, next)).expect("an update"));
        next += 0.025;
    }
    updates
}

fn error(update: &Update) -> f64 {
    update
        .pose
        .distance(truth(update.stamp.since(common::stamp(0.0))))
}

#[test]
fn every_set_follows_a_lap() {
    let map = ring();
    for (name, within) in [("hq", 0.03), ("lq", 0.03), ("adaptive", 0.03)] {
        let mut localizer = localizer(&map, named(name), 1);
        localizer.on_odometry(&odometry(0.0, 1.03)).expect("sound");
        localizer.initialize(truth(0.0)).expect("finite");
        let updates = drive(&mut localizer, &map, 0.02, common::lap(), 1.03);
        let worst = updates[40..].iter().map(error).fold(0.0, f64::max);
        assert!(worst < within, "{name}: {worst}");
    }
}

#[test]
fn every_model_and_method_follows_the_track() {
    let map = ring();
    let mut sets = Vec::new();
    for model in ["tum", "amcl", "arc", "mit"] {
        sets.push(
            named("hq")
                .with_values([("motion_model".into(), model.into())])
                .expect(model)
                .0,
        );
    }
    for method in [RangeMethod::RayMarching, RangeMethod::Cddt] {
        let mut set = named("hq");
        set.sensor.range_method = method;
        set.particles.max_particles = 400;
        set.particles.min_particles = 400;
        sets.push(set);
    }
    let mut field = named("hq");
    field.sensor.sensor_model = SensorModelKind::LikelihoodField;
    sets.push(field);
    for mut set in sets {
        // The particles alone, without the refinement that would cover for them.
        set.refinement.refine = false;
        let mut localizer = localizer(&map, set.clone(), 2);
        localizer.on_odometry(&odometry(0.0, 1.0)).expect("sound");
        localizer.initialize(truth(0.0)).expect("finite");
        let updates = drive(&mut localizer, &map, 0.02, 3.0, 1.0);
        let worst = updates[40..].iter().map(error).fold(0.0, f64::max);
        assert!(
            worst < 0.35,
            "{:?} {:?}: {worst}",
            set.motion.motion_model,
            set.sensor
        );
    }
}

/// Where tables are deferred, the filter's thread used to build them nevertheless and held a lock meanwhile.
#[test]
fn a_localizer_follows_while_its_table_is_built_elsewhere() {
    for method in [RangeMethod::Lut, RangeMethod::Cddt] {
        let map = TrackMap::new(ring().grid().clone()).expect("free space");
        let map = Arc::new(map.with_table_policy(TablePolicy::Defer));
        let mut set = named("hq");
        set.sensor.range_method = method;
        // The particles alone, without the refinement that would cover for them.
        set.refinement.refine = false;
        let mut localizer = localizer(&map, set, 2);
        localizer.on_odometry(&odometry(0.0, 1.0)).expect("sound");
        localizer.initialize(truth(0.0)).expect("finite");
        let (mut odom, mut errors) = (0.0, Vec::new());
        for k in 1..=80 {
            let at = f64::from(k) * 0.025;
            while odom + 0.02 <= at {
                odom += 0.02;
                localizer.on_odometry(&odometry(odom, 1.0)).expect("sound");
            }
            errors.push(error(&localizer.on_scan(&scan(&map, at)).expect("an update")));
            if k == 40 {
                assert_eq!(map.table_bytes(), 0, "the localizer built the table itself");
                let pending = map.pending_tables();
                assert_eq!(pending.len(), 1);
                map.build_table(pending[0]);
            }
        }
        assert_eq!(map.pending_tables(), []);
        assert!(map.table_bytes() > 0);
        let worst = errors[20..].iter().copied().fold(0.0, f64::max);
        assert!(worst < 0.35, "{method:?}: {worst}");
    }
}

#[test]
fn the_same_seed_and_log_give_the_same_bytes_whatever_the_threads() {
    let map = ring();
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads");
        pool.install(|| {
            let map = new_ring();
            let mut localizer = localizer(&map, named("hq"), 5);
            localizer.on_odometry(&odometry(0.0, 1.0)).expect("sound");
            localizer.relocalize();
            format!("{:?}", drive(&mut localizer, &map, 0.02, 1.5, 1.0))
        })
    };
    assert_eq!(run(1), run(3));
    let poses = |seed| {
        let mut particles_alone = named("hq");
        particles_alone.refinement.refine = false;
        let mut localizer = localizer(&map, particles_alone, seed);
        localizer.on_odometry(&odometry(0.0, 1.0)).expect("sound");
        localizer.initialize(truth(0.0)).expect("finite");
        format!("{:?}", drive(&mut localizer, &map, 0.02, 0.5, 1.0))
    };
    assert_ne!(poses(1), poses(2), "the seed matters");
}

#[test]
fn a_car_that_nobody_placed_finds_itself() {
    let map = ring();
    for start in [0.0, 2.5, 5.5] {
        let mut localizer = localizer(&map, named("hq"), 3);
        localizer.on_odometry(&odometry(start, 1.0)).expect("sound");
        localizer.relocalize();
        let updates = drive(&mut localizer, &map, start + 0.02, start + 3.0, 1.0);
        let last = updates.last().expect("updates");
        assert_eq!(last.mode, Mode::Tracking, "from {start}");
        assert!(error(last) < 0.05, "from {start}: {}", error(last));
    }
}

#[test]
fn a_kidnapped_car_says_so_and_recovers() {
    let map = ring();
    let mut localizer = driven(&map, 4);
    // Somebody carries the car on by a third of the track: its pose is set where it no longer is.
    let there = truth(1.0 + common::lap() / 3.0);
    localizer.initialize(there).expect("finite");
    let updates = drive(&mut localizer, &map, 1.02, 4.0, 1.0);
    let noticed = updates
        .iter()
        .position(|update| update.mode == Mode::Searching)
        .expect("noticed");
    assert!(noticed < 40, "after {noticed} scans");
    let last = updates.last().expect("updates");
    assert!(
        last.mode == Mode::Tracking && error(last) < 0.05,
        "{}",
        error(last)
    );
}

/// Drives on from a second, a third of the track farther on than odometry says. Looks at the map take so many scans on another
/// thread; with none they are left to the localizer.
fn carried(rate: f64, delay: Option<usize>) -> Vec<(f64, Update, f64)> {
    let map = ring();
    let mut localizer = driven(&map, 4);
    let missing = common::lap() / 3.0;
    let (mut odom, mut jobs, mut updates) = (1.02, Vec::new(), Vec::new());
    for k in 1..(2.0 * rate) as usize {
        let at = 1.0 + k as f64 / rate;
        while odom <= at {
            // Odometry goes on from where it was: it has not noticed.
            let mut message = odometry(odom + missing, 1.0);
            message.stamp = message.stamp.plus(-missing);
            let (before, after) = (truth(1.0), truth(1.0 + missing));
            message.pose = before * message.pose.since(after);
            localizer.on_odometry(&message).expect("sound");
            odom += 0.02;
        }
        let mut scan = scan(&map, at + missing);
        scan.stamp = scan.stamp.plus(-missing);
        if let Some(delay) = delay {
            jobs.extend(localizer.take_job().map(|job| (k + delay, job)));
            if let Some(done) = jobs.iter().position(|(due, _)| *due <= k) {
                let outcome = jobs.remove(done).1();
                localizer.finish_job(outcome);
            }
        }
        let update = localizer.on_scan(&scan).expect("an update");
        let off = update.pose.distance(truth(at + missing));
        updates.push((at - 1.0, update, off));
    }
    updates
}

#[test]
fn a_carried_car_is_in_doubt_and_found_soon_at_every_scan_rate() {
    for rate in [10.0, 20.0, 40.0] {
        let updates = carried(rate, None);
        let doubted = updates.iter().find(|(_, update, _)| update.doubt.is_some());
        assert!(doubted.is_some_and(|(time, ..)| *time <= 0.3), "{rate} Hz");
        let lost = updates
            .iter()
            .find(|(_, update, _)| update.mode == Mode::Searching);
        // All of a ring looks alike to a laser that sees 2 m of it, so that a scan hardly breaks with the one before.
        assert!(lost.is_some_and(|(time, ..)| *time <= 1.6), "{rate} Hz");
        let (_, last, off) = updates.last().expect("updates");
        assert!(last.mode == Mode::Tracking && *off < 0.05, "{rate} Hz: {off}");
    }
}

#[test]
fn a_look_at_the_map_on_another_thread_may_take_its_time() {
    let here = carried(40.0, None);
    for delay in [1, 4] {
        let there = carried(40.0, Some(delay));
        let (_, last, off) = there.last().expect("updates");
        assert!(last.mode == Mode::Tracking && *off < 0.05, "{delay} scans: {off}");
    }
    assert_eq!(
        format!("{here:?}"),
        format!("{:?}", carried(40.0, None)),
        "the same drive"
    );
}

/// A localizer that has followed the track for a second.
fn driven(map: &Arc<TrackMap>, seed: u64) -> SynPf {
    let mut localizer = localizer(map, named("hq"), seed);
    localizer.on_odometry(&odometry(0.0, 1.0)).expect("sound");
    localizer.initialize(truth(0.0)).expect("finite");
    drive(&mut localizer, map, 0.02, 1.0, 1.0);
    localizer
}

#[test]
fn a_car_that_jumps_with_its_odometry_is_found_where_that_has_put_it() {
    let map = ring();
    for missing in [0.5, common::lap() / 3.0] {
        // The piece is cut out and the stamps are closed up: odometry jumps as far as the car.
        let mut localizer = driven(&map, 11);
        let mut odom = 1.02;
        for k in 1..60 {
            let at = 1.0 + 0.025 * f64::from(k);
            while odom <= at {
                let mut message = odometry(odom + missing, 1.0);
                message.stamp = message.stamp.plus(-missing);
                localizer.on_odometry(&message).expect("sound");
                odom += 0.02;
            }
            let mut scan = scan(&map, at + missing);
            scan.stamp = scan.stamp.plus(-missing);
            let update = localizer.on_scan(&scan).expect("an update");
            let off = update.pose.distance(truth(at + missing));
            match k {
                1 => assert!(update.odometry_jump.is_some_and(|jump| jump[0] > 0.5)),
                2 => assert_eq!(update.mode, Mode::Searching, "the pose is given up at once"),
                20.. => assert!(
                    update.mode == Mode::Tracking && off < 0.05,
                    "{missing} s, {at}: {off}"
                ),
                _ => {}
            }
        }
    }
}

#[test]
fn odometry_that_begins_anew_moves_no_car() {
    let map = ring();
    let mut localizer = driven(&map, 12);
    let anew = odometry(1.0, 1.0).pose.inverse();
    let (mut odom, mut jumps) = (1.02, 0);
    for k in 1..60 {
        let at = 1.0 + 0.025 * f64::from(k);
        while odom <= at {
            let mut message = odometry(odom, 1.0);
            message.pose = anew * message.pose;
            localizer.on_odometry(&message).expect("sound");
            odom += 0.02;
        }
        let update = localizer.on_scan(&scan(&map, at)).expect("an update");
        jumps += usize::from(update.odometry_jump.is_some());
        assert!(
            update.mode == Mode::Tracking && error(&update) < 0.05,
            "{at}: {}",
            error(&update)
        );
    }
    assert_eq!(jumps, 1);
}

#[test]
fn seconds_without_a_message_are_caught_up_by_the_odometry() {
    let map = ring();
    for gap in [0.6, 2.5] {
        let mut localizer = driven(&map, 13);
        let updates = drive(&mut localizer, &map, 1.02 + gap, 1.5 + gap, 1.0);
        let worst = updates.iter().map(error).fold(0.0, f64::max);
        assert!(worst < 0.05, "after {gap} s: {worst}");
        assert!(updates.iter().all(|update| update.odometry_jump.is_none()));
    }
}

#[test]
fn a_set_swapped_in_mid_drive_keeps_the_pose() {
    let map = ring();
    let mut localizer = driven(&map, 6);
    for (k, name) in ["lq", "adaptive", "hq"].into_iter().enumerate() {
        localizer.set_parameters(named(name)).expect("sound");
        let from = 1.02 + 0.5 * k as f64;
        let updates = drive(&mut localizer, &map, from, from + 0.48, 1.0);
        assert!(updates.iter().all(|update| error(update) < 0.03), "{name}");
    }
    let mut bad = named("hq");
    bad.sensor.sigma_hit = f64::NAN;
    assert!(localizer.set_parameters(bad).is_err());
    assert_eq!(localizer.parameters(), &named("hq"));
}

#[test]
fn an_opponent_in_view_is_no_loss() {
    let map = ring();
    let mut localizer = driven(&map, 7);
    let mut odom = 1.0;
    for k in 0..120 {
        let at = 1.0 + 0.025 * f64::from(k + 1);
        while odom <= at {
            localizer
                .on_odometry(&odometry(odom + 0.001, 1.0))
                .expect("sound");
            odom += 0.02;
        }
        let mut scan = scan(&map, at);
        // A car close ahead takes a third of the field of view.
        for range in &mut scan.ranges[180..360] {
            *range = range.min(0.6);
        }
        let update = localizer.on_scan(&scan).expect("an update");
        assert_eq!(update.mode, Mode::Tracking, "scan {k}");
        assert!(error(&update) < 0.05, "scan {k}: {}", error(&update));
        assert!(update.short_beams > 0.1);
    }
}

#[test]
fn what_is_missing_is_said() {
    let map = ring();
    let mut localizer = localizer(&map, named("hq"), 8);
    assert_eq!(
        localizer.on_scan(&scan(&map, 0.0)).err(),
        Some(Dropped::NoOdometry)
    );
    localizer.on_odometry(&odometry(0.0, 1.0)).expect("sound");
    assert_eq!(
        localizer.on_scan(&scan(&map, 0.01)).err(),
        Some(Dropped::NotInitialized)
    );
    localizer.initialize(truth(0.0)).expect("finite");
    assert!(localizer.on_scan(&scan(&map, 0.02)).is_ok());
    assert_eq!(
        localizer.on_scan(&scan(&map, 0.02)).err(),
        Some(Dropped::TimeBackwards)
    );
    assert_eq!(
        localizer.on_scan(&scan(&map, 5.0)).err(),
        Some(Dropped::StaleOdometry)
    );
    assert_eq!(
        localizer.on_odometry(&odometry(0.0, 1.0)).err(),
        Some(Dropped::TimeBackwards)
    );
    assert!(
        localizer
            .initialize(Pose {
                x: f64::NAN,
                ..Pose::IDENTITY
            })
            .is_err()
    );
}

#[test]
fn the_first_scan_after_an_initial_pose_counts() {
    // Scans arrive later than odometry: the pose is true at an odometry that is newer than the next scan.
    let map = ring();
    let mut localizer = localizer(&map, named("hq"), 9);
    for step in 0..5 {
        localizer
            .on_odometry(&odometry(0.02 * f64::from(step), 1.0))
            .expect("sound");
    }
    localizer.initialize(truth(0.08)).expect("finite");
    let update = localizer.on_scan(&scan(&map, 0.06)).expect("an update");
    assert!(error(&update) < 0.05, "{}", error(&update));
}

#[test]
fn a_search_publishes_what_is_known_with_a_covariance_as_large_as_the_doubt() {
    let map = ring();
    let mut blind = scan(&map, 0.0);
    blind.ranges.fill(0.5);
    let searched = |localizer: &mut SynPf| {
        localizer.relocalize();
        let mut scan = blind.clone();
        scan.stamp = common::stamp(1.0);
        localizer.on_odometry(&odometry(1.0, 1.0)).expect("sound");
        let update = localizer.on_scan(&scan).expect("an update");
        assert_eq!(update.mode, Mode::Searching);
        update
    };
    // Somewhere on the ring, which is 14 m across: it used to be the map's corner without any doubt.
    let mut nobody_placed = localizer(&map, named("hq"), 10);
    nobody_placed.on_odometry(&odometry(0.98, 1.0)).expect("sound");
    let update = searched(&mut nobody_placed);
    assert!(update.pose.x.hypot(update.pose.y) < 9.0, "{:?}", update.pose);
    let sigma = (update.covariance[(0, 0)] + update.covariance[(1, 1)]).sqrt();
    assert!(sigma > 1.0, "{sigma}");
    assert!(update.covariance[(2, 2)].sqrt() > 0.4);

    let mut carried = driven(&map, 10);
    let update = searched(&mut carried);
    let sigma = (update.covariance[(0, 0)] + update.covariance[(1, 1)]).sqrt();
    assert!(sigma > 1.0, "{sigma}");
}

#[test]
fn a_map_without_room_is_refused() {
    let walls = maps::OccupancyGrid::new(20, 20, 0.05, Pose::IDENTITY, vec![maps::Cell::Occupied; 400]);
    let message = TrackMap::new(walls).expect_err("no room").to_string();
    assert!(message.contains("20 x 20"), "{message}");
}

/// Any number at all, the odd ones often.
fn any_f64() -> impl Strategy<Value = f64> {
    prop_oneof![
        4 => -10.0..10.0f64,
        1 => any::<f64>(),
        1 => prop_oneof![Just(f64::NAN), Just(f64::INFINITY), Just(0.0), Just(1e300), Just(-1e-300)],
    ]
}

#[derive(Debug, Clone)]
enum Message {
    Odometry(Odometry),
    YawRate(YawRate),
    Scan(Scan),
    GoodScan,
    Initialize(Pose),
    Relocalize,
}

fn any_message() -> impl Strategy<Value = Message> {
    let stamp =
        || prop_oneof![3 => (-1.0..2.0f64).prop_map(common::stamp), 1 => any::<i64>().prop_map(Stamp)];
    let odometry = (stamp(), proptest::array::uniform6(any_f64())).prop_map(|(stamp, v)| {
        Message::Odometry(Odometry {
            stamp,
            pose: Pose {
                x: v[0],
                y: v[1],
                heading: v[2],
            },
            twist: Twist {
                linear_x: v[3],
                linear_y: v[4],
                angular: v[5],
            },
        })
    });
    let ranges = proptest::collection::vec(prop_oneof![3 => 0.0..30.0f32, 1 => any::<f32>()], 0..300);
    let scan = (stamp(), proptest::array::uniform5(any_f64()), ranges).prop_map(|(stamp, v, ranges)| {
        Message::Scan(Scan {
            stamp,
            angle_min: v[0],
            angle_increment: v[1] * 0.01,
            time_increment: v[2].abs() * 1e-6,
            scan_time: Some(v[3]),
            angle_max: Some(v[4]),
            range_min: v[3],
            range_max: v[4].abs() * 10.0,
            ranges,
        })
    });
    prop_oneof![
        3 => odometry,
        1 => (stamp(), any_f64()).prop_map(|(stamp, rate)| Message::YawRate(YawRate { stamp, rate })),
        3 => scan,
        3 => Just(Message::GoodScan),
        1 => (any_f64(), any_f64(), any_f64()).prop_map(|(x, y, heading)| Message::Initialize(Pose { x, y, heading })),
        1 => Just(Message::Relocalize),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Whatever arrives in whatever order: an update with numbers in it, or a reason; never a panic, never a NaN.
    #[test]
    fn nothing_that_arrives_breaks_the_filter(
        messages in proptest::collection::vec(any_message(), 1..40),
        set in 0..Parameters::NAMES.len(),
    ) {
        let map = ring();
        let mut parameters = named(Parameters::NAMES[set]);
        parameters.particles.max_particles = 100;
        parameters.particles.min_particles = 50;
        let mut localizer = localizer(&map, parameters, 9);
        let mut clock = 0.0;
        for message in messages {
            clock += 0.025;
            let outcome = match message {
                Message::Odometry(odometry) => localizer.on_odometry(&odometry).map(|()| None),
                Message::YawRate(rate) => localizer.on_yaw_rate(&rate).map(|()| None),
                Message::Scan(scan) => localizer.on_scan(&scan).map(Some),
                Message::GoodScan => {
                    let _late = localizer.on_odometry(&odometry(clock, 1.0));
                    localizer.on_scan(&scan(&map, clock)).map(Some)
                }
                Message::Initialize(pose) => {
                    let _refused = localizer.initialize(pose);
                    Ok(None)
                }
                Message::Relocalize => {
                    localizer.relocalize();
                    Ok(None)
                }
            };
            if let Ok(Some(update)) = outcome {
                prop_assert!(update.pose.is_finite(), "{update:?}");
                prop_assert!(update.covariance.iter().all(|v| v.is_finite()), "{update:?}");
                prop_assert!((0.0..=1.0).contains(&update.alignment), "{update:?}");
                prop_assert!(wrap_angle(update.pose.heading).is_finite());
                prop_assert!([update.ess_ratio, update.residual, update.w_ratio, update.slip, update.innovation[0]]
                    .iter().all(|v| v.is_finite()), "{update:?}");
            }
        }
    }
}
