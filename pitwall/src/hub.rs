//! The running pit wall: a link whose events keep a fleet up to date and, when asked, fill a recording.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, TrySendError};
use protocol::CarName;
use tokio::task::JoinHandle;

use crate::event::{FleetEvent, Happening};
use crate::fleet::Fleet;
use crate::link::{Link, LinkError, Role, unix_now};
use crate::recording::{Recorder, RecordingError, Status, Summary};

/// A pit wall at work. Cheap to share.
pub struct Hub {
    link: Link,
    shared: Arc<Shared>,
    housekeeping: Mutex<Option<JoinHandle<()>>>,
}

#[derive(Default)]
struct Shared {
    fleet: Mutex<Fleet>,
    recorder: Mutex<Option<Recorder>>,
    taps: Mutex<Vec<Sender<Arc<FleetEvent>>>>,
}

impl Shared {
    fn fleet(&self) -> MutexGuard<'_, Fleet> {
        self.fleet.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn recorder(&self) -> MutexGuard<'_, Option<Recorder>> {
        self.recorder.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn take(&self, event: FleetEvent) {
        self.fleet().apply(&event);
        let event = Arc::new(event);
        if let Some(recorder) = &*self.recorder() {
            recorder.take(&event);
        }
        let mut taps = self.taps.lock().unwrap_or_else(PoisonError::into_inner);
        taps.retain(|tap| !matches!(tap.try_send(event.clone()), Err(TrySendError::Disconnected(_))));
    }
}

impl Hub {
    /// How often time passes for the fleet.
    const TICK: Duration = Duration::from_millis(100);
    /// How often clocks are compared.
    const COMPARE_CLOCKS: Duration = Duration::from_secs(2);
    /// How long gaps may take to fill when a recording is about to end.
    const FILL_GAPS: Duration = Duration::from_millis(1500);

    /// Opens the link. Needs a multi-thread tokio runtime.
    pub async fn open(role: &Role) -> Result<Arc<Self>, LinkError> {
        let shared = Arc::new(Shared::default());
        let sink = shared.clone();
        let link = Link::open(role, Arc::new(move |event| sink.take(event))).await?;
        let hub = Arc::new(Self {
            link,
            shared,
            housekeeping: Mutex::default(),
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
    pub fn fleet(&self) -> MutexGuard<'_, Fleet> {
        self.shared.fleet()
    }

    /// Every event from now on, after what a newcomer needs to know. One that reads too slowly misses some.
    pub fn tap(&self) -> Receiver<Arc<FleetEvent>> {
        const WAITING: usize = 20_000;
        let (tap, events) = crossbeam_channel::bounded(WAITING);
        for event in self.known() {
            drop(tap.try_send(Arc::new(event)));
        }
        self.shared
            .taps
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(tap);
        events
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
        if self.shared.recorder().is_some() {
            return Err(StartError::Recording);
        }
        let recorder = Recorder::start(path)?;
        for event in self.known() {
            recorder.take(&Arc::new(event));
        }
        *self.shared.recorder() = Some(recorder);
        self.link.subscribe_recorded(true).await?;
        Ok(())
    }

    /// Ends the recording and says what is in it. None when there was none.
    pub async fn stop_recording(&self) -> Option<Result<Summary, RecordingError>> {
        let deadline = Instant::now() + Self::FILL_GAPS;
        while Instant::now() < deadline
            && self
                .recording()
                .is_some_and(|status| status.summary.missing() > 0)
        {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        let recorder = self.shared.recorder().take()?;
        if let Err(error) = self.link.subscribe_recorded(false).await {
            tracing::warn!(%error, "still subscribed to the full-rate streams");
        }
        tokio::task::spawn_blocking(move || recorder.finish()).await.ok()
    }

    /// How the recording is getting on; None when there is none.
    pub fn recording(&self) -> Option<Status> {
        self.shared.recorder().as_ref().map(Recorder::status)
    }

    /// The file that is being recorded into.
    pub fn recording_path(&self) -> Option<PathBuf> {
        let recorder = self.shared.recorder();
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

    /// What a recording that begins now would otherwise not know.
    fn known(&self) -> Vec<FleetEvent> {
        let at = unix_now();
        let fleet = self.fleet();
        let mut events = Vec::new();
        for car in fleet.cars() {
            let mut push = |happening| {
                events.push(FleetEvent {
                    at,
                    car: car.name.clone(),
                    happening,
                });
            };
            if car.alive {
                push(Happening::Appeared);
            }
            if let Some((map, bytes)) = &car.map {
                push(Happening::Map {
                    map: map.clone(),
                    bytes: bytes.clone(),
                });
            }
            if let Some(info) = &car.info {
                push(Happening::Info(info.clone()));
            }
            if let Some((offset, round_trip)) = car.clock() {
                push(Happening::Clock { offset, round_trip });
            }
        }
        events
    }
}

/// Lets time pass, and asks each car what no message tells.
async fn keep_house(hub: std::sync::Weak<Hub>) {
    let mut ticks = tokio::time::interval(Hub::TICK);
    let mut compared: Option<Instant> = None;
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
        let compare = compared.is_none_or(|at| at.elapsed() >= Hub::COMPARE_CLOCKS);
        if compare && !cars.is_empty() {
            compared = Some(Instant::now());
            for (car, map, info) in cars {
                let hub = hub.clone();
                tokio::spawn(async move {
                    hub.link.compare_clocks(&car).await;
                    if info {
                        hub.link.fetch_info(&car).await;
                    }
                    if map {
                        hub.link.fetch_map(&car).await;
                    }
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
