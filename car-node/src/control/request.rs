//! A query as it comes off the network.

use protocol::Topic;
use zenoh::query::Query;

/// A query under one of the car's topics, with the way to reply.
#[derive(Debug)]
pub struct Request {
    /// The topic that it came under.
    pub topic: Topic,
    /// The query itself.
    pub query: Query,
}
