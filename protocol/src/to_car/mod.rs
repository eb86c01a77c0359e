//! Messages to a car and the answers to them: commands, requests for lost messages, link reports.

mod answer;
mod command;
mod link_report;
mod missing;

pub use answer::{Answer, Candidate, Outcome, Reply, StoredSet};
pub use command::{Action, Command, CommandId, IdError, ParamsAction, Rates, RatesAction, RelocalizeAction};
pub use link_report::LinkReport;
pub use missing::{Kept, MissingReply, MissingRequest, Resent, Wanted};
