//! Encode and decode are inverse; bytes that are no message are refused, and nothing panics.

use proptest::collection::vec;
use proptest::prelude::*;
use protocol::*;

use crate::{any_bytes, samples};

fn stamps() -> impl Strategy<Value = Stamps> {
    any::<(u64, u64, i64, i64)>().prop_map(|(run_id, sequence, sensor, published)| Stamps {
        run_id,
        sequence,
        sensor,
        published,
    })
}

fn there_and_back<M: Message + PartialEq + std::fmt::Debug>(
    message: &M,
    stamps: Stamps,
) -> Result<(), TestCaseError> {
    let bytes = encode(message, stamps).expect("a good message");
    let (header, back) = decode::<M>(&bytes).expect("our own bytes");
    prop_assert_eq!(header, Header::new(M::SCHEMA, M::VERSION, stamps));
    prop_assert_eq!(&back, message);
    prop_assert_eq!(encode(&back, stamps).expect("the same message"), bytes);
    Ok(())
}

proptest! {
    #[test]
    fn pose(m in samples::any_pose(), s in stamps()) { there_and_back(&m, s)?; }

    #[test]
    fn cloud(m in samples::any_cloud(), s in stamps()) { there_and_back(&m, s)?; }

    #[test]
    fn health(m in samples::any_health(), s in stamps()) { there_and_back(&m, s)?; }

    #[test]
    fn command(m in samples::any_command(), s in stamps()) { there_and_back(&m, s)?; }

    #[test]
    fn scan(m in samples::any_scan(), s in stamps()) { there_and_back(&m, s)?; }

    #[test]
    fn truncated_messages_are_refused(m in samples::any_health(), cut: prop::sample::Index) {
        let bytes = encode(&m, Stamps::default()).expect("a good message");
        prop_assert!(decode::<Health>(&bytes[..cut.index(bytes.len())]).is_err());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1500))]

    #[test]
    fn random_bytes_are_refused(bytes: Vec<u8>, topic in prop::sample::select(Topic::all().collect::<Vec<_>>())) {
        let random = Telemetry::decode(topic, &bytes);
        prop_assert!(random.is_none_or(|r| r.is_err()));
        any_bytes::check(&bytes);
    }

    // Every kind of message, with some of its bytes overwritten, a piece cut out, or one put in.
    #[test]
    fn damaged_messages_are_refused_or_read(
        pick: prop::sample::Index,
        overwritten in vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        cut in prop::option::of((any::<prop::sample::Index>(), 1_usize..16)),
        put_in in prop::option::of((any::<prop::sample::Index>(), vec(any::<u8>(), 1..16))),
    ) {
        let all = samples::all();
        let mut bytes = all[pick.index(all.len())].clone();
        for (at, value) in overwritten {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if let Some((at, length)) = cut {
            let at = at.index(bytes.len());
            bytes.drain(at..(at + length).min(bytes.len()));
        }
        if let Some((at, more)) = put_in {
            let at = at.index(bytes.len() + 1);
            bytes.splice(at..at, more);
        }
        any_bytes::check(&bytes);
    }
}

#[test]
fn every_kind_of_message_comes_back() {
    fn check<M: Message + PartialEq + std::fmt::Debug>(message: &M) {
        there_and_back(message, Stamps::default()).expect("the same message");
    }
    check(&samples::scan_view());
    check(&samples::load());
    check(&samples::params());
    check(&samples::shadow());
    check(&samples::map());
    check(&samples::info());
    for request in samples::files_requests() {
        check(&request);
    }
    for reply in samples::files_replies() {
        check(&reply);
    }
    check(&Truth {
        pose: samples::POSE,
        twist: samples::TWIST,
    });
    for kind in samples::event_kinds() {
        check(&samples::event(kind));
    }
    for action in samples::actions() {
        check(&samples::command(action));
    }
    for outcome in samples::outcomes() {
        check(&samples::answer(outcome));
    }
}

#[test]
fn trailing_bytes_are_refused() {
    let mut bytes = encode(&samples::pose(), Stamps::default()).expect("a good message");
    bytes.push(0);
    assert!(matches!(decode::<Pose>(&bytes), Err(CodecError::Trailing { .. })));
}

#[test]
fn an_oversize_payload_is_refused_before_it_is_read() {
    let mut bytes = Header::new(Schema::Pose, 1, Stamps::default())
        .to_bytes()
        .to_vec();
    bytes.resize(Header::LEN + Pose::MAX_LEN + 1, 0);
    assert_eq!(
        decode::<Pose>(&bytes),
        Err(CodecError::TooLong {
            len: Pose::MAX_LEN + 1,
            max: Pose::MAX_LEN
        })
    );
}

#[test]
fn a_length_that_the_payload_does_not_have_is_refused() {
    // A scan whose list of ranges claims 2^60 entries.
    let mut bytes = encode(&samples::recorded_scan(), Stamps::default()).expect("a good message");
    let length = bytes.len() - 2 * 2 - 8;
    bytes[length..length + 8].copy_from_slice(&(1u64 << 60).to_le_bytes());
    assert!(matches!(
        decode::<RecordedScan>(&bytes),
        Err(CodecError::Payload(_))
    ));
}

#[test]
fn another_version_says_what_to_do() {
    let mut bytes = encode(&samples::pose(), Stamps::default()).expect("a good message");
    bytes[6] = 2;
    let error = decode::<Pose>(&bytes).expect_err("version 2");
    assert_eq!(
        error.to_string(),
        "Pose has version 2, this program reads version 1: update the older side"
    );
}

#[test]
fn another_message_is_refused() {
    let bytes = encode(&samples::pose(), Stamps::default()).expect("a good message");
    let error = decode::<Cloud>(&bytes).expect_err("a pose");
    assert_eq!(error.to_string(), "the message is a Pose, not a Cloud");
}

#[test]
fn no_number_is_refused_both_ways() {
    for value in [f64::NAN, f64::INFINITY] {
        let mut pose = samples::pose();
        pose.pose.heading = value;
        let error = encode(&pose, Stamps::default()).expect_err("no number");
        assert!(error.to_string().starts_with("invalid value: heading"), "{error}");
    }
    let mut bytes = encode(&samples::pose(), Stamps::default()).expect("a good message");
    bytes[Header::LEN..Header::LEN + 8].copy_from_slice(&f64::NAN.to_le_bytes());
    let error = decode::<Pose>(&bytes).expect_err("no number");
    assert_eq!(error.to_string(), "invalid value: x: NaN is not a number");
}

#[test]
fn rules_hold_both_ways() {
    let refused = |error: CodecError, field: &str| {
        assert!(
            matches!(&error, CodecError::Invalid(invalid) if invalid.field == field),
            "{error}"
        );
    };
    let encode_error = |command: Command| encode(&command, Stamps::default()).expect_err("a bad command");
    let mut nobody = samples::command(Action::Auto(true));
    nobody.operator.clear();
    refused(encode_error(nobody), "operator");
    for name in ["", "../hq", "HQ", &"x".repeat(65)] {
        let delete = ParamsAction::Delete { name: name.into() };
        refused(encode_error(samples::command(Action::Params(delete))), "name");
    }
    let mut set = samples::parameter_set();
    set.values.push(set.values[0].clone());
    let put = ParamsAction::Put {
        set,
        revert_after_ms: None,
    };
    refused(encode_error(samples::command(Action::Params(put))), "values");

    let mut map = samples::map();
    map.width = 4;
    refused(
        encode(&map, Stamps::default()).expect_err("too few cells"),
        "runs",
    );
    map.width = u32::MAX;
    refused(
        encode(&map, Stamps::default()).expect_err("too many cells"),
        "width",
    );

    let mut cloud = samples::cloud();
    cloud.ess_ratio = 1.5;
    refused(
        encode(&cloud, Stamps::default()).expect_err("no share"),
        "ess_ratio",
    );
    cloud.ess_ratio = 1.0;
    cloud.particles = vec![cloud.particles[0]; Cloud::MAX_PARTICLES + 1];
    refused(
        encode(&cloud, Stamps::default()).expect_err("too many"),
        "particles",
    );
}
