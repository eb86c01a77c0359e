//! The page: what the race engineer looks at.
//!
//! ```text
//! GET  /               the page and its files, embedded in the program
//! GET  /ws             a snapshot of all cars 15 times a second, and log lines as they come; in: {"select": "car-1"}
//! GET  /snapshot       one snapshot
//! GET  /map/<car>      the map that a car localizes on
//! POST /command        {car, operator, expected_revision, id, action}: waits for the car and says what became of it
//! POST /record         {"on": true|false}
//! POST /mark           {car, operator, text}
//! POST /rerun          starts the Rerun viewer's data and says where the viewer is; it is served under /rerun/
//! ```
//!
//! Only pages of our own origin are served, and nothing on the page comes from anywhere else: the
//! `Content-Security-Policy` says so to the browser. On any but a loopback address a token is asked for.
mod api;
mod guard;
#[cfg(feature = "rerun")]
mod rerun;
mod snapshot;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use axum::Router;
use axum::http::header;
use axum::response::IntoResponse;
use axum::routing::{get, post};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::hub::Hub;
use guard::Guard;

/// How the page is served.
#[derive(Debug, Clone)]
pub struct PageOptions {
    /// Where.
    pub address: SocketAddr,
    /// The folder that recordings go to.
    pub recordings: PathBuf,
}

impl Default for PageOptions {
    fn default() -> Self {
        Self {
            address: SocketAddr::from(([127, 0, 0, 1], 7448)),
            recordings: PathBuf::from("."),
        }
    }
}

/// The page, being served.
pub struct Page {
    url: String,
    stop: watch::Sender<bool>,
    server: JoinHandle<std::io::Result<()>>,
}

/// What every request may need.
#[derive(Clone)]
struct App {
    hub: Arc<Hub>,
    recordings: Arc<PathBuf>,
    stopping: watch::Receiver<bool>,
    #[cfg(feature = "rerun")]
    pane: Arc<tokio::sync::Mutex<Option<rerun::Pane>>>,
}

impl App {
    /// Ends when the page is to stop.
    async fn stopped(&self) {
        drop(self.stopping.clone().wait_for(|stop| *stop).await);
    }
}

impl Page {
    /// Binds the address and serves until [`Page::stop`].
    pub async fn serve(hub: Arc<Hub>, options: PageOptions) -> std::io::Result<Self> {
        let listener = TcpListener::bind(options.address).await?;
        let address = listener.local_addr()?;
        let guard = Guard::new(address);
        let url = guard.url(address);
        let (stop, stopping) = watch::channel(false);
        let app = App {
            hub,
            recordings: Arc::new(options.recordings),
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
            .route("/mark", post(api::mark));
        #[cfg(feature = "rerun")]
        let router = router
            .route("/rerun", post(rerun::open))
            .route("/rerun/{file}", get(rerun::file));
        let router = router
            .layer(axum::middleware::from_fn_with_state(
                Arc::new(guard),
                guard::check,
            ))
            .with_state(app.clone());
        let server = tokio::spawn(async move {
            axum::serve(listener, router)
                .with_graceful_shutdown(async move { app.stopped().await })
                .await
        });
        Ok(Self { url, stop, server })
    }

    /// What to type into a browser.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// Stops serving.
    pub async fn stop(self) {
        self.stop.send_replace(true);
        if let Ok(Err(error)) = self.server.await {
            tracing::warn!(%error, "the page's server");
        }
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
        .route("/app.js", file(include_str!("page/app.js"), script))
        .route("/cards.js", file(include_str!("page/cards.js"), script))
        .route("/track.js", file(include_str!("page/track.js"), script))
        .route("/lists.js", file(include_str!("page/lists.js"), script))
        .route("/link.js", file(include_str!("page/link.js"), script))
        .route("/icon.svg", file(include_str!("page/icon.svg"), "image/svg+xml"))
}
