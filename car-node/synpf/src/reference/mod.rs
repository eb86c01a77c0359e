//! The reference: ForzaETH's `particle_filter` (`synPF.py`) as it is shipped, for comparison.
//!
//! A localizer of its own, beside [`crate::SynPf`]. It shares the map with it, and neither state nor mode. Each tick,
//! one per odometry message, is the reference's:
//!
//! 1. `resample`: multinomial, in every tick;
//! 2. `motion`: one of four models, with noise per message;
//! 3. `reweight`: 21 boxed beams of the latest scan against a range table of 150 directions, by a sensor table in cells;
//!    the product over the beams to the power `1 / squash_factor`; particles off the track count a hundredth;
//! 4. the pose is the weighted mean.
//!
//! What is wrong with it is kept, each defect under a switch of [`ReferenceDefects`], so that every gain over it can be
//! attributed.
//!
//! Where it differs from the reference:
//! - A missing reading (NaN) counts as no return; the reference converts it to an integer, which is undefined.
//! - Odometry that arrives before the first scan moves the particles; the reference drops it.
//! - A pose is published with every scan and carries the stamp of the odometry that it belongs to; the reference
//!   publishes with every odometry message and stamps it with the time of the message before.
//! - The laser's yaw on the car counts; the reference assumes 0.
//! - Turns of odometry are wrapped; in the reference's `arc` and `default` models they are not.
//! - A search of the whole map ends when the particles have come together; the reference has no such state.

mod beams;
mod filter;
mod motion;
mod parameters;
mod particles;
mod range_table;
mod sensor_table;

pub use filter::{Reference, ReferenceTuning};
pub use parameters::ReferenceMotionModel;
pub use parameters::{ReferenceDefects, ReferenceParameters};
pub(crate) use range_table::RangeTables;
