//! Every conversion between the car's own types and those of the protocol.

use maps::{OccupancyGrid, Pose, Raceline};
use nalgebra::Matrix3;
use protocol::{
    Candidate, Cell, Cloud, CloudParticle, Covariance, EndPoint, EndPointKind, Health, Latency, MapRaceline,
    MapReply, Pose2, PoseKind, RecordedOdometry, RecordedScan, ScanView, TrackPoint, Truth, Twist2, Value,
};
use synpf::{Hypothesis, Odometry, Scan, Stamp, Twist};

use crate::health::Metrics;
use crate::sensors::TrueMotion;
pub(crate) use crate::statistics::finite;
use crate::telemetry::counters::Spread;
use crate::telemetry::queue::{BeamClass, CloudSample, HealthReport, PoseReport, ScanPoints};

/// A share in [0, 1].
pub(crate) fn share(value: f64) -> f32 {
    finite(value).clamp(0.0, 1.0)
}

/// A pose.
pub fn pose2(pose: Pose) -> Pose2 {
    Pose2 {
        x: pose.x,
        y: pose.y,
        heading: pose.heading,
    }
}

/// A pose from the network.
pub fn pose(pose: Pose2) -> Pose {
    Pose::new(pose.x, pose.y, pose.heading)
}

/// A velocity.
pub fn twist2(twist: Twist) -> Twist2 {
    Twist2 {
        linear_x: twist.linear_x,
        linear_y: twist.linear_y,
        angular: twist.angular,
    }
}

fn covariance(matrix: &Matrix3<f64>) -> Covariance {
    let at = |row, column| finite(matrix[(row, column)]);
    Covariance {
        xx: at(0, 0),
        xy: at(0, 1),
        xh: at(0, 2),
        yy: at(1, 1),
        yh: at(1, 2),
        hh: at(2, 2),
    }
}

/// A pose estimate.
pub fn pose_message(estimate: &PoseReport) -> protocol::Pose {
    protocol::Pose {
        pose: pose2(estimate.pose),
        twist: twist2(estimate.twist),
        covariance: covariance(&estimate.covariance),
        track: estimate.track.map(|[s, d]| TrackPoint { s, d }),
        lap: estimate.lap,
        update: estimate.update,
        kind: if estimate.predicted {
            PoseKind::Predicted
        } else {
            PoseKind::Updated
        },
    }
}

/// The cloud.
pub fn cloud(sample: &CloudSample) -> Cloud {
    let centre = [sample.centre.x, sample.centre.y];
    let heaviest = sample
        .particles
        .iter()
        .map(|particle| particle.weight)
        .fold(f64::MIN_POSITIVE, f64::max);
    Cloud {
        update: sample.update,
        count: u32::try_from(sample.count).unwrap_or(u32::MAX),
        ess_ratio: share(sample.ess_ratio),
        spread_along: finite(sample.spread[0]),
        spread_across: finite(sample.spread[1]),
        second_mode: share(sample.second_mode),
        centre,
        particles: sample
            .particles
            .iter()
            .take(Cloud::MAX_PARTICLES)
            .map(|particle| CloudParticle::quantise(pose2(particle.pose), centre, particle.weight / heaviest))
            .collect(),
    }
}

/// The end points of a scan.
pub fn scan_view(points: &ScanPoints) -> ScanView {
    ScanView {
        update: points.update,
        centre: points.centre,
        points: points
            .points
            .iter()
            .take(ScanView::MAX_POINTS)
            .map(|(point, fit)| {
                let kind = match fit {
                    BeamClass::OnWall => EndPointKind::OnWall,
                    BeamClass::OffWall => EndPointKind::OffWall,
                    BeamClass::Short => EndPointKind::Short,
                    BeamClass::Long => EndPointKind::Long,
                };
                EndPoint::quantise(*point, points.centre, kind)
            })
            .collect(),
    }
}

fn metrics(metrics: &Metrics) -> protocol::Metrics {
    protocol::Metrics {
        alignment: share(metrics.alignment),
        residual: finite(metrics.residual),
        short_beams: share(metrics.short_beams),
        long_beams: share(metrics.long_beams),
        no_return: share(metrics.no_return),
        ess_ratio: share(metrics.ess_ratio),
        w_ratio: finite(metrics.w_ratio),
        spread_along: finite(metrics.spread_along),
        spread_across: finite(metrics.spread_across),
        second_mode: share(metrics.second_mode),
        slip: finite(metrics.slip),
        yaw_rate_residual: finite(metrics.yaw_rate_residual),
        innovation: finite(metrics.innovation),
        innovation_angle: finite(metrics.innovation_angle),
        age_p50: finite(metrics.age_p50),
        age_p99: finite(metrics.age_p99),
        particles: u32::try_from(metrics.particles).unwrap_or(u32::MAX),
    }
}

/// A health report. `wall` converts its times from the sensors' clock to wall time.
pub fn health(report: &HealthReport, wall: impl Fn(Stamp) -> Stamp) -> Health {
    Health {
        state: report.verdict.state,
        since: wall(report.verdict.since).0,
        causes: report
            .verdict
            .causes
            .iter()
            .take(Health::MAX_CAUSES)
            .copied()
            .collect(),
        update: report.verdict.update,
        metrics: report.verdict.metrics.as_ref().map(metrics),
        proposal: report.proposal.as_ref().map(|proposal| protocol::Proposal {
            set: proposal.set.clone(),
            evidence: proposal.evidence.clone(),
            since: wall(proposal.since).0,
        }),
        auto: report.auto,
    }
}

/// Odometry for the recorder.
pub fn odometry(odometry: &Odometry) -> RecordedOdometry {
    RecordedOdometry {
        pose: pose2(odometry.pose),
        twist: twist2(odometry.twist),
    }
}

/// A scan for the recorder.
pub fn scan(scan: &Scan) -> RecordedScan {
    RecordedScan {
        angle_min: scan.angle_min,
        angle_increment: scan.angle_increment,
        time_increment: scan.time_increment,
        range_min: scan.range_min,
        range_max: scan.range_max,
        ranges: scan
            .ranges
            .iter()
            .take(RecordedScan::MAX_BEAMS)
            .map(|range| RecordedScan::quantise(*range))
            .collect(),
    }
}

/// The truth for the recorder.
pub fn truth(motion: &TrueMotion) -> Truth {
    Truth {
        pose: pose2(motion.pose),
        twist: twist2(motion.twist),
    }
}

/// The summary of a duration, from seconds to microseconds.
pub fn latency(spread: Spread) -> Latency {
    let microseconds = |seconds: f64| finite(seconds * 1e6);
    Latency {
        p50: microseconds(spread.p50),
        p99: microseconds(spread.p99),
        max: microseconds(spread.max),
    }
}

/// The map with its raceline.
pub fn map(name: &str, grid: &OccupancyGrid, raceline: Option<&Raceline>) -> MapReply {
    MapReply {
        name: name.into(),
        width: u32::try_from(grid.width).unwrap_or(u32::MAX),
        height: u32::try_from(grid.height).unwrap_or(u32::MAX),
        resolution: grid.resolution,
        origin: pose2(grid.origin),
        runs: MapReply::pack(grid.cells.iter().map(|cell| match cell {
            maps::Cell::Free => Cell::Free,
            maps::Cell::Occupied => Cell::Occupied,
            maps::Cell::Unknown => Cell::Unknown,
        })),
        raceline: raceline.map(|line| MapRaceline {
            length: line.length(),
            points: line
                .points()
                .iter()
                .map(|point| [point.x as f32, point.y as f32])
                .collect(),
        }),
    }
}

/// A candidate of a search; the best has index 0.
pub fn candidate(index: usize, hypothesis: &Hypothesis) -> Candidate {
    Candidate {
        number: u32::try_from(index + 1).unwrap_or(u32::MAX),
        pose: pose2(hypothesis.pose),
        score: share(hypothesis.fit),
    }
}

/// A parameter's value. None for what cannot be a parameter: null, a list, a table.
pub fn value(value: &serde_json::Value) -> Option<Value> {
    Some(match value {
        serde_json::Value::Bool(value) => Value::Bool(*value),
        serde_json::Value::Number(number) => match number.as_i64() {
            Some(value) => Value::Int(value),
            None => Value::Float(number.as_f64()?),
        },
        serde_json::Value::String(text) => Value::Text(text.clone()),
        serde_json::Value::Null | serde_json::Value::Array(_) | serde_json::Value::Object(_) => return None,
    })
}

/// A parameter's value from the network.
pub fn json(value: &Value) -> serde_json::Value {
    match value {
        Value::Bool(value) => (*value).into(),
        Value::Int(value) => (*value).into(),
        Value::Float(value) => (*value).into(),
        Value::Text(text) => text.clone().into(),
    }
}
