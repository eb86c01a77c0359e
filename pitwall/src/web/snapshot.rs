//! What the page shows, many times a second.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use axum::Json;
use axum::extract::State;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::response::Response;
use protocol::{CarName, Command};
use serde::{Deserialize, Serialize};
use tokio::time::MissedTickBehavior;

use super::App;
use crate::fleet::Lap;
use crate::fleet::LogEntry;
use crate::fleet::{Car, CarView};
use crate::fleet::{HealthSample, ProfileCell};
use crate::recording::RecordingProgress;
use crate::replay::ReplayView;

/// Snapshots per second.
const RATE: f64 = 15.0;
/// Log lines that a page gets when it connects.
const HISTORY: u64 = 300;
/// A browser that does not take a message within this time is let go.
const SLOW: Duration = Duration::from_secs(5);
/// How often the selected car's lap is painted anew.
const REPAINT: Duration = Duration::from_secs(1);
/// A page that has not drawn its last snapshot gets no other for this long: it would wait in the browser and grow old
/// there. A page in the background draws nothing, and lives on what comes then.
const UNDRAWN: Duration = Duration::from_millis(400);

/// All cars at one moment.
#[derive(Serialize)]
pub(super) struct Snapshot {
    /// When [unix ns]; in a replay, when in the recording.
    now: i64,
    /// When it was made, by the laptop's clock [unix ns].
    made: i64,
    /// Counts the snapshots of this page, from 1.
    number: u64,
    /// Another one than before: all that was said before is void.
    epoch: u64,
    cars: Vec<CarView>,
    /// Cars with a map to fetch.
    maps: Vec<CarName>,
    recording: Option<RecordingView>,
    /// Room on the recordings' disk [bytes].
    disk_free: Option<u64>,
    /// Particles and end points of the selected car.
    selected: Option<Selected>,
    /// What happened since the last snapshot.
    log: Vec<LogEntry>,
    /// Alarms up to this line have been acknowledged.
    acknowledged: u64,
    /// Who looks at a page.
    operators: Vec<String>,
    replay: Option<ReplayView>,
    /// In the first snapshot that a page gets.
    #[serde(skip_serializing_if = "Option::is_none")]
    hello: Option<Hello>,
}

/// What a page needs to know once.
#[derive(Serialize)]
struct Hello {
    /// True when the Rerun viewer is built in.
    rerun: bool,
    /// The last two minutes of each car.
    history: BTreeMap<CarName, Vec<HealthSample>>,
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
    /// `[x, y, heading, weight]` [m, m, rad, 0..1].
    particles: Vec<[f32; 4]>,
    /// `[x, y, kind]` [m, m, see `EndPointKind`].
    end_points: Vec<[f32; 3]>,
    /// None when they are as they were.
    #[serde(skip_serializing_if = "Option::is_none")]
    laps: Option<Vec<Lap>>,
    /// Health along the lap; None when it is as it was.
    #[serde(skip_serializing_if = "Option::is_none")]
    health_profile: Option<Vec<Option<ProfileCell>>>,
}

/// What a page says.
#[derive(Deserialize)]
#[serde(untagged)]
enum Said {
    Drawn(Drawn),
    Wish(Wish),
}

/// It has drawn a snapshot.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Drawn {
    /// Its number.
    drawn: u64,
}

/// It wants something.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Wish {
    /// The car whose particles and end points it wants.
    select: Option<CarName>,
    /// Who looks at it.
    operator: Option<String>,
}

/// What one page has been sent.
#[derive(Default)]
struct Seen {
    /// The last snapshot.
    number: u64,
    /// The last log line.
    log: u64,
    epoch: Option<u64>,
    /// The selected car, how many laps it had, and when its lap was painted.
    car: Option<(CarName, usize, Instant)>,
}

impl Seen {
    fn nothing(app: &App) -> Self {
        Self {
            log: app.bus.fleet().log().last().saturating_sub(HISTORY),
            ..Self::default()
        }
    }

    /// Details of `car`, leaving out what is as it was.
    fn details(&mut self, car: &Car) -> Selected {
        let count = car.laps().len();
        let (laps_known, painted) = match &self.car {
            Some((name, laps, painted)) if *name == car.name => (Some(*laps), Some(*painted)),
            _ => (None, None),
        };
        let paint = painted.is_none_or(|at| at.elapsed() >= REPAINT);
        let painted = if paint {
            Instant::now()
        } else {
            painted.unwrap_or_else(Instant::now)
        };
        self.car = Some((car.name.clone(), count, painted));
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
            health_profile: paint.then(|| car.health_profile().to_vec()),
        }
    }
}

impl Snapshot {
    /// The cars now, and what happened since the page was told last.
    fn take(app: &App, selected: Option<&CarName>, seen: &mut Seen) -> Self {
        let now = app.now();
        let fleet = app.bus.fleet();
        let epoch = fleet.epoch();
        let anew = seen.epoch.replace(epoch) != Some(epoch);
        if anew {
            *seen = Seen {
                number: seen.number,
                ..Self::anew(&fleet, epoch)
            };
        }
        seen.number += 1;
        let log = fleet.log().since(seen.log).cloned().collect();
        seen.log = fleet.log().last();
        let hello = anew.then(|| Hello {
            rerun: cfg!(feature = "rerun"),
            history: fleet
                .cars()
                .map(|car| (car.name.clone(), car.history().copied().collect()))
                .collect(),
        });
        let selected = selected
            .and_then(|name| fleet.car(name))
            .map(|car| seen.details(car));
        let cars = fleet.view(now);
        let maps = fleet
            .cars()
            .filter(|car| car.map.is_some())
            .map(|car| car.name.clone())
            .collect();
        let acknowledged = fleet.log().acknowledged();
        drop(fleet);
        Self {
            now,
            made: crate::clock::unix_now(),
            number: seen.number,
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
            operators: app.present.names(),
            replay: app.replay.as_ref().map(|replay| replay.view()),
            hello,
        }
    }

    fn anew(fleet: &crate::fleet::Fleet, epoch: u64) -> Seen {
        Seen {
            log: fleet.log().last().saturating_sub(HISTORY),
            epoch: Some(epoch),
            ..Seen::default()
        }
    }
}

pub(super) async fn once(State(app): State<App>) -> Json<Snapshot> {
    let mut seen = Seen::nothing(&app);
    Json(Snapshot::take(&app, None, &mut seen))
}

pub(super) async fn socket(State(app): State<App>, upgrade: WebSocketUpgrade) -> Response {
    upgrade
        .max_message_size(4096)
        .on_upgrade(move |socket| follow(app, socket))
}

/// Sends snapshots until the page goes away. Each is made when it is sent, and sent when the one before has been drawn:
/// a slow page gets fewer, never older ones.
async fn follow(app: App, mut socket: WebSocket) {
    let mut selected: Option<CarName> = None;
    let mut seen = Seen::nothing(&app);
    let present = app.present.enter();
    let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / RATE));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut drawn = 0;
    let mut sent_at = Instant::now();
    loop {
        let undrawn = drawn < seen.number && sent_at.elapsed() < UNDRAWN;
        tokio::select! {
            // When the page becomes ready after a tick that it has missed, the tick is taken at once.
            _ = ticks.tick(), if !undrawn => {
                sent_at = Instant::now();
                let snapshot = Snapshot::take(&app, selected.as_ref(), &mut seen);
                let Ok(text) = serde_json::to_string(&snapshot) else { return };
                let sent = tokio::time::timeout(SLOW, socket.send(Message::Text(text.into()))).await;
                if !matches!(sent, Ok(Ok(()))) {
                    return;
                }
            }
            () = tokio::time::sleep(UNDRAWN.saturating_sub(sent_at.elapsed())), if undrawn => {}
            message = socket.recv() => match message {
                Some(Ok(Message::Text(text))) => match serde_json::from_str(&text) {
                    Ok(Said::Drawn(said)) => drawn = said.drawn,
                    Ok(Said::Wish(wish)) => {
                        selected = wish.select;
                        if let Some(mut operator) = wish.operator {
                            operator.truncate(operator.floor_char_boundary(Command::MAX_OPERATOR));
                            present.is(operator);
                        }
                    }
                    Err(error) => tracing::debug!(%error, "a page said something strange"),
                },
                Some(Ok(_)) => {}
                Some(Err(_)) | None => return,
            },
            () = app.stopped() => return,
        }
    }
}
