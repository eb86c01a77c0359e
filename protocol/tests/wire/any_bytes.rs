//! Any bytes, as any message and as any key: refused or read, and what was read is written again as it came.
//!
//! Shared by the tests here and by the fuzz target, which looks where the dice do not fall.

use protocol::{
    Answer, CarInfo, ClockReply, ClockRequest, Cloud, Command, Event, FilesReply, FilesRequest, Header,
    Health, Key, LinkReport, Load, MapReply, Message, MissingReply, MissingRequest, Params, Pose,
    RecordedOdometry, RecordedScan, ScanView, Schema, Shadow, Stamps, Telemetry, Topic, Truth, decode,
    encode,
};

/// Checks that nothing but good comes of `data`.
pub(crate) fn check(data: &[u8]) {
    if let Ok(text) = std::str::from_utf8(data)
        && let Ok(key) = text.parse::<Key>()
    {
        assert_eq!(key.to_string(), text);
    }
    as_everything(data);
    // The first byte picks a message whose header is sound, so that the payload is looked at, too.
    if let Some((&pick, payload)) = data.split_first() {
        let schema = Schema::ALL[usize::from(pick) % Schema::ALL.len()];
        let version = 1 + u16::from(pick / 64);
        let mut bytes = Header::new(schema, version, Stamps::default())
            .to_bytes()
            .to_vec();
        bytes.extend_from_slice(payload);
        as_everything(&bytes);
    }
}

fn as_everything(bytes: &[u8]) {
    for topic in Topic::all() {
        drop(Telemetry::decode(topic, bytes));
    }
    there_and_back::<Pose>(bytes);
    there_and_back::<Cloud>(bytes);
    there_and_back::<ScanView>(bytes);
    there_and_back::<Health>(bytes);
    there_and_back::<Load>(bytes);
    there_and_back::<Params>(bytes);
    there_and_back::<Event>(bytes);
    there_and_back::<RecordedOdometry>(bytes);
    there_and_back::<RecordedScan>(bytes);
    there_and_back::<Truth>(bytes);
    there_and_back::<Shadow>(bytes);
    there_and_back::<MapReply>(bytes);
    there_and_back::<CarInfo>(bytes);
    there_and_back::<ClockRequest>(bytes);
    there_and_back::<ClockReply>(bytes);
    there_and_back::<Command>(bytes);
    there_and_back::<Answer>(bytes);
    there_and_back::<LinkReport>(bytes);
    there_and_back::<MissingRequest>(bytes);
    there_and_back::<MissingReply>(bytes);
    there_and_back::<FilesRequest>(bytes);
    there_and_back::<FilesReply>(bytes);
}

fn there_and_back<M: Message>(bytes: &[u8]) {
    if let Ok((header, message)) = decode::<M>(bytes) {
        let stamps = Stamps {
            run_id: header.run_id,
            sequence: header.sequence,
            sensor: header.sensor,
            published: header.published,
        };
        if header.version != M::VERSION {
            return;
        }
        // There are no two ways to write the same, such as a bool of 2.
        assert_eq!(encode(&message, stamps).expect("was valid"), bytes);
    }
}
