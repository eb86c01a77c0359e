//! Requests of the page.

use std::path::PathBuf;

use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use protocol::{Action, CarName, Command, CommandId, Severity};
use serde::Deserialize;
use serde_json::json;

use super::App;
use super::guard::Access;
use crate::clock::unix_now;
use crate::fleet::Car;
use crate::network::{REPLY_TIMEOUT, new_command_id};
use crate::recording::RecorderOptions;

/// The map of a car.
pub(super) async fn map(State(app): State<App>, Path(car): Path<CarName>) -> Response {
    let map = app.bus.fleet().car(&car).and_then(|car| car.map.clone());
    match map {
        Some((map, _)) => Json(&*map).into_response(),
        None => (StatusCode::NOT_FOUND, format!("no map of {car} yet")).into_response(),
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CommandRequest {
    car: CarName,
    operator: String,
    expected_revision: Option<u64>,
    /// A command that is sent again with the same id has no further effect.
    id: Option<CommandId>,
    action: Action,
}

/// Sends a command to a car and returns its outcome, with a text for the operator.
pub(super) async fn command(
    State(app): State<App>,
    Extension(access): Extension<Access>,
    Json(request): Json<CommandRequest>,
) -> Response {
    let CommandRequest {
        car,
        operator,
        expected_revision,
        id,
        action,
    } = request;
    let command = Command {
        id: id.unwrap_or_else(new_command_id),
        operator: access.name(operator),
        expected_revision,
        action,
    };
    let Some(service) = &app.service else {
        return in_a_replay();
    };
    match service.client().send(&car, &command, REPLY_TIMEOUT).await {
        Ok(verdict) => Json(json!({
            "id": command.id,
            "done": verdict.exit_code() == 0,
            "text": verdict.text(&car),
            "verdict": verdict,
        }))
        .into_response(),
        Err(error) => (StatusCode::BAD_REQUEST, error.to_string()).into_response(),
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RecordRequest {
    on: bool,
    /// Another folder than the usual one, such as after the disk was full.
    folder: Option<PathBuf>,
    operator: String,
}

/// Starts or stops a recording, in a file named by the time.
pub(super) async fn record(
    State(app): State<App>,
    Extension(access): Extension<Access>,
    Json(request): Json<RecordRequest>,
) -> Response {
    let RecordRequest { on, folder, operator } = request;
    let operator = access.name(operator);
    let Some(service) = &app.service else {
        return in_a_replay();
    };
    if operator.len() > Command::MAX_OPERATOR {
        return too_long();
    }
    let log = |severity, text: String| {
        let who = Some(operator.clone());
        app.bus
            .fleet()
            .add_entry(unix_now(), None, severity, "recorder", text, who);
    };
    if on {
        let folder = folder.unwrap_or_else(|| app.recordings.to_path_buf());
        let file = folder.join(service.session_name());
        let options = RecorderOptions {
            operator: operator.clone(),
            ..app.recorder.clone()
        };
        match service.start_recording_with(&file, options).await {
            Ok(()) => {
                log(Severity::Info, format!("recording into {}", file.display()));
                Json(json!({"recording": file.display().to_string()})).into_response()
            }
            Err(error) => (StatusCode::CONFLICT, error.to_string()).into_response(),
        }
    } else {
        // It continues when the page closes the connection.
        let service = service.clone();
        let ended = tokio::spawn(async move { service.stop_recording().await });
        match ended.await.ok().flatten() {
            Some(Ok(summary)) => {
                let (messages, missing) = (summary.messages, summary.missing());
                let severity = if missing > 0 {
                    Severity::Warning
                } else {
                    Severity::Info
                };
                log(
                    severity,
                    format!("recording ended: {messages} messages, {missing} missing"),
                );
                Json(json!({"missing": missing, "summary": summary})).into_response()
            }
            Some(Err(error)) => {
                log(Severity::Critical, format!("recording failed: {error}"));
                (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response()
            }
            None => (StatusCode::CONFLICT, "nothing is being recorded").into_response(),
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MarkRequest {
    car: CarName,
    operator: String,
    text: String,
    /// The note is about this time up to now \[s\].
    #[serde(default)]
    for_s: Option<f64>,
    /// True for the run sheet of the car's heat, which is shown with the car and begins every recording.
    #[serde(default)]
    run_sheet: bool,
}

/// Marks this moment in the log and the recording.
pub(super) async fn mark(
    State(app): State<App>,
    Extension(access): Extension<Access>,
    Json(request): Json<MarkRequest>,
) -> Response {
    const LONGEST: usize = 500;
    let MarkRequest {
        car,
        operator,
        text,
        for_s,
        run_sheet,
    } = request;
    let text = match for_s {
        _ if run_sheet => format!("{}{text}", Car::RUN_SHEET),
        Some(for_s) if for_s.is_finite() && for_s > 0.0 => format!("over the last {for_s:.0} s: {text}"),
        _ => text,
    };
    let operator = access.name(operator);
    let Some(service) = &app.service else {
        return in_a_replay();
    };
    if text.len() > LONGEST || operator.len() > Command::MAX_OPERATOR {
        return too_long();
    }
    if app.bus.fleet().car(&car).is_none() {
        return (StatusCode::NOT_FOUND, format!("no such car: {car}")).into_response();
    }
    service.mark(&car, &operator, &text).await;
    StatusCode::NO_CONTENT.into_response()
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct AcknowledgeRequest {
    operator: String,
}

/// Acknowledges every alarm so far, for all pages and terminals.
pub(super) async fn acknowledge(
    State(app): State<App>,
    Extension(access): Extension<Access>,
    Json(request): Json<AcknowledgeRequest>,
) -> Response {
    let operator = access.name(request.operator);
    if operator.len() > Command::MAX_OPERATOR {
        return too_long();
    }
    match &app.service {
        Some(service) => service.acknowledge(&operator).await,
        None => app.bus.fleet().acknowledge(app.now(), &operator),
    }
    StatusCode::NO_CONTENT.into_response()
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DismissRequest {
    car: CarName,
    operator: String,
}

/// Hides a car that is gone, for all pages.
pub(super) async fn dismiss(
    State(app): State<App>,
    Extension(access): Extension<Access>,
    Json(request): Json<DismissRequest>,
) -> Response {
    let DismissRequest { car, operator } = request;
    let operator = access.name(operator);
    if operator.len() > Command::MAX_OPERATOR {
        return too_long();
    }
    if app.bus.fleet().dismiss(&car, app.now(), &operator) {
        StatusCode::NO_CONTENT.into_response()
    } else {
        (StatusCode::CONFLICT, format!("{car} is connected")).into_response()
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ReplayRequest {
    playing: Option<bool>,
    speed: Option<f64>,
    at: Option<f64>,
}

/// Plays, pauses, changes the speed or jumps.
pub(super) async fn replay(State(app): State<App>, Json(request): Json<ReplayRequest>) -> Response {
    let Some(replay) = &app.replay else {
        return (StatusCode::CONFLICT, "this is not a replay").into_response();
    };
    let ReplayRequest { playing, speed, at } = request;
    match replay.set_playback(playing, speed, at) {
        Ok(()) => Json(replay.view()).into_response(),
        Err(fault) => (StatusCode::BAD_REQUEST, fault).into_response(),
    }
}

fn in_a_replay() -> Response {
    (StatusCode::CONFLICT, "this is a replay: the cars are not there").into_response()
}

fn too_long() -> Response {
    (StatusCode::BAD_REQUEST, "too long").into_response()
}
