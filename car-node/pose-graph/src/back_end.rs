//! The back end's work: nodes matched with the frozen map, and the graph optimized. It may run on another thread.

use std::sync::Arc;

use maps::Pose;

use crate::constraint_builder::{Search, match_with_map};
use crate::frozen_map::{FrozenMap, Walls};
use crate::graph::{Graph, MapMatch, NodeId};
use crate::parameters::PoseGraphParameters;
use crate::wall_offset::{WallOffset, fit_offset};

/// A node that is to be matched.
#[derive(Debug, Clone)]
pub(crate) struct PendingMatch {
    pub(crate) node: NodeId,
    pub(crate) search: Search,
    /// The node's pose when it was added, in the grid's frame.
    pub(crate) predicted: Pose,
    pub(crate) points: Vec<[f32; 2]>,
}

/// What there is to do.
#[derive(Debug, Clone)]
pub(crate) struct BackEndWork {
    /// Which work it is.
    pub(crate) number: u64,
    pub(crate) map: Arc<FrozenMap>,
    pub(crate) walls: Arc<Walls>,
    pub(crate) wall_offset: WallOffset,
    pub(crate) graph: Graph,
    pub(crate) pending: Vec<PendingMatch>,
    /// Whether the graph is to be optimized.
    pub(crate) optimize: bool,
    pub(crate) parameters: PoseGraphParameters,
}

/// A node that has matched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct NodeMatch {
    pub(crate) node: NodeId,
    pub(crate) search: Search,
    pub(crate) predicted: Pose,
    pub(crate) found: MapMatch,
}

/// What has come of it.
#[derive(Debug, Clone)]
pub(crate) struct BackEndOutcome {
    pub(crate) number: u64,
    pub(crate) matches: Vec<NodeMatch>,
    /// The walls that the next nodes are to be matched with, and how far off they stand.
    pub(crate) walls: Arc<Walls>,
    pub(crate) wall_offset: WallOffset,
    /// The graph with its new matches, optimized.
    pub(crate) graph: Graph,
}

impl BackEndWork {
    /// Does it. The same work has the same outcome, on whatever thread.
    pub(crate) fn run(mut self) -> BackEndOutcome {
        let matches = self.match_pending();
        for matched in &matches {
            if matched.search == Search::Anywhere && !self.graph.is_anchored() {
                self.graph.place(matched.node, matched.found.pose);
            }
            self.graph.add_match(matched.node, matched.found);
        }
        if self.optimize {
            self.graph.optimize(&self.parameters);
        }
        BackEndOutcome {
            number: self.number,
            matches,
            walls: self.walls,
            wall_offset: self.wall_offset,
            graph: self.graph,
        }
    }
    /// Matches the nodes, and learns from each where the walls stand.
    fn match_pending(&mut self) -> Vec<NodeMatch> {
        let mut matches = Vec::new();
        for pending in std::mem::take(&mut self.pending) {
            let found = match_with_map(&self.walls, &pending.points, pending.search, &self.parameters);
            matches.extend(found.map(|found| NodeMatch {
                node: pending.node,
                search: pending.search,
                predicted: pending.predicted,
                found,
            }));
            let near = match (found, pending.search) {
                (Some(found), _) => Some(found.pose),
                // Walls that stand far off are why it did not match.
                (None, Search::Around(pose)) => Some(pose),
                (None, Search::Anywhere) => None,
            };
            if let Some(near) = near {
                self.learn_wall_offset(&pending.points, near);
            }
        }
        matches
    }

    fn learn_wall_offset(&mut self, points: &[[f32; 2]], near: Pose) {
        let distance = self.parameters.wall_offset_distance;
        if distance <= 0.0 {
            return;
        }
        let Some(seen) = fit_offset(&self.map.field, points, near, self.wall_offset.offset) else {
            return;
        };
        self.wall_offset.learn(seen, near, distance);
        let steps = self.map.steps(self.wall_offset.offset);
        if (steps - f64::from(self.walls.steps)).abs() > 0.75 {
            self.walls = self.map.walls(steps.round() as i32);
        }
    }
}
