//! Messages to a car and the answers to them: commands, requests for lost messages and recorded files, link reports.

mod answer;
mod command;
mod files;
mod link_report;
mod missing;

pub use answer::{Answer, Candidate, Outcome, Reply, StoredSet};
pub use command::{
    Action, Command, CommandId, IdError, ParamsAction, Rates, RatesAction, RecordAction, RelocalizeAction,
};
pub use files::{FileInfo, FileName, FileNameError, FilesReply, FilesRequest, UtcTime};
pub use link_report::LinkReport;
pub use missing::{Kept, MissingReply, MissingRequest, Resent, Wanted};
