//! All cars, as a pure state: events go in, views come out. No clock, no network.

mod car;
mod car_view;
mod clock_estimate;
mod history;
mod laps;
mod limits;
mod log;
mod sequence_tracker;
mod stream_statistics;

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::{CarName, Event, EventKind, Header, MapReply, Severity, Telemetry, Topic};

use crate::event::{EventPayload, FleetEvent};

pub use car::Car;
pub use car_view::{CarView, PoseView, SetView};
pub use history::{HealthSample, ProfileCell};
pub use laps::{Lap, LapGrip, SECTORS};
pub use limits::Limits;
pub use log::{Log, LogEntry};
pub use sequence_tracker::{GapSummary, SequenceStatus, SequenceTracker};
pub use stream_statistics::{StreamStatistics, StreamView};

type SharedMap = Arc<MapReply>;
/// A map, and the message that it came in.
type KeptMap = (SharedMap, Arc<[u8]>);

/// The state of all cars, and the log.
///
/// A live pit wall and a replay do the same: [`Fleet::apply`] for each event, [`Fleet::tick`] as time passes.
#[derive(Debug, Clone, Default)]
pub struct Fleet {
    cars: BTreeMap<CarName, Car>,
    /// Cars of a recording that may come, see [`Car::read_from`].
    expected: BTreeMap<CarName, ([bool; 2], BTreeMap<u64, i64>)>,
    log: Log,
    /// The engineer's limits by track, see `TrackLine::key`.
    limits: BTreeMap<String, Limits>,
    /// When cars beyond the limit were last reported \[unix ns\].
    too_many_reported: Option<i64>,
    /// True when nobody looks at the laps.
    only_newest: bool,
}

impl Fleet {
    /// Most cars that are kept.
    pub const MOST_CARS: usize = 300;
    /// Most bytes of maps that are kept. Cars with the same map share it.
    const MOST_MAP_BYTES: usize = 256_000_000;
    /// Period of the report that there are too many cars \[ns\].
    const REPORT_TOO_MANY: i64 = 60_000_000_000;

    /// Applies an event.
    pub fn apply(&mut self, event: &FleetEvent) {
        let (at, name, payload) = (event.at, &event.car, &event.payload);
        if !self.make_room(name, payload, at) {
            return;
        }
        let map = match payload {
            EventPayload::Map { map, bytes } => self.share_map(name, map, bytes, at),
            _ => None,
        };
        let car = self.cars.entry(name.clone()).or_insert_with(|| {
            let mut car = Car::new(name.clone(), at);
            if let Some((complete, laps_since)) = self.expected.get(name) {
                car.read_from(*complete, laps_since.clone());
            }
            car.only_newest = self.only_newest;
            car
        });
        match payload {
            EventPayload::Appeared => {
                car.alive = true;
                car.dismissed = false;
                car.last_heard = car.last_heard.max(at);
            }
            EventPayload::Vanished => {
                car.alive = false;
                // Nothing is known of it but its name, which cost nothing to invent.
                if !car.heard {
                    self.cars.remove(name);
                    return;
                }
            }
            EventPayload::Message {
                topic,
                header,
                telemetry,
                ..
            } => {
                car.heard = true;
                let is_new = car.apply(*topic, header, telemetry, at);
                let raised = if is_new && *topic == Topic::Health {
                    car.beyond_limits(&self.limits, header.sensor)
                } else {
                    Vec::new()
                };
                if let (Telemetry::Event(event), Topic::Event) = (&**telemetry, topic)
                    && is_new
                {
                    let when = happened_at(header) - car.clock_offset();
                    self.log.push(entry_of(event, name, when));
                }
                for text in raised {
                    self.add_entry(at, Some(name.clone()), Severity::Critical, "limit", text, None);
                }
            }
            EventPayload::Unreadable { topic, header, error } => {
                let first = car.note_unreadable(*topic, header.as_ref(), at);
                if first {
                    self.log.push(LogEntry {
                        number: 0,
                        at,
                        car: Some(name.clone()),
                        severity: Severity::Warning,
                        kind: "unreadable",
                        text: format!("{topic} cannot be read: {error}"),
                        who: None,
                    });
                }
            }
            EventPayload::Rejected {
                topic, count, reason, ..
            } => {
                if let Some(entry) = car.note_rejected(*topic, *count, *reason, at) {
                    self.log.push(entry);
                }
            }
            EventPayload::Map { .. } => {
                if let Some((map, bytes)) = map {
                    car.set_map(map, bytes);
                }
            }
            EventPayload::Info(info) => car.info = Some(info.clone()),
            EventPayload::Marker { who, text } => {
                if text.starts_with(Car::RUN_SHEET) {
                    car.run_sheet = Some((Arc::clone(who), Arc::clone(text)));
                }
                let line = car.book().line().map(|line| line.key.clone());
                if let (Some(key), Some(limits)) = (line, Limits::of_note(text)) {
                    self.limits.insert(key, limits);
                }
                let (car, text, who) = (Some(name.clone()), text.to_string(), Some(who.to_string()));
                self.add_entry(at, car, Severity::Info, "marker", text, who);
            }
            EventPayload::Clock {
                offset, round_trip, ..
            } => car.set_clock(*offset, *round_trip, at),
            EventPayload::StreamEnds { .. } => {}
        }
        self.update_link(&name.clone(), at);
    }

    /// Lets time pass until `now` \[unix ns\]: cars that are silent become BLIND.
    pub fn tick(&mut self, now: i64) {
        let names: Vec<_> = self.cars.keys().cloned().collect();
        for name in names {
            self.update_link(&name, now);
        }
    }

    /// Prepares a car that is about to be read from a recording, see [`Car::read_from`].
    pub(crate) fn read_from(&mut self, name: CarName, complete: [bool; 2], laps_since: BTreeMap<u64, i64>) {
        self.expected.insert(name, (complete, laps_since));
    }

    /// Keeps only the newest messages of each car from now on: no laps, no history and no map check, which take time with each
    /// message and memory with each lap. For a recorder that nobody looks at.
    pub fn keep_only_newest(&mut self) {
        self.only_newest = true;
        for car in self.cars.values_mut() {
            car.only_newest = true;
        }
    }

    /// Forgets what arrived of the full-rate streams, because nobody has listened to them since.
    pub(crate) fn forget_recorded(&mut self) {
        for car in self.cars.values_mut() {
            car.streams.retain(|topic, _| !topic.recorded());
        }
    }

    /// Lets time pass from `since` until `until` \[unix ns\] in steps. A long pause takes a few steps, too.
    pub(crate) fn tick_between(&mut self, since: &mut i64, until: i64) {
        const TICK: i64 = 100_000_000;
        const LONG: i64 = 60_000_000_000;
        if until.saturating_sub(*since) > LONG {
            // Everything that happens in silence has happened after a minute.
            self.tick(since.saturating_add(LONG / 2));
            *since = until.saturating_sub(TICK);
        }
        while since.saturating_add(TICK) < until {
            *since += TICK;
            self.tick(*since);
        }
    }

    /// Adds an entry of the pit wall itself to the log.
    pub fn add_entry(
        &mut self,
        at: i64,
        car: Option<CarName>,
        severity: Severity,
        kind: &'static str,
        text: String,
        who: Option<String>,
    ) {
        self.log.push(LogEntry {
            number: 0,
            at,
            car,
            severity,
            kind,
            text,
            who,
        });
    }

    /// Acknowledges every alarm so far, and logs how many there were.
    pub fn acknowledge(&mut self, at: i64, who: &str) {
        let alarms = self.log.acknowledge();
        if alarms > 0 {
            let alarms = if alarms == 1 {
                "1 alarm".to_owned()
            } else {
                format!("{alarms} alarms")
            };
            let text = format!("{alarms} acknowledged");
            self.add_entry(
                at,
                None,
                Severity::Info,
                "acknowledged",
                text,
                Some(who.to_owned()),
            );
        }
    }

    /// Sets the engineer's alarm limits on a track, see [`TrackLine::key`](crate::TrackLine::key).
    pub fn set_limits(&mut self, track: &str, limits: Limits) {
        self.limits.insert(track.to_owned(), limits);
    }

    /// The engineer's alarm limits on a track; None before they are set.
    pub fn limits(&self, track: &str) -> Option<&Limits> {
        self.limits.get(track)
    }

    /// Hides a car that is not connected, until something comes from it. False when it is connected or not known.
    pub fn dismiss(&mut self, name: &CarName, at: i64, who: &str) -> bool {
        let Some(car) = self.cars.get_mut(name).filter(|car| !car.alive) else {
            return false;
        };
        car.dismissed = true;
        let text = "dismissed: hidden until it is back".to_owned();
        self.add_entry(
            at,
            Some(name.clone()),
            Severity::Info,
            "node",
            text,
            Some(who.to_owned()),
        );
        true
    }

    /// The cars by name.
    pub fn cars(&self) -> impl Iterator<Item = &Car> {
        self.cars.values()
    }

    /// A car.
    pub fn car(&self, name: &CarName) -> Option<&Car> {
        self.cars.get(name)
    }

    /// All cars at `now` \[unix ns\].
    pub fn view(&self, now: i64) -> Vec<CarView> {
        self.cars()
            .filter(|car| !car.dismissed)
            .map(|car| car.view(now))
            .collect()
    }

    /// The log.
    pub fn log(&self) -> &Log {
        &self.log
    }

    /// True when the car is known, or can be added. A car that has sent nothing readable makes room for one that has.
    fn make_room(&mut self, name: &CarName, payload: &EventPayload, at: i64) -> bool {
        if self.cars.len() < Self::MOST_CARS || self.cars.contains_key(name) {
            return true;
        }
        if let EventPayload::Message { .. } = payload {
            let gone = |car: &&Car| !car.heard || !car.alive;
            let oldest = self
                .cars
                .values()
                .filter(gone)
                .min_by_key(|car| (car.heard, car.last_heard));
            if let Some(oldest) = oldest.map(|car| car.name.clone()) {
                self.cars.remove(&oldest);
                return true;
            }
        }
        if self
            .too_many_reported
            .is_none_or(|reported| at - reported >= Self::REPORT_TOO_MANY)
        {
            self.too_many_reported = Some(at);
            let text = format!(
                "more than {} cars: {name} and others are ignored",
                Self::MOST_CARS
            );
            self.add_entry(at, None, Severity::Warning, "limit", text, None);
        }
        false
    }

    /// The map to keep for a car: the same map of another car, if there is one. None when there is no room for it.
    fn share_map(&mut self, name: &CarName, map: &SharedMap, bytes: &Arc<[u8]>, at: i64) -> Option<KeptMap> {
        let maps = || self.cars.values().filter_map(|car| car.map.as_ref());
        let body = |bytes: &[u8]| bytes.get(Header::LEN..).unwrap_or_default().to_vec();
        let same = maps().find(|(_, known)| known.len() == bytes.len() && body(known) == body(bytes));
        if let Some(same) = same {
            return Some(same.clone());
        }
        let mut kept: Vec<_> = maps().map(|(_, bytes)| bytes).collect();
        kept.sort_by_key(|bytes| Arc::as_ptr(bytes).addr());
        kept.dedup_by(|a, b| Arc::ptr_eq(a, b));
        let kept: usize = kept.iter().map(|bytes| bytes.len()).sum();
        if kept + bytes.len() <= Self::MOST_MAP_BYTES {
            return Some((Arc::clone(map), Arc::clone(bytes)));
        }
        let text = format!(
            "no room for its map of {:.1} MB: maps may take {:.0} MB in all",
            bytes.len() as f64 / 1e6,
            Self::MOST_MAP_BYTES as f64 / 1e6
        );
        self.add_entry(at, Some(name.clone()), Severity::Warning, "limit", text, None);
        None
    }

    /// Logs once when a car becomes BLIND, and once when it is back.
    fn update_link(&mut self, name: &CarName, now: i64) {
        let Some(car) = self.cars.get_mut(name) else {
            return;
        };
        let blind = car.blind(now);
        if car.blind_logged && !blind {
            car.back_at = now;
        }
        let silent = car.stale_for(now).filter(|_| !blind);
        if silent.is_some() != car.stale_logged {
            car.stale_logged = silent.is_some();
            let (severity, text) = match silent {
                Some(silent) => {
                    let silent = silent as f64 * 1e-9;
                    let text =
                        format!("STALE: no health message for {silent:.1} s, though the car is connected");
                    (Severity::Critical, text)
                }
                None => (Severity::Info, "health messages are back".to_owned()),
            };
            if silent.is_some() || !blind {
                self.add_entry(now, Some(name.clone()), severity, "link", text, None);
            }
        }
        let Some(car) = self.cars.get_mut(name) else {
            return;
        };
        if blind == car.blind_logged || (blind && now - car.first_seen <= Car::BLIND_AFTER) {
            return;
        }
        car.blind_logged = blind;
        let (severity, text) = if !blind {
            (Severity::Info, "link is back")
        } else if car.alive {
            (Severity::Critical, "BLIND: nothing comes from the car")
        } else {
            (Severity::Critical, "BLIND: the car's node or its link has gone")
        };
        self.add_entry(now, Some(name.clone()), severity, "link", text.to_owned(), None);
    }
}

fn entry_of(event: &Event, car: &CarName, at: i64) -> LogEntry {
    let kind = match &event.kind {
        EventKind::StateChanged { .. } => "state",
        EventKind::ParametersChanged { .. }
        | EventKind::ParametersConfirmed { .. }
        | EventKind::ParametersFellBack { .. }
        | EventKind::SetStored { .. }
        | EventKind::SetDeleted { .. }
        | EventKind::Proposed { .. }
        | EventKind::AutoChanged { .. }
        | EventKind::ShadowStarted { .. }
        | EventKind::ShadowEnded { .. }
        | EventKind::ShadowDropped { .. } => "set",
        EventKind::PoseInitialized { .. } | EventKind::SearchStarted | EventKind::Relocalized { .. } => {
            "pose"
        }
        EventKind::Lap { .. } => "lap",
        EventKind::SlipStarted { .. } | EventKind::SlipEnded { .. } => "slip",
        EventKind::Started { .. } | EventKind::Stopping { .. } | EventKind::SourceEnded => "node",
        EventKind::RatesChanged { .. } | EventKind::RatesLowered { .. } | EventKind::RatesRestored => "rates",
        EventKind::RecordingStarted { .. } | EventKind::RecordingEnded { .. } => "recording",
        EventKind::CommandRefused { .. } => "refused",
        EventKind::Warning { .. } => "warning",
        EventKind::Error { .. } => "error",
    };
    LogEntry {
        number: 0,
        at,
        car: Some(car.clone()),
        severity: event.kind.severity(),
        kind,
        text: event.kind.to_string(),
        who: event.who.clone(),
    }
}

/// When an event happened, by the car's clock \[unix ns\]. An event without a sensor's cause has no sensor time.
fn happened_at(header: &Header) -> i64 {
    if header.sensor == 0 {
        header.published
    } else {
        header.sensor
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::{Delivery, Rejection};
    use protocol::{Health, Schema, Stamps, State};

    const SECOND: i64 = 1_000_000_000;

    fn name() -> CarName {
        CarName::new("car-1").expect("a good name")
    }

    fn message(at: i64, sequence: u64, delivery: Delivery, topic: Topic, telemetry: Telemetry) -> FleetEvent {
        let stamps = Stamps {
            run_id: 1,
            sequence,
            sensor: at,
            published: at,
        };
        FleetEvent {
            at,
            car: name(),
            payload: EventPayload::Message {
                topic,
                delivery,
                header: Header::new(Schema::Health, 1, stamps),
                telemetry: Box::new(telemetry),
                bytes: Arc::new([]),
            },
        }
    }

    fn health(at: i64, sequence: u64, delivery: Delivery, state: State) -> FleetEvent {
        let health = Health {
            state,
            since: 0,
            causes: Vec::new(),
            update: 1,
            metrics: None,
            proposal: None,
            auto: false,
        };
        message(at, sequence, delivery, Topic::Health, Telemetry::Health(health))
    }

    fn appeared(at: i64) -> FleetEvent {
        FleetEvent {
            at,
            car: name(),
            payload: EventPayload::Appeared,
        }
    }

    // A recorder that nobody looks at once kept every lap of every car.
    #[test]
    fn only_the_newest_messages_are_kept_where_nobody_looks() {
        for only_newest in [false, true] {
            let mut fleet = Fleet::default();
            if only_newest {
                fleet.keep_only_newest();
            }
            let health = Health {
                state: State::Localized,
                since: 0,
                causes: Vec::new(),
                update: 1,
                metrics: Some(protocol::Metrics::default()),
                proposal: None,
                auto: false,
            };
            for number in 1..=100 {
                let telemetry = Telemetry::Health(health.clone());
                let at = number as i64 * SECOND;
                fleet.apply(&message(at, number, Delivery::Live, Topic::Health, telemetry));
            }
            let car = fleet.car(&name()).expect("known");
            assert!(car.health.is_some());
            assert_eq!(car.history().count(), if only_newest { 0 } else { 100 });
        }
    }

    #[test]
    fn live_and_ordered_delivery_count_each_message_once() {
        let mut fleet = Fleet::default();
        fleet.apply(&appeared(0));
        for (sequence, delivery) in [
            (1, Delivery::Live),
            (1, Delivery::InOrder),
            (3, Delivery::Live),
            (2, Delivery::InOrder),
            (3, Delivery::InOrder),
        ] {
            fleet.apply(&health(1, sequence, delivery, State::Localized));
        }
        let view = &fleet.view(2)[0].streams["health"];
        assert_eq!((view.received, view.missing, view.filled_late), (3, 0, 1));
    }

    #[test]
    fn a_late_message_does_not_turn_the_state_back() {
        let mut fleet = Fleet::default();
        fleet.apply(&appeared(0));
        fleet.apply(&health(1, 1, Delivery::Live, State::Localized));
        fleet.apply(&health(1, 3, Delivery::Live, State::Lost));
        fleet.apply(&health(1, 2, Delivery::InOrder, State::Degraded));
        assert_eq!(fleet.view(2)[0].state, "LOST");
    }

    #[test]
    fn a_silent_car_is_logged_as_blind_once() {
        let mut fleet = Fleet::default();
        fleet.apply(&appeared(0));
        fleet.apply(&health(0, 1, Delivery::Live, State::Localized));
        fleet.tick(SECOND / 2);
        assert_eq!(fleet.view(SECOND / 2)[0].state, "LOCALIZED");
        for tick in 3..6 {
            fleet.tick(tick * SECOND);
        }
        assert_eq!(fleet.view(6 * SECOND)[0].state, "BLIND");
        fleet.apply(&health(7 * SECOND, 2, Delivery::Live, State::Localized));
        let texts: Vec<_> = fleet.log().since(0).map(|entry| entry.text.as_str()).collect();
        assert_eq!(texts, ["BLIND: nothing comes from the car", "link is back"]);
    }

    // The first message after a cut once raised a second alarm: no health message for as long as the cut.
    #[test]
    fn a_cut_is_one_alarm() {
        const TENTH: i64 = SECOND / 10;
        let mut fleet = Fleet::default();
        fleet.apply(&appeared(0));
        for i in 0..250 {
            if i < 50 {
                fleet.apply(&health(i * TENTH, i as u64 + 1, Delivery::Live, State::Localized));
            }
            fleet.tick(i * TENTH);
        }
        let back = 25 * SECOND;
        let event = Event {
            kind: EventKind::SearchStarted,
            update: 1,
            who: None,
            command: None,
        };
        fleet.apply(&message(
            back,
            1,
            Delivery::Live,
            Topic::Event,
            Telemetry::Event(event),
        ));
        fleet.tick(back + TENTH);
        assert_ne!(fleet.view(back + TENTH)[0].state, "STALE");
        fleet.apply(&health(back + TENTH, 51, Delivery::Live, State::Localized));
        assert_eq!(fleet.log().alarms(), 1, "BLIND");
        assert_eq!(fleet.view(back + TENTH)[0].state, "LOCALIZED");
    }

    /// A car of which only its load comes once stayed "LOCALIZED".
    #[test]
    fn a_car_whose_health_stops_is_stale_whatever_else_arrives() {
        const TENTH: i64 = SECOND / 10;
        let mut fleet = Fleet::default();
        fleet.apply(&appeared(0));
        for i in 0..100 {
            let at = i * TENTH;
            if i < 50 {
                fleet.apply(&health(at, i as u64 + 1, Delivery::Live, State::Localized));
            } else {
                let other = health(at, i as u64 + 1, Delivery::Live, State::Localized);
                let EventPayload::Message {
                    header, telemetry, ..
                } = other.payload
                else {
                    panic!("a message");
                };
                fleet.apply(&FleetEvent {
                    payload: EventPayload::Message {
                        topic: Topic::RecordedHealth,
                        delivery: Delivery::InOrder,
                        header,
                        telemetry,
                        bytes: Arc::new([]),
                    },
                    ..other
                });
            }
            fleet.tick(at);
        }
        let view = &fleet.view(99 * TENTH)[0];
        assert_eq!((view.state.as_str(), view.blind), ("STALE", false));
        assert_eq!(view.causes, ["no health message for 5.0 s"]);
        assert_eq!(fleet.log().alarms(), 1);
        fleet.apply(&health(10 * SECOND, 51, Delivery::Live, State::Localized));
        assert_eq!(fleet.view(10 * SECOND)[0].state, "LOCALIZED");
    }

    #[test]
    fn two_senders_of_one_name_are_one_alarm_and_the_first_cause() {
        let mut fleet = Fleet::default();
        fleet.apply(&appeared(0));
        for second in 0..5 {
            let at = second * SECOND;
            fleet.apply(&health(at, second as u64 + 1, Delivery::Live, State::Localized));
            fleet.apply(&FleetEvent {
                payload: EventPayload::Rejected {
                    topic: Topic::Pose,
                    run_id: 9,
                    sequence: 1,
                    count: 40,
                    reason: Rejection::TwoSenders,
                },
                ..appeared(at)
            });
        }
        let view = &fleet.view(4 * SECOND)[0];
        assert!(view.causes[0].starts_with("two cars of this name"), "{view:?}");
        assert_eq!((fleet.log().alarms(), view.streams["pose"].rejected), (1, 200));
        assert!(!fleet.car(&name()).expect("known").two_senders(8 * SECOND));
    }

    /// The page greys a car whose view is blind. It may show that within 3 s of the last message, so the fleet must know it
    /// well before.
    #[test]
    fn a_silent_car_is_blind_well_within_three_seconds() {
        const TENTH: i64 = SECOND / 10;
        let mut fleet = Fleet::default();
        fleet.apply(&appeared(0));
        // Health at 10 Hz for 5 s, then nothing.
        let last = 50 * TENTH;
        for i in 0..=50 {
            fleet.apply(&health(i * TENTH, i as u64 + 1, Delivery::Live, State::Localized));
            fleet.tick(i * TENTH);
            assert!(!fleet.view(i * TENTH)[0].blind, "at {i} tenths of a second");
        }
        for i in 1..=30 {
            let now = last + i * TENTH;
            fleet.tick(now);
            let view = &fleet.view(now)[0];
            assert_eq!(
                view.blind,
                i > 10,
                "{i} tenths of a second after the last message"
            );
            assert_eq!(view.state == "BLIND", view.blind);
        }
        let alarms: Vec<_> = fleet
            .log()
            .since(0)
            .map(|entry| (entry.at, entry.severity))
            .collect();
        assert_eq!(alarms, [(last + 11 * TENTH, Severity::Critical)]);
    }

    #[test]
    fn a_car_whose_liveliness_token_ends_is_blind_at_once() {
        let mut fleet = Fleet::default();
        fleet.apply(&appeared(0));
        let last = 5 * SECOND;
        fleet.apply(&health(last, 1, Delivery::Live, State::Localized));
        let vanished = FleetEvent {
            payload: EventPayload::Vanished,
            ..appeared(last + 1)
        };
        fleet.apply(&vanished);
        assert_eq!(fleet.view(last + 1)[0].state, "BLIND");
        assert_eq!(fleet.log().alarms(), 1);
    }

    #[test]
    fn an_alarm_stays_until_it_is_acknowledged() {
        let mut fleet = Fleet::default();
        fleet.add_entry(1, None, Severity::Critical, "link", "BLIND".into(), None);
        fleet.add_entry(2, None, Severity::Warning, "link", "slow".into(), None);
        assert_eq!(fleet.log().alarms(), 1);
        fleet.acknowledge(3, "ana");
        fleet.acknowledge(4, "ben");
        assert_eq!(fleet.log().alarms(), 0);
        let texts: Vec<_> = fleet
            .log()
            .since(2)
            .map(|entry| (entry.text.as_str(), entry.who.as_deref()))
            .collect();
        assert_eq!(
            texts,
            [("1 alarm acknowledged", Some("ana"))],
            "nothing is acknowledged twice"
        );
        fleet.add_entry(5, None, Severity::Critical, "link", "BLIND".into(), None);
        assert_eq!(fleet.log().alarms(), 1);
    }

    // They once went with their entries, while the car was still BLIND.
    #[test]
    fn an_open_alarm_outlives_two_thousand_other_entries() {
        let mut fleet = Fleet::default();
        fleet.add_entry(1, None, Severity::Critical, "link", "BLIND".into(), None);
        for at in 2..2500 {
            fleet.add_entry(at, None, Severity::Info, "lap", "lap".into(), None);
        }
        assert_eq!(fleet.log().alarms(), 1);
        assert_eq!(
            fleet.log().open().next().map(|entry| entry.text.as_str()),
            Some("BLIND")
        );
        fleet.acknowledge(3000, "ana");
        assert_eq!(fleet.log().open().count(), 0);
    }

    #[test]
    fn a_dismissed_car_is_gone_until_something_comes_from_it() {
        let mut fleet = Fleet::default();
        fleet.apply(&appeared(0));
        fleet.apply(&health(0, 1, Delivery::Live, State::Localized));
        assert!(!fleet.dismiss(&name(), 1, "ana"), "a car that is connected stays");
        fleet.apply(&FleetEvent {
            payload: EventPayload::Vanished,
            ..appeared(2)
        });
        assert!(fleet.dismiss(&name(), 3, "ana"));
        assert!(fleet.view(4).is_empty());
        fleet.apply(&appeared(5));
        assert_eq!(fleet.view(6).len(), 1);
    }

    #[test]
    fn laps_are_counted_once() {
        let mut fleet = Fleet::default();
        let lap = || {
            Telemetry::Event(Event {
                kind: EventKind::Lap {
                    lap: 1,
                    time: Some(9.2),
                    set: "hq".into(),
                },
                update: 1,
                who: None,
                command: None,
            })
        };
        fleet.apply(&message(1, 1, Delivery::InOrder, Topic::Event, lap()));
        fleet.apply(&message(1, 1, Delivery::InOrder, Topic::Event, lap()));
        assert_eq!(fleet.car(&name()).map(|car| car.laps().len()), Some(1));
        assert_eq!(fleet.log().since(0).count(), 1);
    }
}
