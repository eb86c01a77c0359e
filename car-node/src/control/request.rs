//! A query as it arrives from the network, and the threads that reply to queries.

use std::io;
use std::thread::{self, JoinHandle};

use crossbeam_channel::{Receiver, select};
use protocol::Topic;
use zenoh::Wait;
use zenoh::query::Query;

/// A query under one of the car's topics. It can be replied to.
#[derive(Debug)]
pub struct Request {
    /// The topic that it came under.
    pub topic: Topic,
    /// The query itself.
    pub query: Query,
}

/// Starts a thread that replies to each request with the bytes or the error that `answer` makes of its topic and payload. It
/// ends when `stop` is dropped.
pub(crate) fn serve(
    name: &str,
    requests: Receiver<Request>,
    stop: Receiver<()>,
    answer: impl Fn(Topic, Option<&[u8]>) -> Result<Vec<u8>, String> + Send + 'static,
) -> io::Result<JoinHandle<()>> {
    thread::Builder::new().name(name.into()).spawn(move || {
        loop {
            let Request { topic, query } = select! {
                recv(stop) -> _ => return,
                recv(requests) -> request => match request {
                    Ok(request) => request,
                    Err(_) => return,
                },
            };
            let payload = query.payload().map(|payload| payload.to_bytes());
            let sent = match answer(topic, payload.as_deref()) {
                Ok(bytes) => query.reply(query.key_expr().clone(), bytes).wait(),
                Err(error) => query.reply_err(error).wait(),
            };
            if let Err(error) = sent {
                tracing::debug!(%error, "the reply could not be sent");
            }
        }
    })
}
