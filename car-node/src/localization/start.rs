//! Where a localizer starts.

use maps::Pose;

/// The start of a localizer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Start {
    /// At this `map_from_base_link`.
    Pose(Pose),
    /// At the true pose, as a simulator or a bag with ground truth knows it.
    Truth,
    /// Without a pose: the localizer searches the whole map.
    Global,
}
