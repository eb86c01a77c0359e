//! Serves the map to the car's own nodes, unless another node does: `map_server` of nav2 belongs to many cars. It is watched while the car
//! runs, so that the map is there when that node has gone, and ours is not when it has come.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, after, bounded};
use zenoh::Wait;
use zenoh::handlers::Callback;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};

use super::graph::{Durability, RosNode, RosPublisher};
use super::messages::RosGrid;
use super::types;

/// Others must have come or gone for so long: a node that starts again is away for a moment.
const SETTLED: Duration = Duration::from_millis(500);
/// More servers are not kept.
const MOST_SERVERS: usize = 64;

/// The map on its topic, latched.
pub(super) struct MapServer {
    node: Arc<RosNode>,
    topic: String,
    map: RosGrid,
    /// The tokens of other nodes that serve it.
    others: Arc<Mutex<BTreeSet<String>>>,
    /// Keeps the map for late subscribers; None while another node serves it.
    publisher: Option<RosPublisher>,
    /// The others have changed.
    changes: Receiver<()>,
    /// They have not changed for a while.
    settled: Receiver<Instant>,
    _subscriber: Subscriber<()>,
}

impl MapServer {
    /// Watches the topic. The map is served from half a second later on, if nobody else does.
    pub(super) fn start(node: &Arc<RosNode>, topic: String, map: RosGrid) -> zenoh::Result<Self> {
        let others = Arc::<Mutex<BTreeSet<String>>>::default();
        let (changed, changes) = bounded(1);
        let callback = Callback::from({
            let (node, others) = (Arc::clone(node), Arc::clone(&others));
            move |sample: Sample| {
                let token = sample.key_expr().as_str();
                if !node.yields_to(token) {
                    return;
                }
                let mut others = others.lock().unwrap_or_else(PoisonError::into_inner);
                if sample.kind() == SampleKind::Delete {
                    others.remove(token);
                } else if others.len() < MOST_SERVERS {
                    others.insert(token.to_owned());
                }
                // One that has not been looked at yet is enough.
                changed.try_send(()).ok();
            }
        });
        let subscriber = node
            .session()
            .liveliness()
            .declare_subscriber(node.tokens_of_publishers(&topic, types::OCCUPANCY_GRID))
            .history(true)
            .with(callback)
            .wait()?;
        Ok(Self {
            node: Arc::clone(node),
            topic,
            map,
            others,
            publisher: None,
            changes,
            settled: after(SETTLED),
            _subscriber: subscriber,
        })
    }

    /// Sends when others have come or gone.
    pub(super) fn changes(&self) -> &Receiver<()> {
        &self.changes
    }

    /// Sends once after the last change.
    pub(super) fn settled(&self) -> &Receiver<Instant> {
        &self.settled
    }

    /// Waits anew for the others to settle.
    pub(super) fn on_change(&mut self) {
        self.settled = after(SETTLED);
    }

    /// Serves the map or withdraws it. Returns what was done, for people.
    pub(super) fn on_settled(&mut self) -> Option<String> {
        let other = !self
            .others
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .is_empty();
        let topic = &self.topic;
        match (&self.publisher, other) {
            (Some(_), true) => {
                self.publisher = None;
                Some(format!("{topic}: another node serves the map; ours is withdrawn"))
            }
            (None, false) => {
                let latched = Durability::Latched(1);
                match self.node.publisher(topic, types::OCCUPANCY_GRID, latched) {
                    Ok(mut publisher) => {
                        publisher.publish(&self.map);
                        self.publisher = Some(publisher);
                        None
                    }
                    Err(error) => Some(format!("{topic}: the map cannot be served: {error}")),
                }
            }
            _ => None,
        }
    }
}
