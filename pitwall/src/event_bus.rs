//! Distributes events to the fleet, the recorder and the subscribers, to all of them in the same order.
//!
//! Live events and those of a replay take the same path, [`EventBus::publish`].

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crossbeam_channel::{Receiver, Sender, TrySendError};

use crate::event::{EventPayload, FleetEvent};
use crate::fleet::Fleet;
use crate::recording::{Recorder, RecorderStatus, RecordingProgress};

/// The state of all cars, shared by those who fill it and those who show it.
///
/// One lock guards the fleet, the recorder and the subscribers. The order in which a recording has the events is
/// therefore the order in which the fleet applied them, and a recording starts without a gap after the known state.
#[derive(Default)]
pub struct EventBus {
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    fleet: Fleet,
    epoch: u64,
    recorder: Option<Recorder>,
    subscribers: Vec<Sender<Arc<FleetEvent>>>,
}

/// The locked fleet. Incoming events wait until it is dropped.
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
    /// Number of times that the whole fleet was replaced.
    pub fn epoch(&self) -> u64 {
        self.0.epoch
    }
}

impl EventBus {
    /// Locks the fleet. Hold the lock briefly, and call no other method of the bus meanwhile.
    pub fn fleet(&self) -> FleetGuard<'_> {
        FleetGuard(self.lock())
    }

    /// Applies an event to the fleet, records it and sends it to all subscribers.
    pub fn publish(&self, event: FleetEvent) {
        let mut state = self.lock();
        state.fleet.apply(&event);
        let event = Arc::new(event);
        if let Some(recorder) = &state.recorder {
            recorder.record(&event);
        }
        state.send(&[event]);
    }

    /// Replaces the whole fleet, because a replay has jumped to `at` \[unix ns\]. Subscribers get the new state of the cars:
    /// they have not seen the events between.
    pub fn replace_fleet(&self, fleet: Fleet, at: i64) {
        let mut state = self.lock();
        state.fleet = fleet;
        state.epoch += 1;
        let events = state.current_events(at);
        state.send(&events);
    }

    /// Subscribes to every event from now on, preceded by the current state of the cars. A subscriber that reads too
    /// slowly misses events.
    pub fn subscribe(&self, now: i64) -> Receiver<Arc<FleetEvent>> {
        const CAPACITY: usize = 20_000;
        let (subscriber, events) = crossbeam_channel::bounded(CAPACITY);
        let mut state = self.lock();
        for event in state.current_events(now) {
            drop(subscriber.try_send(event));
        }
        state.subscribers.push(subscriber);
        events
    }

    /// The file of the current recording and its progress; None when nothing is being recorded.
    pub fn recording(&self) -> Option<(PathBuf, RecordingProgress)> {
        let state = self.lock();
        let recorder = state.recorder.as_ref()?;
        Some((recorder.path(), recorder.progress()))
    }

    /// The state of the current recording; None when nothing is being recorded.
    pub(crate) fn recorder_status(&self) -> Option<RecorderStatus> {
        self.lock().recorder.as_ref().map(Recorder::status)
    }

    /// Starts to record at `at` \[unix ns\]: first the current state of the cars, then every event after it. Gives the
    /// recorder back when another one is running.
    pub(crate) fn attach_recorder(&self, recorder: Recorder, at: i64) -> Result<(), Recorder> {
        let mut state = self.lock();
        if state.recorder.is_some() {
            return Err(recorder);
        }
        for event in state.current_events(at) {
            recorder.record(&event);
        }
        state.recorder = Some(recorder);
        Ok(())
    }

    /// Stops to record. The recorder still has to be finished.
    pub(crate) fn detach_recorder(&self) -> Option<Recorder> {
        self.lock().recorder.take()
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// Sends events to all subscribers and forgets those that are gone.
    fn send(&mut self, events: &[Arc<FleetEvent>]) {
        self.subscribers.retain(|subscriber| {
            events.iter().all(|event| {
                !matches!(
                    subscriber.try_send(event.clone()),
                    Err(TrySendError::Disconnected(_))
                )
            })
        });
    }

    /// Events at `at` \[unix ns\] that describe the cars to a recording or a subscriber that starts now.
    fn current_events(&self, at: i64) -> Vec<Arc<FleetEvent>> {
        let mut events = Vec::new();
        for car in self.fleet.cars() {
            let mut push = |payload| {
                events.push(Arc::new(FleetEvent {
                    at,
                    car: car.name.clone(),
                    payload,
                }));
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
            if let Some((who, text)) = &car.run_sheet {
                push(EventPayload::Marker {
                    who: who.clone(),
                    text: text.clone(),
                });
            }
            let limits = car.book().line().and_then(|line| self.fleet.limits(&line.key));
            if let Some(limits) = limits.filter(|limits| limits.iter().next().is_some()) {
                push(EventPayload::Marker {
                    who: "pit wall".into(),
                    text: limits.to_note().into(),
                });
            }
            if let Some((offset, round_trip)) = car.clock() {
                push(EventPayload::Clock {
                    run_id: None,
                    offset,
                    round_trip,
                });
            }
        }
        events
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::read_events;
    use std::sync::Barrier;

    fn marker(text: &str) -> FleetEvent {
        FleetEvent {
            at: 1,
            car: "car-1".parse().expect("a name"),
            payload: EventPayload::Marker {
                who: "ana".into(),
                text: text.into(),
            },
        }
    }

    fn text(event: &FleetEvent) -> Option<String> {
        match &event.payload {
            EventPayload::Marker { text, .. } => Some(text.to_string()),
            _ => None,
        }
    }

    /// Publishes markers from four threads at once.
    fn publish_from_threads(bus: &EventBus, count: usize) {
        const THREADS: usize = 4;
        let start = Barrier::new(THREADS);
        std::thread::scope(|scope| {
            for thread in 0..THREADS {
                let start = &start;
                scope.spawn(move || {
                    start.wait();
                    for number in 0..count {
                        bus.publish(marker(&format!("{thread}-{number}")));
                    }
                });
            }
        });
    }

    // The fleet, the recorder and the subscribers once had a lock each, and got the events of two threads in two orders.
    #[test]
    fn all_receive_the_events_in_the_same_order() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("session.mcap");
        let bus = EventBus::default();
        let recorder = Recorder::start(&path).expect("begun");
        bus.attach_recorder(recorder, 0).ok().expect("the only one");
        let events = bus.subscribe(0);
        // Fewer than a subscriber may be behind, and enough for the threads to run at the same time.
        publish_from_threads(&bus, 4500);
        let applied: Vec<_> = bus
            .fleet()
            .log()
            .since(0)
            .filter(|entry| entry.kind == "marker")
            .map(|entry| entry.text.clone())
            .collect();
        let received: Vec<_> = events.try_iter().filter_map(|event| text(&event)).collect();
        assert_eq!(received.len(), 18_000);
        assert!(received.ends_with(&applied), "the log keeps the last ones");
        let recorder = bus.detach_recorder().expect("a recorder");
        recorder.finish().expect("written");
        let recorded: Vec<_> = read_events(&path)
            .expect("opens")
            .filter_map(|event| text(&event.expect("whole")))
            .collect();
        assert!(recorded == received, "the recording");
    }

    #[test]
    fn a_recording_that_starts_among_events_has_the_cars_first() {
        let folder = tempfile::tempdir().expect("a folder");
        let bus = EventBus::default();
        let appeared = |number: usize| FleetEvent {
            at: 1,
            car: format!("car-{number}").parse().expect("a name"),
            payload: EventPayload::Appeared,
        };
        for round in 0..14 {
            let path = folder.path().join(format!("{round}.mcap"));
            let recorder = Recorder::start(&path).expect("begun");
            let start = Barrier::new(2);
            std::thread::scope(|scope| {
                scope.spawn(|| {
                    start.wait();
                    for number in 0..20 {
                        bus.publish(appeared(20 * round + number));
                    }
                });
                start.wait();
                bus.attach_recorder(recorder, 0).ok().expect("the only one");
            });
            let recorder = bus.detach_recorder().expect("a recorder");
            recorder.finish().expect("written");
            let recorded = read_events(&path).expect("opens").count();
            assert_eq!(recorded, 20 * (round + 1), "each car once");
        }
    }

    #[test]
    fn a_second_recorder_is_given_back() {
        let folder = tempfile::tempdir().expect("a folder");
        let bus = EventBus::default();
        let [first, second] =
            ["first", "second"].map(|name| Recorder::start(&folder.path().join(name)).expect("begun"));
        assert!(bus.attach_recorder(first, 0).is_ok());
        let rejected = bus.attach_recorder(second, 0).expect_err("given back");
        assert!(rejected.path().ends_with("second"));
        rejected.finish().expect("ended");
        let first = bus.detach_recorder().expect("the first");
        first.finish().expect("ended");
    }

    #[test]
    fn after_a_jump_a_subscriber_gets_the_cars() {
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
        let event = events.try_recv().expect("the state of the car");
        assert_eq!((event.at, event.car.as_str()), (5, "car-1"));
    }
}
