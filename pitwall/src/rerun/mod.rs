//! The same events for the Rerun viewer: history and depth beside the page.
//!
//! What the engineer acts on is on the page; this is to look back and into things. Data is decimated, the server's
//! memory is capped, and nothing waits for a viewer: what does not fit into the queue is left out.

mod event_log;
mod layout;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, select};
use rerun::grpc_server::GrpcServerSink;
use rerun::log::ChunkBatcherConfig;
use rerun::sink::{FileSink, LogSink};
use rerun::{
    MemoryLimit, PlaybackBehavior, RecordingStream, RecordingStreamBuilder, RecordingStreamError,
    ServerOptions,
};

use crate::event::FleetEvent;
use event_log::EventLog;

/// Where the data goes.
#[derive(Debug, Clone)]
pub enum RerunOutlet {
    /// Into a file.
    Save(PathBuf),
    /// To viewers that dial this port on loopback.
    Serve(u16),
    /// To a viewer that listens, as `rerun+http://127.0.0.1:9876/proxy`.
    Connect(String),
}

/// Data on its way to Rerun. Dropping it ends it without waiting for anything.
pub struct RerunView {
    /// Says that no more events are wanted, by being dropped.
    closing: Sender<()>,
    /// Hears that everything has been handed over, by being disconnected.
    closed: Receiver<()>,
    patience: Duration,
}

/// Why there is no such view.
#[derive(Debug, thiserror::Error)]
pub enum RerunError {
    /// Rerun refuses.
    #[error("rerun: {0}")]
    Stream(String),
    /// The file cannot be written.
    #[error("{file}: {reason}")]
    File {
        /// The file.
        file: String,
        /// What is wrong.
        reason: String,
    },
    /// The port cannot be served.
    #[error("cannot serve rerun data on port {port}: {reason}")]
    Serve {
        /// The port.
        port: u16,
        /// What is wrong.
        reason: String,
    },
    /// The system gives no thread.
    #[error("no thread for rerun: {0}")]
    Thread(std::io::Error),
}

impl From<RecordingStreamError> for RerunError {
    fn from(error: RecordingStreamError) -> Self {
        Self::Stream(error.to_string())
    }
}

impl RerunView {
    /// HealthHistory that the server keeps for viewers that come later [bytes].
    const MEMORY: u64 = 256 * 1024 * 1024;
    /// Rows wait this long for others of their kind: five times fewer chunks than a live stream has by default, which
    /// is what a viewer in a browser spends its time on.
    const BATCH: Duration = Duration::from_millis(200);

    /// Begins to log `events`. [`RerunOutlet::Serve`] needs a tokio runtime.
    pub fn start(events: Receiver<Arc<FleetEvent>>, outlet: &RerunOutlet) -> Result<Self, RerunError> {
        let builder = RecordingStreamBuilder::new("pitwall").batcher_config(ChunkBatcherConfig {
            flush_tick: Self::BATCH,
            ..ChunkBatcherConfig::DEFAULT
        });
        // A file is to be whole; whoever does not read at the other end of a link is not waited for.
        let mut patience = Duration::from_secs(1);
        let stream = match outlet {
            RerunOutlet::Connect(url) => builder.connect_grpc_opts(url.as_str())?,
            RerunOutlet::Save(file) => {
                let sink = FileSink::new(file).map_err(|error| RerunError::File {
                    file: file.display().to_string(),
                    reason: error.to_string(),
                })?;
                patience = Duration::from_secs(20);
                with_sink(builder, Box::new(sink))?
            }
            &RerunOutlet::Serve(port) => {
                let options = ServerOptions {
                    playback_behavior: PlaybackBehavior::NewestFirst,
                    memory_limit: MemoryLimit::from_bytes(Self::MEMORY),
                    ..ServerOptions::default()
                };
                let sink =
                    GrpcServerSink::new("127.0.0.1", port, options).map_err(|error| RerunError::Serve {
                        port,
                        reason: error.to_string(),
                    })?;
                with_sink(builder, Box::new(sink))?
            }
        };
        // Messages carry their own time.
        stream.set_log_time_enabled(false);
        let (closing, wanted) = crossbeam_channel::bounded::<()>(0);
        let (done, closed) = crossbeam_channel::bounded::<()>(0);
        std::thread::Builder::new()
            .name("rerun".to_owned())
            .spawn(move || {
                run(&stream, &events, &wanted, patience);
                drop(done);
            })
            .map_err(RerunError::Thread)?;
        Ok(Self {
            closing,
            closed,
            patience,
        })
    }

    /// Hands over what has come so far and ends. Gives up after a while, a second where it goes to a viewer.
    pub fn finish(self) {
        drop(self.closing);
        if let Err(crossbeam_channel::RecvTimeoutError::Timeout) =
            self.closed.recv_timeout(self.patience + Duration::from_secs(1))
        {
            tracing::warn!("rerun does not take the last of the data");
        }
    }
}

/// Logs events until no more come or are wanted.
fn run(
    stream: &RecordingStream,
    events: &Receiver<Arc<FleetEvent>>,
    wanted: &Receiver<()>,
    patience: Duration,
) {
    let mut log = EventLog::new(stream.clone());
    let mut take = |event: &FleetEvent| {
        log.take(event)
            .inspect_err(|error| tracing::warn!(%error, "rerun"))
            .is_ok()
    };
    loop {
        select! {
            recv(events) -> event => match event {
                Ok(event) if take(&event) => {}
                Ok(_) => return,
                Err(_) => break,
            },
            recv(wanted) -> _ => {
                // No longer than what had come by now.
                events.try_iter().take(events.len()).all(|event| take(&event));
                break;
            }
        }
    }
    if let Err(error) = log.finish() {
        tracing::warn!(%error, "rerun");
    }
    match stream.flush_with_timeout(patience) {
        // Closes a file with its index.
        Ok(()) => stream.finalize_deferred_sinks(),
        Err(error) => tracing::warn!(%error, "rerun"),
    }
}

fn with_sink(builder: RecordingStreamBuilder, sink: Box<dyn LogSink>) -> Result<RecordingStream, RerunError> {
    let stream = builder.buffered()?;
    stream.set_sinks(vec![sink]);
    Ok(stream)
}
