//! Builds the range tables that localizers wait for, so that no update takes as long as a table.

use std::io;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use crossbeam_channel::{Sender, bounded};
use synpf::TrackMap;

/// A thread that builds the pending tables of one map; see [`TrackMap::pending_tables`]. Dropping it ends the thread, after
/// the table that is being built.
#[derive(Debug)]
pub struct TableWorker {
    map: Arc<TrackMap>,
    wake: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl TableWorker {
    /// Starts the thread.
    pub fn start(map: Arc<TrackMap>) -> io::Result<Self> {
        // One wake-up that waits is enough: the thread looks for all pending tables.
        let (wake, wakes) = bounded(1);
        let tables = Arc::clone(&map);
        let build = move || {
            for () in wakes {
                while let Some(job) = tables.pending_tables().first() {
                    tables.build_table(*job);
                }
            }
        };
        let thread = thread::Builder::new().name("tables".into()).spawn(build)?;
        Ok(Self {
            map,
            wake: Some(wake),
            thread: Some(thread),
        })
    }

    /// Has the pending tables built, if there are any. Does not wait for them.
    pub fn build_pending(&self) {
        if let Some(wake) = &self.wake
            && !self.map.pending_tables().is_empty()
        {
            wake.try_send(()).ok();
        }
    }
}

impl Drop for TableWorker {
    fn drop(&mut self) {
        self.wake = None;
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the thread that builds range tables panicked");
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use maps::Pose;
    use synpf::{Parameters, SynPf, TablePolicy};

    use super::*;
    use crate::localization::job_worker::tests::room;

    #[test]
    fn a_table_that_a_localizer_waits_for_is_built_on_the_workers_thread() {
        let map = Arc::new(room().with_table_policy(TablePolicy::Defer));
        let worker = TableWorker::start(Arc::clone(&map)).expect("a thread");
        let mut localizer =
            SynPf::new(Arc::clone(&map), Pose::IDENTITY, Parameters::default(), 1).expect("a sound set");
        localizer
            .initialize(Pose::new(2.5, 2.5, 0.0))
            .expect("on the map");
        assert_eq!((map.pending_tables().len(), map.table_bytes()), (1, 0));
        worker.build_pending();
        let deadline = Instant::now() + Duration::from_mins(1);
        while map.table_bytes() == 0 {
            assert!(Instant::now() < deadline, "no table within a minute");
            thread::yield_now();
        }
        assert_eq!(map.pending_tables(), []);
    }
}
