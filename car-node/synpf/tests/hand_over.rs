//! Changes of the parameter set on a moving car whose wheels slip.
//!
//! A localizer that learns slip keeps odometry corrected; one that does not keeps it raw. Switching used to take the
//! difference between the two, metres after a lap, for a motion of the car.

mod common;

use std::sync::Arc;

use common::{BASE_LINK_FROM_LASER, odometry, ring, scan, truth};
use synpf::{
    Dropped, HandOver, Localizer, Mode, Parameters, Reference, ReferenceParameters, Scan, SynPf, TrackMap,
    Tuning, Update,
};

/// Wheels turn this much farther than the car goes, as on taped tyres.
const SLIP: f64 = 1.12;

/// SynPF's sets and the reference's.
const SETS: [&str; 4] = ["hq", "lq", "adaptive", "reference"];

/// The localizer that a set belongs to.
fn any(map: &Arc<TrackMap>, name: &str) -> Box<dyn Localizer> {
    if name == "reference" {
        let parameters = ReferenceParameters::default();
        Box::new(Reference::new(Arc::clone(map), BASE_LINK_FROM_LASER, parameters, 3).expect("sound"))
    } else {
        Box::new(localizer(map, name))
    }
}

fn localizer(map: &Arc<TrackMap>, name: &str) -> SynPf {
    let parameters = Parameters::named(name).expect("ships");
    SynPf::new(Arc::clone(map), BASE_LINK_FROM_LASER, parameters, 3).expect("sound")
}

/// Follows the car from one time to the next \[s\], with the sensors of [`common`]; calls back after each scan.
fn drive(
    localizer: &mut dyn Localizer,
    map: &TrackMap,
    span: std::ops::Range<f64>,
    mut after: impl FnMut(&Update),
) {
    let (first, last) = (
        (span.start / 0.02).round() as usize,
        (span.end / 0.02).round() as usize,
    );
    for step in first..last {
        let at = 0.02 * step as f64;
        localizer.on_odometry(&odometry(at, SLIP)).expect("sound");
        if step % 2 == 0 {
            after(&localizer.on_scan(&scan(map, at)).expect("an update"));
        }
    }
}

/// Set `a` for two seconds, then half a second each of `b`, `a` and `b`; the greatest error and whether it was lost.
fn switched(
    map: &Arc<TrackMap>,
    [a, b]: [&str; 2],
    switch: impl Fn(Box<dyn Localizer>, &str) -> Box<dyn Localizer>,
) -> (f64, bool) {
    let mut running = any(map, a);
    running.on_odometry(&odometry(-0.02, SLIP)).expect("sound");
    running.initialize(truth(-0.02)).expect("on the map");
    drive(running.as_mut(), map, 0.0..2.0, |_| {});
    let (mut worst, mut lost) = (0.0f64, false);
    for (k, name) in [b, a, b].into_iter().enumerate() {
        running = switch(running, name);
        let from = 2.0 + 0.5 * k as f64;
        drive(running.as_mut(), map, from..from + 0.5, |update| {
            let there = truth(update.stamp.since(common::stamp(0.0)));
            worst = worst.max(update.pose.distance(there));
            lost |= update.mode != Mode::Tracking;
        });
    }
    (worst, lost)
}

fn every_pair(
    sets: &[&str],
    switch: impl Fn(&Arc<TrackMap>, Box<dyn Localizer>, &str) -> Box<dyn Localizer>,
) {
    let map = ring();
    for &a in sets {
        for &b in sets.iter().filter(|b| **b != a) {
            let (worst, lost) = switched(&map, [a, b], |running, name| switch(&map, running, name));
            // The reference is off by tens of centimetres on slipping wheels.
            let within = if [a, b].contains(&"reference") { 0.5 } else { 0.05 };
            assert!(
                worst < within && !lost,
                "{a} and {b}: {worst:.3} m off, lost: {lost}"
            );
        }
    }
}

#[test]
fn every_switch_of_the_set_keeps_the_pose_of_a_slipping_car() {
    every_pair(&Parameters::NAMES, |map, mut running, name| {
        let parameters = Parameters::named(name).expect("ships");
        let prepared = Tuning::prepare(parameters, map, None).expect("sound");
        running.set_parameters(prepared).expect("of the same kind");
        running
    });
}

#[test]
fn every_change_of_the_localizer_keeps_the_pose_of_a_slipping_car() {
    every_pair(&SETS, |map, running, name| {
        let mut next = any(map, name);
        next.take_over(running.hand_over());
        next
    });
}

#[test]
fn what_is_handed_over_is_as_it_was_received() {
    let map = ring();
    let mut first = localizer(&map, "hq");
    first.on_odometry(&odometry(-0.02, SLIP)).expect("sound");
    first.initialize(truth(-0.02)).expect("on the map");
    let mut last = None;
    drive(&mut first, &map, 0.0..2.0, |update| last = Some(update.clone()));
    let last = last.expect("updates");
    let handed = first.hand_over();
    let estimate = handed.estimate.expect("a pose");
    assert_eq!((estimate.stamp, estimate.pose), (last.stamp, last.pose));
    assert_eq!(estimate.covariance, last.covariance);
    assert_eq!(
        (handed.last_scan, handed.updates),
        (Some(last.stamp), last.number)
    );
    let newest = handed.odometry.last().expect("odometry");
    assert_eq!(newest, &odometry(1.98, SLIP));

    let mut next = localizer(&map, "hq");
    next.take_over(handed);
    // Half of what came since the estimate is still to be applied: none of it is lost, none counts twice.
    let stamp = estimate.stamp.plus(0.02);
    let (was, is) = (
        first.predict(stamp).expect("a pose"),
        next.predict(stamp).expect("a pose"),
    );
    assert!(was.distance(is) < 0.02, "{was:?} {is:?}");
    let old: Scan = scan(&map, 1.9);
    assert_eq!(next.on_scan(&old).err(), Some(Dropped::TimeBackwards));
    drive(&mut next, &map, 2.0..2.1, |update| {
        assert!(update.number > last.number);
    });
}

#[test]
fn without_a_pose_a_search_goes_on() {
    let map = ring();
    let mut next = localizer(&map, "hq");
    next.take_over(HandOver {
        odometry: vec![odometry(-0.02, 1.0)],
        updates: 7,
        ..HandOver::default()
    });
    let update = next.on_scan(&scan(&map, 0.0)).expect("an update");
    assert_eq!((update.mode, update.number), (Mode::Searching, 8));
}
