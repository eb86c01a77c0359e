//! Events of versions 1 and 2, read as events of today: recordings and cars of then have them. What stands here is
//! frozen. Kinds that are not named here have kept their layout; one that gets another leaves its old fields here.

use serde::Deserialize;

use crate::codec::Payload;
use crate::{CodecError, CommandId, Event, EventKind, Pose2};

/// The payload, if it is of a version that is known.
pub(super) fn read(version: u16, payload: &Payload<'_>) -> Option<Result<Event, CodecError>> {
    match (version, payload.variant()) {
        (1 | 2, Some(6)) => Some(with::<SetStored>(payload)),
        (1, Some(8)) => Some(with::<PoseInitialized>(payload)),
        (1, Some(16)) => Some(with::<RatesChanged>(payload)),
        (1, Some(24)) => Some(with::<RatesLowered>(payload)),
        (1 | 2, _) => Some(payload.read()),
        _ => None,
    }
}

/// Reads an event of a kind with the fields `K`.
fn with<K: Into<EventKind> + serde::de::DeserializeOwned>(
    payload: &Payload<'_>,
) -> Result<Event, CodecError> {
    let Older {
        kind,
        update,
        who,
        command,
        ..
    } = payload.read::<Older<K>>()?;
    Ok(Event {
        kind: kind.into(),
        update,
        who,
        command,
    })
}

#[derive(Deserialize)]
struct Older<K> {
    #[expect(dead_code, reason = "it has said that the kind is K")]
    variant: u32,
    kind: K,
    update: u64,
    who: Option<String>,
    command: Option<CommandId>,
}

/// Before version 3.
#[derive(Deserialize)]
struct SetStored {
    name: String,
}

/// Before version 2.
#[derive(Deserialize)]
struct PoseInitialized {
    pose: Pose2,
}

/// Before version 2: not from what, and not to what.
#[derive(Deserialize)]
struct RatesChanged;

/// Before version 2: the full-rate streams always went on.
#[derive(Deserialize)]
struct RatesLowered {
    transit: f32,
    pose: f32,
}

impl From<SetStored> for EventKind {
    fn from(SetStored { name }: SetStored) -> Self {
        Self::SetStored {
            name,
            from: String::new(),
            changes: Vec::new(),
        }
    }
}

impl From<PoseInitialized> for EventKind {
    fn from(PoseInitialized { pose }: PoseInitialized) -> Self {
        Self::PoseInitialized { before: None, pose }
    }
}

impl From<RatesChanged> for EventKind {
    fn from(RatesChanged: RatesChanged) -> Self {
        Self::Warning {
            text: "telemetry rates changed; this version of the car did not say how".to_owned(),
        }
    }
}

impl From<RatesLowered> for EventKind {
    fn from(RatesLowered { transit, pose }: RatesLowered) -> Self {
        Self::RatesLowered {
            transit,
            pose,
            recorded: true,
        }
    }
}
