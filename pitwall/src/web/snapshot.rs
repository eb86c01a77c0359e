//! What the page shows, many times a second.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use axum::extract::State;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use protocol::{CarName, Command};
use serde::{Deserialize, Serialize};
use tokio::time::MissedTickBehavior;

use super::App;
use super::guard::Access;
use super::operators::OpenPage;
use crate::fleet::Lap;
use crate::fleet::LogEntry;
use crate::fleet::{Car, CarView};
use crate::fleet::{HealthSample, ProfileCell};
use crate::recording::RecordingProgress;
use crate::replay::ReplayView;

/// Snapshots per second.
const RATE: f64 = 15.0;
/// Log entries that a page gets when it connects.
const HISTORY: u64 = 300;
/// A browser that does not accept a message within this time is disconnected.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);
/// Period at which the selected car's health profile is sent.
const PROFILE_PERIOD: Duration = Duration::from_secs(1);
/// A page that has not drawn its last snapshot gets no other for this long, because it would only wait in the browser. A
/// page in the background draws nothing and still gets a snapshot after this time.
const DRAW_TIMEOUT: Duration = Duration::from_millis(400);

/// All cars at one moment.
#[derive(Serialize)]
pub(super) struct Snapshot {
    /// The time shown \[unix ns\]; in a replay, the recording's time.
    now: i64,
    /// When it was made, by the laptop's clock \[unix ns\].
    made: i64,
    /// Counts the snapshots of this page, from 1.
    number: u64,
    /// When it differs from the last one, everything sent before is void.
    epoch: u64,
    cars: Vec<CarView>,
    /// Cars with a map to fetch.
    maps: Vec<CarName>,
    recording: Option<RecordingView>,
    /// Free space on the disk of the recordings \[bytes\].
    disk_free: Option<u64>,
    /// Particles and end points of the selected car.
    selected: Option<Selected>,
    /// New log entries.
    log: Vec<LogEntry>,
    /// Alarms up to this entry have been acknowledged.
    acknowledged: u64,
    /// Changes when laps or sessions of the analysis do.
    analysed: u64,
    /// The operators of all open pages.
    operators: Vec<String>,
    replay: Option<ReplayView>,
    /// Only in the first snapshot of a page.
    #[serde(skip_serializing_if = "Option::is_none")]
    hello: Option<Hello>,
}

/// What a page gets once.
#[derive(Serialize)]
struct Hello {
    /// True when the Rerun viewer is built in.
    rerun: bool,
    /// What everybody must know about the network; None when it is protected.
    warning: Option<String>,
    /// The operator whose token this page has; None when the operator types a name.
    operator: Option<String>,
    /// The last two minutes of each car.
    history: BTreeMap<CarName, Vec<HealthSample>>,
    /// The alarms that nobody has acknowledged, however old they are.
    open: Vec<LogEntry>,
}

#[derive(Serialize)]
struct RecordingView {
    file: String,
    #[serde(flatten)]
    progress: RecordingProgress,
}

#[derive(Serialize)]
struct Selected {
    car: CarName,
    /// `[x, y, heading, weight]` \[m, m, rad, 0..1\].
    particles: Vec<[f32; 4]>,
    /// `[x, y, kind]` \[m, m, a number of `EndPointKind`\].
    end_points: Vec<[f32; 3]>,
    /// None when they have not changed.
    #[serde(skip_serializing_if = "Option::is_none")]
    laps: Option<Vec<Lap>>,
    /// Health along the lap; None when it is not due.
    #[serde(skip_serializing_if = "Option::is_none")]
    health_profile: Option<Vec<Option<ProfileCell>>>,
}

/// A message from a page.
#[derive(Deserialize)]
#[serde(untagged)]
enum PageMessage {
    Drawn(Drawn),
    Settings(PageSettings),
}

/// The page has drawn a snapshot.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Drawn {
    /// Its number.
    drawn: u64,
}

/// What the page shows, and to whom.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PageSettings {
    /// The selected car: the page gets its particles and end points.
    select: Option<CarName>,
    /// The operator of the page.
    operator: Option<String>,
}

/// What has been sent to one page.
#[derive(Default)]
struct SentState {
    /// The last snapshot.
    number: u64,
    /// The last log entry.
    log: u64,
    epoch: Option<u64>,
    /// The selected car, its number of laps, and when its health profile was sent.
    car: Option<(CarName, u64, Instant)>,
    access: Access,
}

impl SentState {
    fn new(app: &App, access: Access) -> Self {
        Self {
            access,
            log: app.bus.fleet().log().last().saturating_sub(HISTORY),
            ..Self::default()
        }
    }

    /// Details of `car`, without what has not changed.
    fn details(&mut self, car: &Car) -> Selected {
        let count = car.lap_changes();
        let (laps_known, profile_sent) = match &self.car {
            Some((name, laps, profile_sent)) if *name == car.name => (Some(*laps), Some(*profile_sent)),
            _ => (None, None),
        };
        let profile_due = profile_sent.is_none_or(|at| at.elapsed() >= PROFILE_PERIOD);
        let profile_sent = if profile_due {
            Instant::now()
        } else {
            profile_sent.unwrap_or_else(Instant::now)
        };
        self.car = Some((car.name.clone(), count, profile_sent));
        Selected {
            car: car.name.clone(),
            particles: car
                .cloud
                .iter()
                .flat_map(|cloud| {
                    cloud.particles.iter().map(|&particle| {
                        let pose = cloud.pose(particle);
                        let weight = f32::from(particle.weight) / 65535.0;
                        [pose.x as f32, pose.y as f32, pose.heading as f32, weight]
                    })
                })
                .collect(),
            end_points: car
                .scan
                .iter()
                .flat_map(|scan| {
                    scan.points.iter().map(|&point| {
                        let [x, y] = scan.point(point);
                        [x as f32, y as f32, f32::from(u8::from(point.kind))]
                    })
                })
                .collect(),
            laps: (laps_known != Some(count)).then(|| car.laps().to_vec()),
            health_profile: profile_due.then(|| car.health_profile().to_vec()),
        }
    }
}

impl Snapshot {
    /// The cars now, and the log entries since the last snapshot.
    fn take(app: &App, selected: Option<&CarName>, sent_state: &mut SentState) -> Self {
        let now = app.now();
        let fleet = app.bus.fleet();
        let epoch = fleet.epoch();
        let anew = sent_state.epoch.replace(epoch) != Some(epoch);
        if anew {
            *sent_state = SentState {
                number: sent_state.number,
                access: std::mem::take(&mut sent_state.access),
                ..Self::restarted(&fleet, epoch)
            };
        }
        sent_state.number += 1;
        let log = fleet.log().since(sent_state.log).cloned().collect();
        sent_state.log = fleet.log().last();
        let hello = anew.then(|| Hello {
            rerun: cfg!(feature = "rerun"),
            open: fleet.log().open().cloned().collect(),
            warning: app
                .service
                .as_ref()
                .and_then(|service| service.warning())
                .map(str::to_owned),
            operator: sent_state.access.operator.clone(),
            history: fleet
                .cars()
                .map(|car| (car.name.clone(), car.history().copied().collect()))
                .collect(),
        });
        let selected = selected
            .and_then(|name| fleet.car(name))
            .map(|car| sent_state.details(car));
        let cars = fleet.view(now);
        let maps = fleet
            .cars()
            .filter(|car| car.map.is_some())
            .map(|car| car.name.clone())
            .collect();
        let acknowledged = fleet.log().acknowledged();
        let ended: u64 = fleet.cars().map(|car| car.book().ended()).sum();
        let analysed = ended + app.sessions.count() as u64 * 1_000_000;
        drop(fleet);
        Self {
            now,
            made: crate::clock::unix_now(),
            number: sent_state.number,
            epoch,
            cars,
            maps,
            recording: app.bus.recording().map(|(file, progress)| RecordingView {
                file: file.display().to_string(),
                progress,
            }),
            disk_free: app.disk_free(),
            selected,
            log,
            acknowledged,
            analysed,
            operators: app.operators.names(),
            replay: app.replay.as_ref().map(|replay| replay.view()),
            hello,
        }
    }

    fn restarted(fleet: &crate::fleet::Fleet, epoch: u64) -> SentState {
        SentState {
            log: fleet.log().last().saturating_sub(HISTORY),
            epoch: Some(epoch),
            ..SentState::default()
        }
    }
}

pub(super) async fn once(State(app): State<App>, Extension(access): Extension<Access>) -> Json<Snapshot> {
    let mut sent_state = SentState::new(&app, access);
    Json(Snapshot::take(&app, None, &mut sent_state))
}

pub(super) async fn socket(
    State(app): State<App>,
    Extension(access): Extension<Access>,
    upgrade: WebSocketUpgrade,
) -> Response {
    let Some(page) = app.operators.open_page() else {
        return (StatusCode::SERVICE_UNAVAILABLE, "too many pages are open").into_response();
    };
    upgrade
        .max_message_size(4096)
        .on_upgrade(move |socket| follow(app, access, page, socket))
}

/// Sends snapshots until the page is closed. Each is made when it is sent, after the one before has been drawn. A slow
/// page therefore gets fewer snapshots, but no old ones.
async fn follow(app: App, access: Access, page: OpenPage, mut socket: WebSocket) {
    let mut selected: Option<CarName> = None;
    let mut sent_state = SentState::new(&app, access.clone());
    let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / RATE));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut drawn = 0;
    let mut sent_at = Instant::now();
    loop {
        let undrawn = drawn < sent_state.number && sent_at.elapsed() < DRAW_TIMEOUT;
        tokio::select! {
            // A page that becomes ready after a missed tick gets its snapshot at once.
            _ = ticks.tick(), if !undrawn => {
                sent_at = Instant::now();
                let snapshot = Snapshot::take(&app, selected.as_ref(), &mut sent_state);
                let Ok(text) = serde_json::to_string(&snapshot) else { return };
                let sent = tokio::time::timeout(SEND_TIMEOUT, socket.send(Message::Text(text.into()))).await;
                if !matches!(sent, Ok(Ok(()))) {
                    return;
                }
            }
            () = tokio::time::sleep(DRAW_TIMEOUT.saturating_sub(sent_at.elapsed())), if undrawn => {}
            message = socket.recv() => match message {
                Some(Ok(Message::Text(text))) => match serde_json::from_str(&text) {
                    Ok(PageMessage::Drawn(message)) => drawn = message.drawn,
                    Ok(PageMessage::Settings(settings)) => {
                        selected = settings.select;
                        if let Some(operator) = settings.operator {
                            let mut operator = access.name(operator);
                            operator.truncate(operator.floor_char_boundary(Command::MAX_OPERATOR));
                            page.set_operator(&operator);
                        }
                    }
                    Err(error) => tracing::debug!(%error, "a page sent an unknown message"),
                },
                Some(Ok(_)) => {}
                Some(Err(_)) | None => return,
            },
            () = app.stopped() => return,
        }
    }
}
