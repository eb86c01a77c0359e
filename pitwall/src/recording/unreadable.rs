//! Messages in a recording that cannot be decoded, because of their version or of damage in transit.

use std::collections::BTreeMap;
use std::fmt;

use protocol::{CarName, Topic};
use serde::Serialize;

use crate::event::{EventPayload, FleetEvent};

/// Messages of one stream that cannot be decoded.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Unreadable {
    /// The car.
    pub car: CarName,
    /// The stream.
    pub topic: Topic,
    /// How many.
    pub messages: u64,
    /// The error of the first of them.
    pub error: String,
}

impl fmt::Display for Unreadable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            car,
            topic,
            messages,
            error,
        } = self;
        let messages = match messages {
            1 => "1 message is".to_owned(),
            n => format!("{n} messages are"),
        };
        write!(
            f,
            "{car} {topic}: {messages} left out because they cannot be decoded: {error}"
        )
    }
}

/// Counts messages that cannot be decoded, by stream.
#[derive(Debug, Default)]
pub struct UnreadableCount(BTreeMap<(CarName, Topic), (u64, String)>);

impl UnreadableCount {
    /// Counts an event if it is unreadable.
    pub fn add(&mut self, event: &FleetEvent) {
        if let EventPayload::Unreadable { topic, error, .. } = &event.payload {
            let (messages, _) = self
                .0
                .entry((event.car.clone(), *topic))
                .or_insert_with(|| (0, error.clone()));
            *messages += 1;
        }
    }

    /// The counts by stream.
    pub fn list(&self) -> Vec<Unreadable> {
        let of = |((car, topic), (messages, error)): (&(CarName, Topic), &(u64, String))| Unreadable {
            car: car.clone(),
            topic: *topic,
            messages: *messages,
            error: error.clone(),
        };
        self.0.iter().map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::reader::tests::event;
    use crate::recording::writer::RecordingWriter;
    use crate::{Replay, Report, read_events};
    use std::sync::Arc;

    #[test]
    fn messages_of_another_version_are_left_out_and_reported() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("session.mcap");
        let file = std::fs::File::create(&path).expect("a file");
        let mut recording = RecordingWriter::new(file).expect("begun");
        for (number, version) in [(1, 1), (2, 99), (3, 2), (4, 99), (5, 3)] {
            recording.write(&event(number, Some(version))).expect("written");
        }
        // One that the pit wall that recorded could not read either.
        let mut unread = event(6, None);
        if let EventPayload::Message { topic, header, .. } = unread.payload {
            unread.payload = EventPayload::Unreadable {
                topic,
                header: Some(header),
                error: "damaged".into(),
            };
        }
        recording.write(&unread).expect("written");
        recording.write(&event(8, None)).expect("written");
        recording.finish().expect("ended");

        let read: Vec<_> = read_events(&path)
            .expect("opens")
            .map(|event| matches!(event.expect("goes on").payload, EventPayload::Message { .. }))
            .collect();
        assert_eq!(read, [true, false, true, false, true, false, true]);
        let report = Report::of(&path).expect("a report");
        let texts: Vec<_> = report.unreadable.iter().map(ToString::to_string).collect();
        let expected = "car-1 event: 3 messages are left out because they cannot be decoded: Event has version 99, this program \
                        reads version 3: update the older side";
        assert_eq!(texts, [expected]);
        assert_eq!(
            report.cars[0].missing, 1,
            "number 7; the others are left out, not missing"
        );
        assert!(report.to_html().contains(expected));
        let replay: Arc<Replay> = Replay::start(&path).expect("it plays");
        assert_eq!(replay.unreadable(), report.unreadable);
        replay.stop();
    }
}
