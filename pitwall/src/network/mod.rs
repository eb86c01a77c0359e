//! The network side: the only modules that name zenoh.
//!
//! | file | what it does |
//! |---|---|
//! | `role.rs` | router or client, and the zenoh configuration of each |
//! | `connection.rs` | opens the zenoh session and subscribes |
//! | `flood_limit.rs` | what one car may send; pure |
//! | `decoder.rs` | a thread that decodes messages, puts them in order and finds gaps |
//! | `reorder_buffer.rs` | puts the messages of a stream in order and tracks which are missing; pure |
//! | `gap_recovery.rs` | decides which missing messages to request, and when; pure |
//! | `query.rs` | one query to a car |
//! | `recorders.rs` | what the recorders of all pit walls do |
//! | `client.rs` | queries and commands to a car |
//! | `verdict.rs` | the outcome of a command |

mod acknowledgement;
mod client;
mod connection;
mod decoder;
mod error;
mod flood_limit;
pub(crate) mod gap_recovery;
mod marker;
mod query;
pub(crate) mod recorders;
mod reorder_buffer;
mod role;
mod run_gate;
mod verdict;

pub use client::{CarFiles, Client, REPLY_TIMEOUT, new_command_id};
pub use connection::{Connection, Router, open_router};
pub use error::ConnectionError;
pub use recorders::{RecorderNews, RecorderView};
pub(crate) use role::endpoint;
pub use role::{LOCAL_PITWALL, Role};
pub use verdict::Verdict;
