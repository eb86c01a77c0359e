//! The running pit wall: connects to the cars, and feeds their events to the fleet and to a recording.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;
use keys::Protection;
use protocol::{CarName, LinkReport, Severity};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::clock::{stepped, system_now, unix_now};
use crate::event::{EventPayload, FleetEvent};
use crate::event_bus::{EventBus, FleetGuard};
use crate::fleet::Fleet;
use crate::network::gap_recovery::Outstanding;
use crate::network::recorders::Recorders;
use crate::network::{Client, Connection, ConnectionError, RecorderNews, RecorderView, Role};
use crate::recording::{
    Recorder, RecorderOptions, RecorderStatus, RecordingError, RecordingSummary, session_name,
};

/// A running pit wall. Cheap to share.
pub struct FleetService {
    connection: Connection,
    bus: Arc<EventBus>,
    warning: Option<String>,
    periodic_tasks: Mutex<Option<JoinHandle<()>>>,
    _acknowledged: Box<dyn Send + Sync>,
    _heard_recorders: Box<dyn Send + Sync>,
    /// The recorders of all pit walls on the network.
    recorders: Arc<Mutex<Recorders>>,
    /// Cars whose map and info are being fetched. Over a slow link a fetch takes longer than the period of the fetches.
    fetching: Mutex<BTreeSet<CarName>>,
    /// Why the last recording has failed; None while it has not.
    recording_failure: watch::Sender<Option<String>>,
}

impl FleetService {
    /// Period of [`Fleet::tick`].
    const TICK: Duration = Duration::from_millis(100);
    /// Period of the link reports to the cars.
    const REPORT_LINKS: Duration = Duration::from_secs(1);
    /// Their period for a car whose poses are late, so that it sends less before much waits on its link.
    const REPORT_LATE: Duration = Duration::from_millis(250);
    /// Poses that arrive later than this are late \[s\].
    const LATE: f32 = 0.2;
    /// Period of the clock comparisons.
    const COMPARE_CLOCKS: Duration = Duration::from_secs(2);
    /// The final sync of a recording ends when nothing has arrived for this long.
    const FINAL_SYNC_QUIET: Duration = Duration::from_millis(1500);
    /// The final sync of a recording takes this long at most.
    const FINAL_SYNC_MAX: Duration = Duration::from_secs(15);

    /// Opens the connection. Needs a multi-thread tokio runtime.
    pub async fn open(role: &Role) -> Result<Arc<Self>, ConnectionError> {
        Self::open_protected(role, &Protection::None).await
    }

    /// Opens the connection with keys or a passphrase. Needs a multi-thread tokio runtime.
    pub async fn open_protected(role: &Role, protection: &Protection) -> Result<Arc<Self>, ConnectionError> {
        let bus = Arc::new(EventBus::default());
        let sink = bus.clone();
        let connection =
            Connection::open(role, protection, Arc::new(move |event| sink.publish(event))).await?;
        let fleet = bus.clone();
        let acknowledged = connection
            .watch_acknowledged(move |operator| fleet.fleet().acknowledge(unix_now(), operator))
            .await?;
        let recorders = Arc::new(Mutex::new(Recorders::default()));
        let (board, fleet) = (recorders.clone(), bus.clone());
        let heard_recorders = connection
            .watch_recorders(move |news| {
                let host = news.host.clone();
                let failure = lock(&board).hear(news, Instant::now());
                if let Some(error) = failure {
                    let text = format!("RECORDING FAILED on {host}: {error}");
                    fleet
                        .fleet()
                        .add_entry(unix_now(), None, Severity::Critical, "recorder", text, None);
                }
            })
            .await?;
        let service = Arc::new(Self {
            _acknowledged: acknowledged,
            _heard_recorders: heard_recorders,
            recorders,
            connection,
            bus,
            warning: exposure(role, protection),
            periodic_tasks: Mutex::default(),
            fetching: Mutex::default(),
            recording_failure: watch::Sender::new(None),
        });
        let task = tokio::spawn(run_periodic_tasks(Arc::downgrade(&service)));
        *service
            .periodic_tasks
            .lock()
            .unwrap_or_else(PoisonError::into_inner) = Some(task);
        Ok(service)
    }

    /// The connection to the cars.
    pub fn connection(&self) -> &Connection {
        &self.connection
    }

    /// What everybody at this pit wall must know about its network. None when it is protected or stays on this machine.
    pub fn warning(&self) -> Option<&str> {
        self.warning.as_deref()
    }

    /// Sends queries and commands to the cars.
    pub fn client(&self) -> &Client {
        self.connection.client()
    }

    /// Locks the fleet. Hold the lock briefly: incoming events wait for it.
    pub fn fleet(&self) -> FleetGuard<'_> {
        self.bus.fleet()
    }

    /// Distributes the events.
    pub fn bus(&self) -> &Arc<EventBus> {
        &self.bus
    }

    /// Every event from now on, preceded by the current state. A receiver that reads too slowly misses events.
    pub fn subscribe(&self) -> Receiver<Arc<FleetEvent>> {
        self.bus.subscribe(unix_now())
    }

    /// Waits until a car is connected; false when it is not within `timeout`.
    pub async fn wait_for(&self, car: &CarName, timeout: Duration) -> bool {
        self.wait_until(timeout, |fleet| fleet.car(car).is_some_and(|car| car.alive))
            .await
    }

    /// Waits until the fleet meets `condition`; false when it does not within `timeout`.
    pub async fn wait_until(&self, timeout: Duration, condition: impl Fn(&Fleet) -> bool) -> bool {
        let deadline = Instant::now() + timeout;
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

    /// Starts a recording of all cars. It begins with the known maps, info and clock offsets.
    pub async fn start_recording(&self, path: &Path) -> Result<(), StartRecordingError> {
        self.start_recording_with(path, RecorderOptions::default()).await
    }

    /// The name of a recording that starts now: the time and the track.
    pub fn session_name(&self) -> String {
        let fleet = self.fleet();
        let track = fleet
            .cars()
            .find_map(|car| car.map.as_ref().map(|(map, _)| map.name.clone()));
        session_name(system_now(), track.as_deref())
    }

    /// Starts a recording of all cars with options.
    pub async fn start_recording_with(
        &self,
        path: &Path,
        options: RecorderOptions,
    ) -> Result<(), StartRecordingError> {
        if self.bus.recording().is_some() {
            return Err(StartRecordingError::Recording);
        }
        let recorder = Recorder::start_with(path, options)?;
        let file = recorder.path();
        self.recording_failure.send_replace(None);
        if let Err(rejected) = self.bus.attach_recorder(recorder, unix_now()) {
            // Another recording has started since the check. The new file is empty.
            drop(rejected);
            if let Err(error) = std::fs::remove_file(&file) {
                tracing::warn!(file = %file.display(), %error, "an empty recording is left");
            }
            return Err(StartRecordingError::Recording);
        }
        // What was sent since an earlier recording is not missing.
        self.fleet().forget_recorded();
        self.connection.subscribe_recorded(true).await?;
        Ok(())
    }

    /// Waits until the recording fails, and returns the error. Never returns while it goes on, or when there is none.
    pub async fn recording_failed(&self) -> String {
        let mut failure = self.recording_failure.subscribe();
        loop {
            if let Some(error) = failure.borrow_and_update().clone() {
                return error;
            }
            if failure.changed().await.is_err() {
                return std::future::pending().await;
            }
        }
    }

    /// An alarm when the recording has moved to the spare folder.
    fn note_moved_recording(&self, noted: &mut Option<String>) {
        let recording = self.bus.recording();
        let moved = recording
            .as_ref()
            .and_then(|(_, progress)| progress.moved.clone());
        if moved != *noted
            && let (Some(error), Some((file, _))) = (&moved, &recording)
        {
            let text = format!("RECORDING MOVED: {error}; it goes on in {}", file.display());
            self.fleet()
                .add_entry(unix_now(), None, Severity::Critical, "recorder", text, None);
        }
        *noted = moved;
    }

    /// Ends a recording that has failed: an alarm, and the next one can be started.
    async fn end_failed_recording(&self) {
        let Some(error) = self.bus.recording().and_then(|(_, progress)| progress.error) else {
            return;
        };
        let file = self.recording_path().unwrap_or_default();
        tracing::error!(file = %file.display(), %error, "recording has failed");
        let text = format!("RECORDING FAILED: {error}; start another one, on another disk if need be");
        self.fleet()
            .add_entry(unix_now(), None, Severity::Critical, "recorder", text, None);
        if let Some(Ok(_)) = self.cut_recording().await {
            tracing::warn!("the recording was completed although it had failed");
        }
        self.recording_failure.send_replace(Some(error));
    }

    /// Notes that the laptop's clock was set.
    fn note_clock_step(&self, noted: &mut i64) {
        const STEP: i64 = 500_000_000;
        let stepped = stepped();
        if (stepped - *noted).abs() < STEP {
            return;
        }
        let by = (stepped - *noted) as f64 * 1e-9;
        *noted = stepped;
        let text = format!("the laptop's clock was set by {by:+.1} s; times here go on without that step");
        tracing::warn!("{text}");
        let cars: Vec<_> = self.fleet().cars().map(|car| car.name.clone()).collect();
        for car in cars {
            let (who, text) = ("pitwall".into(), text.as_str().into());
            self.client().emit(&car, EventPayload::Marker { who, text });
        }
    }

    /// Ends the recording and returns its summary; None when nothing was being recorded. A final sync with every car
    /// comes first, so that all of its streams end at the same moment.
    pub async fn stop_recording(&self) -> Option<Result<RecordingSummary, RecordingError>> {
        self.recording_path()?;
        self.await_final_sync().await;
        self.cut_recording().await
    }

    /// Ends the recording without a final sync and returns its summary; None when nothing was being recorded.
    pub async fn cut_recording(&self) -> Option<Result<RecordingSummary, RecordingError>> {
        // Messages held back behind a gap are recorded first.
        if let Err(error) = self.connection.subscribe_recorded(false).await {
            tracing::warn!(%error, "still subscribed to the full-rate topics");
        }
        let news = self.recorder_news(true);
        let recorder = self.bus.detach_recorder()?;
        if let Some(news) = news {
            self.tell_recorder(news).await;
        }
        tokio::task::spawn_blocking(move || recorder.finish()).await.ok()
    }

    /// What the recorder here does; None when nothing is being recorded.
    fn recorder_news(&self, ended: bool) -> Option<RecorderNews> {
        let (file, progress) = self.bus.recording()?;
        let name = file.file_name().unwrap_or_default();
        Some(RecorderNews {
            host: sysinfo::System::host_name().unwrap_or_default(),
            file: name.to_string_lossy().into_owned(),
            seconds: progress.seconds,
            bytes: progress.bytes,
            missing: progress.missing.saturating_add(progress.overrun),
            error: progress.error,
            ended,
            ..RecorderNews::default()
        })
    }

    async fn tell_recorder(&self, news: RecorderNews) {
        let news = self.connection.tell_recorder(news).await;
        // Its failure is in the log of this pit wall already.
        lock(&self.recorders).hear(news, Instant::now());
    }

    /// The recorders of all pit walls on the network; those that have failed or died come first.
    pub fn recorders(&self) -> Vec<RecorderView> {
        lock(&self.recorders).view(Instant::now())
    }

    async fn await_final_sync(&self) {
        let mut outstanding = self.connection.final_sync();
        let begun = Instant::now();
        let (mut progressed, mut least) = (begun, Outstanding::UNKNOWN);
        loop {
            match *outstanding.borrow_and_update() {
                Outstanding::NOTHING => return,
                less if less < least => (progressed, least) = (Instant::now(), less),
                _ => {}
            }
            let left = Self::FINAL_SYNC_QUIET.saturating_sub(progressed.elapsed());
            let left = left.min(Self::FINAL_SYNC_MAX.saturating_sub(begun.elapsed()));
            match tokio::time::timeout(left, outstanding.changed()).await {
                Ok(Ok(())) => {}
                Ok(Err(_)) | Err(_) => return,
            }
        }
    }

    /// The state of the recording; None when nothing is being recorded.
    pub fn recording(&self) -> Option<RecorderStatus> {
        self.bus.recorder_status()
    }

    /// The file that is being recorded.
    pub fn recording_path(&self) -> Option<PathBuf> {
        self.bus.recording().map(|(path, _)| path)
    }

    /// Acknowledges every alarm so far, here and on all pit walls of the network.
    pub async fn acknowledge(&self, operator: &str) {
        self.fleet().acknowledge(unix_now(), operator);
        self.connection.tell_acknowledged(operator).await;
    }

    /// Marks this moment in the logs and the recordings of all pit walls on this network.
    pub async fn mark(&self, car: &CarName, who: &str, text: &str) {
        self.client().mark(car, who, text).await;
    }

    /// Ends the recording, if there is one, and closes the connection.
    pub async fn close(&self) {
        if let Some(task) = self
            .periodic_tasks
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take()
        {
            task.abort();
        }
        if let Some(Err(error)) = self.stop_recording().await {
            tracing::error!(%error, "the recording could not be completed");
        }
        self.connection.close().await;
    }

    /// Sends the cars their link reports that are `wanted`.
    async fn report_links(&self, wanted: impl Fn(&LinkReport) -> bool) {
        let now = unix_now();
        let reports: Vec<_> = self
            .fleet()
            .cars()
            .filter_map(|car| Some((car.name.clone(), car.link_report(now)?)))
            .filter(|(_, report)| wanted(report))
            .collect();
        for (car, report) in reports {
            self.client().report(&car, &report).await;
        }
    }
}

/// Ticks the fleet, reports links to the cars, compares clocks, and fetches maps and info.
async fn run_periodic_tasks(service: std::sync::Weak<FleetService>) {
    let mut ticks = tokio::time::interval(FleetService::TICK);
    let mut compared: Option<Instant> = None;
    let mut reported: Option<Instant> = None;
    let mut reported_late: Option<Instant> = None;
    let mut clock_step = stepped();
    let mut moved = None;
    loop {
        ticks.tick().await;
        let Some(service) = service.upgrade() else {
            return;
        };
        let cars: Vec<_> = {
            let mut fleet = service.fleet();
            fleet.tick(unix_now());
            for flood in service.connection.floods() {
                let car = Some(flood.car);
                fleet.add_entry(unix_now(), car, Severity::Warning, "flood", flood.text, None);
            }
            let alive = fleet.cars().filter(|car| car.alive);
            alive
                .map(|car| (car.name.clone(), car.map.is_none(), car.info.is_none()))
                .collect()
        };
        if reported.is_none_or(|at| at.elapsed() >= FleetService::REPORT_LINKS) {
            reported = Some(Instant::now());
            service.connection.note_revoked().await;
            for refusal in keys::refusals::take() {
                tracing::warn!("{refusal}");
                service
                    .fleet()
                    .add_entry(unix_now(), None, Severity::Warning, "refused", refusal, None);
            }
            service.note_clock_step(&mut clock_step);
            service.note_moved_recording(&mut moved);
            service.end_failed_recording().await;
            if let Some(news) = service.recorder_news(false) {
                service.tell_recorder(news).await;
            }
            reported_late = reported;
            service.report_links(|_| true).await;
        } else if reported_late.is_none_or(|at| at.elapsed() >= FleetService::REPORT_LATE) {
            reported_late = Some(Instant::now());
            service
                .report_links(|report| report.transit - report.uncertainty > FleetService::LATE)
                .await;
        }
        let compare = compared.is_none_or(|at| at.elapsed() >= FleetService::COMPARE_CLOCKS);
        if compare && !cars.is_empty() {
            compared = Some(Instant::now());
            for (car, map, info) in cars {
                let service = service.clone();
                tokio::spawn(async move {
                    service.client().compare_clocks(&car).await;
                    let fetching = || service.fetching.lock().unwrap_or_else(PoisonError::into_inner);
                    if !(info || map) || !fetching().insert(car.clone()) {
                        return;
                    }
                    if info {
                        let info = service.client().fetch_info(&car).await;
                        if let Some(text) = info.and_then(|info| version_note(&car, &info.version)) {
                            let entry_of = Some(car.clone());
                            service.fleet().add_entry(
                                unix_now(),
                                entry_of,
                                Severity::Warning,
                                "version",
                                text,
                                None,
                            );
                        }
                    }
                    if map {
                        service.client().fetch_map(&car).await;
                    }
                    fetching().remove(&car);
                });
            }
        }
    }
}

/// Says that a car runs another version than this program; None when it is the same.
fn version_note(car: &CarName, version: &str) -> Option<String> {
    let own = env!("CARGO_PKG_VERSION");
    (version != own).then(|| {
        format!(
            "{car} runs version {}, this pit wall {own}: update the older one before the race",
            protocol::plain_text(version)
        )
    })
}

/// Why a recording cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum StartRecordingError {
    /// One is running already.
    #[error("a recording is already running")]
    Recording,
    /// The file.
    #[error(transparent)]
    File(#[from] RecordingError),
    /// The network.
    #[error(transparent)]
    Connection(#[from] ConnectionError),
}
fn lock<T>(shared: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The warning of a pit wall that everybody on the network can read and command.
fn exposure(role: &Role, protection: &Protection) -> Option<String> {
    let endpoint = role.reachable_endpoint()?;
    (!protection.protects()).then(|| {
        format!("unprotected: whoever reaches {endpoint} can read, forge and command every car; see `pitwall keys`")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_car_of_another_version_is_named() {
        let car = CarName::new("car-1").expect("a good name");
        assert_eq!(version_note(&car, env!("CARGO_PKG_VERSION")), None);
        let note = version_note(&car, "0.0.9\u{1b}]0;").expect("another version");
        assert!(note.starts_with("car-1 runs version 0.0.9"), "{note}");
        assert!(!note.contains('\u{1b}'), "{note}");
    }
}
