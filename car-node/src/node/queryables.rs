//! Declares the queries and commands that a car takes, and listens to the pit walls' reports of the link.

use std::sync::{Arc, PoisonError};

use crossbeam_channel::{Sender, TrySendError};
use protocol::{
    CarName, ClockReply, ClockRequest, EventKind, Key, LinkReport, Stamps, Topic, decode, encode,
};
use zenoh::pubsub::Subscriber;
use zenoh::query::{Query, Queryable};
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use crate::control::Request;
use crate::network::NetworkError;
use crate::sensors::clock::{SensorClock, wall_now};
use crate::telemetry::shared_state::SharedState;
use crate::telemetry::throttle::Change;

/// Declares every query and command. The servers reply to all but the clock's; zenoh's threads never wait.
pub(super) fn declare(
    session: &Session,
    car: &CarName,
    run_id: u64,
    to_command_server: &Sender<Request>,
    to_query_server: &Sender<Request>,
    to_file_server: &Sender<Request>,
    shared: &Arc<SharedState>,
) -> Result<Vec<Queryable<()>>, NetworkError> {
    let declare = |topic: Topic, callback: Box<dyn Fn(Query) + Send + Sync>| {
        let key = Key::new(car.clone(), topic).to_string();
        session
            .declare_queryable(key.clone())
            .callback(callback)
            .wait()
            .map_err(|error| NetworkError::Declare {
                key,
                reason: error.to_string(),
            })
    };
    let mut queryables = vec![declare(Topic::Clock, {
        let shared = Arc::clone(shared);
        Box::new(move |query| reply_clock(&query, run_id, &shared))
    })?];
    for topic in [
        Topic::Map,
        Topic::Info,
        Topic::Missing,
        Topic::CmdParams,
        Topic::CmdPose,
        Topic::CmdRelocalize,
        Topic::CmdRates,
        Topic::CmdAuto,
        Topic::CmdRecord,
        Topic::Files,
    ] {
        let server = match topic {
            Topic::Map | Topic::Info | Topic::Missing => to_query_server.clone(),
            Topic::Files => to_file_server.clone(),
            _ => to_command_server.clone(),
        };
        queryables.push(declare(
            topic,
            Box::new(move |query| match server.try_send(Request { topic, query }) {
                Ok(()) | Err(TrySendError::Disconnected(_)) => {}
                Err(TrySendError::Full(request)) => {
                    // Dropping the query ends it without a reply; its sender may try again.
                    tracing::warn!(%topic, "too many requests at once");
                    drop(request);
                }
            }),
        )?);
    }
    Ok(queryables)
}

/// Subscribes to the pit walls' reports of the link, and lowers the rates while it is slow.
pub(super) fn subscribe_to_link_reports(
    session: &Session,
    car: &CarName,
    shared: &Arc<SharedState>,
    clock: SensorClock,
) -> Result<Subscriber<()>, NetworkError> {
    let key = Key::new(car.clone(), Topic::Link).to_string();
    let shared = Arc::clone(shared);
    let handle = move |sample: Sample| {
        let Ok((_, report)) = decode::<LinkReport>(&sample.payload().to_bytes()) else {
            let count = shared.counters.bad_payload() + 1;
            if count.is_power_of_two() {
                tracing::warn!(topic = %Topic::Link, count, "a link report cannot be read");
            }
            return;
        };
        let change = shared
            .throttle
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .on_report(wall_now(), &report);
        let kind = match change {
            Some(Change::Lowered { transit, rates }) => EventKind::RatesLowered {
                transit: transit as f32,
                pose: rates.pose,
                recorded: rates.recorded,
            },
            Some(Change::Restored) => EventKind::RatesRestored,
            None => return,
        };
        shared.event(clock.now(), 0, kind, None, None);
    };
    session
        .declare_subscriber(key.clone())
        .callback(handle)
        .wait()
        .map_err(|error| NetworkError::Declare {
            key,
            reason: error.to_string(),
        })
}

/// Replies to a clock query with this machine's time.
fn reply_clock(query: &Query, run_id: u64, shared: &SharedState) {
    let received = wall_now();
    let request = query
        .payload()
        .and_then(|payload| decode::<ClockRequest>(&payload.to_bytes()).ok());
    let Some((_, request)) = request else {
        let count = shared.counters.bad_payload() + 1;
        if count.is_power_of_two() {
            tracing::warn!(topic = %Topic::Clock, count, "a clock query cannot be read");
        }
        return;
    };
    let reply = ClockReply {
        sent: request.sent,
        received: received.0,
        answered: wall_now().0,
    };
    let stamps = Stamps {
        run_id,
        sequence: 1,
        sensor: received.0,
        published: reply.answered,
    };
    if let Ok(bytes) = encode(&reply, stamps)
        && let Err(error) = query.reply(query.key_expr().clone(), bytes).wait()
    {
        tracing::debug!(%error, "the reply could not be sent");
    }
}
