//! Maps of race tracks: occupancy grids, racelines, distance fields and exact ray casting.
//!
//! Everything here is pure but for the loaders, which read files. Nothing here knows of particles, cars
//! or networks.
mod grid;
mod pose;
mod raceline;

pub use grid::{Cell, OccupancyGrid};
pub use pose::{Pose, wrap_angle};
pub use raceline::{Raceline, RacelinePoint, TrackPosition};
