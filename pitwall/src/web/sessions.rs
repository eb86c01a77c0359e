//! The sessions in the recordings folder, and their replays beside the live view: each has a page of its own.

use std::collections::VecDeque;
use std::path::Path;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::Json;
use axum::extract::{Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use serde_json::json;

use super::guard::Guard;
use super::{App, Page, PageOptions};
use crate::recording::{Session, SessionIndex, SessionIndexError};
use crate::replay::Replay;

/// Most sessions in one answer.
const MOST: usize = 500;
/// An index that is nearly up to date is read within this time.
const BRIEF: Duration = Duration::from_millis(300);
/// Most replays that are open at a time. The oldest is closed for the next.
const MOST_REPLAYS: usize = 4;

/// The list of sessions and the open replays. Cheap to share.
#[derive(Clone, Default)]
pub(super) struct SessionList {
    /// True while the index is brought up to date.
    reading: Arc<AtomicBool>,
    replays: Arc<tokio::sync::Mutex<VecDeque<OpenReplay>>>,
    /// Why the index could not be brought up to date.
    fault: Arc<Mutex<Option<String>>>,
}

struct OpenReplay {
    page: Page,
    replay: Arc<Replay>,
}

impl OpenReplay {
    async fn close(self) {
        self.page.stop().await;
        self.replay.stop();
    }
}

impl SessionList {
    /// Closes all replays.
    async fn close(&self) {
        let replays = std::mem::take(&mut *self.replays.lock().await);
        for replay in replays {
            replay.close().await;
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SearchQuery {
    #[serde(default)]
    text: String,
}

/// The sessions with these words, as the index has them. It is brought up to date first. Where that takes long, or another
/// request has begun it, the answer comes meanwhile: ask again while `reading`.
pub(super) async fn list(State(app): State<App>, Query(query): Query<SearchQuery>) -> Response {
    let folder = app.recordings.clone();
    let SessionList { reading, fault, .. } = app.session_list.clone();
    let mut still_reading = true;
    if !reading.swap(true, Ordering::AcqRel) {
        let (folder, fault) = (folder.clone(), fault.clone());
        let skip = app.service.as_ref().and_then(|service| service.recording_path());
        let refresh = tokio::task::spawn_blocking(move || {
            let outcome =
                SessionIndex::open(&folder).and_then(|mut index| index.refresh(skip.as_deref(), |_| ()));
            *fault.lock().unwrap_or_else(PoisonError::into_inner) =
                outcome.err().map(|error| error.to_string());
            reading.store(false, Ordering::Release);
        });
        still_reading = tokio::time::timeout(BRIEF, refresh).await.is_err();
    }
    // After the index is up to date, or it is said that it is not yet.
    let found = tokio::task::spawn_blocking(move || search(&folder, &query.text)).await;
    match found {
        Ok(Ok(mut sessions)) => {
            sessions.truncate(MOST);
            let fault = fault.lock().unwrap_or_else(PoisonError::into_inner).clone();
            Json(json!({"sessions": sessions, "reading": still_reading, "fault": fault})).into_response()
        }
        Ok(Err(error)) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}

fn search(folder: &Path, text: &str) -> Result<Vec<Session>, SessionIndexError> {
    SessionIndex::open(folder)?.search(text)
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct OpenRequest {
    file: std::path::PathBuf,
}

/// Opens a session for replay, on a page of its own. Returns its address.
pub(super) async fn open(State(app): State<App>, Json(request): Json<OpenRequest>) -> Response {
    let folder = app.recordings.clone();
    let opened = tokio::task::spawn_blocking(move || {
        // Only what the index has is opened, so that no other file can be.
        let known = search(&folder, "").map_err(|error| error.to_string())?;
        if !known.iter().any(|session| session.file == request.file) {
            return Err(format!("no session {}", request.file.display()));
        }
        Replay::start(&folder.join(&request.file)).map_err(|error| error.to_string())
    });
    let replay = match opened.await {
        Ok(Ok(replay)) => replay,
        Ok(Err(fault)) => return (StatusCode::CONFLICT, fault).into_response(),
        Err(error) => return (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    };
    let mut address = app.address;
    address.set_port(0);
    let options = PageOptions {
        address,
        recordings: app.recordings.to_path_buf(),
        ..PageOptions::default()
    };
    let page = match serve(replay.clone(), options, app.guard.clone()).await {
        Ok(page) => page,
        Err(error) => {
            replay.stop();
            return (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response();
        }
    };
    let url = page.url().to_owned();
    let mut replays = app.session_list.replays.lock().await;
    if replays.is_empty() {
        let (list, stopped) = (app.session_list.clone(), app.clone());
        tokio::spawn(async move {
            stopped.stopped().await;
            list.close().await;
        });
    }
    replays.push_back(OpenReplay { page, replay });
    let oldest = (replays.len() > MOST_REPLAYS)
        .then(|| replays.pop_front())
        .flatten();
    drop(replays);
    if let Some(oldest) = oldest {
        tokio::spawn(oldest.close());
    }
    Json(json!({"url": url})).into_response()
}

/// A future of a known type: a page that opens pages would otherwise have a type that contains itself.
fn serve(
    replay: Arc<Replay>,
    options: PageOptions,
    guard: Guard,
) -> Pin<Box<dyn Future<Output = std::io::Result<Page>> + Send>> {
    Box::pin(Page::serve_beside(replay, options, guard))
}
