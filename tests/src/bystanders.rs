//! Cars that drive beside an attack and must lose nothing.

use std::time::{Duration, Instant};

use keys::Protection;
use pitwall::{FleetService, unix_now};
use protocol::{CarName, Topic};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

use crate::{Behaviour, DEADLINE, FakeCar, wait_until};

/// Share of a car's poses that may be missing. They are not asked for again, and a sender without processor time drops some: the cars
/// share this process with whoever does harm.
const MOST_MISSING_POSES: f64 = 0.01;

/// The streams that are judged, and the share of each that may be missing.
const JUDGED: [(Topic, f64); 3] = [
    (Topic::Health, 0.0),
    (Topic::Event, 0.0),
    (Topic::Pose, MOST_MISSING_POSES),
];

/// Three cars at full rate, seen by the pit wall. `protection` gives each its keys.
pub async fn three_cars(
    endpoint: &str,
    wall: &FleetService,
    protection: impl Fn(&str) -> Protection,
) -> Vec<FakeCar> {
    let mut cars = Vec::new();
    for name in ["car-1", "car-2", "car-3"] {
        let keys = protection(name);
        cars.push(FakeCar::start_protected(name, endpoint, Behaviour::default(), &keys).await);
    }
    for car in &cars {
        wait_until("the car is seen", || received(wall, car.name()) > 0).await;
    }
    cars
}

/// How many times as large each attack is: `PITWALL_ATTACK`, usually 1.
pub fn attack_factor() -> usize {
    let factor = std::env::var("PITWALL_ATTACK").ok();
    factor.and_then(|factor| factor.parse().ok()).unwrap_or(1)
}

/// Poses that have arrived from a car.
pub fn received(wall: &FleetService, car: &CarName) -> u64 {
    stream(wall, car, Topic::Pose).0
}

/// Messages of a stream that arrived, and that are missing.
fn stream(wall: &FleetService, car: &CarName, topic: Topic) -> (u64, u64) {
    let fleet = wall.fleet();
    let view = fleet.car(car).map(|car| car.view(unix_now()));
    view.and_then(|view| {
        let stream = view.streams.get(topic.as_str())?;
        Some((stream.received, stream.missing))
    })
    .unwrap_or_default()
}

/// Waits for forty more poses of each car, and checks that health and events are complete since its start, and nearly all poses there.
pub async fn nothing_is_lost(wall: &FleetService, cars: &[FakeCar]) {
    for car in cars {
        nothing_is_lost_since(wall, car, [0; 3]).await;
    }
}

/// The same for cars that came while the pit wall was busy with others: what a car sends before zenoh has told it that somebody
/// listens goes nowhere, so that what counts is from now on.
pub async fn nothing_more_is_lost(wall: &FleetService, cars: &[FakeCar]) {
    for car in cars {
        let so_far = JUDGED.map(|(topic, _)| stream(wall, car.name(), topic).1);
        nothing_is_lost_since(wall, car, so_far).await;
    }
}

/// `lost`: how many messages of each judged stream were missing before.
async fn nothing_is_lost_since(wall: &FleetService, car: &FakeCar, lost: [u64; 3]) {
    let before = received(wall, car.name());
    wait_until("the car goes on", || received(wall, car.name()) >= before + 40).await;
    for ((topic, share), lost) in JUDGED.into_iter().zip(lost) {
        few_are_missing(wall, car.name(), topic, share, lost).await;
    }
}

/// Waits until at most this share of a stream's messages is missing beyond what was `lost` before.
async fn few_are_missing(wall: &FleetService, car: &CarName, topic: Topic, share: f64, lost: u64) {
    let deadline = Instant::now() + DEADLINE;
    loop {
        let (received, missing) = stream(wall, car, topic);
        let missing = missing.saturating_sub(lost);
        let sent = received + missing;
        if missing as f64 <= share * sent as f64 {
            return;
        }
        assert!(
            Instant::now() < deadline,
            "{car}: {missing} of {sent} messages of the stream {topic} are missing after {DEADLINE:?}",
        );
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

/// True when an entry of the pit wall's log contains the text.
pub fn log_has(wall: &FleetService, text: &str) -> bool {
    wall.fleet().log().since(0).any(|entry| entry.text.contains(text))
}

/// Waits until the pit wall's log names an attack.
pub async fn is_named(wall: &FleetService, text: &str) {
    wait_until(text, || log_has(wall, text)).await;
}

/// Held by a test that waits for refusals: zenoh's log, where they are read, belongs to the whole process, and whichever pit wall
/// comes first takes them.
pub async fn alone() -> tokio::sync::MutexGuard<'static, ()> {
    static ALONE: tokio::sync::Mutex<()> = tokio::sync::Mutex::const_new(());
    static WATCH: std::sync::Once = std::sync::Once::new();
    let alone = ALONE.lock().await;
    WATCH.call_once(|| {
        tracing_subscriber::registry()
            .with(keys::refusals::watch())
            .init();
    });
    keys::refusals::forget();
    alone
}
