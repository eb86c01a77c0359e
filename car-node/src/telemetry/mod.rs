//! What the car sends: the queue, the publisher, what is kept to be sent again, and the load.

pub mod counters;
pub mod load;
pub mod publisher;
pub mod queue;
pub mod replay_buffer;
pub mod shared_state;
pub mod throttle;
