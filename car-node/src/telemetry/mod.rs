//! What the car sends: queue, publisher, replay buffer, throttle and load.

pub mod counters;
pub mod load;
pub mod publisher;
pub mod queue;
pub mod replay_buffer;
pub mod shared_state;
pub mod throttle;
