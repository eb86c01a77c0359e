//! Parameters under Cartographer's own names.
//!
//! A key is the path of the value in Cartographer's Lua configuration, in lower case: what a team writes as
//! `TRAJECTORY_BUILDER_2D.submaps.num_range_data = 80` is `trajectory_builder_2d.submaps.num_range_data: 80` here. The
//! defaults are Cartographer's.

use localizer::{ParameterFault, ParameterValues, overlay, to_values};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// A value that can be held against a range.
trait Number {
    /// None for what has no range.
    fn number(&self) -> Option<f64>;
}

impl Number for f64 {
    fn number(&self) -> Option<f64> {
        Some(*self)
    }
}

impl Number for usize {
    fn number(&self) -> Option<f64> {
        Some(*self as f64)
    }
}

impl Number for bool {
    fn number(&self) -> Option<f64> {
        None
    }
}

/// One line for each parameter: name, type, default, allowed range, key.
macro_rules! parameters {
    ($($(#[$doc:meta])* $name:ident: $type:ty = $default:expr, $low:expr, $high:expr, $key:literal;)*) => {
        /// Parameters of pose-graph localization; the default is Cartographer's.
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(default)]
        pub struct PoseGraphParameters {
            $($(#[$doc])* #[serde(rename = $key)] pub $name: $type,)*
        }

        impl Default for PoseGraphParameters {
            fn default() -> Self {
                Self { $($name: $default,)* }
            }
        }

        impl PoseGraphParameters {
            /// Every value that is out of its range.
            pub fn validate(&self) -> Result<(), Vec<ParameterFault>> {
                let mut faults = Vec::new();
                $(if let Some(value) = self.$name.number() {
                    let (low, high): (f64, f64) = ($low, $high);
                    if !(low..=high).contains(&value) {
                        let fault = format!("{value} is not in [{low}, {high}]");
                        faults.push(ParameterFault { key: $key.into(), fault });
                    }
                })*
                if faults.is_empty() { Ok(()) } else { Err(faults) }
            }
        }
    };
}

const DEGREE: f64 = std::f64::consts::PI / 180.0;

parameters! {
    /// Share of the odometry messages that are used, in (0, 1].
    odometry_sampling_ratio: f64 = 1.0, 0.01, 1.0, "odometry_sampling_ratio";
    /// Whether the gyroscope gives the turn between scans, where there is one.
    use_imu_data: bool = false, 0.0, 1.0, "trajectory_builder_2d.use_imu_data";
    /// Nearer readings are left out \[m\].
    min_range: f64 = 0.0, 0.0, 100.0, "trajectory_builder_2d.min_range";
    /// Farther readings count as free space only \[m\].
    max_range: f64 = 30.0, 0.5, 200.0, "trajectory_builder_2d.max_range";
    /// How much free space a reading beyond `max_range` shows \[m\].
    missing_data_ray_length: f64 = 5.0, 0.0, 100.0, "trajectory_builder_2d.missing_data_ray_length";
    /// Edge of the voxels of which each keeps one end point \[m\].
    voxel_filter_size: f64 = 0.025, 0.001, 2.0, "trajectory_builder_2d.voxel_filter_size";
    /// Longest edge of a voxel for scan matching \[m\]; it shrinks until enough end points are left.
    adaptive_voxel_max_length: f64 = 0.5, 0.001, 10.0, "trajectory_builder_2d.adaptive_voxel_filter.max_length";
    /// End points that are enough for scan matching.
    adaptive_voxel_min_num_points: usize = 200, 1.0, 10_000.0,
        "trajectory_builder_2d.adaptive_voxel_filter.min_num_points";
    /// Farther end points are left out of scan matching \[m\].
    adaptive_voxel_max_range: f64 = 50.0, 0.5, 500.0, "trajectory_builder_2d.adaptive_voxel_filter.max_range";
    /// Longest edge of a voxel for constraints \[m\].
    loop_closure_voxel_max_length: f64 = 0.9, 0.001, 10.0,
        "trajectory_builder_2d.loop_closure_adaptive_voxel_filter.max_length";
    /// End points that are enough for constraints.
    loop_closure_voxel_min_num_points: usize = 100, 1.0, 10_000.0,
        "trajectory_builder_2d.loop_closure_adaptive_voxel_filter.min_num_points";
    /// Farther end points are left out of constraints \[m\].
    loop_closure_voxel_max_range: f64 = 50.0, 0.5, 500.0,
        "trajectory_builder_2d.loop_closure_adaptive_voxel_filter.max_range";
    /// Whether the correlative matcher looks around the prediction before the non-linear one refines.
    use_online_correlative_scan_matching: bool = false, 0.0, 1.0,
        "trajectory_builder_2d.use_online_correlative_scan_matching";
    /// How far the correlative matcher looks \[m\].
    correlative_linear_search_window: f64 = 0.1, 0.0, 2.0,
        "trajectory_builder_2d.real_time_correlative_scan_matcher.linear_search_window";
    /// How far it turns \[rad\].
    correlative_angular_search_window: f64 = 20.0 * DEGREE, 0.0, 1.6,
        "trajectory_builder_2d.real_time_correlative_scan_matcher.angular_search_window";
    /// By how much candidates lose with distance from the prediction [1/m].
    correlative_translation_delta_cost_weight: f64 = 0.1, 0.0, 1e6,
        "trajectory_builder_2d.real_time_correlative_scan_matcher.translation_delta_cost_weight";
    /// By how much candidates lose with their turn from the prediction [1/rad].
    correlative_rotation_delta_cost_weight: f64 = 0.1, 0.0, 1e6,
        "trajectory_builder_2d.real_time_correlative_scan_matcher.rotation_delta_cost_weight";
    /// Weight of the end points in the non-linear matcher.
    matcher_occupied_space_weight: f64 = 1.0, 1e-6, 1e6,
        "trajectory_builder_2d.ceres_scan_matcher.occupied_space_weight";
    /// Weight of the predicted position [1/m].
    matcher_translation_weight: f64 = 10.0, 0.0, 1e6,
        "trajectory_builder_2d.ceres_scan_matcher.translation_weight";
    /// Weight of the predicted heading [1/rad].
    matcher_rotation_weight: f64 = 40.0, 0.0, 1e6, "trajectory_builder_2d.ceres_scan_matcher.rotation_weight";
    /// Most iterations of the non-linear matcher.
    matcher_max_num_iterations: usize = 20, 1.0, 1000.0,
        "trajectory_builder_2d.ceres_scan_matcher.ceres_solver_options.max_num_iterations";
    /// A scan becomes a node after this time at the latest \[s\]...
    motion_filter_max_time_seconds: f64 = 5.0, 0.0, 1e6, "trajectory_builder_2d.motion_filter.max_time_seconds";
    /// ...after this way \[m\]...
    motion_filter_max_distance_meters: f64 = 0.2, 0.0, 100.0,
        "trajectory_builder_2d.motion_filter.max_distance_meters";
    /// ...or after this turn \[rad\].
    motion_filter_max_angle_radians: f64 = DEGREE, 0.0, 7.0,
        "trajectory_builder_2d.motion_filter.max_angle_radians";
    /// Scans after which the next submap begins; each submap is finished after twice as many.
    submaps_num_range_data: usize = 90, 1.0, 1000.0, "trajectory_builder_2d.submaps.num_range_data";
    /// Edge of a submap's cells \[m\].
    submaps_resolution: f64 = 0.05, 0.01, 1.0,
        "trajectory_builder_2d.submaps.grid_options_2d.resolution";
    /// Whether the cells that a beam passes count as free.
    insert_free_space: bool = true, 0.0, 1.0,
        "trajectory_builder_2d.submaps.range_data_inserter.probability_grid_range_data_inserter.insert_free_space";
    /// Probability that a cell in which a beam ends is occupied, in (0.5, 0.99].
    hit_probability: f64 = 0.55, 0.500_001, 0.99,
        "trajectory_builder_2d.submaps.range_data_inserter.probability_grid_range_data_inserter.hit_probability";
    /// Probability that a cell which a beam passes is occupied, in [0.01, 0.5).
    miss_probability: f64 = 0.49, 0.01, 0.499_999,
        "trajectory_builder_2d.submaps.range_data_inserter.probability_grid_range_data_inserter.miss_probability";
    /// Submaps that are kept; older ones are trimmed with their nodes.
    max_submaps_to_keep: usize = 3, 2.0, 50.0, "trajectory_builder.pure_localization_trimmer.max_submaps_to_keep";
    /// Nodes after which the graph is optimized.
    optimize_every_n_nodes: usize = 90, 1.0, 10_000.0, "pose_graph.optimize_every_n_nodes";
    /// Share of the nodes that each frozen submap is matched with around their pose, in [0, 1].
    sampling_ratio: f64 = 0.3, 0.0, 1.0, "pose_graph.constraint_builder.sampling_ratio";
    /// Frozen submaps that a node is taken to lie in. Cartographer's map is made of submaps that overlap, and each of them
    /// samples the nodes by itself; ours is one grid.
    frozen_submaps_in_reach: usize = 3, 1.0, 100.0, "frozen_submaps_in_reach";
    /// Whether the local frame stands in the map where the last optimized node says, and not the last submap. A submap's pose
    /// is a mean over its nodes, which is metres old. Cartographer has no such choice.
    local_to_global_by_last_node: bool = false, 0.0, 1.0, "local_to_global_by_last_node";
    /// Whether a match counts in each direction by how well its scan determines it, and not in all alike. Cartographer has no such
    /// choice.
    match_weights_by_information: bool = false, 0.0, 1.0, "match_weights_by_information";
    /// Way over which the offset of the walls from the map's is learned \[m\]; 0 takes them where they are drawn. Cartographer's map
    /// is made of the laser's own end points and has none.
    wall_offset_distance: f64 = 3.0, 0.0, 1e4, "wall_offset_distance";
    /// Least score of a match around a node's pose, in [0, 1].
    min_score: f64 = 0.55, 0.0, 1.0, "pose_graph.constraint_builder.min_score";
    /// Least score of a match anywhere on the map, in [0, 1].
    global_localization_min_score: f64 = 0.6, 0.0, 1.0,
        "pose_graph.constraint_builder.global_localization_min_score";
    /// Weight of a match's position in the graph [1/m].
    loop_closure_translation_weight: f64 = 1.1e4, 0.0, 1e9,
        "pose_graph.constraint_builder.loop_closure_translation_weight";
    /// Weight of a match's heading in the graph [1/rad].
    loop_closure_rotation_weight: f64 = 1e5, 0.0, 1e9,
        "pose_graph.constraint_builder.loop_closure_rotation_weight";
    /// How far the branch-and-bound matcher looks around a node's pose \[m\].
    fast_linear_search_window: f64 = 7.0, 0.0, 100.0,
        "pose_graph.constraint_builder.fast_correlative_scan_matcher.linear_search_window";
    /// How far it turns \[rad\].
    fast_angular_search_window: f64 = 30.0 * DEGREE, 0.0, 3.2,
        "pose_graph.constraint_builder.fast_correlative_scan_matcher.angular_search_window";
    /// Resolutions of the branch-and-bound matcher.
    branch_and_bound_depth: usize = 7, 1.0, 10.0,
        "pose_graph.constraint_builder.fast_correlative_scan_matcher.branch_and_bound_depth";
    /// Weight of the end points when a match is refined.
    constraint_occupied_space_weight: f64 = 20.0, 1e-6, 1e6,
        "pose_graph.constraint_builder.ceres_scan_matcher.occupied_space_weight";
    /// Weight of the matched position when it is refined [1/m].
    constraint_translation_weight: f64 = 10.0, 0.0, 1e6,
        "pose_graph.constraint_builder.ceres_scan_matcher.translation_weight";
    /// Weight of the matched heading when it is refined [1/rad].
    constraint_rotation_weight: f64 = 1.0, 0.0, 1e6,
        "pose_graph.constraint_builder.ceres_scan_matcher.rotation_weight";
    /// Most iterations when a match is refined.
    constraint_max_num_iterations: usize = 10, 1.0, 1000.0,
        "pose_graph.constraint_builder.ceres_scan_matcher.ceres_solver_options.max_num_iterations";
    /// Weight of a node's position in its submaps [1/m].
    graph_matcher_translation_weight: f64 = 5e2, 0.0, 1e9, "pose_graph.matcher_translation_weight";
    /// Weight of a node's heading in its submaps [1/rad].
    graph_matcher_rotation_weight: f64 = 1.6e3, 0.0, 1e9, "pose_graph.matcher_rotation_weight";
    /// Weighted residual from which a match counts linearly in place of squared.
    huber_scale: f64 = 10.0, 1e-6, 1e9, "pose_graph.optimization_problem.huber_scale";
    /// Weight of the way between nodes by local scan matching [1/m].
    local_slam_pose_translation_weight: f64 = 1e5, 0.0, 1e9,
        "pose_graph.optimization_problem.local_slam_pose_translation_weight";
    /// Weight of the turn between nodes by local scan matching [1/rad].
    local_slam_pose_rotation_weight: f64 = 1e5, 0.0, 1e9,
        "pose_graph.optimization_problem.local_slam_pose_rotation_weight";
    /// Weight of the way between nodes by odometry [1/m].
    odometry_translation_weight: f64 = 1e5, 0.0, 1e9,
        "pose_graph.optimization_problem.odometry_translation_weight";
    /// Weight of the turn between nodes by odometry [1/rad].
    odometry_rotation_weight: f64 = 1e5, 0.0, 1e9, "pose_graph.optimization_problem.odometry_rotation_weight";
    /// Most iterations of the optimization.
    optimization_max_num_iterations: usize = 50, 1.0, 1000.0,
        "pose_graph.optimization_problem.ceres_solver_options.max_num_iterations";
    /// Share of the nodes that are matched with the whole map while none has matched for long, in [0, 1].
    global_sampling_ratio: f64 = 0.003, 0.0, 1.0, "pose_graph.global_sampling_ratio";
    /// For how long no node must have matched for that \[s\].
    global_constraint_search_after_n_seconds: f64 = 10.0, 0.0, 1e6,
        "pose_graph.global_constraint_search_after_n_seconds";
}

impl PoseGraphParameters {
    /// The names of the sets that ship.
    pub const NAMES: [&'static str; 2] = ["pose-graph", "pose-graph-tuned"];

    /// A set that ships, by name.
    pub fn named(name: &str) -> Option<Self> {
        match name {
            "pose-graph" => Some(Self::published()),
            "pose-graph-tuned" => Some(Self::tuned()),
            _ => None,
        }
    }

    /// What a race team has published for its cars on Cartographer (`ForzaETH`, `race_stack`).
    fn published() -> Self {
        Self {
            odometry_sampling_ratio: 0.5,
            min_range: 0.05,
            max_range: 25.0,
            matcher_translation_weight: 2.0,
            matcher_rotation_weight: 8.0,
            submaps_num_range_data: 80,
            max_submaps_to_keep: 5,
            optimize_every_n_nodes: 5,
            sampling_ratio: 0.05,
            odometry_translation_weight: 0.0,
            odometry_rotation_weight: 0.0,
            global_sampling_ratio: 0.05,
            ..Self::default()
        }
    }

    /// All odometry, the correlative matcher, shorter submaps and fewer of them, more nodes matched with the map, and none
    /// matched far away. The weights of the graph are inverse standard deviations: 3 mm and 1 mrad from node to node, 5 cm and
    /// 17 mrad in a submap, a match 5 cm and 8 mrad, beyond two of which it counts linearly.
    fn tuned() -> Self {
        Self {
            odometry_sampling_ratio: 1.0,
            use_online_correlative_scan_matching: true,
            submaps_num_range_data: 40,
            max_submaps_to_keep: 3,
            sampling_ratio: 0.15,
            fast_linear_search_window: 0.7,
            fast_angular_search_window: 15.0 * DEGREE,
            local_slam_pose_translation_weight: 330.0,
            local_slam_pose_rotation_weight: 1000.0,
            graph_matcher_translation_weight: 20.0,
            graph_matcher_rotation_weight: 60.0,
            loop_closure_translation_weight: 20.0,
            loop_closure_rotation_weight: 120.0,
            huber_scale: 2.0,
            local_to_global_by_last_node: true,
            ..Self::published()
        }
    }

    /// The set as flat keys and values, sorted by key.
    pub fn to_values(&self) -> ParameterValues {
        to_values(self)
    }

    /// This set with some values replaced, and the keys that are unknown. Every fault is listed.
    pub fn with_values(
        &self,
        given: impl IntoIterator<Item = (String, Value)>,
    ) -> Result<(Self, Vec<String>), Vec<ParameterFault>> {
        overlay(self, given, Self::validate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sets_that_ship_are_valid_and_their_values_lead_back_to_them() {
        for name in PoseGraphParameters::NAMES {
            let set = PoseGraphParameters::named(name).expect("ships");
            assert_eq!(set.validate(), Ok(()), "{name}");
            let back = PoseGraphParameters::default().with_values(set.to_values());
            assert_eq!(back, Ok((set, Vec::new())));
        }
        assert_eq!(PoseGraphParameters::named("hq"), None);
    }

    #[test]
    fn every_fault_is_listed_with_its_key() {
        let keys = [
            "pose_graph.optimization_problem.huber_scale",
            "trajectory_builder_2d.max_range",
        ];
        let given = keys.map(|key| (key.to_owned(), Value::from(-1)));
        let faults = PoseGraphParameters::default()
            .with_values(given)
            .expect_err("faulty");
        let mut found: Vec<_> = faults.iter().map(|fault| fault.key.as_str()).collect();
        found.sort_unstable();
        assert_eq!(found, keys);
    }
}
