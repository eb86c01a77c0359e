//! Recordings: one MCAP file per session, all cars.
//!
//! Every message is written twice. The bytes as they came, under the key they came on, are what a replay reads:
//! it sees the same events as the live pit wall did. Beside them, under `/<car>/...`, stand the same contents as
//! JSON in Foxglove's schemas where there is one, for the tools that everybody has.
//!
//! | channel | encoding | content |
//! |---|---|---|
//! | `synpf/v1/<car>/<topic>` | `synpf-v1` | the message as it came, header and all |
//! | `pitwall/<car>/note` | json | what no message carries: a car came or went, its clock, unreadable payloads |
//! | `/<car>/pose` | json, `foxglove.PoseInFrame` | pose of `base_link` in `map` |
//! | `/<car>/tf` | json, `foxglove.FrameTransform` | the same as a transform |
//! | `/<car>/cloud` | json, `foxglove.PosesInFrame` | particles |
//! | `/<car>/scan` | json, `foxglove.PointCloud` | end points of the scan |
//! | `/<car>/map` | json, `foxglove.Grid` | the map |
//! | `/<car>/event` | json, `foxglove.Log` | events |
//! | `/<car>/{state,health,load,params}` | json | our own |
//!
//! The log time is the arrival by the laptop's clock, the publish time is the car's.
mod error;
mod foxglove;
mod note;
mod reader;
mod recorder;
mod recover;
mod salvage;
mod summary;
mod unreadable;
mod writer;

pub use error::RecordingError;
pub use reader::{Recording, read_events};
pub use recorder::{Recorder, RecorderStatus, RecordingProgress};
pub use recover::{Damage, Recovered, recover};
pub use summary::{RecordingSummary, StreamSummary};
pub use unreadable::{Unreadable, UnreadableCount};
