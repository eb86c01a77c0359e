//! Maps of race tracks: occupancy grids, racelines, distance fields and exact ray casting.
//!
//! Everything here is pure but for the loaders, which read files. Nothing here knows of particles, cars
//! or networks.
mod distance_field;
mod error;
mod faces;
mod grid;
mod map_file;
mod marching_squares;
mod polyline;
mod pose;
mod raceline;
mod raceline_file;
mod raster;
mod ray_cast;

pub use distance_field::{DistanceField, Sample, solidity};
pub use error::{MapError, read_text};
pub use grid::{Cell, OccupancyGrid};
pub use map_file::{MapMetadata, MapMode};
pub use marching_squares::{CORNERS, Crossing, zero_lines};
pub use pose::{Pose, wrap_angle};
pub use raceline::{Raceline, RacelineFault, RacelinePoint, TrackPosition};
