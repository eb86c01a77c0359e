//! One query to a car, and its replies.

use std::time::Duration;

use protocol::{CarName, Key, Stamps, Topic};
use tokio::sync::mpsc;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::ConsolidationMode;

use crate::clock::unix_now;

/// The priority of commands and of queries that an operator waits for: ahead of telemetry.
pub(super) const OPERATOR_PRIORITY: Priority = Priority::InteractiveHigh;
/// A full queue drops a query and never blocks its sender.
pub(super) const CONGESTION: CongestionControl = CongestionControl::Drop;

/// Sends a query, with a signature as its attachment. Every reply within `timeout` goes to `replies`, with the query's priority.
#[expect(clippy::too_many_arguments, reason = "each is a part of the query")]
pub(super) async fn query(
    session: &zenoh::Session,
    car: &CarName,
    topic: Topic,
    request: Vec<u8>,
    signature: Option<Vec<u8>>,
    timeout: Duration,
    priority: Priority,
    replies: &mpsc::UnboundedSender<Vec<u8>>,
) {
    let key = Key::new(car.clone(), topic).to_string();
    let replies = replies.clone();
    let sent = session
        .get(&key)
        .payload(request)
        .attachment(signature)
        .timeout(timeout)
        .consolidation(ConsolidationMode::None)
        .congestion_control(CONGESTION)
        .priority(priority)
        .callback(move |reply| match reply.into_result() {
            // After the first reply the receiver may be gone.
            Ok(sample) => drop(replies.send(sample.payload().to_bytes().into_owned())),
            Err(error) => tracing::debug!(?error, "the reply is an error"),
        })
        .await;
    if let Err(error) = sent {
        tracing::debug!(%key, %error, "the query could not be sent");
    }
}

/// The first reply to a query; None if there is none within `timeout`.
pub(super) async fn first_reply(
    session: &zenoh::Session,
    car: &CarName,
    topic: Topic,
    request: Vec<u8>,
    timeout: Duration,
    priority: Priority,
) -> Option<Vec<u8>> {
    let (sender, mut replies) = mpsc::unbounded_channel();
    query(session, car, topic, request, None, timeout, priority, &sender).await;
    // The query holds the other sender until it is answered or times out. Then `recv` returns None.
    drop(sender);
    replies.recv().await
}

/// The stamps of a query or a command: only the time of sending matters.
pub(super) fn stamps() -> Stamps {
    Stamps {
        published: unix_now(),
        ..Stamps::default()
    }
}
