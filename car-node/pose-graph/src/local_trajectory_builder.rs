//! Local scan matching: each scan is held against the submap of the scans before it.

use localizer::Stamp;
use maps::Pose;

use crate::correlative_matcher::correlative_match;
use crate::motion_filter::MotionFilter;
use crate::nonlinear_matcher::{MatchWeights, nonlinear_match};
use crate::parameters::PoseGraphParameters;
use crate::range_data::Points;
use crate::submap::{ActiveSubmaps, RangeData, SubmapId};
use crate::voxel_filter::{adaptive_voxel_filter, voxel_filter};

/// The front end.
#[derive(Debug, Clone)]
pub(crate) struct LocalTrajectoryBuilder {
    submaps: ActiveSubmaps,
    motion_filter: MotionFilter,
}

/// What a scan has come to.
#[derive(Debug, Clone)]
pub(crate) struct LocalMatch {
    /// In the local frame.
    pub(crate) pose: Pose,
    /// Set if the scan is to be a node: the submaps that it is in, as number and local pose.
    pub(crate) inserted: Option<Vec<(SubmapId, Pose)>>,
    /// End points after the first voxel filter.
    pub(crate) points: Vec<[f32; 2]>,
}

impl LocalTrajectoryBuilder {
    /// No submaps yet; the first one gets the number `next_submap`.
    pub(crate) fn new(next_submap: SubmapId, parameters: &PoseGraphParameters) -> Self {
        Self {
            submaps: ActiveSubmaps::new(next_submap, parameters),
            motion_filter: MotionFilter::default(),
        }
    }

    /// Number of the next submap that begins.
    pub(crate) fn next_submap(&self) -> SubmapId {
        self.submaps.next_id()
    }

    /// Matches a scan around the prediction, and inserts it if the car has moved enough.
    pub(crate) fn add(
        &mut self,
        stamp: Stamp,
        scan: &Points,
        base_link_from_laser: Pose,
        prediction: Pose,
        parameters: &PoseGraphParameters,
    ) -> LocalMatch {
        let points = voxel_filter(&scan.returns, parameters.voxel_filter_size);
        let pose = self.matched(&points, prediction, parameters);
        let inserted = self.motion_filter.passes(stamp, pose, parameters).then(|| {
            let range_data = RangeData {
                base_link_from_laser,
                returns: &points,
                misses: &scan.misses,
            };
            self.submaps.insert(range_data, pose, parameters)
        });
        LocalMatch {
            pose,
            inserted,
            points,
        }
    }

    fn matched(&self, points: &[[f32; 2]], prediction: Pose, parameters: &PoseGraphParameters) -> Pose {
        let Some(submap) = self.submaps.matching() else {
            return prediction;
        };
        let filtered = adaptive_voxel_filter(
            points,
            parameters.adaptive_voxel_max_length,
            parameters.adaptive_voxel_min_num_points,
            parameters.adaptive_voxel_max_range,
        );
        let start = if parameters.use_online_correlative_scan_matching {
            correlative_match(&submap.grid, &filtered, prediction, parameters)
        } else {
            prediction
        };
        let weights = MatchWeights {
            occupied_space: parameters.matcher_occupied_space_weight,
            translation: parameters.matcher_translation_weight,
            rotation: parameters.matcher_rotation_weight,
            max_num_iterations: parameters.matcher_max_num_iterations,
        };
        nonlinear_match(&submap.grid, &filtered, prediction, start, weights)
    }
}
