//! The known map as a submap that stays as it is.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError, Weak};

use maps::{Cell, DistanceField, OccupancyGrid};

use crate::branch_and_bound::PrecomputationGridStack;
use crate::probability_grid::{LEAST, MOST, ProbabilityGrid};

/// From where a wall stands, a cell is likely to be occupied up to so many cells. At 2, scans of a real car match the map at wrong
/// places, metres off.
const REACH: f64 = 1.5;

/// Walls are moved in steps of this many cells.
const STEP: f64 = 0.2;

/// Most levels of the branch-and-bound matcher.
const DEPTHS: usize = 10;

/// The map that a car is localized on, shared between localizers. Its frame is the grid's: the corner is the origin.
#[derive(Debug)]
pub struct FrozenMap {
    pub(crate) occupancy: Arc<OccupancyGrid>,
    pub(crate) field: Arc<DistanceField>,
    /// The walls that some localizer uses, by the steps that they are moved.
    walls: Mutex<BTreeMap<i32, Weak<Walls>>>,
}

/// The map's walls for scans to be matched with, standing where the laser sees them.
#[derive(Debug)]
pub(crate) struct Walls {
    /// How far they stand from the drawn faces, in steps; see [`FrozenMap::steps`].
    pub(crate) steps: i32,
    pub(crate) grid: ProbabilityGrid,
    stacks: [OnceLock<PrecomputationGridStack>; DEPTHS],
}

impl FrozenMap {
    /// A map from its grid and the distance field of that.
    pub fn new(occupancy: Arc<OccupancyGrid>, field: Arc<DistanceField>) -> Self {
        Self {
            occupancy,
            field,
            walls: Mutex::default(),
        }
    }

    /// An offset of the walls \[m\] as a number of steps.
    pub(crate) fn steps(&self, offset: f64) -> f64 {
        offset / (STEP * self.occupancy.resolution)
    }

    /// The walls, moved by so many steps.
    pub(crate) fn walls(&self, steps: i32) -> Arc<Walls> {
        let mut walls = self.walls.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(walls) = walls.get(&steps).and_then(Weak::upgrade) {
            return walls;
        }
        let moved = Arc::new(Walls::new(self, steps));
        walls.insert(steps, Arc::downgrade(&moved));
        moved
    }
}

impl Walls {
    /// A cell's probability falls with its distance from where the wall stands, as it does in a grid that laser scans were inserted
    /// in. Maps are drawn with walls of any thickness, and within a thick one a scan could be anywhere.
    fn new(map: &FrozenMap, steps: i32) -> Self {
        let resolution = map.occupancy.resolution;
        let offset = f64::from(steps) * STEP * resolution;
        let cells = map.occupancy.cells.iter().zip(map.field.values());
        let probability = |(cell, &distance): (&Cell, &f32)| {
            let share = 1.0 - (f64::from(distance) - offset).abs() / (REACH * resolution);
            let known = *cell != Cell::Unknown || share > 0.0;
            known.then(|| LEAST + (MOST - LEAST) * share.max(0.0))
        };
        Self {
            steps,
            grid: ProbabilityGrid::from_probabilities(
                map.occupancy.width,
                resolution,
                cells.map(probability),
            ),
            stacks: [const { OnceLock::new() }; DEPTHS],
        }
    }

    /// The levels for the branch-and-bound matcher, built when they are first needed.
    pub(crate) fn stack(&self, depth: usize) -> &PrecomputationGridStack {
        let depth = depth.clamp(1, DEPTHS);
        self.stacks[depth - 1].get_or_init(|| PrecomputationGridStack::new(&self.grid, depth))
    }
}
