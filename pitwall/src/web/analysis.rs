//! Laps and health over the track for the page, with the laps of other recordings.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use axum::extract::{Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::Deserialize;
use serde_json::json;

use super::App;
use super::guard::Access;
use crate::analysis::{AnalysisView, SessionLaps, TrackLine};

/// Name of the laps that the page itself shows.
const HERE: &str = "now";
/// Most recordings whose laps are kept.
const MOST_SESSIONS: usize = 8;
/// Most recordings in the list.
const MOST_FILES: usize = 500;

/// The laps of other recordings, by file. Cheap to share.
#[derive(Clone, Default)]
pub(super) struct Sessions(Arc<Mutex<BTreeMap<String, Arc<SessionLaps>>>>);

impl Sessions {
    fn all(&self) -> Vec<Arc<SessionLaps>> {
        let sessions = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        sessions.values().cloned().collect()
    }

    fn add(&self, file: String, laps: SessionLaps) {
        let mut sessions = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if sessions.len() == MOST_SESSIONS && !sessions.contains_key(&file) {
            sessions.pop_first();
        }
        sessions.insert(file, Arc::new(laps));
    }

    /// Changes when the list does.
    pub(super) fn count(&self) -> usize {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).len()
    }
}

/// All laps: the fleet's and those of other recordings. The fleet is locked only while they are copied.
fn all(app: &App) -> Vec<Arc<SessionLaps>> {
    let here = SessionLaps::now(HERE, &app.bus.fleet());
    std::iter::once(Arc::new(here))
        .chain(app.sessions.all())
        .collect()
}

fn sectors(app: &App) -> impl Fn(&TrackLine) -> Option<crate::analysis::Sectors> + '_ {
    |line| app.tracks.of(line).sectors
}

/// Everything but the laps' data.
pub(super) async fn view(State(app): State<App>) -> Response {
    on_a_thread(move || {
        let sessions = all(&app);
        let laps: Vec<_> = sessions.iter().flat_map(|session| session.cars()).collect();
        Json(AnalysisView::of(&laps, sectors(&app))).into_response()
    })
    .await
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LapQuery {
    id: String,
}

/// The data of one lap.
pub(super) async fn lap(State(app): State<App>, Query(query): Query<LapQuery>) -> Response {
    let sessions = all(&app);
    let laps: Vec<_> = sessions.iter().flat_map(|session| session.cars()).collect();
    match AnalysisView::data(&laps, &query.id) {
        Some(data) => Json(data).into_response(),
        None => (StatusCode::NOT_FOUND, format!("no lap {}", query.id)).into_response(),
    }
}

/// Gives the fleet the limits that are kept with the tracks that cars are on.
pub(super) fn load_limits(bus: &crate::event_bus::EventBus, tracks: &super::tracks::Tracks) {
    let new: Vec<_> = {
        let fleet = bus.fleet();
        let lines = fleet.cars().filter_map(|car| car.book().line().cloned());
        lines.filter(|line| fleet.limits(&line.key).is_none()).collect()
    };
    for line in new {
        let limits = tracks.of(&line).limits;
        bus.fleet().set_limits(&line.key, limits);
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LimitsRequest {
    car: protocol::CarName,
    limits: BTreeMap<String, f64>,
    operator: String,
}

/// The alarm limits on the track of a car, and the metrics that can have one.
pub(super) async fn limits(
    State(app): State<App>,
    axum::extract::Path(car): axum::extract::Path<protocol::CarName>,
) -> Response {
    let line = app
        .bus
        .fleet()
        .car(&car)
        .and_then(|car| car.book().line().cloned());
    let limits = line.map(|line| app.tracks.of(&line).limits);
    let channels: Vec<_> = crate::analysis::Channel::ALL
        .into_iter()
        .map(crate::analysis::Channel::info)
        .collect();
    Json(json!({"limits": limits, "channels": channels})).into_response()
}

/// Sets the alarm limits on the track of a car, for all cars on it, and keeps them.
pub(super) async fn set_limits(
    State(app): State<App>,
    Extension(access): Extension<Access>,
    Json(request): Json<LimitsRequest>,
) -> Response {
    let LimitsRequest {
        car,
        limits,
        operator,
    } = request;
    let operator = access.name(operator);
    let Some(line) = app
        .bus
        .fleet()
        .car(&car)
        .and_then(|car| car.book().line().cloned())
    else {
        return (StatusCode::NOT_FOUND, format!("{car} has no track")).into_response();
    };
    let limits = match crate::fleet::Limits::new(limits) {
        Ok(limits) if operator.len() <= protocol::Command::MAX_OPERATOR => limits,
        Ok(_) => return (StatusCode::BAD_REQUEST, "too long").into_response(),
        Err(fault) => return (StatusCode::BAD_REQUEST, fault).into_response(),
    };
    let (tracks, kept) = (app.tracks.clone(), limits.clone());
    let on_line = line.clone();
    let written = tokio::task::spawn_blocking(move || tracks.keep_limits(&on_line, kept)).await;
    match written.map_err(|error| error.to_string()) {
        Ok(Ok(())) => {}
        Ok(Err(fault)) | Err(fault) => return (StatusCode::INTERNAL_SERVER_ERROR, fault).into_response(),
    }
    let note = limits.to_note();
    app.bus.fleet().set_limits(&line.key, limits);
    match &app.service {
        // A note, so that they are part of the recording.
        Some(service) => service.mark(&car, &operator, &note).await,
        None => app.bus.fleet().add_entry(
            app.now(),
            None,
            protocol::Severity::Info,
            "limit",
            note,
            Some(operator),
        ),
    }
    StatusCode::NO_CONTENT.into_response()
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SectorsRequest {
    track: String,
    borders: Vec<f64>,
}

/// Keeps the sectors of a track.
pub(super) async fn keep_sectors(State(app): State<App>, Json(request): Json<SectorsRequest>) -> Response {
    let SectorsRequest { track, borders } = request;
    on_a_thread(move || {
        let line = all(&app).iter().find_map(|session| {
            let lines = session.cars().filter_map(|car| car.book.line().cloned());
            lines.into_iter().find(|line| line.key == track)
        });
        let Some(line) = line else {
            return (StatusCode::NOT_FOUND, format!("no track {track}")).into_response();
        };
        match app.tracks.keep_sectors(&line, borders) {
            Ok(()) => StatusCode::NO_CONTENT.into_response(),
            Err(fault) => (StatusCode::BAD_REQUEST, fault).into_response(),
        }
    })
    .await
}

/// The recordings beside this one.
pub(super) async fn files(State(app): State<App>) -> Response {
    on_a_thread(move || {
        let Ok(entries) = std::fs::read_dir(&*app.recordings) else {
            return Json(json!([])).into_response();
        };
        let mut names: Vec<String> = entries
            .flatten()
            .map(|entry| entry.path())
            .filter(|path| path.extension().is_some_and(|extension| extension == "mcap"))
            .filter_map(|path| Some(path.file_name()?.to_str()?.to_owned()))
            .collect();
        names.sort_unstable_by(|a, b| b.cmp(a));
        names.truncate(MOST_FILES);
        Json(names).into_response()
    })
    .await
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LoadRequest {
    file: String,
}

/// Reads the laps of a recording in the folder of the recordings.
pub(super) async fn load(State(app): State<App>, Json(LoadRequest { file }): Json<LoadRequest>) -> Response {
    // A name alone, so that no other folder can be read.
    if PathBuf::from(&file).file_name().and_then(|name| name.to_str()) != Some(file.as_str()) {
        return (StatusCode::BAD_REQUEST, format!("{file:?} is no name of a file")).into_response();
    }
    on_a_thread(move || match SessionLaps::of(&app.recordings.join(&file)) {
        Ok(laps) => {
            app.sessions.add(file, laps);
            StatusCode::NO_CONTENT.into_response()
        }
        Err(error) => (StatusCode::BAD_REQUEST, error.to_string()).into_response(),
    })
    .await
}

/// Runs what reads files or computes for long beside the server's own threads.
async fn on_a_thread(work: impl FnOnce() -> Response + Send + 'static) -> Response {
    match tokio::task::spawn_blocking(work).await {
        Ok(response) => response,
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}
