//! The known map as a submap that stays as it is.

use std::sync::{Arc, OnceLock};

use maps::{Cell, DistanceField, OccupancyGrid};

use crate::branch_and_bound::PrecomputationGridStack;
use crate::probability_grid::{LEAST, MOST, ProbabilityGrid};

/// From the wall's face, a cell is likely to be occupied up to so many cells. At 2, scans of a real car match the map at wrong
/// places, metres off.
const WALL: f64 = 1.5;

/// The map that a car is localized on, shared between localizers. Its frame is the grid's: the corner is the origin.
#[derive(Debug)]
pub struct FrozenMap {
    pub(crate) occupancy: Arc<OccupancyGrid>,
    pub(crate) field: Arc<DistanceField>,
    pub(crate) grid: ProbabilityGrid,
    stacks: [OnceLock<PrecomputationGridStack>; DEPTHS],
}

/// Most levels of the branch-and-bound matcher.
const DEPTHS: usize = 10;

impl FrozenMap {
    /// A map from its grid and the distance field of that.
    ///
    /// A cell's probability falls with its distance from the wall's face, as it does in a grid that laser scans were inserted
    /// in. Maps are drawn with walls of any thickness, and within a thick one a scan could be anywhere.
    pub fn new(occupancy: Arc<OccupancyGrid>, field: Arc<DistanceField>) -> Self {
        let reach = WALL * occupancy.resolution;
        let cells = occupancy.cells.iter().zip(field.values());
        let probability = |(cell, &distance): (&Cell, &f32)| {
            let share = 1.0 - f64::from(distance).abs() / reach;
            let known = *cell != Cell::Unknown || share > 0.0;
            known.then(|| LEAST + (MOST - LEAST) * share.max(0.0))
        };
        let grid = ProbabilityGrid::from_probabilities(
            occupancy.width,
            occupancy.resolution,
            cells.map(probability),
        );
        Self {
            occupancy,
            field,
            grid,
            stacks: [const { OnceLock::new() }; DEPTHS],
        }
    }

    /// The levels for the branch-and-bound matcher, built when they are first needed.
    pub(crate) fn stack(&self, depth: usize) -> &PrecomputationGridStack {
        let depth = depth.clamp(1, DEPTHS);
        self.stacks[depth - 1].get_or_init(|| PrecomputationGridStack::new(&self.grid, depth))
    }
}
