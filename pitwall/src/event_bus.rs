//! Where events arrive: the fleet, a recording that may be going on, and whoever else listens.
//!
//! Live events and a replay's go the same way, [`EventBus::take`].

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crossbeam_channel::{Receiver, Sender, TrySendError};

use crate::event::{EventPayload, FleetEvent};
use crate::fleet::Fleet;
use crate::recording::{Recorder, RecordingProgress};

/// The state of all cars, shared by those who fill it and those who show it.
#[derive(Default)]
pub struct EventBus {
    state: Mutex<State>,
    recorder: Mutex<Option<Recorder>>,
    subscribers: Mutex<Vec<Sender<Arc<FleetEvent>>>>,
}

#[derive(Default)]
struct State {
    fleet: Fleet,
    epoch: u64,
}

/// The fleet, held. What comes in meanwhile waits.
pub struct FleetGuard<'a>(MutexGuard<'a, State>);

impl std::ops::Deref for FleetGuard<'_> {
    type Target = Fleet;

    fn deref(&self) -> &Fleet {
        &self.0.fleet
    }
}

impl std::ops::DerefMut for FleetGuard<'_> {
    fn deref_mut(&mut self) -> &mut Fleet {
        &mut self.0.fleet
    }
}

impl FleetGuard<'_> {
    /// Counts how often the fleet was begun anew.
    pub fn epoch(&self) -> u64 {
        self.0.epoch
    }
}

impl EventBus {
    /// What is known. Hold it briefly.
    pub fn fleet(&self) -> FleetGuard<'_> {
        FleetGuard(self.state.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Takes in an event and hands it on to the recorder and to all subscribers.
    pub fn publish(&self, event: FleetEvent) {
        self.fleet().apply(&event);
        let event = Arc::new(event);
        if let Some(recorder) = &*self.recorder() {
            recorder.record(&event);
        }
        let mut subscribers = self.subscribers.lock().unwrap_or_else(PoisonError::into_inner);
        subscribers.retain(|subscriber| {
            !matches!(
                subscriber.try_send(event.clone()),
                Err(TrySendError::Disconnected(_))
            )
        });
    }

    /// Puts `fleet` in place of what was known: a replay has jumped to `at` [unix ns]. Taps are told what a newcomer
    /// needs to know: they have not seen what lies between.
    pub fn replace_fleet(&self, fleet: Fleet, at: i64) {
        {
            let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
            state.fleet = fleet;
            state.epoch += 1;
        }
        let events: Vec<_> = self.current_state(at).into_iter().map(Arc::new).collect();
        let mut subscribers = self.subscribers.lock().unwrap_or_else(PoisonError::into_inner);
        subscribers.retain(|subscriber| {
            events.iter().all(|event| {
                !matches!(
                    subscriber.try_send(event.clone()),
                    Err(TrySendError::Disconnected(_))
                )
            })
        });
    }

    /// Every event from now on, after what a newcomer needs to know. One that reads too slowly misses some.
    pub fn subscribe(&self, now: i64) -> Receiver<Arc<FleetEvent>> {
        const WAITING: usize = 20_000;
        let (subscriber, events) = crossbeam_channel::bounded(WAITING);
        for event in self.current_state(now) {
            drop(subscriber.try_send(Arc::new(event)));
        }
        self.subscribers
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(subscriber);
        events
    }

    /// The file that is being recorded into, and how that is getting on.
    pub fn recording(&self) -> Option<(PathBuf, RecordingProgress)> {
        let recorder = self.recorder();
        recorder
            .as_ref()
            .map(|recorder| (recorder.path().to_owned(), recorder.progress()))
    }

    /// The recording that is going on.
    pub(crate) fn recorder(&self) -> MutexGuard<'_, Option<Recorder>> {
        self.recorder.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What a recording that begins at `at` [unix ns] would otherwise not know.
    pub(crate) fn current_state(&self, at: i64) -> Vec<FleetEvent> {
        let fleet = self.fleet();
        let mut events = Vec::new();
        for car in fleet.cars() {
            let mut push = |payload| {
                events.push(FleetEvent {
                    at,
                    car: car.name.clone(),
                    payload,
                });
            };
            if car.alive {
                push(EventPayload::Appeared);
            }
            if let Some((map, bytes)) = &car.map {
                push(EventPayload::Map {
                    map: map.clone(),
                    bytes: bytes.clone(),
                });
            }
            if let Some(info) = &car.info {
                push(EventPayload::Info(info.clone()));
            }
            if let Some((offset, round_trip)) = car.clock() {
                push(EventPayload::Clock { offset, round_trip });
            }
        }
        events
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn after_a_jump_a_tap_knows_the_cars() {
        let bus = EventBus::default();
        let events = bus.subscribe(0);
        assert!(events.is_empty());
        let mut fleet = Fleet::default();
        fleet.apply(&FleetEvent {
            at: 1,
            car: "car-1".parse().expect("a name"),
            payload: EventPayload::Appeared,
        });
        bus.replace_fleet(fleet, 5);
        let event = events.try_recv().expect("what a newcomer needs to know");
        assert_eq!((event.at, event.car.as_str()), (5, "car-1"));
    }
}
