//! Every ordered pair of shipped sets, switched by command on a car that drives: the pose continues. On slipping tyres the pose
//! graph is itself half a metre off at times, so that its pairs are driven on tyres that grip.
//!
//! The car drives on the filter's estimates. The test waits for the filter after each odometry message, so that the
//! load of the machine has no effect.

#[path = "common/circuit.rs"]
mod circuit;

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use car_node::control::parameter_store::ParameterStore;
use car_node::control::persisted_state::PersistedState;
use car_node::control::{CommandHandler, CommandHandlerConfig};
use car_node::evaluate::Truth;
use car_node::health::{Monitor, Thresholds};
use car_node::localization::LocalizerParameters;
use car_node::localization::filter_worker::{self, FilterConfig};
use car_node::localization::shadow_channel::shadow_channel;
use car_node::sensors::bag::SensorEvent;
use car_node::sensors::clock::SensorClock;
use car_node::sensors::{Feed, Next, PoseEstimate, Race, Source};
use car_node::telemetry::shared_state::SharedState;
use circuit::circuit;
use crossbeam_channel::{Sender, bounded};
use maps::Pose;
use protocol::{Action, Answer, Command, CommandId, Outcome, ParamsAction, Stamps, Topic, decode, encode};
use simulator::{CarSetup, Grip, Track, YawSource};
use synpf::{Stamp, TrackMap};

/// The car drives this long before the first switch, and then under each set \[s\].
const BEFORE: f64 = 4.0;
const UNDER_EACH: f64 = 1.2;

/// The reference is off by up to 0.3 m here.
const NEAR: f64 = 0.5;

/// The filter replies within this time, or it hangs.
const DEADLINE: Duration = Duration::from_mins(1);

/// A filter that takes commands, without a network.
struct Car {
    handler: CommandHandler,
    shared: Arc<SharedState>,
    feed: Sender<Feed>,
    filter: std::thread::JoinHandle<()>,
    commands: u128,
}

impl Car {
    fn start(
        name: &'static str,
        map: &Arc<TrackMap>,
        base_link_from_laser: Pose,
        begin: Pose,
        now: Stamp,
    ) -> Self {
        let set = LocalizerParameters::named(name).expect("ships");
        set.prepare_tables(map, Some(begin));
        let mut localizer = set.build(map, base_link_from_laser, 1).expect("sound");
        localizer.initialize(begin).expect("on the map");
        let shared = Arc::new(SharedState::default());
        let clock = SensorClock::starting_at(now, 1.0);
        let store = ParameterStore::new(PersistedState::default(), name.into(), set, Stamp(0));
        let (to_filter, filter_commands) = bounded(8);
        let (feed, filter_feed) = bounded(64);
        let (to_shadow, _) = bounded(8);
        let (shadow, _) = shadow_channel();
        let config = FilterConfig {
            localizer,
            map: Arc::clone(map),
            monitor: Monitor::new(Thresholds::default(), clock.now()),
            base_link_from_laser,
            raceline: None,
            clock: clock.clone(),
            set: store.reference(),
            predict: true,
            shared: Arc::clone(&shared),
            shadow,
            ros: None,
        };
        let filter = filter_worker::start(config, filter_feed, filter_commands).expect("a thread");
        let handler = CommandHandler::new(CommandHandlerConfig {
            store,
            file: None,
            filter_commands: to_filter,
            shadow_commands: to_shadow,
            base_link_from_laser,
            shared: Arc::clone(&shared),
            clock,
            run_id: 7,
            track_map: Arc::clone(map),
            search_patience: Duration::ZERO,
        });
        Self {
            handler,
            shared,
            feed,
            filter,
            commands: 0,
        }
    }

    /// Waits until the filter has an estimate for `stamp` or later.
    fn estimate(&self, stamp: Stamp) -> PoseEstimate {
        let until = Instant::now() + DEADLINE;
        loop {
            if let Some(estimate) = self.shared.latest_pose().filter(|e| e.stamp >= stamp) {
                return estimate;
            }
            assert!(Instant::now() < until, "the filter has no pose");
            std::thread::yield_now();
        }
    }

    /// The first update under the set.
    fn select(&mut self, name: &str) -> u64 {
        self.commands += 1;
        let command = Command {
            id: CommandId(self.commands),
            operator: "anna".into(),
            expected_revision: None,
            action: Action::Params(ParamsAction::Select {
                name: name.into(),
                revert_after_ms: None,
            }),
        };
        let bytes = encode(&command, Stamps::default()).expect("encodes");
        let answer = self
            .handler
            .answer(Topic::CmdParams, Some(&bytes))
            .expect("readable");
        let (_, answer) = decode::<Answer>(&answer).expect("an answer");
        match answer.outcome {
            Outcome::Done {
                update: Some(update), ..
            } => update,
            other => panic!("{name}: {other:?}"),
        }
    }

    fn stop(self) {
        drop(self.handler);
        drop(self.feed);
        self.filter.join().expect("the filter did not panic");
    }
}

fn car_on_taped_tyres() -> CarSetup {
    let mut setup = CarSetup::default();
    setup.vehicle = setup.vehicle.with_grip(Grip::LQ);
    setup.odometry.yaw_source = YawSource::Steering;
    setup
}

#[test]
fn the_pose_continues_through_every_switch_of_set_on_slipping_tyres() {
    let names: Vec<_> = LocalizerParameters::NAMES
        .into_iter()
        .filter(|name| !name.starts_with("pose-graph"))
        .collect();
    assert!(names.len() >= 4, "{names:?}");
    drive_circuit(&names, vec![car_on_taped_tyres()]);
}

#[test]
fn the_pose_continues_through_every_switch_of_set_on_tyres_that_grip() {
    drive_circuit(&LocalizerParameters::NAMES, vec![CarSetup::default()]);
}

/// Drives the first of the cars through all ordered pairs of the sets.
fn drive_circuit(names: &[&'static str], cars: Vec<CarSetup>) {
    let tracks = Path::new(env!("CARGO_MANIFEST_DIR")).join("../maps/tracks");
    let track = Track::load(tracks.join("club"), None).expect("bundled");
    let map = Arc::new(TrackMap::new(track.grid.clone()).expect("free cells"));
    let mut source = Race::new(track, cars, 1, Vec::new()).car(0);
    let begin = source.start().expect("known");
    let sets = circuit(names);
    let mut car = Car::start(
        sets[0],
        &map,
        source.mount().base_link_from_laser,
        begin,
        Stamp(0),
    );

    let (mut truth, mut estimates) = (Vec::new(), Vec::new());
    let (mut begun, mut latest, mut scans) = (None, None, 0);
    let (mut under, mut first_updates) = (0, Vec::new());
    while let Next::Due(due, feed) = source.next(latest) {
        let elapsed = due.since(*begun.get_or_insert(due));
        match feed {
            Feed::Truth(sample) => truth.push((sample.stamp, sample.pose)),
            Feed::Sensor(event) => {
                let odometry = match &event {
                    SensorEvent::Odometry(odometry) => Some(odometry.stamp),
                    SensorEvent::Scan(_) => {
                        scans += 1;
                        None
                    }
                    SensorEvent::YawRate(_) | SensorEvent::Pose(_) => None,
                };
                car.feed.send(Feed::Sensor(event)).expect("the filter runs");
                // There is no pose before the first scan.
                let Some(stamp) = odometry.filter(|_| scans > 0) else {
                    continue;
                };
                let estimate = car.estimate(stamp);
                latest = Some(estimate);
                estimates.push((under, estimate));
                if elapsed > BEFORE + UNDER_EACH * under as f64 {
                    under += 1;
                    let Some(name) = sets.get(under) else { break };
                    first_updates.push(car.select(name));
                }
            }
            Feed::Log(_) => {}
            Feed::InitialPose { .. }
            | Feed::GlobalSearch { .. }
            | Feed::Clock { .. }
            | Feed::Mount { .. } => {
                panic!("the recovery crew had to come under {}", sets[under])
            }
        }
    }
    car.stop();

    assert_eq!(first_updates.len(), sets.len() - 1);
    assert!(first_updates.is_sorted_by(|a, b| a < b), "{first_updates:?}");
    let truth = Truth::new(truth);
    let distance = truth_length(&truth, &estimates);
    assert!(distance > 40.0, "the car moves all the time: {distance} m");
    for (under, estimate) in estimates {
        let Some(pose) = truth.at(estimate.stamp) else {
            continue;
        };
        let error = estimate.pose.distance(pose);
        let pair = [under.saturating_sub(1), under].map(|index| sets[index]);
        assert!(error < NEAR, "{error:.2} m off after {pair:?}");
    }
}

/// The distance that the car has driven \[m\].
fn truth_length(truth: &Truth, estimates: &[(usize, PoseEstimate)]) -> f64 {
    let poses: Vec<Pose> = estimates
        .iter()
        .filter_map(|(_, estimate)| truth.at(estimate.stamp))
        .collect();
    poses.windows(2).map(|pair| pair[0].distance(pair[1])).sum()
}
