//! Converts messages to JSON for other tools, in Foxglove's schemas if there is one.

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use protocol::{
    CarName, Cloud, Event, EventKind, Header, MapReply, Pose, Pose2, ScanView, Severity, Telemetry,
};
use serde_json::{Value, json};

/// One message in JSON.
pub(super) struct Exported {
    /// The last part of the channel, after `/<car>/`.
    pub(super) channel: &'static str,
    /// Name of the schema.
    pub(super) schema: &'static str,
    /// The message.
    pub(super) json: Value,
}

/// The JSON messages for a message on a live topic.
pub(super) fn export(car: &CarName, header: &Header, telemetry: &Telemetry) -> Vec<Exported> {
    let exported = |channel, schema, json| Exported {
        channel,
        schema,
        json,
    };
    let time = timestamp(header.sensor);
    match telemetry {
        Telemetry::Pose(pose) => vec![
            exported(
                "pose",
                "foxglove.PoseInFrame",
                json!({"timestamp": time, "frame_id": "map", "pose": pose_json(pose.pose)}),
            ),
            exported("tf", "foxglove.FrameTransform", transform(car, &time, pose)),
            exported("state", "synpf.Pose", stamped(&time, pose)),
        ],
        Telemetry::Cloud(cloud) => vec![exported(
            "cloud",
            "foxglove.PosesInFrame",
            particles(&time, cloud),
        )],
        Telemetry::Scan(scan) => vec![exported("scan", "foxglove.PointCloud", end_points(&time, scan))],
        Telemetry::Health(health) => vec![exported("health", "synpf.Health", stamped(&time, health))],
        Telemetry::Load(load) => vec![exported("load", "synpf.Load", stamped(&time, load))],
        Telemetry::Params(params) => vec![exported("params", "synpf.Params", stamped(&time, params))],
        Telemetry::Shadow(shadow) => vec![exported("shadow", "synpf.Shadow", stamped(&time, shadow))],
        Telemetry::Event(event) => {
            let time = timestamp(if header.sensor == 0 {
                header.published
            } else {
                header.sensor
            });
            vec![exported("event", "foxglove.Log", log_line(car, &time, event))]
        }
        Telemetry::Truth(truth) => vec![exported(
            "truth",
            "foxglove.PoseInFrame",
            json!({"timestamp": time, "frame_id": "map", "pose": pose_json(truth.pose)}),
        )],
        Telemetry::Odometry(_) | Telemetry::RecordedScan(_) => Vec::new(),
    }
}

/// The map as JSON.
pub(super) fn export_map(map: &MapReply, at: i64) -> Exported {
    let data = map.occupancy();
    Exported {
        channel: "map",
        schema: "foxglove.Grid",
        json: json!({
            "timestamp": timestamp(at),
            "frame_id": "map",
            "pose": pose_json(map.origin),
            "column_count": map.width,
            "cell_size": {"x": map.resolution, "y": map.resolution},
            "row_stride": map.width,
            "cell_stride": 1,
            "fields": [{"name": "occupancy", "offset": 0, "type": NumericType::Uint8 as u8}],
            "data": BASE64.encode(data),
        }),
    }
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

/// Foxglove's numbers for the types of packed fields.
#[derive(Clone, Copy)]
enum NumericType {
    Uint8 = 1,
    Float32 = 7,
}

fn timestamp(unix_ns: i64) -> Value {
    let unix_ns = unix_ns.max(0);
    json!({"sec": unix_ns / 1_000_000_000, "nsec": unix_ns % 1_000_000_000})
}

fn quaternion(heading: f64) -> Value {
    let (sin, cos) = (heading / 2.0).sin_cos();
    json!({"x": 0.0, "y": 0.0, "z": sin, "w": cos})
}

fn pose_json(pose: Pose2) -> Value {
    json!({
        "position": {"x": pose.x, "y": pose.y, "z": 0.0},
        "orientation": quaternion(pose.heading),
    })
}

fn transform(car: &CarName, time: &Value, pose: &Pose) -> Value {
    json!({
        "timestamp": time,
        "parent_frame_id": "map",
        "child_frame_id": format!("{car}/base_link"),
        "translation": {"x": pose.pose.x, "y": pose.pose.y, "z": 0.0},
        "rotation": quaternion(pose.pose.heading),
    })
}

fn particles(time: &Value, cloud: &Cloud) -> Value {
    let poses: Vec<_> = cloud
        .particles
        .iter()
        .map(|&particle| pose_json(cloud.pose(particle)))
        .collect();
    json!({"timestamp": time, "frame_id": "map", "poses": poses})
}

fn end_points(time: &Value, scan: &ScanView) -> Value {
    let mut data = Vec::with_capacity(scan.points.len() * 13);
    for &end_point in &scan.points {
        for coordinate in scan.point(end_point) {
            data.extend_from_slice(&(coordinate as f32).to_le_bytes());
        }
        data.extend_from_slice(&0f32.to_le_bytes());
        data.push(end_point.kind.into());
    }
    let float = NumericType::Float32 as u8;
    json!({
        "timestamp": time,
        "frame_id": "map",
        "pose": pose_json(Pose2::default()),
        "point_stride": 13,
        "fields": [
            {"name": "x", "offset": 0, "type": float},
            {"name": "y", "offset": 4, "type": float},
            {"name": "z", "offset": 8, "type": float},
            {"name": "kind", "offset": 12, "type": NumericType::Uint8 as u8},
        ],
        "data": BASE64.encode(data),
    })
}

fn log_line(car: &CarName, time: &Value, event: &Event) -> Value {
    let level = match event.kind.severity() {
        Severity::Info => 2,
        Severity::Warning => 3,
        Severity::Critical => 4,
    };
    let who = event
        .who
        .as_ref()
        .map_or_else(String::new, |who| format!(" [{who}]"));
    let level = if matches!(event.kind, EventKind::Error { .. }) {
        5
    } else {
        level
    };
    json!({
        "timestamp": time,
        "level": level,
        "message": format!("{}{who}", event.kind),
        "name": car,
        "file": "",
        "line": event.update,
    })
}

/// One of our own messages, with its time.
fn stamped(time: &Value, message: &impl serde::Serialize) -> Value {
    let mut json = serde_json::to_value(message).unwrap_or_else(|error| json!({"error": error.to_string()}));
    json["timestamp"] = time.clone();
    json
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use protocol::{Covariance, PoseKind, Twist2};

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
        let message = json!({"timestamp": timestamp(1_500_000_000), "x": 1.5, "names": ["a"], "data": "AA==", "no": null});
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
        let z = quaternion(std::f64::consts::FRAC_PI_2)["z"]
            .as_f64()
            .expect("a number");
        assert!((z - std::f64::consts::FRAC_1_SQRT_2).abs() < 1e-12);
    }
}
