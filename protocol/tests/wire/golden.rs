//! The bytes on the wire, one message of each kind. A failure here means that a message's layout has changed: give
//! it a new version, do not mend the bytes.

use protocol::*;

use crate::samples;

const STAMPS: Stamps = Stamps {
    run_id: 1,
    sequence: 2,
    sensor: 3,
    published: 4,
};

/// The payload of a message in hexadecimal digits.
fn payload(message: &impl Message) -> String {
    let bytes = encode(message, STAMPS).expect("a good message");
    hex(&bytes[Header::LEN..])
}

fn hex(bytes: &[u8]) -> String {
    bytes
        .iter()
        .fold(String::new(), |digits, b| digits + &format!("{b:02x}"))
}

#[test]
fn header() {
    let bytes = encode(&ClockRequest { sent: 5 }, STAMPS).expect("a good message");
    assert_eq!(
        hex(&bytes),
        concat!(
            "53595046",
            "0d00",
            "0100",
            "0100000000000000",
            "0200000000000000",
            "0300000000000000",
            "0400000000000000",
            "0500000000000000",
        )
    );
}

#[test]
fn schemas_keep_their_numbers() {
    let ids: Vec<_> = Schema::ALL.iter().map(|&schema| schema as u16).collect();
    assert_eq!(ids, (1..=22).collect::<Vec<_>>());
    assert_eq!(Schema::from_id(7), Some(Schema::Event));
    assert_eq!(Schema::from_id(0), None);
}

/// Topics travel in questions for what is missing.
#[test]
fn topics_keep_their_numbers() {
    let tags: Vec<_> = Topic::all()
        .map(|topic| {
            let request = MissingRequest {
                run_id: 0,
                streams: vec![Wanted {
                    topic,
                    ranges: Vec::new(),
                }],
                budget: 0,
            };
            let bytes = encode(&request, STAMPS).expect("a good message");
            // Run id 8, the list's length 8.
            let tag = bytes[Header::LEN + 16..].first_chunk().expect("a tag");
            u32::from_le_bytes(*tag)
        })
        .collect();
    assert_eq!(tags, (0..26).collect::<Vec<_>>());
}

#[test]
fn variants_keep_their_numbers() {
    fn tags<M: Message>(messages: impl IntoIterator<Item = M>, at: usize) -> Vec<u32> {
        let tag = |message: M| {
            let bytes = encode(&message, STAMPS).expect("a good message");
            let tag = bytes[Header::LEN + at..].first_chunk().expect("a tag");
            u32::from_le_bytes(*tag)
        };
        messages.into_iter().map(tag).collect()
    }
    let count = |n: u32| (0..n).collect::<Vec<_>>();
    assert_eq!(tags(samples::STATES.map(samples::health), 0), count(7));
    assert_eq!(
        tags(samples::event_kinds().into_iter().map(samples::event), 0),
        count(28)
    );
    // A command: id 16, operator 8 + 3, revision 1 + 8.
    let commands = || samples::actions().into_iter().map(samples::command);
    assert_eq!(
        tags(commands(), 36),
        [0, 0, 0, 0, 0, 0, 1, 2, 2, 3, 3, 4, 0, 5, 5, 5]
    );
    let about_sets = commands().take(6).chain(commands().skip(12).take(1));
    assert_eq!(tags(about_sets, 40), count(7));
    // An answer: id 16, the outcome, and for Done the update 1 + 8.
    let answers = || samples::outcomes().into_iter().map(samples::answer);
    assert_eq!(tags(answers(), 16), [0, 0, 0, 0, 0, 1, 2]);
    assert_eq!(tags(answers().take(5), 29), count(5));
}

/// The payload that `golden.txt` has under `name`.
fn golden(name: &str) -> &'static str {
    include_str!("golden.txt")
        .lines()
        .find_map(|line| line.strip_prefix(name)?.strip_prefix(": "))
        .unwrap_or("missing in golden.txt")
}

/// A message of an older version, of which the payload is given.
fn older<M: Message>(version: u16, payload: &str) -> M {
    let header = Header::new(M::SCHEMA, version, STAMPS);
    let digits = payload.replace(' ', "");
    let mut bytes = header.to_bytes().to_vec();
    bytes.extend((0..digits.len()).step_by(2).map(|at| {
        let digits = &digits[at..at + 2];
        u8::from_str_radix(digits, 16).expect("hexadecimal digits")
    }));
    let (back, message) = decode::<M>(&bytes).expect("a good message");
    assert_eq!(back, header);
    message
}

#[test]
fn health_of_version_2_is_read() {
    let mut expected = samples::health(State::Degraded);
    let last = expected.causes.pop().map(|cause| cause.kind);
    assert_eq!(
        last,
        Some(CauseKind::OdometryStands),
        "version 2 knows all but this"
    );
    assert_eq!(older::<Health>(2, golden("health of version 2")), expected);
}

#[test]
fn health_of_version_1_is_read() {
    let mut expected = samples::health(State::Degraded);
    // The causes of sensors came later.
    expected.causes.truncate(21);
    let last = expected.causes.pop().map(|cause| cause.kind);
    assert_eq!(
        last,
        Some(CauseKind::OdometryJump),
        "version 1 knows all but this"
    );
    assert_eq!(older::<Health>(1, golden("health of version 1")), expected);
}

#[test]
fn load_of_version_1_is_read() {
    let expected = Load {
        recorder: None,
        ..samples::load()
    };
    assert_eq!(older::<Load>(1, golden("load of version 1")), expected);
}

/// Events as cars of versions 1 and 2 have sent them.
#[test]
fn events_of_older_versions_are_read() {
    let event = older::<Event>;
    // Update 77, by `ana`, under a command.
    let rest = "4d00000000000000 01 0300000000000000 616e61 01 100f0e0d0c0b0a090807060504030201";
    let stored = EventKind::SetStored {
        name: "wet".into(),
        from: String::new(),
        changes: Vec::new(),
    };
    assert_eq!(stored.to_string(), "set wet stored");
    let pose = "000000000000f83f 00000000000002c0 000000000000e03f";
    let kinds = [
        (
            "0c000000 0000803e".to_owned(),
            EventKind::SlipStarted { slip: 0.25 },
        ),
        ("06000000 0300000000000000 776574".to_owned(), stored),
        (
            format!("08000000 {pose}"),
            EventKind::PoseInitialized {
                before: None,
                pose: samples::POSE,
            },
        ),
        (
            "10000000".to_owned(),
            EventKind::Warning {
                text: "telemetry rates changed; the car's version does not send how".into(),
            },
        ),
        (
            "18000000 0000003f 00002041".to_owned(),
            EventKind::RatesLowered {
                transit: 0.5,
                pose: 10.0,
                recorded: true,
            },
        ),
    ];
    for (i, (bytes, kind)) in kinds.into_iter().enumerate() {
        let expected = samples::event(kind);
        assert_eq!(event(1, &format!("{bytes} {rest}")), expected);
        // Of those, version 2 has changed the last three.
        if i < 2 {
            assert_eq!(event(2, &format!("{bytes} {rest}")), expected);
        }
    }
    let before = EventKind::PoseInitialized {
        before: Some(samples::POSE),
        pose: samples::POSE,
    };
    let bytes = format!("08000000 01 {pose} {pose} {rest}");
    assert_eq!(event(2, &bytes), samples::event(before));
}

macro_rules! payloads {
    ($($name:ident: $message:expr;)*) => {
        $(#[test]
        fn $name() {
            assert_eq!(payload(&$message), golden(stringify!($name)));
        })*
    };
}

payloads! {
    pose: samples::pose();
    cloud: samples::cloud();
    scan_view: samples::scan_view();
    health: samples::health(State::Degraded);
    load: samples::load();
    params: samples::params();
    event: samples::event(EventKind::SlipStarted { slip: 0.25 });
    odometry: RecordedOdometry { pose: samples::POSE, twist: samples::TWIST };
    scan: samples::recorded_scan();
    truth: Truth { pose: samples::POSE, twist: samples::TWIST };
    map: samples::map();
    info: samples::info();
    clock_reply: ClockReply { sent: 1, received: 2, answered: 3 };
    command: samples::command(samples::actions().swap_remove(1));
    shadow: samples::shadow();
    link_report: LinkReport { transit: 0.25, uncertainty: 0.125, poses: 40 };
    missing_request: samples::missing_request();
    missing_reply: samples::missing_reply();
    answer: samples::answer(samples::outcomes().swap_remove(1));
    files_read: samples::files_requests()[1];
    files_list: samples::files_replies()[0];
    files_checksum: samples::files_replies()[2];
    record_command: samples::command(samples::actions().swap_remove(14));
    recorder_answer: samples::answer(samples::outcomes().swap_remove(4));
}
