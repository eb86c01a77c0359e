//! The thread that replies to queries that change nothing: the map, the versions that run here, and missing telemetry.
//!
//! It is separate from the command server, so that a map on its way over a slow link delays no command.

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, Sender};
use protocol::{EventKind, MissingRequest, Stamps, Topic, decode, encode};

use super::asker_versions::AskerVersions;
use super::request::{Request, serve};
use crate::sensors::clock::{SensorClock, wall_now};
use crate::telemetry::replay_buffer::ReplayBuffer;
use crate::telemetry::shared_state::SharedState;

/// The data that replies are made from.
#[derive(Debug)]
pub struct QueryServer {
    /// The reply to `map`, encoded.
    pub map: Vec<u8>,
    /// The reply to `info`, encoded.
    pub info: Vec<u8>,
    /// Telemetry that was sent before.
    pub replay_buffer: Arc<Mutex<ReplayBuffer>>,
    /// Counts queries that cannot be decoded, and takes events.
    pub shared: Arc<SharedState>,
    /// The sensors' clock, for events.
    pub clock: SensorClock,
    /// This run of the node.
    pub run_id: u64,
    /// Has room for one. Holds something when a pit wall has asked for missing telemetry.
    pub asked: Sender<()>,
}

impl QueryServer {
    /// Starts the thread. It ends when `stop` is dropped.
    pub fn start(self, requests: Receiver<Request>, stop: Receiver<()>) -> std::io::Result<JoinHandle<()>> {
        let versions = Mutex::new(AskerVersions::default());
        serve("query-server", requests, stop, move |topic, payload| {
            if topic == Topic::Info {
                self.compare_versions(&versions, payload.unwrap_or_default());
            }
            self.reply(topic, payload)
        })
    }

    /// The encoded reply; an error names what is wrong with a query that cannot be decoded.
    fn reply(&self, topic: Topic, payload: Option<&[u8]>) -> Result<Vec<u8>, String> {
        match topic {
            Topic::Map => Ok(self.map.clone()),
            Topic::Info => Ok(self.info.clone()),
            _ => self.missing(payload).inspect_err(|error| {
                let count = self.shared.counters.bad_payload() + 1;
                if count.is_power_of_two() {
                    tracing::warn!(%topic, count, error, "a query cannot be read");
                }
            }),
        }
    }

    /// Says so when the program that asks has another version than this one.
    fn compare_versions(&self, versions: &Mutex<AskerVersions>, asker: &[u8]) {
        let note = versions
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .note(asker, env!("CARGO_PKG_VERSION"));
        if let Some(text) = note {
            tracing::warn!("{text}");
            let kind = EventKind::Warning { text };
            self.shared.event(self.clock.now(), 0, kind, None, None);
        }
    }

    fn missing(&self, payload: Option<&[u8]>) -> Result<Vec<u8>, String> {
        let payload = payload.ok_or("this query needs a payload")?;
        let (_, request) = decode::<MissingRequest>(payload).map_err(|error| error.to_string())?;
        let replay_buffer = self.replay_buffer.lock().unwrap_or_else(PoisonError::into_inner);
        let reply = replay_buffer.find(self.run_id, &request);
        // Taken under the lock: what is published later is not in the reply's ranges.
        let now = wall_now().0;
        drop(replay_buffer);
        let stamps = Stamps {
            run_id: self.run_id,
            sequence: 0,
            sensor: now,
            published: now,
        };
        // When it is full, it says so already.
        self.asked.try_send(()).ok();
        encode(&reply, stamps).map_err(|error| error.to_string())
    }
}
