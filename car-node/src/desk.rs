//! The thread that takes commands and questions off the network, and hands the clerk's answers back.
//!
//! ```text
//! query --> known id? the same answer again
//!           payload broken? refused, counted
//!           sets: keeper plans --> filter swaps between two updates --> keeper commits --> file, event, answer
//!           pose, search: filter does it --> event, answer
//! ```

mod answers;
mod clerk;
mod file;

use std::thread::{self, JoinHandle};
use std::time::Duration;

use crossbeam_channel::{Receiver, select};
use protocol::Topic;
use zenoh::Wait;
use zenoh::query::Query;

pub use self::answers::{Answered, Print};
pub use self::clerk::{Clerk, Desk, SEARCH_PATIENCE};
pub use self::file::{FileError, StateFile};

/// Deadlines and proposals are looked at this often.
const TICK: Duration = Duration::from_millis(50);

/// What is asked of the car, with the way to answer.
#[derive(Debug)]
pub struct Inquiry {
    /// Under which topic it came.
    pub topic: Topic,
    /// The question itself.
    pub query: Query,
}

/// Starts the thread. It ends when `stop` is dropped.
pub fn start(
    desk: Desk,
    inquiries: Receiver<Inquiry>,
    stop: Receiver<()>,
) -> std::io::Result<JoinHandle<()>> {
    thread::Builder::new().name("desk".into()).spawn(move || {
        let mut clerk = Clerk::new(desk);
        loop {
            select! {
                recv(stop) -> _ => return,
                recv(inquiries) -> inquiry => match inquiry {
                    Ok(inquiry) => serve(&mut clerk, &inquiry),
                    Err(_) => return,
                },
                default(TICK) => {}
            }
            clerk.look_at_the_clock();
        }
    })
}

fn serve(clerk: &mut Clerk, inquiry: &Inquiry) {
    let Inquiry { topic, query } = inquiry;
    let payload = query.payload().map(|payload| payload.to_bytes());
    // One command is for one car: a wildcard would switch the whole field.
    let answer = if query.key_expr().is_wild() {
        Err(clerk.unreadable(*topic, "a command needs one car's key, without wildcards".into()))
    } else {
        clerk.answer(*topic, payload.as_deref())
    };
    let told = match answer {
        Ok(bytes) => query.reply(query.key_expr().clone(), bytes).wait(),
        Err(error) => query.reply_err(error).wait(),
    };
    if let Err(error) = told {
        // Whoever asked sees that no answer came, and asks again under the same id.
        tracing::debug!(%error, "nobody to answer");
    }
}
