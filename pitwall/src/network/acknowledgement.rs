//! Acknowledgements of alarms, told to all pit walls on the network: who acknowledges on one page or terminal does so for all.

use protocol::Command;
use serde::{Deserialize, Serialize};
use zenoh::sample::Sample;

use super::error::ConnectionError;

/// The key that acknowledgements are put on. No car has such a name. Keys allow a pit wall what is under `synpf`, and nothing else.
const KEY: &str = "synpf/v1/_pitwall/acknowledged";

/// An operator has acknowledged all alarms so far.
#[derive(Serialize, Deserialize)]
struct Acknowledgement {
    operator: String,
    /// The program that it comes from, which has done so already.
    program: String,
}

/// Tells the other programs.
pub(super) async fn tell(session: &zenoh::Session, operator: &str) {
    let program = session.zid().to_string();
    let message = Acknowledgement {
        operator: operator.to_owned(),
        program,
    };
    let Ok(json) = serde_json::to_vec(&message) else {
        return;
    };
    if let Err(error) = session.put(KEY, json).await {
        tracing::debug!(%error, "the other pit walls were not told");
    }
}

/// Calls `on_acknowledged` with the operator whenever another program acknowledges.
pub(super) async fn watch(
    session: &zenoh::Session,
    on_acknowledged: impl Fn(&str) + Send + Sync + 'static,
) -> Result<Box<dyn Send + Sync>, ConnectionError> {
    let own = session.zid().to_string();
    let subscriber = session
        .declare_subscriber(KEY)
        .callback(move |sample: Sample| {
            let bytes = sample.payload().to_bytes();
            // What is not ours to read is ignored: anybody can put anything here.
            if let Ok(message) = serde_json::from_slice::<Acknowledgement>(&bytes)
                && message.program != own
                && message.operator.len() <= Command::MAX_OPERATOR
            {
                on_acknowledged(&message.operator);
            }
        })
        .await;
    match subscriber {
        Ok(subscriber) => Ok(Box::new(subscriber)),
        Err(error) => Err(ConnectionError::subscribe(KEY, &error)),
    }
}
