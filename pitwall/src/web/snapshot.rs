//! What the page shows, many times a second.

use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::response::Response;
use protocol::CarName;
use serde::{Deserialize, Serialize};
use tokio::time::MissedTickBehavior;

use super::App;
use crate::car::{CarView, Lap};
use crate::hub::Hub;
use crate::link::unix_now;
use crate::log::LogEntry;

/// Snapshots per second.
const RATE: f64 = 15.0;
/// Log lines that a page gets when it connects.
const HISTORY: u64 = 300;
/// A browser that does not take a message within this time is let go.
const SLOW: Duration = Duration::from_secs(5);

/// All cars at one moment.
#[derive(Serialize)]
pub(super) struct Snapshot {
    /// When [unix ns].
    now: i64,
    cars: Vec<CarView>,
    /// Cars with a map to fetch.
    maps: Vec<CarName>,
    recording: Option<RecordingView>,
    /// Particles and end points of the selected car.
    selected: Option<Selected>,
    /// What happened since the last snapshot.
    log: Vec<LogEntry>,
}

#[derive(Serialize)]
struct RecordingView {
    file: String,
    bytes: u64,
    seconds: f64,
    messages: u64,
    missing: u64,
    overrun: u64,
    error: Option<String>,
}

#[derive(Serialize)]
struct Selected {
    car: CarName,
    /// `[x, y, heading, weight]` [m, m, rad, 0..1].
    particles: Vec<[f64; 4]>,
    /// `[x, y, kind]` [m, m, see `EndPointKind`].
    end_points: Vec<[f64; 3]>,
    laps: Vec<Lap>,
}

/// What a page says.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Wish {
    /// The car whose particles and end points it wants.
    select: Option<CarName>,
}

impl Snapshot {
    /// The cars now, and the log after line `seen`.
    pub(super) fn take(hub: &Hub, selected: Option<&CarName>, seen: &mut u64) -> Self {
        let now = unix_now();
        let fleet = hub.fleet();
        let log = fleet.log().since(*seen).cloned().collect();
        *seen = fleet.log().last();
        let selected = selected.and_then(|name| fleet.car(name)).map(|car| Selected {
            car: car.name.clone(),
            particles: car
                .cloud
                .iter()
                .flat_map(|cloud| {
                    cloud.particles.iter().map(|&particle| {
                        let pose = cloud.pose(particle);
                        [pose.x, pose.y, pose.heading, f64::from(particle.weight) / 65535.0]
                    })
                })
                .collect(),
            end_points: car
                .scan
                .iter()
                .flat_map(|scan| {
                    scan.points.iter().map(|&point| {
                        let [x, y] = scan.point(point);
                        [x, y, f64::from(u8::from(point.kind))]
                    })
                })
                .collect(),
            laps: car.laps.clone(),
        });
        let cars = fleet.view(now);
        let maps = fleet
            .cars()
            .filter(|car| car.map.is_some())
            .map(|car| car.name.clone())
            .collect();
        drop(fleet);
        Self {
            now,
            cars,
            maps,
            recording: hub
                .recording()
                .zip(hub.recording_path())
                .map(|(status, file)| RecordingView {
                    file: file.display().to_string(),
                    bytes: status.bytes,
                    seconds: status.summary.duration_s,
                    messages: status.summary.messages,
                    missing: status.summary.missing(),
                    overrun: status.overrun,
                    error: status.error,
                }),
            selected,
            log,
        }
    }
}

pub(super) async fn once(State(app): State<App>) -> Json<Snapshot> {
    let mut seen = app.hub.fleet().log().last().saturating_sub(HISTORY);
    Json(Snapshot::take(&app.hub, None, &mut seen))
}

pub(super) async fn socket(State(app): State<App>, upgrade: WebSocketUpgrade) -> Response {
    upgrade
        .max_message_size(4096)
        .on_upgrade(move |socket| follow(app, socket))
}

/// Sends snapshots until the page goes away. Each is made when it is sent: a slow page gets fewer, never older ones.
async fn follow(app: App, mut socket: WebSocket) {
    let mut selected: Option<CarName> = None;
    let mut seen = app.hub.fleet().log().last().saturating_sub(HISTORY);
    let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / RATE));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            _ = ticks.tick() => {
                let snapshot = Snapshot::take(&app.hub, selected.as_ref(), &mut seen);
                let Ok(text) = serde_json::to_string(&snapshot) else { return };
                let sent = tokio::time::timeout(SLOW, socket.send(Message::Text(text.into()))).await;
                if !matches!(sent, Ok(Ok(()))) {
                    return;
                }
            }
            message = socket.recv() => match message {
                Some(Ok(Message::Text(text))) => match serde_json::from_str::<Wish>(&text) {
                    Ok(wish) => selected = wish.select,
                    Err(error) => tracing::debug!(%error, "a page said something strange"),
                },
                Some(Ok(_)) => {}
                Some(Err(_)) | None => return,
            },
            () = app.stopped() => return,
        }
    }
}
