//! The running pit wall: a link whose events keep a fleet up to date and, when asked, fill a recording.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;
use protocol::CarName;
use tokio::task::JoinHandle;

use crate::board::{Board, FleetGuard};
use crate::catch_up::Outstanding;
use crate::event::{FleetEvent, Happening};
use crate::fleet::Fleet;
use crate::link::{Link, LinkError, Role, unix_now};
use crate::recording::{Recorder, RecordingError, Status, Summary};

/// A pit wall at work. Cheap to share.
pub struct Hub {
    link: Link,
    board: Arc<Board>,
    housekeeping: Mutex<Option<JoinHandle<()>>>,
    /// Cars that are being asked for their map and what runs on them: over a slow link the answer takes longer than it
    /// takes until the next look.
    fetching: Mutex<BTreeSet<CarName>>,
}

impl Hub {
    /// How often time passes for the fleet.
    const TICK: Duration = Duration::from_millis(100);
    /// How often a car is told how late its poses arrive.
    const REPORT_LINKS: Duration = Duration::from_secs(1);
    /// How often clocks are compared.
    const COMPARE_CLOCKS: Duration = Duration::from_secs(2);
    /// When a recording is about to end, what is missing is waited for while something comes at least this often...
    const LAST_CALL: Duration = Duration::from_millis(1500);
    /// ...but no longer than this in all.
    const LAST_CALL_AT_MOST: Duration = Duration::from_secs(15);

    /// Opens the link. Needs a multi-thread tokio runtime.
    pub async fn open(role: &Role) -> Result<Arc<Self>, LinkError> {
        let board = Arc::new(Board::default());
        let sink = board.clone();
        let link = Link::open(role, Arc::new(move |event| sink.take(event))).await?;
        let hub = Arc::new(Self {
            link,
            board,
            housekeeping: Mutex::default(),
            fetching: Mutex::default(),
        });
        let task = tokio::spawn(keep_house(Arc::downgrade(&hub)));
        *hub.housekeeping.lock().unwrap_or_else(PoisonError::into_inner) = Some(task);
        Ok(hub)
    }

    /// The way to the cars.
    pub fn link(&self) -> &Link {
        &self.link
    }

    /// What is known. Hold it briefly: what comes in meanwhile waits.
    pub fn fleet(&self) -> FleetGuard<'_> {
        self.board.fleet()
    }

    /// Where events arrive.
    pub fn board(&self) -> &Arc<Board> {
        &self.board
    }

    /// Every event from now on, after what a newcomer needs to know. One that reads too slowly misses some.
    pub fn tap(&self) -> Receiver<Arc<FleetEvent>> {
        self.board.tap(unix_now())
    }

    /// Waits until a car is there; false when it is not within `patience`.
    pub async fn wait_for(&self, car: &CarName, patience: Duration) -> bool {
        self.wait_until(patience, |fleet| fleet.car(car).is_some_and(|car| car.alive))
            .await
    }

    /// Waits until the fleet is as `condition` wants it; false when it is not within `patience`.
    pub async fn wait_until(&self, patience: Duration, condition: impl Fn(&Fleet) -> bool) -> bool {
        let deadline = Instant::now() + patience;
        loop {
            if condition(&self.fleet()) {
                return true;
            }
            if Instant::now() >= deadline {
                return false;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    /// Begins a recording of all cars. What is known already of map, set in force and clock goes in first.
    pub async fn start_recording(&self, path: &Path) -> Result<(), StartError> {
        if self.board.recorder().is_some() {
            return Err(StartError::Recording);
        }
        let recorder = Recorder::start(path)?;
        for event in self.board.known(unix_now()) {
            recorder.take(&Arc::new(event));
        }
        *self.board.recorder() = Some(recorder);
        self.link.subscribe_recorded(true).await?;
        Ok(())
    }

    /// Ends the recording and says what is in it. Every car is asked for what it has sent by now, so that all its streams
    /// end together; that is waited for while something comes. None when there was none.
    pub async fn stop_recording(&self) -> Option<Result<Summary, RecordingError>> {
        self.recording_path()?;
        self.await_last_messages().await;
        self.cut_recording().await
    }

    /// Ends the recording with what has come, and says what is in it. None when there was none.
    pub async fn cut_recording(&self) -> Option<Result<Summary, RecordingError>> {
        // What was held back until gaps are filled goes in first.
        if let Err(error) = self.link.subscribe_recorded(false).await {
            tracing::warn!(%error, "still subscribed to the full-rate streams");
        }
        let recorder = self.board.recorder().take()?;
        tokio::task::spawn_blocking(move || recorder.finish()).await.ok()
    }

    async fn await_last_messages(&self) {
        let mut outstanding = self.link.last_call();
        let begun = Instant::now();
        let (mut came, mut least) = (begun, Outstanding::MOST);
        loop {
            match *outstanding.borrow_and_update() {
                Outstanding::NOTHING => return,
                less if less < least => (came, least) = (Instant::now(), less),
                _ => {}
            }
            let left = Self::LAST_CALL.saturating_sub(came.elapsed());
            let left = left.min(Self::LAST_CALL_AT_MOST.saturating_sub(begun.elapsed()));
            match tokio::time::timeout(left, outstanding.changed()).await {
                Ok(Ok(())) => {}
                Ok(Err(_)) | Err(_) => return,
            }
        }
    }

    /// How the recording is getting on; None when there is none.
    pub fn recording(&self) -> Option<Status> {
        self.board.recorder().as_ref().map(Recorder::status)
    }

    /// The file that is being recorded into.
    pub fn recording_path(&self) -> Option<PathBuf> {
        let recorder = self.board.recorder();
        recorder.as_ref().map(|recorder| recorder.path().to_owned())
    }

    /// Marks this moment, for the log and the recording.
    pub fn mark(&self, car: &CarName, who: &str, text: &str) {
        self.link.hand_on(
            car,
            Happening::Marker {
                who: who.into(),
                text: text.into(),
            },
        );
    }

    /// Closes the link and ends a recording that is still going on.
    pub async fn close(&self) {
        if let Some(task) = self
            .housekeeping
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take()
        {
            task.abort();
        }
        if let Some(Err(error)) = self.stop_recording().await {
            tracing::error!(%error, "the recording is damaged");
        }
        self.link.close().await;
    }
}

/// Lets time pass, and asks each car what no message tells.
async fn keep_house(hub: std::sync::Weak<Hub>) {
    let mut ticks = tokio::time::interval(Hub::TICK);
    let mut compared: Option<Instant> = None;
    let mut reported: Option<Instant> = None;
    loop {
        ticks.tick().await;
        let Some(hub) = hub.upgrade() else {
            return;
        };
        let cars: Vec<_> = {
            let mut fleet = hub.fleet();
            fleet.tick(unix_now());
            let alive = fleet.cars().filter(|car| car.alive);
            alive
                .map(|car| (car.name.clone(), car.map.is_none(), car.info.is_none()))
                .collect()
        };
        if reported.is_none_or(|at| at.elapsed() >= Hub::REPORT_LINKS) {
            reported = Some(Instant::now());
            let now = unix_now();
            let reports: Vec<_> = hub
                .fleet()
                .cars()
                .filter_map(|car| Some((car.name.clone(), car.link_report(now)?)))
                .collect();
            for (car, report) in reports {
                hub.link.report(&car, &report).await;
            }
        }
        let compare = compared.is_none_or(|at| at.elapsed() >= Hub::COMPARE_CLOCKS);
        if compare && !cars.is_empty() {
            compared = Some(Instant::now());
            for (car, map, info) in cars {
                let hub = hub.clone();
                tokio::spawn(async move {
                    hub.link.compare_clocks(&car).await;
                    let fetching = || hub.fetching.lock().unwrap_or_else(PoisonError::into_inner);
                    if !(info || map) || !fetching().insert(car.clone()) {
                        return;
                    }
                    if info {
                        hub.link.fetch_info(&car).await;
                    }
                    if map {
                        hub.link.fetch_map(&car).await;
                    }
                    fetching().remove(&car);
                });
            }
        }
    }
}

/// Why no recording was begun.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// One is going on.
    #[error("a recording is going on already")]
    Recording,
    /// The file.
    #[error(transparent)]
    File(#[from] RecordingError),
    /// The network.
    #[error(transparent)]
    Link(#[from] LinkError),
}
