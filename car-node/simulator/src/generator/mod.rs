//! Generated tracks: walls from a centre line, a raceline between them, and the map that SLAM would draw of them.

mod generate;
mod mapping;
mod minimum_curvature;
mod random;
mod ring;
mod spec;
mod spline;

pub use mapping::{MappingParams, draw_map};
pub use minimum_curvature::{LineError, minimum_curvature};
pub use spec::{BlackStretch, Block, TrackSpec};
