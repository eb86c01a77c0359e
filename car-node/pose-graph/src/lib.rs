//! Pose-graph localization on a known map, after Hess, Kohler, Rapp and Andor, "Real-Time Loop Closure in 2D LIDAR SLAM"
//! (ICRA 2016), in the form that Cartographer calls pure localization.
//!
//! Each scan is matched with a submap of the scans before it. Some of them become nodes of a graph, and some of these are
//! matched with the known map, which is frozen. Every few nodes the graph is optimized over a window of the last submaps, and
//! its last submap says where the local frame stands in the map.
//!
//! The crate is a [`localizer::Localizer`]. It has no clock, no file, no thread and no randomness: the same log gives the same
//! bytes. What takes longer than a scan, the back end, comes out of [`localizer::Localizer::take_job`] and may run elsewhere.
//!
//! | part | file |
//! |---|---|
//! | pose extrapolator | `pose_extrapolator.rs` |
//! | voxel filters, motion filter | `voxel_filter.rs`, `motion_filter.rs` |
//! | submaps as probability grids | `probability_grid.rs`, `submap.rs` |
//! | real-time correlative scan matcher | `correlative_matcher.rs` |
//! | non-linear scan matcher | `nonlinear_matcher.rs` |
//! | constraint builder with branch and bound | `constraint_builder.rs`, `branch_and_bound.rs` |
//! | offset of the map's walls | `wall_offset.rs`, `frozen_map.rs` |
//! | pose graph, trimming, optimization | `graph.rs`, `optimization.rs`, `back_end.rs` |
//! | parameters, a team's Lua file | `parameters.rs`, `lua.rs` |
//!
//! ```
//! use std::sync::Arc;
//!
//! use localizer::{Localizer, Odometry, Scan, Stamp, Twist};
//! use maps::{Cell, DistanceField, OccupancyGrid, Pose};
//! use pose_graph::{FrozenMap, PoseGraph, PoseGraphParameters};
//!
//! // A room of 5 m x 4 m.
//! let wall = |x: usize, y: usize| x < 2 || y < 2 || x > 97 || y > 77;
//! let cell = |i: usize| if wall(i % 100, i / 100) { Cell::Occupied } else { Cell::Free };
//! let grid = OccupancyGrid::new(100, 80, 0.05, Pose::IDENTITY, (0..8000).map(cell).collect());
//! let field = DistanceField::new(&grid);
//! let range = |beam: usize| grid.cast(Pose::new(2.0, 2.0, 0.01 * beam as f64), 30.0) as f32;
//! let ranges = (0..628).map(range).collect();
//!
//! let map = Arc::new(FrozenMap::new(Arc::new(grid.clone()), Arc::new(field)));
//! let mut localizer = PoseGraph::new(map, Pose::IDENTITY, PoseGraphParameters::default())?;
//! localizer.initialize(Pose::new(2.0, 2.0, 0.0))?;
//! localizer.on_odometry(&Odometry { stamp: Stamp(0), pose: Pose::IDENTITY, twist: Twist::default() })?;
//! let update = localizer.on_scan(&Scan {
//!     stamp: Stamp(10_000_000),
//!     angle_min: 0.0,
//!     angle_increment: 0.01,
//!     time_increment: 0.0,
//!     scan_time: None,
//!     angle_max: None,
//!     range_min: 0.05,
//!     range_max: 30.0,
//!     ranges,
//! })?;
//! assert!(update.alignment > 0.9);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod back_end;
mod branch_and_bound;
mod constraint_builder;
mod correlative_matcher;
mod frozen_map;
mod graph;
mod local_trajectory_builder;
mod lua;
mod match_errors;
mod motion_filter;
mod nonlinear_matcher;
mod optimization;
mod parameters;
mod pose_extrapolator;
mod pose_graph;
mod probability_grid;
mod range_data;
mod sampler;
mod scan_points;
mod slip;
mod submap;
#[cfg(test)]
mod test_room;
mod voxel_filter;
mod wall_offset;

pub use frozen_map::FrozenMap;
pub use lua::LuaConfiguration;
pub use parameters::PoseGraphParameters;
pub use pose_graph::{PoseGraph, PoseGraphTuning, SetUpError};
