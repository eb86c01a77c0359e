//! The same events for the Rerun viewer: history and depth beside the page.
//!
//! What the engineer acts on is on the page; this is to look back and into things. Data is decimated, the server's
//! memory is capped, and nothing waits for a viewer.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use crossbeam_channel::Receiver;
use protocol::{CarName, Cloud, Health, MapReply, Params, Pose, ScanView, Severity, Telemetry, Topic};
use rerun::blueprint::{Blueprint, ContainerLike, Horizontal, Spatial3DView};
use rerun::blueprint::{StateTimelineView, TextLogView, TimeSeriesView, Vertical};
use rerun::grpc_server::GrpcServerSink;
use rerun::sink::{FileSink, LogSink};
use rerun::{
    Arrows3D, Boxes3D, Color, GridMap, LineStrips3D, MemoryLimit, PlaybackBehavior, Points3D, Quaternion,
    RecordingStream, RecordingStreamBuilder, RecordingStreamError, Scalars, ServerOptions, StateChange,
    TextLog, TextLogLevel, Transform3D,
};

use crate::event::{FleetEvent, Happening};

/// Where the data goes.
#[derive(Debug, Clone)]
pub enum RerunOutlet {
    /// Into a file.
    Save(PathBuf),
    /// To viewers that dial this port on loopback.
    Serve(u16),
    /// To a viewer that listens, as `rerun+http://127.0.0.1:9876/proxy`.
    Connect(String),
}

/// Data on its way to Rerun. Ends when the pit wall closes.
pub struct RerunView {
    stream: RecordingStream,
}

/// Why there is no such view.
#[derive(Debug, thiserror::Error)]
pub enum RerunError {
    /// Rerun refuses.
    #[error("rerun: {0}")]
    Stream(#[from] RecordingStreamError),
    /// The file cannot be written.
    #[error("{file}: {reason}")]
    File {
        /// The file.
        file: String,
        /// What is wrong.
        reason: String,
    },
    /// The port cannot be served.
    #[error("cannot serve rerun data on port {port}: {reason}")]
    Serve {
        /// The port.
        port: u16,
        /// What is wrong.
        reason: String,
    },
    /// The system gives no thread.
    #[error("no thread for rerun: {0}")]
    Thread(std::io::Error),
}

impl RerunView {
    /// History that the server keeps for viewers that come later [bytes].
    const MEMORY: u64 = 256 * 1024 * 1024;

    /// Begins to log `events`. [`RerunOutlet::Serve`] needs a tokio runtime.
    pub fn start(events: Receiver<Arc<FleetEvent>>, outlet: &RerunOutlet) -> Result<Self, RerunError> {
        let builder = RecordingStreamBuilder::new("pitwall").with_blueprint(blueprint());
        let stream = match outlet {
            RerunOutlet::Connect(url) => builder.connect_grpc_opts(url.as_str())?,
            RerunOutlet::Save(file) => {
                let sink = FileSink::new(file).map_err(|error| RerunError::File {
                    file: file.display().to_string(),
                    reason: error.to_string(),
                })?;
                with_sink(builder, Box::new(sink))?
            }
            &RerunOutlet::Serve(port) => {
                let options = ServerOptions {
                    playback_behavior: PlaybackBehavior::NewestFirst,
                    memory_limit: MemoryLimit::from_bytes(Self::MEMORY),
                    ..ServerOptions::default()
                };
                let sink =
                    GrpcServerSink::new("127.0.0.1", port, options).map_err(|error| RerunError::Serve {
                        port,
                        reason: error.to_string(),
                    })?;
                with_sink(builder, Box::new(sink))?
            }
        };
        let log = EventLog {
            stream: stream.clone(),
            last: HashMap::new(),
            trails: HashMap::new(),
        };
        std::thread::Builder::new()
            .name("rerun".to_owned())
            .spawn(move || log.run(&events))
            .map_err(RerunError::Thread)?;
        Ok(Self { stream })
    }

    /// Writes out what is waiting; gives up after a second.
    pub fn flush(&self) {
        if let Err(error) = self.stream.flush_with_timeout(std::time::Duration::from_secs(1)) {
            tracing::warn!(%error, "rerun");
        }
    }
}

fn with_sink(builder: RecordingStreamBuilder, sink: Box<dyn LogSink>) -> Result<RecordingStream, RerunError> {
    // Buffered until the sink is there, so that the blueprint is not lost.
    let stream = builder.buffered()?;
    stream.set_sinks(vec![sink]);
    Ok(stream)
}

/// The track from above, lanes for state and set, curves, and what happened.
fn blueprint() -> Blueprint {
    let curves =
        |name: &str, what: &str| TimeSeriesView::new(name).with_contents([format!("/plots/*/{what}")]);
    let lanes = StateTimelineView::new("state and set").with_contents(["/lanes/**"]);
    let right: [ContainerLike; 5] = [
        lanes.into(),
        curves("alignment", "alignment").into(),
        curves("slip", "slip").into(),
        curves("spread along [m]", "spread_along").into(),
        TextLogView::new("events").with_contents(["/events/**"]).into(),
    ];
    let track = Spatial3DView::new("track").with_origin("/track");
    let root = Horizontal::new([track.into(), Vertical::new(right).into()]).with_column_shares([3.0, 2.0]);
    Blueprint::new(root)
}

/// Turns events into what Rerun draws.
struct EventLog {
    stream: RecordingStream,
    last: HashMap<(CarName, Topic), i64>,
    trails: HashMap<CarName, Vec<[f32; 3]>>,
}

impl EventLog {
    /// Points of a trail: about twenty seconds.
    const TRAIL: usize = 400;
    /// Updates from one drawing of the trail to the next: about a second.
    const TRAIL_EVERY: u64 = 40;

    fn run(mut self, events: &Receiver<Arc<FleetEvent>>) {
        for event in events {
            if let Err(error) = self.log(&event) {
                tracing::warn!(%error, "rerun");
                return;
            }
        }
    }

    fn log(&mut self, event: &FleetEvent) -> Result<(), RecordingStreamError> {
        let car = &event.car;
        match &event.happening {
            Happening::Map { map, .. } => self.stream.log_static("track/map", &grid(map)),
            Happening::Message {
                topic,
                header,
                telemetry,
                ..
            } => {
                let at = if header.sensor == 0 {
                    header.published
                } else {
                    header.sensor
                };
                if !self.due(car, *topic, at) {
                    return Ok(());
                }
                self.stream.set_timestamp_nanos_since_epoch("time", at);
                match &**telemetry {
                    Telemetry::Pose(pose) => self.pose(car, pose),
                    Telemetry::Cloud(cloud) => self.cloud(car, cloud),
                    Telemetry::Scan(scan) => self.scan(car, scan),
                    Telemetry::Health(health) => self.health(car, health),
                    Telemetry::Params(params) => self.params(car, params),
                    Telemetry::Event(event) => {
                        let level = match event.kind.severity() {
                            Severity::Info => TextLogLevel::INFO,
                            Severity::Warning => TextLogLevel::WARN,
                            Severity::Critical => TextLogLevel::ERROR,
                        };
                        let line = TextLog::new(event.kind.to_string()).with_level(level);
                        self.stream.log(format!("events/{car}"), &line)
                    }
                    Telemetry::Load(load) => self.stream.log(
                        format!("plots/{car}/update_ms"),
                        &Scalars::single(f64::from(load.update_us.p99) / 1e3),
                    ),
                    Telemetry::Odometry(_)
                    | Telemetry::RecordedScan(_)
                    | Telemetry::Truth(_)
                    | Telemetry::Shadow(_) => Ok(()),
                }
            }
            _ => Ok(()),
        }
    }

    /// True when enough time has passed since the last message of this kind that was drawn.
    fn due(&mut self, car: &CarName, topic: Topic, at: i64) -> bool {
        const MILLISECOND: i64 = 1_000_000;
        let apart = match topic {
            Topic::Pose => 50 * MILLISECOND,
            Topic::Cloud | Topic::Scan => 200 * MILLISECOND,
            Topic::Health => 100 * MILLISECOND,
            Topic::Load | Topic::Params | Topic::Event => 0,
            _ => return false,
        };
        let last = self.last.entry((car.clone(), topic)).or_insert(i64::MIN);
        // A tenth less, so that a rate just at the limit is not halved.
        let due = at.saturating_sub(*last) >= apart - apart / 10;
        if due {
            *last = at;
        }
        due
    }

    fn pose(&mut self, car: &CarName, pose: &Pose) -> Result<(), RecordingStreamError> {
        let at = [pose.pose.x as f32, pose.pose.y as f32, 0.0];
        let trail = self.trails.entry(car.clone()).or_default();
        if trail.len() == Self::TRAIL {
            trail.remove(0);
        }
        trail.push(at);
        let colour = colour_of(car);
        // The whole trail is logged each time, so not each time.
        if pose.update % Self::TRAIL_EVERY < 2 {
            let line = LineStrips3D::new([trail.clone()])
                .with_colors([colour])
                .with_radii([0.02]);
            self.stream.log(format!("track/{car}/trail"), &line)?;
        }
        let body = format!("track/{car}/body");
        let transform = Transform3D::from_translation_rotation(at, turned(pose.pose.heading));
        self.stream.log(body.clone(), &transform)?;
        let outline = Boxes3D::from_centers_and_half_sizes([[0.16, 0.0, 0.08]], [[0.26, 0.14, 0.08]])
            .with_colors([colour])
            .with_labels([car.as_str()]);
        self.stream.log(format!("{body}/outline"), &outline)?;
        let ahead =
            Arrows3D::from_vectors([[pose.twist.linear_x as f32 * 0.2, 0.0, 0.0]]).with_colors([colour]);
        self.stream.log(format!("{body}/speed"), &ahead)?;
        let speed = pose.twist.linear_x.hypot(pose.twist.linear_y);
        self.stream
            .log(format!("plots/{car}/speed"), &Scalars::single(speed))
    }

    fn cloud(&self, car: &CarName, cloud: &Cloud) -> Result<(), RecordingStreamError> {
        let point = |&particle| {
            let pose = cloud.pose(particle);
            [pose.x as f32, pose.y as f32, 0.02]
        };
        let points = Points3D::new(cloud.particles.iter().map(point))
            .with_radii([0.01])
            .with_colors([colour_of(car)]);
        self.stream.log(format!("track/{car}/particles"), &points)
    }

    fn scan(&self, car: &CarName, scan: &ScanView) -> Result<(), RecordingStreamError> {
        let points = scan.points.iter().map(|&end_point| {
            let [x, y] = scan.point(end_point);
            [x as f32, y as f32, 0.05]
        });
        let colours = scan
            .points
            .iter()
            .map(|end_point| match u8::from(end_point.kind) {
                0 => Color::from_rgb(76, 195, 138),
                1 => Color::from_rgb(147, 160, 176),
                2 => Color::from_rgb(245, 179, 66),
                _ => Color::from_rgb(255, 93, 93),
            });
        let points = Points3D::new(points).with_radii([0.025]).with_colors(colours);
        self.stream.log(format!("track/{car}/scan"), &points)
    }

    fn health(&self, car: &CarName, health: &Health) -> Result<(), RecordingStreamError> {
        let state = StateChange::single(health.state.to_string());
        self.stream.log(format!("lanes/{car}/state"), &state)?;
        let Some(metrics) = &health.metrics else {
            return Ok(());
        };
        for (name, value) in [
            ("alignment", metrics.alignment),
            ("residual", metrics.residual),
            ("slip", metrics.slip),
            ("spread_along", metrics.spread_along),
            ("spread_across", metrics.spread_across),
        ] {
            self.stream
                .log(format!("plots/{car}/{name}"), &Scalars::single(f64::from(value)))?;
        }
        Ok(())
    }

    fn params(&self, car: &CarName, params: &Params) -> Result<(), RecordingStreamError> {
        let set = StateChange::single(params.set.name.as_str());
        self.stream.log(format!("lanes/{car}/set"), &set)
    }
}

/// The grid; its first row is its lowest, an image's its highest.
fn grid(map: &MapReply) -> GridMap {
    let cells = map.occupancy();
    let rows: Vec<_> = cells.chunks(map.width.max(1) as usize).rev().collect();
    let format = rerun::components::ImageFormat::from_color_model(
        [map.width, map.height],
        rerun::ColorModel::L,
        rerun::ChannelDatatype::U8,
    );
    GridMap::new(rows.concat(), format, map.resolution as f32)
        .with_translation([map.origin.x as f32, map.origin.y as f32, 0.0])
        .with_quaternion(turned(map.origin.heading))
        .with_colormap(rerun::components::Colormap::RvizMap)
}

/// A turn about the vertical [rad].
fn turned(heading: f64) -> Quaternion {
    let (sin, cos) = (heading / 2.0).sin_cos();
    Quaternion::from_xyzw([0.0, 0.0, sin as f32, cos as f32])
}

/// A car's own colour, the same in every session.
fn colour_of(car: &CarName) -> Color {
    const COLOURS: [[u8; 3]; 6] = [
        [90, 169, 255],
        [255, 157, 92],
        [185, 140, 255],
        [47, 208, 200],
        [255, 111, 174],
        [216, 216, 74],
    ];
    let sum: usize = car.as_str().bytes().map(usize::from).sum();
    let [r, g, b] = COLOURS[sum % COLOURS.len()];
    Color::from_rgb(r, g, b)
}
