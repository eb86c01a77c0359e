//! A query as it arrives from the network.

use protocol::Topic;
use zenoh::query::Query;

/// A query under one of the car's topics. It can be replied to.
#[derive(Debug)]
pub struct Request {
    /// The topic that it came under.
    pub topic: Topic,
    /// The query itself.
    pub query: Query,
}
