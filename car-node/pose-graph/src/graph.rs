//! The pose graph: nodes, the submaps that they are in, and their matches with the frozen map.

use maps::Pose;
use nalgebra::Matrix2;

use crate::optimization::{InMap, Problem, Relative, Weights};
use crate::parameters::PoseGraphParameters;
use crate::submap::SubmapId;

/// Number of a node since the start.
pub(crate) type NodeId = u64;

/// A scan that passed the motion filter.
#[derive(Debug, Clone)]
pub(crate) struct Node {
    pub(crate) id: NodeId,
    /// By local scan matching.
    pub(crate) local: Pose,
    /// By the graph.
    pub(crate) global: Pose,
    /// By odometry.
    pub(crate) odom: Pose,
    submaps: Vec<SubmapId>,
    matched: Option<MapMatch>,
}

/// Where a node stands in the frozen map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct MapMatch {
    pub(crate) pose: Pose,
    /// By how much each direction counts, see [`InMap`].
    pub(crate) shape: Matrix2<f64>,
}

#[derive(Debug, Clone, Copy)]
struct SubmapPose {
    id: SubmapId,
    local: Pose,
    global: Pose,
    optimized: bool,
}

/// The graph over the window of the submaps that are kept.
#[derive(Debug, Clone)]
pub(crate) struct Graph {
    nodes: Vec<Node>,
    submaps: Vec<SubmapPose>,
    next_id: NodeId,
    /// The transform before anything is optimized.
    start: Pose,
    /// The transform by the last node that was optimized, if that is to count.
    by_node: Option<Pose>,
}

impl Graph {
    /// An empty graph of a drive whose local frame stands at `global_from_local` in the grid's.
    pub(crate) fn new(global_from_local: Pose, next_id: NodeId) -> Self {
        Self {
            nodes: Vec::new(),
            submaps: Vec::new(),
            next_id,
            start: global_from_local,
            by_node: None,
        }
    }

    /// Number of the next node.
    pub(crate) fn next_id(&self) -> NodeId {
        self.next_id
    }

    /// The local frame's pose in the grid's, by the last node or the last submap that was optimized.
    pub(crate) fn global_from_local(&self) -> Pose {
        if let Some(by_node) = self.by_node {
            return by_node;
        }
        let last = self.submaps.iter().rev().find(|submap| submap.optimized);
        last.map_or(self.start, |submap| submap.global * submap.local.inverse())
    }

    /// Adds a node that is in some submaps, and trims what is older than the last `max_submaps_to_keep`. Returns its number and
    /// its pose in the grid's frame.
    pub(crate) fn add(
        &mut self,
        local: Pose,
        odom: Pose,
        submaps: &[(SubmapId, Pose)],
        max_submaps_to_keep: usize,
    ) -> (NodeId, Pose) {
        let global_from_local = self.global_from_local();
        for &(id, pose) in submaps {
            if self.submaps.last().is_none_or(|last| last.id < id) {
                self.submaps.push(SubmapPose {
                    id,
                    local: pose,
                    global: global_from_local * pose,
                    optimized: false,
                });
            }
        }
        let global = global_from_local * local;
        let id = self.next_id;
        self.next_id += 1;
        self.nodes.push(Node {
            id,
            local,
            global,
            odom,
            submaps: submaps.iter().map(|(id, _)| *id).collect(),
            matched: None,
        });
        self.trim(max_submaps_to_keep);
        (id, global)
    }

    fn trim(&mut self, max_submaps_to_keep: usize) {
        let trimmed = self.submaps.len().saturating_sub(max_submaps_to_keep);
        if trimmed == 0 {
            return;
        }
        // What is known of the transform outlives the submap that it is known by.
        let start = self.global_from_local();
        self.submaps.drain(..trimmed);
        self.start = start;
        let Some(oldest) = self.submaps.first().map(|submap| submap.id) else {
            return;
        };
        self.nodes
            .retain(|node| node.submaps.iter().any(|&submap| submap >= oldest));
    }

    /// Adds a node's match with the frozen map. A node that has been trimmed is ignored.
    pub(crate) fn add_match(&mut self, node: NodeId, matched: MapMatch) {
        if let Ok(index) = self.nodes.binary_search_by_key(&node, |node| node.id) {
            self.nodes[index].matched = Some(matched);
        }
    }

    /// Whether any node in the window has matched the frozen map.
    pub(crate) fn is_anchored(&self) -> bool {
        self.nodes.iter().any(|node| node.matched.is_some())
    }

    /// Moves the whole graph so that a node has this pose in the grid's frame.
    pub(crate) fn place(&mut self, node: NodeId, global: Pose) {
        let Ok(index) = self.nodes.binary_search_by_key(&node, |node| node.id) else {
            return;
        };
        let by = global * self.nodes[index].global.inverse();
        for node in &mut self.nodes {
            node.global = by * node.global;
        }
        for submap in &mut self.submaps {
            (submap.global, submap.optimized) = (by * submap.global, true);
        }
        self.start = by * self.start;
        self.by_node = self.by_node.map(|pose| by * pose);
    }

    /// The last node's pose by local scan matching.
    pub(crate) fn last_local(&self) -> Option<Pose> {
        self.nodes.last().map(|node| node.local)
    }

    /// The nodes in the window, oldest first.
    #[cfg(test)]
    pub(crate) fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// Adjusts all poses to the constraints. Without a match there is nothing to adjust to.
    pub(crate) fn optimize(&mut self, parameters: &PoseGraphParameters) {
        if !self.is_anchored() {
            return;
        }
        let mut problem = self.problem(parameters);
        problem.solve(parameters.optimization_max_num_iterations);
        for (node, pose) in self.nodes.iter_mut().zip(&problem.nodes) {
            node.global = *pose;
        }
        for (submap, pose) in self.submaps.iter_mut().zip(&problem.submaps) {
            (submap.global, submap.optimized) = (*pose, true);
        }
        let last = self
            .nodes
            .last()
            .filter(|_| parameters.local_to_global_by_last_node);
        self.by_node = last.map(|node| node.global * node.local.inverse());
    }

    fn problem(&self, parameters: &PoseGraphParameters) -> Problem {
        let local_slam = Weights {
            translation: parameters.local_slam_pose_translation_weight,
            rotation: parameters.local_slam_pose_rotation_weight,
        };
        let odometry = Weights {
            translation: parameters.odometry_translation_weight,
            rotation: parameters.odometry_rotation_weight,
        };
        let used = |weights: &Weights| weights.translation > 0.0 || weights.rotation > 0.0;
        let link = |pair: &[Node]| {
            let local = (pair[1].local.since(pair[0].local), local_slam);
            let odom = (pair[1].odom.since(pair[0].odom), odometry);
            [local, odom]
                .into_iter()
                .filter(|(_, weights)| used(weights))
                .collect()
        };
        let intra = Weights {
            translation: parameters.graph_matcher_translation_weight,
            rotation: parameters.graph_matcher_rotation_weight,
        };
        let inter = Weights {
            translation: parameters.loop_closure_translation_weight,
            rotation: parameters.loop_closure_rotation_weight,
        };
        let mut in_submap = Vec::with_capacity(2 * self.nodes.len());
        let mut in_map = Vec::new();
        for (index, node) in self.nodes.iter().enumerate() {
            for id in &node.submaps {
                let Ok(submap) = self.submaps.binary_search_by_key(id, |submap| submap.id) else {
                    continue;
                };
                let measured = node.local.since(self.submaps[submap].local);
                let relative = Relative {
                    node: index,
                    measured,
                    weights: intra,
                };
                in_submap.push((submap, relative));
            }
            in_map.extend(node.matched.map(|matched| InMap {
                at: Relative {
                    node: index,
                    measured: matched.pose,
                    weights: inter,
                },
                shape: matched.shape,
            }));
        }
        Problem {
            nodes: self.nodes.iter().map(|node| node.global).collect(),
            submaps: self.submaps.iter().map(|submap| submap.global).collect(),
            chain: self.nodes.windows(2).map(link).collect(),
            in_submap,
            in_map,
            huber_scale: parameters.huber_scale,
        }
    }

    /// Takes over the poses of a copy that was optimized meanwhile. Nodes and submaps that are newer move along.
    pub(crate) fn adopt(&mut self, optimized: &Self) {
        for node in &mut self.nodes {
            if let Ok(index) = optimized.nodes.binary_search_by_key(&node.id, |node| node.id) {
                node.global = optimized.nodes[index].global;
                node.matched = optimized.nodes[index].matched;
            }
        }
        for submap in &mut self.submaps {
            if let Ok(index) = optimized
                .submaps
                .binary_search_by_key(&submap.id, |submap| submap.id)
            {
                submap.global = optimized.submaps[index].global;
                submap.optimized = optimized.submaps[index].optimized;
            }
        }
        self.start = optimized.global_from_local();
        self.by_node = optimized.by_node;
        let global_from_local = self.global_from_local();
        let newest = optimized.nodes.last().map_or(0, |node| node.id);
        let newest_submap = optimized.submaps.last().map_or(0, |submap| submap.id);
        for node in self.nodes.iter_mut().filter(|node| node.id > newest) {
            node.global = global_from_local * node.local;
        }
        for submap in self.submaps.iter_mut().filter(|submap| submap.id > newest_submap) {
            submap.global = global_from_local * submap.local;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(pose: Pose) -> MapMatch {
        MapMatch {
            pose,
            shape: Matrix2::identity(),
        }
    }

    fn driven(nodes: usize, keep: usize) -> Graph {
        driven_with(nodes, keep, &PoseGraphParameters::default())
    }

    /// A straight drive whose local frame drifts to the left, matched with the map every tenth node.
    fn driven_with(nodes: usize, keep: usize, parameters: &PoseGraphParameters) -> Graph {
        let parameters = PoseGraphParameters {
            odometry_translation_weight: 0.0,
            odometry_rotation_weight: 0.0,
            ..parameters.clone()
        };
        let mut graph = Graph::new(Pose::IDENTITY, 0);
        for k in 0..nodes {
            let (x, drift) = (0.2 * k as f64, 0.001 * k as f64);
            let local = Pose::new(x, drift, 0.0);
            let begin = |submap: usize| Pose::new(0.2 * (10 * submap) as f64, 0.01 * submap as f64, 0.0);
            let first = (k / 10).saturating_sub(1);
            let submaps: Vec<_> = (first..=k / 10)
                .map(|submap| (submap as SubmapId, begin(submap)))
                .collect();
            let (id, _) = graph.add(local, Pose::IDENTITY, &submaps, keep);
            if k % 10 == 0 {
                graph.add_match(id, found(Pose::new(x, 0.0, 0.0)));
                graph.optimize(&parameters);
            }
        }
        graph
    }

    #[test]
    fn matches_take_the_drift_out() {
        let graph = driven(101, 5);
        let last = graph.nodes().last().expect("a node");
        assert!(last.local.y > 0.09);
        assert!(last.global.y.abs() < 0.05, "{:?}", last.global);
        let now = graph.global_from_local() * last.local;
        assert!(now.y.abs() < 0.05, "{now:?}");
    }

    #[test]
    fn the_local_frame_stands_where_the_last_node_says_if_that_is_to_count() {
        let off = |local_to_global_by_last_node| {
            let parameters = PoseGraphParameters {
                local_to_global_by_last_node,
                local_slam_pose_translation_weight: 300.0,
                local_slam_pose_rotation_weight: 1000.0,
                ..PoseGraphParameters::default()
            };
            // Optimized with the last node.
            let graph = driven_with(101, 5, &parameters);
            let last = graph.nodes().last().expect("a node");
            (graph.global_from_local() * last.local).distance(last.global)
        };
        assert!(off(true) < 1e-9, "{}", off(true));
        assert!(off(false) < 0.05, "{}", off(false));
    }

    #[test]
    fn the_window_is_trimmed() {
        let graph = driven(200, 3);
        assert_eq!(graph.submaps.len(), 3);
        assert!(graph.nodes().len() <= 40, "{}", graph.nodes().len());
        assert!(graph.nodes().iter().all(|node| node.id >= 160));
    }

    #[test]
    fn what_was_added_meanwhile_moves_along() {
        let mut graph = driven(35, 5);
        let mut copy = graph.clone();
        let local = Pose::new(7.0, 0.035, 0.0);
        let (id, before) = graph.add(local, Pose::IDENTITY, &[(3, Pose::new(6.0, 0.03, 0.0))], 5);
        for node in &mut copy.nodes {
            node.global.y += 1.0;
        }
        for submap in &mut copy.submaps {
            submap.global.y += 1.0;
        }
        graph.adopt(&copy);
        let newest = graph.nodes().last().expect("a node");
        assert_eq!(newest.id, id);
        assert!((newest.global.y - before.y - 1.0).abs() < 1e-9);
        // Of a trimmed node nothing is learned.
        graph.add_match(10_000, found(Pose::IDENTITY));
    }
}
