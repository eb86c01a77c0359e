//! Converts messages to JSON for other tools, in Foxglove's schemas if there is one.
//!
//! Most of what is recorded passes here. So the messages are structs that are written as they are, and no tree of values is
//! built for each.

use std::fmt;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use protocol::{CarName, Cloud, Event, EventKind, Header, MapReply, Pose2, ScanView, Severity, Telemetry};
use serde::Serialize;
use serde_json::{Value, json};

/// Writes JSON messages.
pub(super) trait JsonSink {
    /// Why a message cannot be written.
    type Error;

    /// Writes a message. `channel` is the last part of the channel, after `/<car>/`; `schema` is the name of the schema.
    fn write(
        &mut self,
        channel: &'static str,
        schema: &'static str,
        message: &impl Serialize,
    ) -> Result<(), Self::Error>;
}

/// Writes the JSON messages for a message on a live topic.
pub(super) fn export<S: JsonSink>(
    car: &CarName,
    header: &Header,
    telemetry: &Telemetry,
    sink: &mut S,
) -> Result<(), S::Error> {
    let timestamp = Timestamp::of(header.sensor);
    match telemetry {
        Telemetry::Pose(pose) => {
            sink.write(
                "pose",
                "foxglove.PoseInFrame",
                &PoseInFrame::new(timestamp, pose.pose),
            )?;
            sink.write(
                "tf",
                "foxglove.FrameTransform",
                &FrameTransform::new(timestamp, car, pose.pose),
            )?;
            sink.write("state", "synpf.Pose", &Stamped::new(timestamp, pose))
        }
        Telemetry::Cloud(cloud) => sink.write(
            "cloud",
            "foxglove.PosesInFrame",
            &PosesInFrame {
                timestamp,
                frame_id: MAP,
                poses: Particles(cloud),
            },
        ),
        Telemetry::Scan(scan) => sink.write(
            "scan",
            "foxglove.PointCloud",
            &PointCloud {
                timestamp,
                frame_id: MAP,
                pose: Pose2::default().into(),
                point_stride: 13,
                fields: [
                    PackedField::new("x", 0, NumericType::Float32),
                    PackedField::new("y", 4, NumericType::Float32),
                    PackedField::new("z", 8, NumericType::Float32),
                    PackedField::new("kind", 12, NumericType::Uint8),
                ],
                data: BASE64.encode(end_points(scan)),
            },
        ),
        Telemetry::Health(health) => sink.write("health", "synpf.Health", &Stamped::new(timestamp, health)),
        Telemetry::Load(load) => sink.write("load", "synpf.Load", &Stamped::new(timestamp, load)),
        Telemetry::Params(params) => sink.write("params", "synpf.Params", &Stamped::new(timestamp, params)),
        Telemetry::Shadow(shadow) => sink.write("shadow", "synpf.Shadow", &Stamped::new(timestamp, shadow)),
        Telemetry::Event(event) => {
            let at = if header.sensor == 0 {
                header.published
            } else {
                header.sensor
            };
            sink.write("event", "foxglove.Log", &Log::new(Timestamp::of(at), car, event))
        }
        Telemetry::Truth(truth) => sink.write(
            "truth",
            "foxglove.PoseInFrame",
            &PoseInFrame::new(timestamp, truth.pose),
        ),
        Telemetry::Odometry(_) | Telemetry::RecordedScan(_) => Ok(()),
    }
}

/// Writes the map as JSON.
pub(super) fn export_map<S: JsonSink>(map: &MapReply, at: i64, sink: &mut S) -> Result<(), S::Error> {
    let grid = Grid {
        timestamp: Timestamp::of(at),
        frame_id: MAP,
        pose: map.origin.into(),
        column_count: map.width,
        cell_size: CellSize {
            x: map.resolution,
            y: map.resolution,
        },
        row_stride: map.width,
        cell_stride: 1,
        fields: [PackedField::new("occupancy", 0, NumericType::Uint8)],
        data: BASE64.encode(map.occupancy()),
    };
    sink.write("map", "foxglove.Grid", &grid)
}

/// The JSON schema of a message with this name, made from `example`.
pub(super) fn schema(name: &str, example: &Value) -> Value {
    let mut schema = shape(example);
    schema["title"] = json!(name);
    for (field, encoding) in [("data", "base64")] {
        if schema["properties"].get(field).is_some() {
            schema["properties"][field]["contentEncoding"] = json!(encoding);
        }
    }
    schema
}

/// The schema of a value's type. A null value may be of any type.
fn shape(value: &Value) -> Value {
    match value {
        Value::Null => json!({}),
        Value::Bool(_) => json!({"type": "boolean"}),
        Value::Number(number) if number.is_f64() => json!({"type": "number"}),
        Value::Number(_) => json!({"type": "integer"}),
        Value::String(_) => json!({"type": "string"}),
        Value::Array(items) => {
            let items = items.first().map_or(json!({}), shape);
            json!({"type": "array", "items": items})
        }
        Value::Object(fields) => {
            let properties: serde_json::Map<_, _> = fields
                .iter()
                .map(|(name, value)| (name.clone(), shape(value)))
                .collect();
            json!({"type": "object", "properties": properties})
        }
    }
}

/// The frame of all poses.
const MAP: &str = "map";

/// Foxglove's numbers for the types of packed fields.
#[derive(Clone, Copy)]
enum NumericType {
    Uint8 = 1,
    Float32 = 7,
}

#[derive(Clone, Copy, Serialize)]
struct Timestamp {
    sec: i64,
    nsec: i64,
}

impl Timestamp {
    fn of(unix_ns: i64) -> Self {
        let unix_ns = unix_ns.max(0);
        Self {
            sec: unix_ns / 1_000_000_000,
            nsec: unix_ns % 1_000_000_000,
        }
    }
}

#[derive(Serialize)]
struct Vector3 {
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Serialize)]
struct Quaternion {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

impl Quaternion {
    fn of(heading: f64) -> Self {
        let (sin, cos) = (heading / 2.0).sin_cos();
        Self {
            x: 0.0,
            y: 0.0,
            z: sin,
            w: cos,
        }
    }
}

#[derive(Serialize)]
struct PoseMessage {
    position: Vector3,
    orientation: Quaternion,
}

impl From<Pose2> for PoseMessage {
    fn from(pose: Pose2) -> Self {
        Self {
            position: Vector3 {
                x: pose.x,
                y: pose.y,
                z: 0.0,
            },
            orientation: Quaternion::of(pose.heading),
        }
    }
}

#[derive(Serialize)]
struct PoseInFrame {
    timestamp: Timestamp,
    frame_id: &'static str,
    pose: PoseMessage,
}

impl PoseInFrame {
    fn new(timestamp: Timestamp, pose: Pose2) -> Self {
        Self {
            timestamp,
            frame_id: MAP,
            pose: pose.into(),
        }
    }
}

#[derive(Serialize)]
struct FrameTransform<'a> {
    timestamp: Timestamp,
    parent_frame_id: &'static str,
    child_frame_id: Text<BaseLink<'a>>,
    translation: Vector3,
    rotation: Quaternion,
}

impl<'a> FrameTransform<'a> {
    fn new(timestamp: Timestamp, car: &'a CarName, pose: Pose2) -> Self {
        let PoseMessage {
            position,
            orientation,
        } = pose.into();
        Self {
            timestamp,
            parent_frame_id: MAP,
            child_frame_id: Text(BaseLink(car)),
            translation: position,
            rotation: orientation,
        }
    }
}

/// The name of a car's frame.
struct BaseLink<'a>(&'a CarName);

impl fmt::Display for BaseLink<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/base_link", self.0)
    }
}

/// Something that can be displayed, as a string.
struct Text<T>(T);

impl<T: fmt::Display> Serialize for Text<T> {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(&self.0)
    }
}

#[derive(Serialize)]
struct PosesInFrame<'a> {
    timestamp: Timestamp,
    frame_id: &'static str,
    poses: Particles<'a>,
}

/// The poses of a cloud.
struct Particles<'a>(&'a Cloud);

impl Serialize for Particles<'_> {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let cloud = self.0;
        serializer.collect_seq(
            cloud
                .particles
                .iter()
                .map(|&particle| PoseMessage::from(cloud.pose(particle))),
        )
    }
}

#[derive(Serialize)]
struct PackedField {
    name: &'static str,
    offset: u32,
    r#type: u8,
}

impl PackedField {
    fn new(name: &'static str, offset: u32, kind: NumericType) -> Self {
        Self {
            name,
            offset,
            r#type: kind as u8,
        }
    }
}

#[derive(Serialize)]
struct PointCloud {
    timestamp: Timestamp,
    frame_id: &'static str,
    pose: PoseMessage,
    point_stride: u32,
    fields: [PackedField; 4],
    data: String,
}

/// The end points of a scan in the layout of [`PointCloud`].
fn end_points(scan: &ScanView) -> Vec<u8> {
    let mut data = Vec::with_capacity(scan.points.len() * 13);
    for &end_point in &scan.points {
        for coordinate in scan.point(end_point) {
            data.extend_from_slice(&(coordinate as f32).to_le_bytes());
        }
        data.extend_from_slice(&0f32.to_le_bytes());
        data.push(end_point.kind.into());
    }
    data
}

#[derive(Serialize)]
struct CellSize {
    x: f64,
    y: f64,
}

#[derive(Serialize)]
struct Grid {
    timestamp: Timestamp,
    frame_id: &'static str,
    pose: PoseMessage,
    column_count: u32,
    cell_size: CellSize,
    row_stride: u32,
    cell_stride: u32,
    fields: [PackedField; 1],
    data: String,
}

#[derive(Serialize)]
struct Log<'a> {
    timestamp: Timestamp,
    level: u8,
    message: String,
    name: &'a CarName,
    file: &'static str,
    line: u64,
}

impl<'a> Log<'a> {
    fn new(timestamp: Timestamp, car: &'a CarName, event: &Event) -> Self {
        let level = match event.kind.severity() {
            _ if matches!(event.kind, EventKind::Error { .. }) => 5,
            Severity::Info => 2,
            Severity::Warning => 3,
            Severity::Critical => 4,
        };
        let who = event
            .who
            .as_ref()
            .map_or_else(String::new, |who| format!(" [{who}]"));
        Self {
            timestamp,
            level,
            message: format!("{}{who}", event.kind),
            name: car,
            file: "",
            line: event.update,
        }
    }
}

/// One of our own messages, with its time.
#[derive(Serialize)]
struct Stamped<'a, M> {
    timestamp: Timestamp,
    #[serde(flatten)]
    message: &'a M,
}

impl<'a, M> Stamped<'a, M> {
    fn new(timestamp: Timestamp, message: &'a M) -> Self {
        Self { timestamp, message }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use protocol::{Covariance, Pose, PoseKind, Twist2};

    pub(in super::super) fn pose() -> Pose {
        Pose {
            pose: Pose2::default(),
            twist: Twist2 {
                linear_x: 1.0,
                linear_y: 0.0,
                angular: 0.0,
            },
            covariance: Covariance::default(),
            track: None,
            lap: 0,
            update: 1,
            kind: PoseKind::Updated,
        }
    }

    #[test]
    fn a_schema_describes_its_message() {
        let message = json!({"timestamp": Timestamp::of(1_500_000_000), "x": 1.5, "names": ["a"], "data": "AA==", "no": null});
        assert_eq!(
            schema("test", &message),
            json!({
                "title": "test",
                "type": "object",
                "properties": {
                    "timestamp": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
                    "x": {"type": "number"},
                    "names": {"type": "array", "items": {"type": "string"}},
                    "data": {"type": "string", "contentEncoding": "base64"},
                    "no": {},
                },
            })
        );
    }

    #[test]
    fn a_quarter_turn_is_a_quaternion() {
        let z = Quaternion::of(std::f64::consts::FRAC_PI_2).z;
        assert!((z - std::f64::consts::FRAC_1_SQRT_2).abs() < 1e-12);
    }
}
