//! The thread that answers what only needs looking up: the map, what runs here, and what did not arrive. On its own, so
//! that a map on its way over a slow link keeps no command waiting.

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use crossbeam_channel::{Receiver, select};
use protocol::{MissingRequest, Stamps, Topic, decode, encode};
use zenoh::Wait;

use crate::archive::Archive;
use crate::clock::wall_now;
use crate::desk::Inquiry;
use crate::filter::Shared;

/// What can be looked up.
#[derive(Debug)]
pub struct Library {
    /// The answer to `map`, encoded.
    pub map: Vec<u8>,
    /// The answer to `info`, encoded.
    pub info: Vec<u8>,
    /// What was sent.
    pub archive: Arc<Mutex<Archive>>,
    /// Where questions that cannot be read are counted.
    pub shared: Arc<Shared>,
    /// This run of the node.
    pub run_id: u64,
}

impl Library {
    /// Starts the thread. It ends when `stop` is dropped.
    pub fn start(self, inquiries: Receiver<Inquiry>, stop: Receiver<()>) -> std::io::Result<JoinHandle<()>> {
        thread::Builder::new().name("library".into()).spawn(move || {
            loop {
                select! {
                    recv(stop) -> _ => return,
                    recv(inquiries) -> inquiry => match inquiry {
                        Ok(inquiry) => self.serve(&inquiry),
                        Err(_) => return,
                    },
                }
            }
        })
    }

    fn serve(&self, Inquiry { topic, query }: &Inquiry) {
        let payload = query.payload().map(|payload| payload.to_bytes());
        let told = match self.answer(*topic, payload.as_deref()) {
            Ok(bytes) => query.reply(query.key_expr().clone(), bytes).wait(),
            Err(error) => query.reply_err(error).wait(),
        };
        if let Err(error) = told {
            tracing::debug!(%error, "nobody to answer");
        }
    }

    /// The answer to a question, as bytes. An error says what is wrong with a question that cannot be read.
    fn answer(&self, topic: Topic, payload: Option<&[u8]>) -> Result<Vec<u8>, String> {
        match topic {
            Topic::Map => Ok(self.map.clone()),
            Topic::Info => Ok(self.info.clone()),
            _ => self.missing(payload).inspect_err(|error| {
                let count = self.shared.counters.bad_payload() + 1;
                if count.is_power_of_two() {
                    tracing::warn!(%topic, count, error, "a question cannot be read");
                }
            }),
        }
    }

    fn missing(&self, payload: Option<&[u8]>) -> Result<Vec<u8>, String> {
        let payload = payload.ok_or("this question needs a payload")?;
        let (_, request) = decode::<MissingRequest>(payload).map_err(|error| error.to_string())?;
        let archive = self.archive.lock().unwrap_or_else(PoisonError::into_inner);
        let reply = archive.find(self.run_id, &request);
        // A recording ends here: what is published later is not among the last numbers.
        let now = wall_now().0;
        drop(archive);
        let stamps = Stamps {
            run_id: self.run_id,
            sequence: 0,
            sensor: now,
            published: now,
        };
        encode(&reply, stamps).map_err(|error| error.to_string())
    }
}
