//! Recordings: one MCAP file with all cars.
//!
//! Every message is written twice. A replay reads the bytes as received, under the key of the message, and therefore has
//! the same events as the live pit wall. Other tools read the same content as JSON under `/<car>/...`, in Foxglove's
//! schemas if there is one.
//!
//! | channel | encoding | content |
//! |---|---|---|
//! | `synpf/v1/<car>/<topic>` | `synpf-v1` | the message as received, with its header |
//! | `pitwall/<car>/note` | json | events that are not messages: a car appeared or vanished, its clock, unreadable messages |
//! | `/<car>/pose` | json, `foxglove.PoseInFrame` | pose of `base_link` in `map` |
//! | `/<car>/tf` | json, `foxglove.FrameTransform` | the same as a transform |
//! | `/<car>/cloud` | json, `foxglove.PosesInFrame` | particles |
//! | `/<car>/scan` | json, `foxglove.PointCloud` | end points of the scan |
//! | `/<car>/map` | json, `foxglove.Grid` | the map |
//! | `/<car>/event` | json, `foxglove.Log` | events |
//! | `/<car>/{state,health,load,params}` | json | our own |
//!
//! The log time is the arrival by the laptop's clock, the publish time is the car's.
mod check;
mod error;
pub(crate) mod fetch;
mod foxglove;
mod merge;
mod note;
mod ordered;
mod reader;
mod recorder;
mod recover;
mod ros_bag;
mod salvage;
mod session;
mod session_index;
mod summary;
mod survey;
mod unreadable;
mod writer;

/// What the car's program calls itself at the start of its files.
const CAR_LIBRARY: &str = "car-node";

pub use check::{CarCheck, Check, GapCheck, RunCheck, StreamCheck, check};
pub use error::RecordingError;
pub use fetch::{FetchError, FetchOptions, FetchProgress, Fetched, FileSource, fetch};
pub use merge::{Merged, MergedInput, merge};
pub use ordered::{InOrder, read_in_order};
pub use reader::{Recording, read_events};
pub use recorder::{Recorder, RecorderOptions, RecorderStatus, RecordingProgress};
pub use recover::{Damage, Recovered, recover};
pub use ros_bag::RosBag;
pub use session::session_name;
pub use session_index::{Session, SessionIndex, SessionIndexError};
pub use summary::{RecordingSummary, StreamSummary, missing_content};
pub(crate) use survey::{Survey, survey};
pub use unreadable::{Unreadable, UnreadableCount};
