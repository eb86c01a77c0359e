//! Recordings on the car's own disk, for when the link to the pit wall is cut.
//!
//! A recording is a series of MCAP files of limited size. When all of them together are larger than the limit, the oldest is
//! deleted. Each file begins with the map and can be read alone.
//!
//! | channel | encoding | content |
//! |---|---|---|
//! | `synpf/v1/<car>/<topic>` | `synpf-v1` | every message that the car sends, as on the wire, header and all; and the map |
//! | `pitwall/<car>/note` | json | what the pit wall fetches by query: that the car is there, and its info |
//! | `/scan`, `/odom`, `/imu` | cdr | what the localizer got, as ROS 2 messages; of the IMU the yaw rate only |
//! | `/ground_truth/odom` | cdr | the truth, where the source knows it |
//! | `/tf_static` | cdr | how the laser is mounted |
//!
//! So `pitwall` reads a file as one of its own, merges it with one by sequence numbers, and `car-node evaluate --bag` runs the
//! filter over it again. The full-rate streams are in it whether they are sent or not.
//!
//! ```text
//! publisher --offer--> queue --every 0.4 s--> file --sync--> disk
//! ```
//!
//! Recording never delays the filter or the publisher: a full queue drops what is offered and counts it.

mod file_server;
mod file_writer;
mod folder;
mod recorder;
mod ros_channels;

pub use file_server::FileServer;
pub use file_writer::FileHead;
pub use folder::{RecordedFile, RecordingFolder};
pub use recorder::{Entry, Launch, RecordError, RecordOptions, Recorder, RecorderThread};
pub use ros_channels::RosMessage;
