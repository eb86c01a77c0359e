//! The reference emulation as a whole, on a track made of geometry.

mod common;

use std::sync::Arc;

use common::{BASE_LINK_FROM_LASER, lap, odometry, ring, scan, stamp, truth};
use serde_json::Value;
use synpf::{
    Dropped, Localizer, Mode, PreparedParameters, Reference, ReferenceParameters, ReferenceTuning, Scan,
    TrackMap, Update,
};

/// The shipped set with some values replaced.
fn set(values: &[(&str, Value)]) -> ReferenceParameters {
    let values = values
        .iter()
        .map(|(key, value)| ((*key).to_owned(), value.clone()));
    let (set, unknown) = ReferenceParameters::default().with_values(values).expect("sound");
    assert!(unknown.is_empty(), "{unknown:?}");
    set
}

fn reference(map: &Arc<TrackMap>, parameters: ReferenceParameters, seed: u64) -> Reference {
    Reference::prepare(map, Some(truth(0.0)), &parameters);
    Reference::new(Arc::clone(map), BASE_LINK_FROM_LASER, parameters, seed).expect("sound")
}

/// Starts at the beginning of the drive.
fn placed(map: &Arc<TrackMap>, parameters: ReferenceParameters, seed: u64) -> Reference {
    let mut localizer = reference(map, parameters, seed);
    localizer.on_odometry(&odometry(0.0, 1.0)).expect("sound");
    localizer.initialize(truth(0.0)).expect("on the map");
    localizer
}

/// Drives from `from` to `to` \[s\] with odometry at 50 Hz and scans at 40 Hz; the updates in order.
fn drive(localizer: &mut dyn Localizer, map: &TrackMap, from: f64, to: f64) -> Vec<Update> {
    let (mut odom, mut next, mut updates) = (from, from, Vec::new());
    while next < to {
        while odom <= next {
            localizer.on_odometry(&odometry(odom, 1.0)).expect("sound");
            odom += 0.02;
        }
        updates.push(localizer.on_scan(&scan(map, next)).expect("an update"));
        next += 0.025;
    }
    updates
}

fn error(update: &Update) -> f64 {
    update.pose.distance(truth(update.stamp.since(stamp(0.0))))
}

#[test]
fn as_shipped_it_follows_a_lap_to_some_centimetres() {
    let map = ring();
    let mut localizer = placed(&map, ReferenceParameters::default(), 1);
    let updates = drive(&mut localizer, &map, 0.02, lap());
    let errors: Vec<f64> = updates[40..].iter().map(error).collect();
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    assert!((0.01..0.12).contains(&mean), "{mean}");
    assert!(errors.iter().all(|error| *error < 0.5));
    assert!(
        updates[40..]
            .iter()
            .all(|update| update.mode == Mode::Tracking && update.alignment > 0.5)
    );
}

#[test]
fn mended_every_motion_model_follows_the_track() {
    let map = ring();
    for model in ["tum", "amcl", "arc", "default"] {
        let mut values: Vec<(&str, Value)> = [
            "defect_unsigned_rotation",
            "defect_biased_translation",
            "defect_deadband",
            "defect_late_odometry",
            "defect_mirrored_arc",
            "defect_lambda_short",
            "defect_update_per_odometry",
            "defect_noise_per_message",
            "defect_long_ranges",
            "defect_covariance_about_previous",
        ]
        .map(|key| (key, Value::from(false)))
        .into();
        values.push(("motion_model", model.into()));
        let mut localizer = placed(&map, set(&values), 1);
        let updates = drive(&mut localizer, &map, 0.02, 3.0);
        let worst = updates[40..].iter().map(error).fold(0.0, f64::max);
        assert!(worst < 0.3, "{model}: {worst}");
        // One update per scan, at its own time.
        assert!((updates[50].stamp.since(stamp(0.0)) - (0.02 + 50.0 * 0.025)).abs() < 1e-6);
    }
}

#[test]
fn there_is_one_update_per_odometry_message_and_its_stamp_is_told() {
    let map = ring();
    let mut localizer = placed(&map, ReferenceParameters::default(), 1);
    drive(&mut localizer, &map, 0.02, 1.0);
    let before = localizer.predict(stamp(1.0)).expect("a pose");
    localizer.on_odometry(&odometry(1.02, 1.0)).expect("sound");
    let after = localizer.predict(stamp(1.02)).expect("a pose");
    assert!(after.distance(before) > 0.01);
    let update = localizer.on_scan(&scan(&map, 1.03)).expect("an update");
    assert_eq!(update.stamp, stamp(1.02));
    assert!(update.pose.distance(after) < 1e-9);
    assert!((update.covariance.determinant()).is_finite());
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    let map = ring();
    let run = |seed| {
        let mut localizer = placed(&map, ReferenceParameters::default(), seed);
        drive(&mut localizer, &map, 0.02, 0.5)
    };
    assert_eq!(run(3), run(3));
    assert_ne!(run(3), run(4));
}

#[test]
fn a_new_one_goes_on_from_what_another_hands_over() {
    let map = ring();
    let mut first = placed(&map, ReferenceParameters::default(), 1);
    let updates = drive(&mut first, &map, 0.02, 2.0);
    let mut second = reference(&map, ReferenceParameters::default(), 2);
    second.take_over(first.hand_over());
    let at = stamp(1.99);
    let [one, other] = [first.predict(at), second.predict(at)].map(|pose| pose.expect("a pose"));
    assert!(one.distance(other) < 0.01, "{one:?} {other:?}");
    let more = drive(&mut second, &map, 2.02, 3.0);
    assert_eq!(more[0].number, updates.len() as u64 + 1);
    let worst = more.iter().map(error).fold(0.0, f64::max);
    assert!(worst < 0.4, "{worst}");
}

#[test]
fn a_set_is_swapped_and_one_for_another_kind_comes_back() {
    let map = ring();
    let mut localizer = placed(&map, ReferenceParameters::default(), 1);
    drive(&mut localizer, &map, 0.02, 0.5);
    let fewer = set(&[("max_particles", 500.into()), ("des_lidar_beams", 15.into())]);
    let tuning = ReferenceTuning::new(fewer.clone(), &map).expect("sound");
    localizer
        .set_parameters(PreparedParameters::new(tuning))
        .expect("its own kind");
    assert_eq!(localizer.parameters(), &fewer);
    let updates = drive(&mut localizer, &map, 0.52, 1.0);
    assert_eq!(updates.last().map(|update| update.particles), Some(500));
    assert!(
        localizer
            .set_parameters(PreparedParameters::new("another kind"))
            .is_err()
    );
}

#[test]
fn a_search_spreads_particles_over_the_map_and_ends_when_they_have_come_together() {
    let map = ring();
    let mut localizer = placed(&map, ReferenceParameters::default(), 1);
    localizer.relocalize();
    let update = localizer.on_scan(&scan(&map, 0.01)).expect("an update");
    assert_eq!(update.mode, Mode::Searching);
    assert!(update.spread[0] > 2.0, "{:?}", update.spread);
    assert!(!localizer.hypotheses().is_empty());
    let updates = drive(&mut localizer, &map, 0.02, 4.0);
    let found = updates.iter().find(|update| update.mode == Mode::Tracking);
    assert!(found.is_some(), "right or wrong, they come together");
    assert!(localizer.hypotheses().is_empty());
}

#[test]
fn what_makes_no_sense_is_dropped_with_its_cause() {
    let map = ring();
    let mut localizer = reference(&map, ReferenceParameters::default(), 1);
    assert_eq!(localizer.on_scan(&scan(&map, 0.0)), Err(Dropped::NoOdometry));
    localizer.on_odometry(&odometry(0.0, 1.0)).expect("sound");
    assert_eq!(
        localizer.on_odometry(&odometry(0.0, 1.0)),
        Err(Dropped::TimeBackwards)
    );
    assert_eq!(localizer.on_scan(&scan(&map, 0.01)), Err(Dropped::NotInitialized));
    localizer.initialize(truth(0.0)).expect("on the map");
    let blind = Scan {
        ranges: vec![f32::NAN; 541],
        ..scan(&map, 0.02)
    };
    assert_eq!(localizer.on_scan(&blind), Err(Dropped::NoBeams));
    assert_eq!(localizer.on_scan(&scan(&map, 5.0)), Err(Dropped::StaleOdometry));
    assert_eq!(
        localizer.on_scan(&Scan {
            ranges: Vec::new(),
            ..scan(&map, 0.05)
        }),
        Err(Dropped::Malformed)
    );
}
