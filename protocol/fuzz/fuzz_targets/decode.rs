//! Any bytes, as any message: refused or read, and what was read is written again as it came.
#![no_main]

use libfuzzer_sys::fuzz_target;
use protocol::{
    Answer, CarInfo, ClockReply, ClockRequest, Command, Header, LinkReport, MapReply, Message, Schema, Stamps,
    Telemetry, Topic, decode, encode,
};

fn there_and_back<M: Message>(bytes: &[u8]) {
    if let Ok((header, message)) = decode::<M>(bytes) {
        let stamps = Stamps {
            session: header.session,
            sequence: header.sequence,
            sensor: header.sensor,
            published: header.published,
        };
        // Not the same bytes only where two encodings mean the same, such as a bool of 2: there are none.
        assert_eq!(encode(&message, stamps).expect("was valid"), bytes);
    }
}

fuzz_target!(|data: &[u8]| {
    for topic in Topic::all() {
        drop(Telemetry::decode(topic, data));
    }
    // The first byte picks a message whose header is sound, so that the payload is looked at, too.
    if let Some((&pick, payload)) = data.split_first() {
        let schema = Schema::ALL[usize::from(pick) % Schema::ALL.len()];
        let mut bytes = Header::new(schema, 1, Stamps::default()).to_bytes().to_vec();
        bytes.extend_from_slice(payload);
        there_and_back::<Command>(&bytes);
        there_and_back::<Answer>(&bytes);
        there_and_back::<LinkReport>(&bytes);
        there_and_back::<ClockRequest>(&bytes);
        there_and_back::<ClockReply>(&bytes);
        there_and_back::<CarInfo>(&bytes);
        there_and_back::<MapReply>(&bytes);
        for topic in Topic::all() {
            drop(Telemetry::decode(topic, &bytes));
        }
    }
});
