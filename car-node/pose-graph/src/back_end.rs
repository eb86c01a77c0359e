//! The back end's work: nodes matched with the frozen map, and the graph optimized. It may run on another thread.

use std::sync::Arc;

use maps::Pose;

use crate::constraint_builder::{Search, match_with_map};
use crate::frozen_map::FrozenMap;
use crate::graph::{Graph, MapMatch, NodeId};
use crate::parameters::PoseGraphParameters;

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
    /// The graph with its new matches, optimized.
    pub(crate) graph: Graph,
}

impl BackEndWork {
    /// Does it. The same work has the same outcome, on whatever thread.
    pub(crate) fn run(mut self) -> BackEndOutcome {
        let matches: Vec<NodeMatch> = self
            .pending
            .iter()
            .filter_map(|pending| {
                let found = match_with_map(&self.map, &pending.points, pending.search, &self.parameters)?;
                Some(NodeMatch {
                    node: pending.node,
                    search: pending.search,
                    predicted: pending.predicted,
                    found,
                })
            })
            .collect();
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
            graph: self.graph,
        }
    }
}
