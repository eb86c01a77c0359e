//! A race as a recording of the pit wall: as fast as the machine computes it, and the same each time.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use car_node::localization::LocalizerParameters;
use car_node::race::{
    CarResult, Content, PoseSource, Quality, RaceSetup, Transmission, damaged_map, transmitted_race,
};
use car_node::stress::{Defect, Part};
use car_node::wire;
use pitwall::{Delivery, EventPayload, FleetEvent, Recorder, RecordingSummary, RunEnd};
use protocol::{
    CarInfo, CarName, Event, MapReply, Message, ParameterSet, Params, Pose2, Stamps, Telemetry, Topic, Value,
    encode,
};
use simulator::Track;
use synpf::TrackMap;

use crate::fake_car::load;

/// When sessions begin \[unix ns\].
const BEGIN: i64 = 1_790_000_000_000_000_000;
/// How long a message is on its way \[ns\].
const ON_ITS_WAY: i64 = 3_000_000;
/// Events that may wait for the recorder.
const WAITING: u64 = 20_000;

/// Races one after the other, in one recording.
#[derive(Debug, Clone)]
pub struct RaceSession {
    /// Name of a bundled track.
    pub track: String,
    /// Cars on it.
    pub cars: usize,
    /// Each heat: the name of the set that the cars drive on, their tyres, and the laps of each car.
    pub heats: Vec<(String, Quality, u32)>,
    /// Seed of the first heat; the others count up from it.
    pub seed: u64,
    /// Defects of the map and of all sensors.
    pub defects: Vec<Defect>,
    /// Record whole scans, too, which are most of a recording.
    pub scans: bool,
}

impl RaceSession {
    /// Two cars that drive three laps of `club` on `hq`, and then on `lq`.
    pub fn two_heats() -> Self {
        Self {
            track: "club".into(),
            cars: 2,
            heats: vec![("hq".into(), Quality::Hq, 3), ("lq".into(), Quality::Hq, 3)],
            seed: 3,
            defects: Vec::new(),
            scans: false,
        }
    }

    /// Drives the heats and records them. Returns the results by heat and car.
    pub fn record(&self, path: &Path) -> anyhow::Result<(Vec<Vec<CarResult>>, RecordingSummary)> {
        let track = Arc::new(Track::find(&self.track, None)?);
        let map = Arc::new(TrackMap::new(track.grid.clone())?);
        // The cars of all heats have one map, which is the one that the pit wall gets.
        let map = damaged_map(&track, &map, &self.defects, self.seed)?;
        let of_sensors = self
            .defects
            .iter()
            .filter(|defect| defect.kind.part() != Part::Map);
        let of_sensors: Vec<_> = of_sensors.copied().collect();
        let recorder = Recorder::start(path)?;
        let mut session = Session {
            recorder,
            waiting: 0,
            begin: BEGIN,
            last: BEGIN,
            run_id: BEGIN as u64,
            cars: (1..=self.cars)
                .map(|number| {
                    Ok(CarStreams {
                        name: CarName::new(format!("car-{number}"))?,
                        sequences: BTreeMap::new(),
                        update: 0,
                        load_due: 0,
                    })
                })
                .collect::<anyhow::Result<_>>()?,
        };
        session.arrive(&wire::map(&track.name, map.grid(), Some(&track.raceline)))?;
        let mut results = Vec::new();
        for ((set, quality, laps), seed) in self.heats.iter().zip(self.seed..) {
            let parameters = LocalizerParameters::named(set).with_context(|| format!("no set {set}"))?;
            let setup = RaceSetup {
                laps: *laps,
                cars: self.cars,
                quality: *quality,
                pose_source: PoseSource::Localizer(parameters),
                speed_scale: 1.0,
                seed,
                defects: of_sensors.clone(),
            };
            let mut fault = None;
            session.put_in_force(set, results.len() as u64 + 1)?;
            let heat = transmitted_race(&track, &map, &setup, set, &mut |sent| {
                if !self.scans && matches!(sent.content, Content::Scan(_)) {
                    return;
                }
                if fault.is_none() {
                    fault = session.transmit(&sent).err();
                }
            })?;
            if let Some(fault) = fault {
                return Err(fault);
            }
            results.push(heat);
            session.stop();
            // The cars go to the start again.
            session.begin = session.last + 20_000_000_000;
            session.run_id += 1;
            for car in &mut session.cars {
                car.sequences.clear();
            }
        }
        let summary = session.recorder.finish()?;
        Ok((results, summary))
    }
}

/// The recording, and what was sent so far.
struct Session {
    recorder: Recorder,
    waiting: u64,
    /// When the present heat begins \[unix ns\].
    begin: i64,
    /// The newest message \[unix ns\].
    last: i64,
    /// The cars' nodes start anew for each heat.
    run_id: u64,
    cars: Vec<CarStreams>,
}

/// The numbers of the messages of one car.
struct CarStreams {
    name: CarName,
    sequences: BTreeMap<Topic, u64>,
    update: u64,
    load_due: i64,
}

impl Session {
    /// The cars and their map.
    fn arrive(&mut self, map: &MapReply) -> anyhow::Result<()> {
        let map = Arc::new(map.clone());
        let stamps = Stamps {
            run_id: BEGIN as u64,
            sequence: 0,
            sensor: BEGIN,
            published: BEGIN,
        };
        let bytes: Arc<[u8]> = encode(&*map, stamps)?.into();
        for car in 0..self.cars.len() {
            let info = CarInfo {
                version: env!("CARGO_PKG_VERSION").into(),
                started: BEGIN as u64,
                source: "race".into(),
                map: map.name.clone(),
                lap_length: map.raceline.as_ref().map(|line| line.length),
                base_link_from_laser: Pose2 {
                    x: 0.27,
                    y: 0.0,
                    heading: 0.0,
                },
                host: "simulator".into(),
            };
            self.record(car, BEGIN, EventPayload::Appeared);
            self.record(car, BEGIN, EventPayload::Info(info));
            let clock = EventPayload::Clock {
                run_id: None,
                offset: 0,
                round_trip: 2 * ON_ITS_WAY,
            };
            self.record(car, BEGIN, clock);
            let map = EventPayload::Map {
                map: Arc::clone(&map),
                bytes: Arc::clone(&bytes),
            };
            self.record(car, BEGIN, map);
        }
        Ok(())
    }

    /// A set comes into force on all cars.
    fn put_in_force(&mut self, name: &str, revision: u64) -> anyhow::Result<()> {
        for car in 0..self.cars.len() {
            let params = Params {
                set: ParameterSet {
                    name: name.to_owned(),
                    values: vec![("max_particles".into(), Value::Int(3000))],
                },
                revision,
                who: "start".into(),
                when: self.begin,
                since_update: self.cars[car].update + 1,
                pending_revert: None,
                available: vec!["hq".into(), "lq".into()],
            };
            self.send(car, Topic::Params, self.begin, self.begin, &params)?;
        }
        Ok(())
    }

    /// The cars stop, and have confirmed how far their streams go.
    fn stop(&mut self) {
        let published = self.last;
        for car in 0..self.cars.len() {
            let ends = EventPayload::StreamEnds {
                run_id: self.run_id,
                published,
                end: RunEnd::Stopped,
                outstanding: Vec::new(),
            };
            self.record(car, published, ends);
        }
    }

    fn transmit(&mut self, sent: &Transmission) -> anyhow::Result<()> {
        let (car, at) = (sent.car, self.begin + sent.sent.0);
        let stamp = self.begin + sent.stamp.0;
        let begin = self.begin;
        match &sent.content {
            Content::Pose(pose, shown) => {
                self.cars[car].update = pose.update;
                if *shown {
                    self.send(car, Topic::Pose, stamp, at, &**pose)?;
                }
                self.send(car, Topic::RecordedPose, stamp, at, &**pose)?;
                if at >= self.cars[car].load_due {
                    self.cars[car].load_due = at + 1_000_000_000;
                    self.send(car, Topic::Load, at, at, &load())?;
                }
            }
            Content::Health(health, shown) => {
                let mut health = health.clone();
                health.since += begin;
                if *shown {
                    self.send(car, Topic::Health, stamp, at, &*health)?;
                }
                self.send(car, Topic::RecordedHealth, stamp, at, &*health)?;
            }
            Content::Cloud(cloud) => self.send(car, Topic::Cloud, stamp, at, cloud)?,
            Content::ScanView(view) => self.send(car, Topic::Scan, stamp, at, view)?,
            Content::Scan(scan) => self.send(car, Topic::RecordedScan, stamp, at, scan)?,
            Content::Odometry(odometry) => self.send(car, Topic::RecordedOdometry, stamp, at, odometry)?,
            Content::Truth(truth) => self.send(car, Topic::RecordedTruth, stamp, at, truth)?,
            Content::Event(kind) => {
                let event = Event {
                    kind: kind.clone(),
                    update: self.cars[car].update,
                    who: None,
                    command: None,
                };
                self.send(car, Topic::Event, stamp, at, &event)?;
            }
        }
        Ok(())
    }

    fn send<M: Message>(
        &mut self,
        car: usize,
        topic: Topic,
        sensor: i64,
        published: i64,
        message: &M,
    ) -> anyhow::Result<()> {
        let sequence = self.cars[car].sequences.entry(topic).or_default();
        *sequence += 1;
        let stamps = Stamps {
            run_id: self.run_id,
            sequence: *sequence,
            sensor,
            published,
        };
        let bytes = encode(message, stamps)?;
        let (header, telemetry) = Telemetry::decode(topic, &bytes).context("a topic of telemetry")??;
        let delivery = if topic.recovered() {
            Delivery::InOrder
        } else {
            Delivery::Live
        };
        let payload = EventPayload::Message {
            topic,
            delivery,
            header,
            telemetry: Box::new(telemetry),
            bytes: bytes.into(),
        };
        self.record(car, published + ON_ITS_WAY, payload);
        Ok(())
    }

    /// Records an event, and waits while too many wait for the disk.
    fn record(&mut self, car: usize, at: i64, payload: EventPayload) {
        self.last = self.last.max(at);
        let car = self.cars[car].name.clone();
        self.recorder.record(&Arc::new(FleetEvent { at, car, payload }));
        self.waiting += 1;
        while self.waiting.is_multiple_of(WAITING) {
            let progress = self.recorder.progress();
            if progress.error.is_some() || progress.messages + 2 * WAITING >= self.waiting {
                break;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}
