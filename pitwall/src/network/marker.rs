//! Markers, which pit walls send to each other: a JSON text under `synpf/v1/<car>/marker`. Every recorder has them, whoever set
//! them. Cars do not listen.

use std::sync::Arc;

use protocol::CarName;
use serde::{Deserialize, Serialize};

use crate::event::EventPayload;

/// The markers of all cars.
pub(super) const OF_ALL_CARS: &str = "synpf/v1/*/marker";

/// Longest marker \[bytes\].
const MAX_LEN: usize = 4096;

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Marker {
    who: String,
    text: String,
}

pub(super) fn key(car: &CarName) -> String {
    OF_ALL_CARS.replace('*', car.as_str())
}

pub(super) fn encode(who: &str, text: &str) -> String {
    serde_json::json!({"who": who, "text": text}).to_string()
}

/// The event of a marker; None for one that is damaged.
pub(super) fn decode(key: &str, bytes: &[u8]) -> Option<(CarName, EventPayload)> {
    let (before, after) = OF_ALL_CARS.split_once('*')?;
    let car = key.strip_prefix(before)?.strip_suffix(after)?.parse().ok()?;
    if bytes.len() > MAX_LEN {
        tracing::debug!(key, length = bytes.len(), "ignored a marker that is too long");
        return None;
    }
    let Marker { who, text } = serde_json::from_slice(bytes)
        .inspect_err(|error| tracing::debug!(key, %error, "ignored a damaged marker"))
        .ok()?;
    let (who, text) = (Arc::from(who), Arc::from(text));
    Some((car, EventPayload::Marker { who, text }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decode_undoes_encode_and_refuses_the_rest() {
        let car: CarName = "car-1".parse().expect("a name");
        let (key, bytes) = (key(&car), encode("ana", "a \"crash\""));
        let Some((decoded, EventPayload::Marker { who, text })) = decode(&key, bytes.as_bytes()) else {
            panic!("a marker");
        };
        assert_eq!((decoded, &*who, &*text), (car, "ana", "a \"crash\""));
        let long = encode("ana", &"x".repeat(MAX_LEN));
        for bytes in [&b"{"[..], b"{}", b"\xff", long.as_bytes()] {
            assert!(decode(&key, bytes).is_none());
        }
        assert!(decode("synpf/v1/Car 1/marker", bytes.as_bytes()).is_none());
    }
}
