//! The parts of an update that the pit wall draws: particles, and the scan's end points on the map.

use maps::Pose;
use synpf::{Scan, TrackMap, Update, WeightedPose};

use crate::telemetry::queue::{BeamClass, CloudSample, ScanPoints};

/// End points nearer to a wall than this are on it \[m\]; the limit of [`Update::alignment`].
const ON_WALL: f64 = 0.10;
/// Beams that differ from the map by more than this are short or long \[m\]; the limit of [`Update::long_beams`].
const SHORT_OR_LONG: f64 = 0.3;

/// The particles of an update; `particles` is a fair sample of them.
pub(crate) fn cloud(update: &Update, particles: Vec<WeightedPose>) -> CloudSample {
    CloudSample {
        stamp: update.stamp,
        update: update.number,
        centre: update.pose,
        count: update.particles,
        ess_ratio: update.ess_ratio,
        spread: update.spread,
        second_mode: update.second_mode,
        particles,
    }
}

/// Every n-th end point of a scan at the pose of its update, at most [`protocol::ScanView::MAX_POINTS`] of them.
pub(crate) fn scan_points(
    update: &Update,
    scan: &Scan,
    map: &TrackMap,
    base_link_from_laser: Pose,
) -> ScanPoints {
    let map_from_laser = update.pose * base_link_from_laser;
    let step = scan.ranges.len().div_ceil(protocol::ScanView::MAX_POINTS).max(1);
    let points = scan
        .ranges
        .iter()
        .enumerate()
        .step_by(step)
        .map(|(beam, range)| (beam, f64::from(*range)))
        .filter(|(_, range)| (scan.nearest()..scan.range_max).contains(range))
        .map(|(beam, range)| {
            let angle = scan.angle_min + scan.angle_increment * beam as f64;
            let (sin, cos) = angle.sin_cos();
            let point = map_from_laser.transform([range * cos, range * sin]);
            let expected = map.range(map_from_laser * Pose::new(0.0, 0.0, angle), scan.range_max);
            (point, classify_beam(map.distance(point), range - expected))
        })
        .collect();
    ScanPoints {
        stamp: update.stamp,
        update: update.number,
        centre: [map_from_laser.x, map_from_laser.y],
        points,
    }
}

/// Compares a beam with the map. `distance` is that of its end point to the nearest wall \[m\]; `longer` is its range less
/// the expected one \[m\].
fn classify_beam(distance: f64, longer: f64) -> BeamClass {
    if distance.abs() < ON_WALL {
        BeamClass::OnWall
    } else if longer > SHORT_OR_LONG {
        BeamClass::Long
    } else if longer < -SHORT_OR_LONG {
        BeamClass::Short
    } else {
        BeamClass::OffWall
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn beams_are_classified_by_distance_and_length() {
        assert_eq!(classify_beam(0.05, 1.0), BeamClass::OnWall);
        assert_eq!(classify_beam(0.5, 1.0), BeamClass::Long);
        assert_eq!(classify_beam(0.5, -1.0), BeamClass::Short);
        assert_eq!(classify_beam(0.2, 0.1), BeamClass::OffWall);
    }
}
