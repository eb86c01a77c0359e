//! Commands and queries: what the pit wall may ask of a car, and what it may change.
//!
//! ```text
//! query --> known id? the same reply again
//!           payload broken? refused, counted
//!           sets: store plans --> filter swaps between two updates --> store commits --> file, event, reply
//!           pose, search: filter does it --> event, reply
//! ```

mod answer_cache;
mod asker_versions;
mod command_handler;
pub mod command_server;
mod local_commands;
pub mod parameter_sets;
pub mod parameter_store;
pub mod persisted_state;
pub mod query_server;
mod request;
mod state_file;

pub use answer_cache::{CachedAnswer, PayloadHash};
pub use command_handler::{CommandHandler, CommandHandlerConfig, SEARCH_PATIENCE};
pub use local_commands::{LocalCommands, LocalRequest};
pub use request::Request;
pub(crate) use request::serve;
pub use state_file::{StateFile, StateFileError};
