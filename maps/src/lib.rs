//! Maps of race tracks: occupancy grids, racelines, distance fields and exact ray casting.
//!
//! The crate reads maps as `map_server` does, and Cartographer's states ([`OccupancyGrid::load`]), and racelines of several
//! tools ([`Raceline::load`]). It measures ranges and distances on them. It also defines [`Pose`], the rigid transform of the
//! plane that all crates use.
//!
//! It never localizes, never simulates and never uses a network. Only the loaders touch files; everything else depends on
//! its arguments alone.
//!
//! ```
//! use maps::{DistanceField, OccupancyGrid, Pose};
//!
//! // A row of three free cells of 1 m between two walls, in a map of 5 x 3 m.
//! let yaml = "image: map.pgm\nresolution: 1.0\norigin: [0, 0, 0]\n";
//! let image = b"P2 5 3 255  0 0 0 0 0  0 254 254 254 0  0 0 0 0 0";
//! let grid = OccupancyGrid::from_parts(yaml, image)?;
//!
//! // A laser in the middle of the first free cell looks along x.
//! let laser = Pose::new(1.5, 1.5, 0.0);
//! assert!((grid.cast(laser, 10.0) - 2.5).abs() < 1e-9);
//!
//! // The nearest wall's face is half a metre away.
//! let field = DistanceField::new(&grid);
//! assert!((field.distance([2.5, 1.5]) - 0.5).abs() < 0.01);
//! # Ok::<(), maps::MapError>(())
//! ```
mod bmp;
mod distance_field;
mod error;
mod faces;
mod grid;
mod image_file;
mod map_file;
mod marching_squares;
mod pbstream;
mod pgm;
mod polyline;
mod pose;
mod raceline;
mod raceline_csv;
mod raceline_file;
mod raceline_rows;
mod raster;
mod ray_cast;

pub use distance_field::{DistanceField, Sample, solidity};
pub use error::{MapError, read_text};
pub use grid::{Cell, OccupancyGrid};
pub use map_file::{MapMetadata, MapMode};
pub use marching_squares::{CORNERS, Crossing, zero_lines};
pub use pbstream::{PbStream, TrajectoryNode, is_pbstream, write_pbstream};
pub use pose::{Pose, wrap_angle};
pub use raceline::{Raceline, RacelineFault, RacelinePoint, TrackPosition};
