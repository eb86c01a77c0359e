//! Notices another car of the same name. Their messages would be mixed up, and commands would reach both.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use protocol::{CarName, EventKind, Key, Topic};
use zenoh::pubsub::Subscriber;
use zenoh::sample::SampleKind;
use zenoh::{Session, Wait};

use crate::network::NetworkError;
use crate::sensors::clock::SensorClock;
use crate::telemetry::shared_state::SharedState;

/// The token of a run that has crashed stays for the lease of its link, four seconds.
const PATIENCE: Duration = Duration::from_secs(6);

/// Watches the run tokens of this name. Raises an error when another one stays.
pub(super) fn watch(
    session: &Session,
    car: &CarName,
    run_id: u64,
    shared: &Arc<SharedState>,
    clock: SensorClock,
) -> Result<Subscriber<()>, NetworkError> {
    let key = format!("{}/*", Key::new(car.clone(), Topic::Alive));
    let (name, shared) = (car.clone(), Arc::clone(shared));
    let others = Arc::<Mutex<BTreeSet<u64>>>::default();
    session
        .liveliness()
        .declare_subscriber(&key)
        .history(true)
        .callback(move |sample| {
            let Some((_, other)) = Key::parse_run_token(sample.key_expr().as_str()) else {
                return;
            };
            if other == run_id {
                return;
            }
            let mut present = others.lock().unwrap_or_else(PoisonError::into_inner);
            if sample.kind() == SampleKind::Delete {
                present.remove(&other);
                return;
            }
            present.insert(other);
            // One watch at a time is enough: one namesake is an error, however many there are.
            if present.len() > 1 {
                return;
            }
            let (name, shared, others) = (name.clone(), Arc::clone(&shared), Arc::clone(&others));
            let clock = clock.clone();
            let watch = move || {
                std::thread::sleep(PATIENCE);
                if others.lock().unwrap_or_else(PoisonError::into_inner).is_empty() {
                    return;
                }
                let text =
                    format!("another car is named {name}, too: give each car a name of its own (--car)");
                tracing::error!("{text}");
                shared.event(clock.now(), 0, EventKind::Error { text }, None, None);
            };
            if let Err(error) = std::thread::Builder::new().name("namesake".into()).spawn(watch) {
                tracing::warn!(%error, "cars of the same name are not noticed");
            }
        })
        .wait()
        .map_err(|error| NetworkError::Declare {
            key,
            reason: error.to_string(),
        })
}
