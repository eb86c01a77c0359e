//! Logs the events to the Rerun viewer, for history and details.
//!
//! Data is decimated and the memory of the server is limited. Nothing waits for a viewer: events that do not fit into the
//! queue are dropped.

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
    /// A file.
    Save(PathBuf),
    /// Viewers that connect to this port on loopback.
    Serve(u16),
    /// A running viewer, such as `rerun+http://127.0.0.1:9876/proxy`.
    Connect(String),
}

/// A running log to Rerun. Dropping it stops it without waiting.
pub struct RerunView {
    /// Dropped to stop the thread.
    closing: Sender<()>,
    /// Disconnected when the thread has sent everything.
    closed: Receiver<()>,
    patience: Duration,
}

/// Why logging to Rerun cannot start.
#[derive(Debug, thiserror::Error)]
pub enum RerunError {
    /// An error of Rerun.
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
    /// The thread cannot be started.
    #[error("cannot start the thread for rerun: {0}")]
    Thread(std::io::Error),
}

impl From<RecordingStreamError> for RerunError {
    fn from(error: RecordingStreamError) -> Self {
        Self::Stream(error.to_string())
    }
}

impl RerunView {
    /// Memory for the history that later viewers get \[bytes\].
    const MEMORY: u64 = 256 * 1024 * 1024;
    /// Time for which rows are collected into a chunk. It gives five times fewer chunks than the default, and chunks are what
    /// costs a viewer in a browser its time.
    const BATCH: Duration = Duration::from_millis(200);

    /// Starts to log `events`. [`RerunOutlet::Serve`] needs a tokio runtime.
    pub fn start(events: Receiver<Arc<FleetEvent>>, outlet: &RerunOutlet) -> Result<Self, RerunError> {
        let builder = RecordingStreamBuilder::new("pitwall").batcher_config(ChunkBatcherConfig {
            flush_tick: Self::BATCH,
            ..ChunkBatcherConfig::DEFAULT
        });
        // A file must be complete. A viewer that does not read is not waited for.
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

    /// Sends the remaining events and ends. Gives up after a timeout, which is a second for a viewer.
    pub fn finish(self) {
        drop(self.closing);
        if let Err(crossbeam_channel::RecvTimeoutError::Timeout) =
            self.closed.recv_timeout(self.patience + Duration::from_secs(1))
        {
            tracing::warn!("rerun does not accept the last data in time");
        }
    }
}

/// Logs events until the sender is gone or the view is closed.
fn run(
    stream: &RecordingStream,
    events: &Receiver<Arc<FleetEvent>>,
    wanted: &Receiver<()>,
    patience: Duration,
) {
    let mut log = EventLog::new(stream.clone());
    let mut add = |event: &FleetEvent| {
        log.add(event)
            .inspect_err(|error| tracing::warn!(%error, "rerun"))
            .is_ok()
    };
    loop {
        select! {
            recv(events) -> event => match event {
                Ok(event) if add(&event) => {}
                Ok(_) => return,
                Err(_) => break,
            },
            recv(wanted) -> _ => {
                // Only the events that have arrived by now.
                events.try_iter().take(events.len()).all(|event| add(&event));
                break;
            }
        }
    }
    if let Err(error) = log.finish() {
        tracing::warn!(%error, "rerun");
    }
    match stream.flush_with_timeout(patience) {
        // Completes a file with its index.
        Ok(()) => stream.finalize_deferred_sinks(),
        Err(error) => tracing::warn!(%error, "rerun"),
    }
}

fn with_sink(builder: RecordingStreamBuilder, sink: Box<dyn LogSink>) -> Result<RecordingStream, RerunError> {
    let stream = builder.buffered()?;
    stream.set_sinks(vec![sink]);
    Ok(stream)
}
