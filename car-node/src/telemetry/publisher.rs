//! The publisher: the thread that sends what the other threads queue. A slow network blocks none of them.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crossbeam_channel::{Receiver, TryRecvError};
use protocol::{CarName, Message, Stamps, Topic, encode};
use synpf::{Odometry, Scan, Stamp, YawRate};
use zenoh::{Session, Wait};

use crate::network::{self, NetworkError};
use crate::recording::{Entry, RosMessage};
use crate::sensors::TrueMotion;
use crate::sensors::clock::{SensorClock, wall_now};
use crate::telemetry::queue::Record;
use crate::telemetry::replay_buffer::ReplayBuffer;
use crate::telemetry::shared_state::SharedState;
use crate::wire;

/// The topics that are published.
pub const TOPICS: [Topic; 13] = [
    Topic::Pose,
    Topic::Cloud,
    Topic::Scan,
    Topic::Health,
    Topic::Load,
    Topic::Params,
    Topic::Shadow,
    Topic::Event,
    Topic::RecordedPose,
    Topic::RecordedHealth,
    Topic::RecordedOdometry,
    Topic::RecordedScan,
    Topic::RecordedTruth,
];

/// The stop signal is checked at least this often.
const TICK: Duration = Duration::from_millis(50);

/// The zenoh publisher of a topic, and the sequence number of its last message.
struct TopicPublisher {
    publisher: zenoh::pubsub::Publisher<'static>,
    sequence: u64,
}

/// Sends a car's telemetry.
pub struct Publisher {
    streams: HashMap<Topic, TopicPublisher>,
    run_id: u64,
    clock: SensorClock,
    shared: Arc<SharedState>,
    replay_buffer: Arc<Mutex<ReplayBuffer>>,
    failed: HashMap<Topic, u64>,
}

impl Publisher {
    /// Declares every topic on `session`. `run_id` identifies this run of the node.
    pub fn new(
        session: &Session,
        car: &CarName,
        run_id: u64,
        clock: SensorClock,
        shared: Arc<SharedState>,
        replay_buffer: Arc<Mutex<ReplayBuffer>>,
    ) -> Result<Self, NetworkError> {
        let streams = TOPICS
            .into_iter()
            .map(|topic| {
                let publisher = network::declare_publisher(session, car, topic)?;
                Ok((
                    topic,
                    TopicPublisher {
                        publisher,
                        sequence: 0,
                    },
                ))
            })
            .collect::<Result<_, NetworkError>>()?;
        Ok(Self {
            streams,
            run_id,
            clock,
            shared,
            replay_buffer,
            failed: HashMap::new(),
        })
    }

    /// Starts the thread. When `stop` is dropped, it sends what is queued and ends; it returns true when somebody receives the
    /// car's events.
    pub fn start(mut self, stop: Receiver<()>) -> std::io::Result<JoinHandle<bool>> {
        thread::Builder::new().name("publisher".into()).spawn(move || {
            while stop.try_recv() == Err(TryRecvError::Empty) {
                self.shared.telemetry.wait(TICK);
                self.flush();
            }
            self.flush();
            self.has_receivers(Topic::Event)
        })
    }

    fn has_receivers(&self, topic: Topic) -> bool {
        let status = self
            .streams
            .get(&topic)
            .map(|stream| stream.publisher.matching_status().wait());
        status.is_some_and(|status| status.is_ok_and(|status| status.matching()))
    }

    /// Sends everything that is queued, the pose first.
    fn flush(&mut self) {
        let shared = Arc::clone(&self.shared);
        if let Some(pose) = shared.telemetry.take_pose() {
            self.send(
                Topic::Pose,
                self.clock.wall(pose.stamp),
                &wire::pose_message(&pose),
            );
            shared
                .counters
                .published(self.clock.now().since(pose.stamp).max(0.0));
        }
        while let Some(record) = shared.telemetry.next_record() {
            self.send_record(record);
        }
        if let Some(cloud) = shared.telemetry.take_cloud() {
            self.send(Topic::Cloud, self.clock.wall(cloud.stamp), &wire::cloud(&cloud));
        }
        if let Some(scan) = shared.telemetry.take_scan() {
            self.send(Topic::Scan, self.clock.wall(scan.stamp), &wire::scan_view(&scan));
        }
    }

    fn send_record(&mut self, record: Record) {
        match record {
            Record::Pose(pose) => self.send(
                Topic::RecordedPose,
                self.clock.wall(pose.stamp),
                &wire::pose_message(&pose),
            ),
            Record::Health {
                report,
                live,
                recorded,
            } => {
                let stamp = self.clock.wall(report.stamp);
                let message = wire::health(&report, |stamp| self.clock.wall(stamp));
                if live {
                    self.send(Topic::Health, stamp, &message);
                }
                if recorded {
                    self.send(Topic::RecordedHealth, stamp, &message);
                }
            }
            Record::Odometry(odometry) => {
                let stamp = self.clock.wall(odometry.stamp);
                self.send(Topic::RecordedOdometry, stamp, &wire::odometry(&odometry));
                self.record_on_car(|| RosMessage::Odometry(Odometry { stamp, ..odometry }));
            }
            Record::YawRate(yaw_rate) => {
                let stamp = self.clock.wall(yaw_rate.stamp);
                self.record_on_car(|| RosMessage::YawRate(YawRate { stamp, ..yaw_rate }));
            }
            Record::Scan(scan) => {
                let stamp = self.clock.wall(scan.stamp);
                self.send(Topic::RecordedScan, stamp, &wire::scan(&scan));
                self.record_on_car(|| RosMessage::Scan(Scan { stamp, ..scan }));
            }
            Record::Truth(truth) => {
                let stamp = self.clock.wall(truth.stamp);
                self.send(Topic::RecordedTruth, stamp, &wire::truth(&truth));
                self.record_on_car(|| RosMessage::Truth(TrueMotion { stamp, ..truth }));
            }
            Record::Params(params) => self.send(Topic::Params, wall_now(), params.as_ref()),
            Record::Shadow(shadow) => self.send(Topic::Shadow, wall_now(), shadow.as_ref()),
            Record::Load(load) => self.send(Topic::Load, wall_now(), load.as_ref()),
            Record::Event(event) => self.send(
                Topic::Event,
                self.clock.wall(event.stamp),
                &protocol::Event {
                    kind: event.kind,
                    update: event.update,
                    who: event.who,
                    command: event.command,
                },
            ),
        }
    }

    /// Records sensor data on the car as a ROS 2 message, if the car records.
    fn record_on_car(&self, message: impl FnOnce() -> RosMessage) {
        if let Some(recorder) = self
            .shared
            .recorder
            .as_ref()
            .filter(|recorder| recorder.recording())
        {
            recorder.offer(Entry::Ros {
                at: wall_now().0,
                message: message(),
            });
        }
    }

    /// Sends a message, and records it if the car records. If its stream must be complete, the message is also kept. While the link is too slow, messages for the
    /// recorder are only kept.
    fn send<M: Message>(&mut self, topic: Topic, sensor: Stamp, message: &M) {
        let Some(stream) = self.streams.get_mut(&topic) else {
            return;
        };
        let stamps = Stamps {
            run_id: self.run_id,
            sequence: stream.sequence + 1,
            sensor: sensor.0,
            published: wall_now().0,
        };
        let sent = encode(message, stamps)
            .map_err(|error| error.to_string())
            .and_then(|bytes| {
                stream.sequence += 1;
                if let Some(recorder) = self
                    .shared
                    .recorder
                    .as_ref()
                    .filter(|recorder| recorder.recording())
                {
                    recorder.offer(Entry::Message {
                        topic,
                        sequence: stream.sequence,
                        published: stamps.published,
                        bytes: bytes.clone(),
                    });
                }
                if topic.recorded() {
                    let rates = self.shared.rates.lock().unwrap_or_else(PoisonError::into_inner);
                    if !rates.recorded {
                        // It is for the recorder on the car only.
                        return Ok(());
                    }
                }
                if topic.recovered() {
                    let mut replay_buffer = self.replay_buffer.lock().unwrap_or_else(PoisonError::into_inner);
                    replay_buffer.keep(topic, stream.sequence, bytes.clone());
                    let throttle = self
                        .shared
                        .throttle
                        .lock()
                        .unwrap_or_else(PoisonError::into_inner);
                    if topic.recorded() && throttle.parked() {
                        return Ok(());
                    }
                }
                stream
                    .publisher
                    .put(bytes)
                    .wait()
                    .map_err(|error| error.to_string())
            });
        if let Err(error) = sent {
            let failed = self.failed.entry(topic).or_default();
            *failed += 1;
            // Logged at every power of two only, so that a fault at 40 Hz does not fill the disk.
            if failed.is_power_of_two() {
                tracing::warn!(%topic, failed, error, "a message was not sent");
            }
        }
    }
}
