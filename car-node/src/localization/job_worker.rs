//! Runs the jobs of a localizer that take longer than an update, such as a search of the whole map, on another thread.

use std::io;
use std::thread::{self, JoinHandle};

use crossbeam_channel::{Receiver, Sender, TrySendError, bounded};
use localizer::{Job, JobOutcome, Localizer};

/// A thread that runs the jobs of one localizer. Dropping it ends the thread, after the job that is running.
#[derive(Debug)]
pub(super) struct JobWorker {
    jobs: Option<Sender<(u64, Job)>>,
    outcomes: Receiver<(u64, JobOutcome)>,
    /// Counts the localizers; outcomes for an earlier one are discarded.
    generation: u64,
    thread: Option<JoinHandle<()>>,
}

/// A localizer asks for one job at a time; a second one may come while the first is outdated.
const QUEUED: usize = 2;

impl JobWorker {
    /// Starts the thread.
    pub(super) fn start() -> io::Result<Self> {
        let (jobs, waiting) = bounded::<(u64, Job)>(QUEUED);
        let (done, outcomes) = bounded(2 * QUEUED);
        let run = move || {
            for (generation, job) in waiting {
                // The filter has ended: nobody needs the outcome.
                if done.send((generation, job())).is_err() {
                    return;
                }
            }
        };
        Ok(Self {
            jobs: Some(jobs),
            outcomes,
            generation: 0,
            thread: Some(thread::Builder::new().name("jobs".into()).spawn(run)?),
        })
    }

    /// Hands in the outcomes that have come. Call it before each scan.
    pub(super) fn hand_in(&self, localizer: &mut dyn Localizer) {
        for (generation, outcome) in self.outcomes.try_iter() {
            if generation == self.generation {
                localizer.finish_job(outcome);
            }
        }
    }

    /// Takes the job that the latest scan has asked for, and does not wait for it. Call it after each scan.
    pub(super) fn take_from(&self, localizer: &mut dyn Localizer) {
        let (Some(jobs), Some(job)) = (&self.jobs, localizer.take_job()) else {
            return;
        };
        // If the queue is full or its thread has ended, the job runs here, because the localizer needs an outcome.
        if let Err(TrySendError::Full((_, job)) | TrySendError::Disconnected((_, job))) =
            jobs.try_send((self.generation, job))
        {
            localizer.finish_job(job());
        }
    }

    /// The localizer has been replaced: outcomes for the previous one are discarded.
    pub(super) fn discard(&mut self) {
        self.generation += 1;
    }
}

impl Drop for JobWorker {
    fn drop(&mut self) {
        self.jobs = None;
        // The thread may be waiting to send an outcome.
        self.outcomes = crossbeam_channel::never();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the thread that runs a localizer's jobs panicked");
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::Arc;
    use std::time::{Duration, Instant};

    use maps::{Cell, OccupancyGrid, Pose};
    use synpf::{Odometry, Parameters, Scan, Stamp, SynPf, TrackMap, Twist};

    use super::*;

    /// A room of 5 m x 4 m without symmetry, and a scan in it.
    pub(in super::super) fn room() -> TrackMap {
        let wall = |x: usize, y: usize| {
            x == 0 || y == 0 || x == 99 || y == 79 || ((60..64).contains(&x) && y < 30) || (x < 20 && y == 50)
        };
        let grid = OccupancyGrid::from_fn(100, 80, 0.05, Pose::IDENTITY, |x, y| {
            if wall(x, y) { Cell::Occupied } else { Cell::Free }
        });
        TrackMap::new(grid).expect("free space")
    }

    fn scan(map: &TrackMap, pose: Pose, stamp: Stamp) -> Scan {
        let (angle_min, angle_increment) = (-2.3, 0.01);
        Scan {
            stamp,
            angle_min,
            angle_increment,
            time_increment: 0.0,
            scan_time: None,
            angle_max: None,
            range_min: 0.05,
            range_max: 20.0,
            ranges: (0..460)
                .map(|beam| pose * Pose::new(0.0, 0.0, angle_min + angle_increment * f64::from(beam)))
                .map(|beam| map.range(beam, 20.0) as f32)
                .collect(),
        }
    }

    #[test]
    fn a_search_goes_on_with_what_the_worker_has_found() {
        let map = Arc::new(room());
        let mut localizer =
            SynPf::new(Arc::clone(&map), Pose::IDENTITY, Parameters::default(), 1).expect("a sound set");
        let worker = JobWorker::start().expect("a thread");
        let pose = Pose::new(1.5, 1.2, 0.4);
        localizer.relocalize();
        let deadline = Instant::now() + Duration::from_mins(1);
        for step in 0.. {
            assert!(Instant::now() < deadline, "no candidate within a minute");
            let stamp = Stamp(1_000_000_000).plus(0.025 * f64::from(step));
            let odometry = Odometry {
                stamp,
                pose: Pose::IDENTITY,
                twist: Twist::default(),
            };
            localizer.on_odometry(&odometry).expect("sound");
            worker.hand_in(&mut localizer);
            localizer.on_scan(&scan(&map, pose, stamp)).expect("sound");
            worker.take_from(&mut localizer);
            assert!(localizer.take_job().is_none(), "the worker has it");
            if localizer
                .hypotheses()
                .iter()
                .any(|found| found.pose.distance(pose) < 0.1)
            {
                return;
            }
            thread::yield_now();
        }
    }
}
