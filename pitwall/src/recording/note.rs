//! Events in a recording that are not messages.

use std::sync::Arc;

use protocol::{CarInfo, CarName, Header, Topic};
use serde::{Deserialize, Serialize};

use crate::event::{EventPayload, Rejection, RunEnd, SentRange};

/// An event that is not a message.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "note")]
pub(super) enum Note {
    Appeared,
    Vanished,
    Unreadable {
        topic: Topic,
        /// Older recordings have none.
        #[serde(default)]
        header: Option<Header>,
        error: String,
    },
    Rejected {
        topic: Topic,
        run_id: u64,
        sequence: u64,
        count: u64,
        reason: Rejection,
    },
    StreamEnds {
        run_id: u64,
        published: i64,
        /// Older recordings have none.
        #[serde(default)]
        end: RunEnd,
        outstanding: Vec<SentRange>,
    },
    Info {
        info: CarInfo,
    },
    Clock {
        /// Older recordings have none.
        #[serde(default)]
        run_id: Option<u64>,
        offset: i64,
        round_trip: i64,
    },
    Marker {
        who: String,
        text: String,
    },
}

impl Note {
    /// Start of every note's channel.
    pub(super) const PREFIX: &str = "pitwall/";
    const SUFFIX: &str = "/note";

    pub(super) fn channel(car: &CarName) -> String {
        format!("{}{car}{}", Self::PREFIX, Self::SUFFIX)
    }

    /// The car that a channel of notes is about.
    pub(super) fn car(channel: &str) -> Option<CarName> {
        channel
            .strip_prefix(Self::PREFIX)?
            .strip_suffix(Self::SUFFIX)?
            .parse()
            .ok()
    }

    /// The note for a payload; None for a payload that is stored as bytes.
    pub(super) fn of(payload: &EventPayload) -> Option<Self> {
        Some(match payload {
            EventPayload::Appeared => Self::Appeared,
            EventPayload::Vanished => Self::Vanished,
            EventPayload::Unreadable { topic, header, error } => Self::Unreadable {
                topic: *topic,
                header: *header,
                error: error.clone(),
            },
            EventPayload::Rejected {
                topic,
                run_id,
                sequence,
                count,
                reason,
            } => Self::Rejected {
                topic: *topic,
                run_id: *run_id,
                sequence: *sequence,
                count: *count,
                reason: *reason,
            },
            EventPayload::Info(info) => Self::Info { info: info.clone() },
            EventPayload::Clock {
                run_id,
                offset,
                round_trip,
            } => Self::Clock {
                run_id: *run_id,
                offset: *offset,
                round_trip: *round_trip,
            },
            EventPayload::Marker { who, text } => Self::Marker {
                who: who.to_string(),
                text: text.to_string(),
            },
            EventPayload::StreamEnds {
                run_id,
                published,
                end,
                outstanding,
            } => Self::StreamEnds {
                run_id: *run_id,
                published: *published,
                end: *end,
                outstanding: outstanding.clone(),
            },
            EventPayload::Message { .. } | EventPayload::Map { .. } => return None,
        })
    }
}

impl From<Note> for EventPayload {
    fn from(note: Note) -> Self {
        match note {
            Note::Appeared => Self::Appeared,
            Note::Vanished => Self::Vanished,
            Note::Unreadable { topic, header, error } => Self::Unreadable { topic, header, error },
            Note::Rejected {
                topic,
                run_id,
                sequence,
                count,
                reason,
            } => Self::Rejected {
                topic,
                run_id,
                sequence,
                count,
                reason,
            },
            Note::StreamEnds {
                run_id,
                published,
                end,
                outstanding,
            } => Self::StreamEnds {
                run_id,
                published,
                end,
                outstanding,
            },
            Note::Info { info } => Self::Info(info),
            Note::Clock {
                run_id,
                offset,
                round_trip,
            } => Self::Clock {
                run_id,
                offset,
                round_trip,
            },
            Note::Marker { who, text } => Self::Marker {
                who: Arc::from(who),
                text: Arc::from(text),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // The header's field `run_id` was once called `session`.
    #[test]
    fn notes_of_older_recordings_are_read() {
        let json = r#"{"note":"unreadable","topic":"event","header":{"schema":"Event","version":3,
            "session":7,"sequence":5,"sensor":1,"published":2},"error":"damaged"}"#;
        let note: Note = serde_json::from_str(json).expect("a note");
        let Note::Unreadable {
            header: Some(header), ..
        } = note
        else {
            panic!("{note:?}");
        };
        assert_eq!((header.run_id, header.sequence), (7, 5));
    }
}
