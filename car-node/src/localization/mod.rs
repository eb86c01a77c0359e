//! The thread that owns the localizer, the shadow set, and the lap counter.

mod external;
pub mod filter_command;
pub mod filter_worker;
mod job_worker;
pub mod lap_counter;
mod localizer_parameters;
mod map_watch;
mod pace;
mod ros_feed;
pub mod shadow;
pub mod shadow_channel;
mod start;
pub mod table_worker;
pub(crate) mod views;

pub use external::{External, ExternalParameters};
pub use localizer_parameters::{EXTERNAL, KIND_KEY, LocalizerParameters};
pub(crate) use pace::Pace;
pub use start::Start;
