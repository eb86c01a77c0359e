//! What the page asks for and commands.

use axum::Json;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use protocol::{Action, CarName, Command, CommandId};
use serde::Deserialize;
use serde_json::json;

use super::App;
use crate::ask::{PATIENCE, new_command_id};
use crate::link::unix_now;

/// The map of a car.
pub(super) async fn map(State(app): State<App>, Path(car): Path<CarName>) -> Response {
    let map = app.hub.fleet().car(&car).and_then(|car| car.map.clone());
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
    /// Given again, the command is the same one: it does nothing more.
    id: Option<CommandId>,
    action: Action,
}

/// Gives a car a command and says what became of it, with a text for the operator.
pub(super) async fn command(State(app): State<App>, Json(request): Json<CommandRequest>) -> Response {
    let CommandRequest {
        car,
        operator,
        expected_revision,
        id,
        action,
    } = request;
    let command = Command {
        id: id.unwrap_or_else(new_command_id),
        operator,
        expected_revision,
        action,
    };
    match app.hub.link().send(&car, &command, PATIENCE).await {
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
}

/// Begins or ends a recording, in a file named by the time.
pub(super) async fn record(State(app): State<App>, Json(request): Json<RecordRequest>) -> Response {
    if request.on {
        let file = app
            .recordings
            .join(format!("session-{}.mcap", unix_now() / 1_000_000_000));
        match app.hub.start_recording(&file).await {
            Ok(()) => Json(json!({"recording": file.display().to_string()})).into_response(),
            Err(error) => (StatusCode::CONFLICT, error.to_string()).into_response(),
        }
    } else {
        match app.hub.stop_recording().await {
            Some(Ok(summary)) => {
                Json(json!({"missing": summary.missing(), "summary": summary})).into_response()
            }
            Some(Err(error)) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
            None => (StatusCode::CONFLICT, "no recording is going on").into_response(),
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MarkRequest {
    car: CarName,
    operator: String,
    text: String,
}

/// Marks this moment in the log and the recording.
pub(super) async fn mark(State(app): State<App>, Json(request): Json<MarkRequest>) -> Response {
    const LONGEST: usize = 500;
    let MarkRequest { car, operator, text } = request;
    if text.len() > LONGEST || operator.len() > Command::MAX_OPERATOR {
        return (StatusCode::BAD_REQUEST, "too long").into_response();
    }
    if app.hub.fleet().car(&car).is_none() {
        return (StatusCode::NOT_FOUND, format!("no such car: {car}")).into_response();
    }
    app.hub.mark(&car, &operator, &text);
    StatusCode::NO_CONTENT.into_response()
}
