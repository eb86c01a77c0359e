//! Converts events to Rerun's data.
//!
//! ```text
//! track/map                  the grid, once
//! track/CAR/body             pose, outline and speed; 20 times a second at most
//! track/CAR/trail            positions of about the last twenty seconds, once a second
//! track/CAR/particles, scan  5 times a second at most
//! lanes/CAR/state, set       in the page's colours
//! plots/CURVE/CAR            see `layout::CURVES`
//! events/CAR                 the log
//! ```
//!
//! The only timeline is `time`: the sensors' time, if a message has one.

use std::collections::{HashMap, HashSet, VecDeque};

use protocol::{CarName, Cloud, Health, MapReply, Params, Pose, ScanView, Severity, Telemetry, Topic};
use rerun::{
    Arrows3D, Boxes3D, Color, GridMap, LineStrips3D, Points3D, Quaternion, Radius, RecordingStream,
    RecordingStreamError, Scalars, SeriesLines, StateChange, StateConfiguration, TextLog, TextLogLevel,
    Transform3D,
};

use super::layout::{CURVES, Layout, curve};
use crate::event::{Delivery, EventPayload, FleetEvent};

type Logged = Result<(), RecordingStreamError>;

const SECOND: i64 = 1_000_000_000;
/// Number of points of a trail: about twenty seconds.
const TRAIL: usize = 400;
/// Period at which a trail is logged \[ns\]. It is logged whole each time.
const TRAIL_EVERY: i64 = SECOND;

/// Logs events to Rerun.
pub(super) struct EventLog {
    stream: RecordingStream,
    cars: HashMap<CarName, Drawn>,
    layout: Layout,
}

/// What is logged of one car.
struct Drawn {
    colour: Color,
    /// When a message of this topic was last logged \[unix ns\].
    last: HashMap<Topic, i64>,
    trail: VecDeque<[f32; 3]>,
    trail_at: i64,
    /// True when live messages arrive. The full-rate ones repeat them.
    live: bool,
    sets: HashSet<String>,
}

impl EventLog {
    pub(super) fn new(stream: RecordingStream) -> Self {
        Self {
            stream,
            cars: HashMap::new(),
            layout: Layout::default(),
        }
    }

    /// Logs an event to Rerun.
    pub(super) fn add(&mut self, event: &FleetEvent) -> Logged {
        let car = &event.car;
        if !self.cars.contains_key(car) {
            self.introduce(car)?;
        }
        if let Some(layout) = self.layout.learn(event) {
            layout.send(&self.stream)?;
        }
        match &event.payload {
            EventPayload::Map { map, .. } => self.stream.log_static("track/map", &grid(map)),
            EventPayload::Message {
                topic,
                header,
                telemetry,
                delivery,
                ..
            } => {
                let at = if header.sensor == 0 {
                    header.published
                } else {
                    header.sensor
                };
                let Some(drawn) = self.cars.get_mut(car) else {
                    return Ok(());
                };
                drawn.live |= *delivery == Delivery::Live;
                if (drawn.live && *delivery == Delivery::InOrder) || !drawn.due(*topic, at) {
                    return Ok(());
                }
                self.stream.set_timestamp_nanos_since_epoch("time", at);
                draw(&self.stream, car, drawn, at, telemetry)
            }
            EventPayload::Marker { who, text } => {
                self.stream.set_timestamp_nanos_since_epoch("time", event.at);
                let line = TextLog::new(format!("{text} [{who}]")).with_level(TextLogLevel::INFO);
                self.stream.log(format!("events/{car}"), &line)
            }
            _ => Ok(()),
        }
    }

    /// Sends the layout if it still waits, because no more events follow.
    pub(super) fn finish(mut self) -> Logged {
        match self.layout.settle() {
            Some(layout) => layout.send(&self.stream),
            None => Ok(()),
        }
    }

    /// Logs what does not change about a car.
    fn introduce(&mut self, car: &CarName) -> Logged {
        let colour = colour_of(self.cars.len());
        for (what, _) in CURVES {
            let line = SeriesLines::new()
                .with_colors([colour])
                .with_names([car.as_str()]);
            self.stream.log_static(curve(what, car), &line)?;
        }
        let delivery = StateConfiguration::new()
            .with_values(STATES.map(|(state, _)| state))
            .with_colors(STATES.map(|(_, [r, g, b])| Color::from_rgb(r, g, b)));
        self.stream.log_static(format!("lanes/{car}/state"), &delivery)?;
        let outline = Boxes3D::from_centers_and_half_sizes([[0.16, 0.0, 0.08]], [[0.26, 0.14, 0.08]])
            .with_colors([colour])
            .with_labels([car.as_str()]);
        self.stream
            .log_static(format!("track/{car}/body/outline"), &outline)?;
        let drawn = Drawn {
            colour,
            last: HashMap::new(),
            trail: VecDeque::with_capacity(TRAIL),
            trail_at: i64::MIN,
            live: false,
            sets: HashSet::new(),
        };
        self.cars.insert(car.clone(), drawn);
        Ok(())
    }
}

impl Drawn {
    /// True when enough time has passed since the last logged message of this topic.
    fn due(&mut self, topic: Topic, at: i64) -> bool {
        let apart = match topic {
            Topic::Pose => SECOND / 20,
            Topic::Cloud | Topic::Scan => SECOND / 5,
            Topic::Health => SECOND / 10,
            Topic::Load | Topic::Params | Topic::Event => 0,
            _ => return false,
        };
        let last = self.last.entry(topic).or_insert(i64::MIN);
        // A tenth less, so that a rate just at the limit is not halved. In a replay, time can jump back.
        let due =
            apart == 0 || at.saturating_sub(*last) >= apart - apart / 10 || last.saturating_sub(at) > SECOND;
        if due {
            *last = at;
        }
        due
    }
}

fn draw(
    stream: &RecordingStream,
    car: &CarName,
    drawn: &mut Drawn,
    at: i64,
    telemetry: &Telemetry,
) -> Logged {
    match telemetry {
        Telemetry::Pose(pose) => draw_pose(stream, car, drawn, at, pose),
        Telemetry::Cloud(cloud) => {
            stream.log(format!("track/{car}/particles"), &particles(cloud, drawn.colour))
        }
        Telemetry::Scan(scan) => stream.log(format!("track/{car}/scan"), &end_points(scan)),
        Telemetry::Health(health) => draw_health(stream, car, health),
        Telemetry::Params(params) => draw_set(stream, car, drawn, params),
        Telemetry::Event(event) => {
            let level = match event.kind.severity() {
                Severity::Info => TextLogLevel::INFO,
                Severity::Warning => TextLogLevel::WARN,
                Severity::Critical => TextLogLevel::ERROR,
            };
            let line = TextLog::new(event.kind.to_string()).with_level(level);
            stream.log(format!("events/{car}"), &line)
        }
        Telemetry::Load(load) => stream.log(
            curve("update_ms", car),
            &Scalars::single(f64::from(load.update_us.p99) / 1e3),
        ),
        Telemetry::Odometry(_) | Telemetry::RecordedScan(_) | Telemetry::Truth(_) | Telemetry::Shadow(_) => {
            Ok(())
        }
    }
}

fn draw_pose(stream: &RecordingStream, car: &CarName, drawn: &mut Drawn, time: i64, pose: &Pose) -> Logged {
    let at = [pose.pose.x as f32, pose.pose.y as f32, 0.0];
    if drawn.trail.len() == TRAIL {
        drawn.trail.pop_front();
    }
    // A jump of the estimate is not part of the path.
    if drawn
        .trail
        .back()
        .is_some_and(|last| (last[0] - at[0]).hypot(last[1] - at[1]) > 2.0)
    {
        drawn.trail.clear();
    }
    drawn.trail.push_back(at);
    // In a replay, time can jump back.
    if time.saturating_sub(drawn.trail_at) >= TRAIL_EVERY || time < drawn.trail_at {
        drawn.trail_at = time;
        let line = LineStrips3D::new([drawn.trail.iter().copied().collect::<Vec<_>>()])
            .with_colors([drawn.colour])
            .with_radii([Radius::new_ui_points(1.5)]);
        stream.log(format!("track/{car}/trail"), &line)?;
    }
    let body = format!("track/{car}/body");
    let transform = Transform3D::from_translation_rotation(at, turned(pose.pose.heading));
    stream.log(body.clone(), &transform)?;
    let ahead =
        Arrows3D::from_vectors([[pose.twist.linear_x as f32 * 0.2, 0.0, 0.0]]).with_colors([drawn.colour]);
    stream.log(format!("{body}/speed"), &ahead)?;
    let speed = pose.twist.linear_x.hypot(pose.twist.linear_y);
    stream.log(curve("speed", car), &Scalars::single(speed))
}

fn draw_health(stream: &RecordingStream, car: &CarName, health: &Health) -> Logged {
    let state = StateChange::single(health.state.to_string());
    stream.log(format!("lanes/{car}/state"), &state)?;
    let Some(metrics) = &health.metrics else {
        return Ok(());
    };
    for (what, value) in [
        ("alignment", metrics.alignment),
        ("slip", metrics.slip),
        ("spread_along", metrics.spread_along),
        ("spread_across", metrics.spread_across),
    ] {
        stream.log(curve(what, car), &Scalars::single(f64::from(value)))?;
    }
    Ok(())
}

/// The colour of a set, the same for all cars.
fn draw_set(stream: &RecordingStream, car: &CarName, drawn: &mut Drawn, params: &Params) -> Logged {
    let delivery = format!("lanes/{car}/set");
    let name = params.set.name.as_str();
    if drawn.sets.insert(name.to_owned()) {
        let mut names: Vec<&str> = drawn.sets.iter().map(String::as_str).collect();
        names.sort_unstable();
        let colours: Vec<Color> = names.iter().map(|name| colour_of_set(name)).collect();
        let sets = StateConfiguration::new().with_values(names).with_colors(colours);
        stream.log_static(delivery.clone(), &sets)?;
    }
    stream.log(delivery, &StateChange::single(name))
}

fn particles(cloud: &Cloud, colour: Color) -> Points3D {
    let point = |&particle| {
        let pose = cloud.pose(particle);
        [pose.x as f32, pose.y as f32, 0.02]
    };
    Points3D::new(cloud.particles.iter().map(point))
        .with_radii([Radius::new_ui_points(1.0)])
        .with_colors([colour])
}

fn end_points(scan: &ScanView) -> Points3D {
    let point = |&end_point| {
        let [x, y] = scan.point(end_point);
        [x as f32, y as f32, 0.05]
    };
    let colours = scan
        .points
        .iter()
        .map(|end_point| match u8::from(end_point.kind) {
            0 => Color::from_rgb(76, 195, 138),
            1 => Color::from_rgb(147, 160, 176),
            2 => Color::from_rgb(245, 179, 66),
            _ => Color::from_rgb(255, 107, 107),
        });
    Points3D::new(scan.points.iter().map(point))
        .with_radii([Radius::new_ui_points(1.8)])
        .with_colors(colours)
}

/// The grid. Its first row is the lowest; that of an image is the highest.
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

/// A rotation about the vertical axis \[rad\].
fn turned(heading: f64) -> Quaternion {
    let (sin, cos) = (heading / 2.0).sin_cos();
    Quaternion::from_xyzw([0.0, 0.0, sin as f32, cos as f32])
}

/// The page's colours of the states.
const STATES: [(&str, [u8; 3]); 7] = [
    ("INIT", [139, 149, 163]),
    ("CONVERGING", [90, 169, 255]),
    ("LOCALIZED", [76, 195, 138]),
    ("DEGRADED", [245, 179, 66]),
    ("LOST", [255, 107, 107]),
    ("RELOCALIZING", [90, 169, 255]),
    ("STALE", [200, 60, 60]),
];

/// A car's colour, by its order of appearance. It is that of the page if all cars are present from the start.
fn colour_of(index: usize) -> Color {
    const COLOURS: [[u8; 3]; 10] = [
        [90, 169, 255],
        [255, 157, 92],
        [185, 140, 255],
        [47, 208, 200],
        [255, 111, 174],
        [201, 201, 58],
        [127, 212, 107],
        [224, 122, 95],
        [159, 180, 255],
        [192, 160, 128],
    ];
    let [r, g, b] = COLOURS[index % COLOURS.len()];
    Color::from_rgb(r, g, b)
}

fn colour_of_set(name: &str) -> Color {
    let [r, g, b] = match name {
        "hq" => [28, 102, 184],
        "lq" => [181, 106, 16],
        "adaptive" => [122, 86, 190],
        _ => [110, 120, 135],
    };
    Color::from_rgb(r, g, b)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::sync::Arc;

    use super::*;
    use protocol::{Covariance, Header, Pose2, PoseKind, Schema, Stamps, Twist2};
    use rerun::RecordingStreamBuilder;
    use rerun::log::{Chunk, LogMsg};

    fn message(topic: Topic, delivery: Delivery, at: i64, telemetry: Telemetry) -> FleetEvent {
        FleetEvent {
            at,
            car: "car-1".parse().expect("a name"),
            payload: EventPayload::Message {
                topic,
                delivery,
                header: Header::new(
                    Schema::Pose,
                    1,
                    Stamps {
                        sensor: at,
                        ..Stamps::default()
                    },
                ),
                telemetry: Box::new(telemetry),
                bytes: Arc::default(),
            },
        }
    }

    fn pose() -> Telemetry {
        Telemetry::Pose(Pose {
            pose: Pose2 {
                x: 1.0,
                y: 2.0,
                heading: 0.5,
            },
            twist: Twist2::default(),
            covariance: Covariance::default(),
            track: None,
            lap: 0,
            update: 1,
            kind: PoseKind::Updated,
        })
    }

    /// Number of rows of each entity with a time, and number of times.
    fn rows(events: impl IntoIterator<Item = FleetEvent>) -> BTreeMap<String, usize> {
        let (stream, stored) = RecordingStreamBuilder::new("pitwall").memory().expect("a stream");
        stream.set_log_time_enabled(false);
        let mut log = EventLog::new(stream.clone());
        for event in events {
            log.add(&event).expect("drawn");
        }
        log.finish().expect("ended");
        stream.flush_blocking().expect("flushed");
        let mut rows = BTreeMap::new();
        for message in stored.take() {
            let LogMsg::ArrowMsg(store, arrow) = message else {
                continue;
            };
            let chunk = Chunk::from_arrow_msg(&arrow).expect("a chunk");
            if !store.is_blueprint() && !chunk.is_static() {
                assert_eq!(chunk.timelines().len(), 1, "{}", chunk.entity_path());
                *rows.entry(chunk.entity_path().to_string()).or_default() += chunk.num_rows();
            }
        }
        rows
    }

    #[test]
    fn ten_seconds_at_full_rate_are_decimated() {
        let events = (0..1000).map(|i| message(Topic::Pose, Delivery::Live, i * SECOND / 100, pose()));
        let rows = rows(events);
        assert_eq!(rows["/track/car-1/body"], 200, "{rows:?}");
        assert_eq!(rows["/plots/speed/car-1"], 200);
        assert_eq!(rows["/track/car-1/trail"], 10);
    }

    #[test]
    fn what_the_recorder_gets_once_more_is_drawn_once() {
        let twice = |i| {
            [Delivery::Live, Delivery::InOrder]
                .map(|delivery| message(Topic::Pose, delivery, i * SECOND, pose()))
        };
        assert_eq!(rows((0..10).flat_map(twice))["/track/car-1/body"], 10);
        let replayed = (0..10).map(|i| message(Topic::Pose, Delivery::InOrder, i * SECOND, pose()));
        assert_eq!(rows(replayed)["/track/car-1/body"], 10);
    }

    #[test]
    fn a_replay_that_jumps_back_is_drawn_on() {
        let times = [50, 51, 52, 10, 11];
        let events = times.map(|s| message(Topic::Pose, Delivery::InOrder, s * SECOND, pose()));
        let rows = rows(events);
        assert_eq!(rows["/track/car-1/body"], 5);
        assert_eq!(rows["/track/car-1/trail"], 5);
    }
}
