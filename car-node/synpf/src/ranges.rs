//! Predicted ranges.

use std::sync::Arc;

use crate::cddt::Cddt;
use crate::range_table::RangeTable;

/// Where predicted ranges come from in the region that the particles are in.
#[derive(Debug, Clone)]
pub(crate) enum Ranges {
    /// Looked up.
    Table(Arc<RangeTable>),
    /// Marched on the distance field.
    RayMarching,
    /// Searched for in the sorted crossings with walls.
    Cddt(Arc<Cddt>),
}
