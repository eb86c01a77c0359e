//! The motion filter: which scans become nodes of the graph.

use localizer::Stamp;
use maps::Pose;

use crate::parameters::PoseGraphParameters;

/// Passes a scan once the car has moved enough since the last one that passed, or enough time has gone by.
#[derive(Debug, Clone, Default)]
pub(crate) struct MotionFilter {
    last: Option<(Stamp, Pose)>,
}

impl MotionFilter {
    /// Whether the scan taken at `stamp` and `pose` passes.
    pub(crate) fn passes(&mut self, stamp: Stamp, pose: Pose, parameters: &PoseGraphParameters) -> bool {
        let near = self.last.is_some_and(|(at, last)| {
            stamp.since(at) <= parameters.motion_filter_max_time_seconds
                && pose.distance(last) <= parameters.motion_filter_max_distance_meters
                && maps::wrap_angle(pose.heading - last.heading).abs()
                    <= parameters.motion_filter_max_angle_radians
        });
        if !near {
            self.last = Some((stamp, pose));
        }
        !near
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scan_passes_after_a_way_a_turn_or_a_time() {
        let parameters = PoseGraphParameters::default();
        let mut filter = MotionFilter::default();
        let mut passes = |seconds: f64, x: f64, heading: f64| {
            filter.passes(Stamp(0).plus(seconds), Pose::new(x, 0.0, heading), &parameters)
        };
        assert!(passes(0.0, 0.0, 0.0));
        assert!(!passes(0.1, 0.19, 0.01));
        assert!(passes(0.2, 0.21, 0.01));
        assert!(passes(0.3, 0.21, 0.03));
        assert!(!passes(5.2, 0.21, 0.03));
        assert!(passes(5.4, 0.21, 0.03));
    }
}
