//! The constraint builder: matches of nodes with the frozen map.

use maps::Pose;
use nalgebra::Matrix2;

use crate::branch_and_bound::SearchWindow;
use crate::frozen_map::Walls;
use crate::graph::MapMatch;
use crate::nonlinear_matcher::{MatchWeights, nonlinear_match, shape_of_information};
use crate::parameters::PoseGraphParameters;

/// Where to look for a node.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Search {
    /// Around its pose.
    Around(Pose),
    /// Anywhere on the map.
    Anywhere,
}

/// The best match of a node's end points with the frozen map, refined; None if it is too bad.
pub(crate) fn match_with_map(
    walls: &Walls,
    points: &[[f32; 2]],
    search: Search,
    parameters: &PoseGraphParameters,
) -> Option<MapMatch> {
    let stack = walls.stack(parameters.branch_and_bound_depth);
    let found = match search {
        Search::Around(pose) => {
            let window = SearchWindow {
                linear: parameters.fast_linear_search_window,
                angular: parameters.fast_angular_search_window,
            };
            stack.match_around(points, pose, window, parameters.min_score)?
        }
        Search::Anywhere => stack.match_anywhere(points, parameters.global_localization_min_score)?,
    };
    let weights = MatchWeights {
        occupied_space: parameters.constraint_occupied_space_weight,
        translation: parameters.constraint_translation_weight,
        rotation: parameters.constraint_rotation_weight,
        max_num_iterations: parameters.constraint_max_num_iterations,
    };
    let pose = nonlinear_match(&walls.grid, points, found.pose, found.pose, weights);
    let shape = if parameters.match_weights_by_information {
        shape_of_information(&walls.grid, points, pose)
    } else {
        Matrix2::identity()
    };
    Some(MapMatch { pose, shape })
}
