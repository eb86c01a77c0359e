//! Why a localizer could not be set up.

use localizer::{ParameterFault, PoseError};

/// Why a localizer could not be set up.
#[derive(Debug, thiserror::Error)]
pub enum SetUpError {
    /// The map has no free cell, so there is nowhere to be.
    #[error("the map has no free cell ({width} x {height} cells)")]
    NoFreeSpace {
        /// Cells along x.
        width: usize,
        /// Cells along y.
        height: usize,
    },
    /// Every cell of the map has the same state, so a scan cannot show where the car is.
    #[error("the map has no wall ({width} x {height} cells)")]
    NoWall {
        /// Cells along x.
        width: usize,
        /// Cells along y.
        height: usize,
    },
    /// A parameter set with faults, all of them.
    #[error("parameter set refused: {}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))]
    Parameters(Vec<ParameterFault>),
    /// A mount or a pose that cannot be.
    #[error(transparent)]
    Pose(#[from] PoseError),
}
