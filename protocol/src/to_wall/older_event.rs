//! Reads events of versions 1 and 2, which older recordings and older cars have.
//!
//! The structs here never change. Kinds that are not named here have kept their layout. When a kind changes, its old
//! fields come here.

use serde::Deserialize;

use crate::codec::Payload;
use crate::{CodecError, CommandId, Event, EventKind, Pose2};

/// Reads the payload of a known version.
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
    #[expect(dead_code, reason = "the caller has read it to choose K")]
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

/// Before version 2: without the rates.
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
            text: "telemetry rates changed; the car's version does not send how".to_owned(),
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
