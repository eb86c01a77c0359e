//! Serves the page of the race engineer.
//!
//! ```text
//! GET  /               the page and its files, embedded in the program
//! GET  /ws             a snapshot of all cars 15 times a second, and log lines as they come;
//!                      in: {"select": "car-1", "operator": "ana"}, {"drawn": 17}: ready for the next
//! GET  /snapshot       one snapshot
//! GET  /map/<car>      the map that a car localizes on
//! POST /command        {car, operator, expected_revision, id, action}: returns the outcome of the command
//! GET  /sessions?text= the recordings in the folder with these words
//! POST /sessions/open  {file}: opens one for replay on a page of its own and returns its URL
//! POST /record         {"on": true|false, "operator"}
//! POST /mark           {car, operator, text, for_s, run_sheet}: a note on this moment or the time before it, or a run sheet
//! POST /acknowledge    {operator}: acknowledges every alarm so far
//! GET  /analysis       laps, sectors and map faults of all cars; /analysis/lap?id=... the data of one lap
//! POST /analysis/load  {file}: adds the laps of a recording; GET /analysis/files lists them
//! POST /limits         {car, limits, operator}: sets the alarm limits on a track; GET /limits/<car>
//! POST /sectors        {track, borders}: keeps the sectors of a track
//! POST /dismiss        {car, operator}: hides a car that is gone, until it is back
//! POST /replay         {"playing": bool, "speed": n, "at": s}, each optional; only in a replay
//! POST /rerun          starts the data stream for the Rerun viewer and returns its URL, under /rerun/
//! ```
//!
//! Requests from other origins are rejected. The `Content-Security-Policy` keeps the page from loading anything from
//! elsewhere. On an address other than loopback, a token is required (`POST /login`), and with keys the page is HTTPS.
mod analysis;
mod api;
mod connections;
mod disk;
mod guard;
mod operators;
#[cfg(feature = "rerun")]
mod rerun;
mod sessions;
mod snapshot;
mod tracks;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::http::header;
use axum::response::IntoResponse;
use axum::routing::{get, post};
use keys::Bundle;
use protocol::Severity;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::clock::unix_now;
use crate::event_bus::EventBus;
use crate::fleet_service::FleetService;
use crate::recording::RecorderOptions;
use crate::replay::Replay;
use analysis::Sessions;
pub(crate) use disk::free as free_space;
pub use disk::free as disk_free;
use guard::Guard;
use operators::Operators;
use sessions::SessionList;
pub(crate) use tracks::Tracks;

/// Longest body of a request \[bytes\]: a whole parameter set fits.
const LONGEST_BODY: usize = 256 * 1024;

/// Where the page is served and recordings go.
#[derive(Debug, Clone)]
pub struct PageOptions {
    /// The address.
    pub address: SocketAddr,
    /// The folder for recordings.
    pub recordings: PathBuf,
    /// How to record.
    pub recorder: RecorderOptions,
}

impl Default for PageOptions {
    fn default() -> Self {
        Self {
            address: SocketAddr::from(([127, 0, 0, 1], 7448)),
            recordings: PathBuf::from("."),
            recorder: RecorderOptions::default(),
        }
    }
}

/// The running page server.
pub struct Page {
    url: String,
    stop: watch::Sender<bool>,
    server: JoinHandle<()>,
}

/// State shared by all request handlers.
#[derive(Clone)]
struct App {
    bus: Arc<EventBus>,
    /// The connection to the cars; None in a replay.
    service: Option<Arc<FleetService>>,
    /// None when live.
    replay: Option<Arc<Replay>>,
    recordings: Arc<PathBuf>,
    address: SocketAddr,
    guard: Guard,
    session_list: SessionList,
    recorder: RecorderOptions,
    disk_free: watch::Receiver<Option<u64>>,
    operators: Operators,
    tracks: Tracks,
    sessions: Sessions,
    stopping: watch::Receiver<bool>,
    #[cfg(feature = "rerun")]
    pane: Arc<tokio::sync::Mutex<Option<rerun::Pane>>>,
}

impl App {
    /// The time that is shown \[unix ns\].
    fn now(&self) -> i64 {
        self.replay.as_ref().map_or_else(unix_now, |replay| replay.now())
    }

    /// Free space on the disk of the recordings \[bytes\].
    fn disk_free(&self) -> Option<u64> {
        *self.disk_free.borrow()
    }

    /// Waits until the page is stopped.
    async fn stopped(&self) {
        drop(self.stopping.clone().wait_for(|stop| *stop).await);
    }
}

impl Page {
    /// Binds the address and serves until [`Page::stop`].
    pub async fn serve(service: Arc<FleetService>, options: PageOptions) -> std::io::Result<Self> {
        Self::serve_with_keys(service, options, None).await
    }

    /// Serves over HTTPS when there are keys and the address is beyond loopback.
    pub async fn serve_with_keys(
        service: Arc<FleetService>,
        options: PageOptions,
        keys: Option<Arc<Bundle>>,
    ) -> std::io::Result<Self> {
        Self::serve_from(service.bus().clone(), Some(service), None, options, keys, None).await
    }

    /// Serves a replay.
    pub async fn serve_replay(replay: Arc<Replay>, options: PageOptions) -> std::io::Result<Self> {
        Self::serve_replay_with_keys(replay, options, None).await
    }

    /// Serves a replay over HTTPS when there are keys and the address is beyond loopback.
    pub async fn serve_replay_with_keys(
        replay: Arc<Replay>,
        options: PageOptions,
        keys: Option<Arc<Bundle>>,
    ) -> std::io::Result<Self> {
        Self::serve_from(replay.bus().clone(), None, Some(replay), options, keys, None).await
    }

    /// Serves a replay to those whom the guard of another page admits. A browser keeps one token for all ports of an address.
    async fn serve_beside(replay: Arc<Replay>, options: PageOptions, guard: Guard) -> std::io::Result<Self> {
        Self::serve_from(
            replay.bus().clone(),
            None,
            Some(replay),
            options,
            None,
            Some(guard),
        )
        .await
    }

    async fn serve_from(
        bus: Arc<EventBus>,
        service: Option<Arc<FleetService>>,
        replay: Option<Arc<Replay>>,
        options: PageOptions,
        keys: Option<Arc<Bundle>>,
        guard: Option<Guard>,
    ) -> std::io::Result<Self> {
        let listener = TcpListener::bind(options.address).await?;
        let address = listener.local_addr()?;
        let guard = match guard {
            Some(guard) => guard,
            None => Guard::with_keys(address, keys.as_deref())?,
        };
        let tls = guard.tls.clone();
        let url = guard.url(address);
        let (stop, stopping) = watch::channel(false);
        let (room, disk_free) = watch::channel(None);
        if service.is_some() {
            tokio::spawn(watch_disk(
                bus.clone(),
                options.recordings.clone(),
                room,
                stopping.clone(),
            ));
        }
        let tracks = Tracks::new(&options.recordings);
        tokio::spawn(watch_limits(bus.clone(), tracks.clone(), stopping.clone()));
        let app = App {
            bus,
            service,
            replay,
            tracks,
            sessions: Sessions::default(),
            recordings: Arc::new(options.recordings),
            address,
            guard: guard.clone(),
            session_list: SessionList::default(),
            recorder: options.recorder,
            disk_free,
            operators: Operators::default(),
            stopping,
            #[cfg(feature = "rerun")]
            pane: Arc::default(),
        };
        let router = files()
            .route("/ws", get(snapshot::socket))
            .route("/snapshot", get(snapshot::once))
            .route("/map/{car}", get(api::map))
            .route("/command", post(api::command))
            .route("/record", post(api::record))
            .route("/mark", post(api::mark))
            .route("/sessions", get(sessions::list))
            .route("/sessions/open", post(sessions::open))
            .route("/acknowledge", post(api::acknowledge))
            .route("/analysis", get(analysis::view))
            .route("/analysis/lap", get(analysis::lap))
            .route("/analysis/files", get(analysis::files))
            .route("/analysis/load", post(analysis::load))
            .route("/limits/{car}", get(analysis::limits))
            .route("/limits", post(analysis::set_limits))
            .route("/sectors", post(analysis::keep_sectors))
            .route("/dismiss", post(api::dismiss))
            .route("/replay", post(api::replay));
        #[cfg(feature = "rerun")]
        let router = router
            .route("/rerun", post(rerun::open))
            .route("/rerun/{file}", get(rerun::file));
        let router = router
            .layer(axum::middleware::from_fn_with_state(
                Arc::new(guard),
                guard::check,
            ))
            .layer(DefaultBodyLimit::max(LONGEST_BODY))
            .with_state(app.clone());
        let server = tokio::spawn(connections::serve(listener, tls, router, app.stopping.clone()));
        Ok(Self { url, stop, server })
    }

    /// The URL of the page, with the token if one is required.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// Stops serving.
    pub async fn stop(self) {
        self.stop.send_replace(true);
        if let Err(error) = self.server.await {
            tracing::warn!(%error, "the page's server");
        }
    }
}

/// Reads the engineer's limits of each track that a car appears on.
async fn watch_limits(bus: Arc<EventBus>, tracks: Tracks, mut stopping: watch::Receiver<bool>) {
    let mut ticks = tokio::time::interval(Duration::from_secs(1));
    loop {
        tokio::select! {
            _ = ticks.tick() => {}
            _ = stopping.wait_for(|stop| *stop) => return,
        }
        let (bus, tracks) = (bus.clone(), tracks.clone());
        if tokio::task::spawn_blocking(move || analysis::load_limits(&bus, &tracks))
            .await
            .is_err()
        {
            return;
        }
    }
}

/// Measures the free disk space every few seconds, and raises an alarm when it runs short during a recording.
async fn watch_disk(
    bus: Arc<EventBus>,
    folder: PathBuf,
    room: watch::Sender<Option<u64>>,
    mut stopping: watch::Receiver<bool>,
) {
    let mut ticks = tokio::time::interval(Duration::from_secs(5));
    let mut reported = false;
    loop {
        tokio::select! {
            _ = ticks.tick() => {}
            _ = stopping.wait_for(|stop| *stop) => return,
        }
        // While recording, the disk that is recorded to counts.
        let recorded = bus
            .recording()
            .and_then(|(file, _)| file.parent().map(PathBuf::from));
        let folder = match recorded {
            // A bare file name is in the present folder.
            Some(folder) if folder.as_os_str().is_empty() => PathBuf::from("."),
            Some(folder) => folder,
            None => folder.clone(),
        };
        // A network drive may be slow.
        let Ok(free) = tokio::task::spawn_blocking(move || disk::free(&folder)).await else {
            return;
        };
        room.send_replace(free);
        let scarce = bus.recording().is_some() && free.is_some_and(|free| free < disk::SCARCE);
        if scarce && !reported {
            let text = format!("{:.1} GB left for the recording", free.unwrap_or(0) as f64 / 1e9);
            bus.fleet()
                .add_entry(unix_now(), None, Severity::Critical, "disk", text, None);
        }
        reported = scarce;
    }
}

/// The page's own files.
fn files() -> Router<App> {
    let file = |content: &'static str, kind: &'static str| {
        get(move || async move { ([(header::CONTENT_TYPE, kind)], content).into_response() })
    };
    let script = "text/javascript; charset=utf-8";
    Router::new()
        .route(
            "/",
            file(include_str!("page/index.html"), "text/html; charset=utf-8"),
        )
        .route(
            "/style.css",
            file(include_str!("page/style.css"), "text/css; charset=utf-8"),
        )
        .route(
            "/analysis.css",
            file(include_str!("page/analysis.css"), "text/css; charset=utf-8"),
        )
        .route("/analysis.js", file(include_str!("page/analysis.js"), script))
        .route("/app.js", file(include_str!("page/app.js"), script))
        .route("/cards.js", file(include_str!("page/cards.js"), script))
        .route("/chart.js", file(include_str!("page/chart.js"), script))
        .route("/large.js", file(include_str!("page/large.js"), script))
        .route("/lists.js", file(include_str!("page/lists.js"), script))
        .route("/connection.js", file(include_str!("page/connection.js"), script))
        .route("/sessions.js", file(include_str!("page/sessions.js"), script))
        .route("/sound.js", file(include_str!("page/sound.js"), script))
        .route("/track.js", file(include_str!("page/track.js"), script))
        .route("/icon.svg", file(include_str!("page/icon.svg"), "image/svg+xml"))
}
