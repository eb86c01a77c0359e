//! Malformed messages on every key, in both directions: refused, counted, logged once, and without other effect.

use std::time::Duration;

use pitwall::FleetService;
use protocol::{
    Action, CarName, Command, CommandId, Header, Key, LinkReport, Message, ParamsAction, Stamps, Topic,
    encode,
};
use system_tests::{free_endpoint, in_force, router, select, send_command, start_real, stranger, wait_until};
use zenoh::qos::CongestionControl;

/// Random bytes that are the same in every run (xorshift, Marsaglia 2003).
fn random(length: usize, mut state: u64) -> Vec<u8> {
    std::iter::repeat_with(|| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 32) as u8
    })
    .take(length)
    .collect()
}

/// None of these is a message of any topic.
fn garbage() -> Vec<Vec<u8>> {
    let stamps = Stamps::default();
    let command = Command {
        id: CommandId(1),
        operator: "stranger".into(),
        expected_revision: None,
        action: select("lq"),
    };
    let command = encode(&command, stamps).expect("a good message");
    let report = LinkReport {
        transit: 0.1,
        uncertainty: 0.001,
        poses: 40,
    };
    let report = encode(&report, stamps).expect("a good message");
    let mut garbage = vec![
        Vec::new(),
        vec![0],
        b"SYPF".to_vec(),
        vec![0xff; 39],
        vec![0xff; 40],
    ];
    // Cut off within the header, at its end, and within the payload; and with something behind.
    for message in [&command, &report] {
        garbage.extend([1, 20, 40, message.len() - 1].map(|length| message[..length].to_vec()));
        garbage.push([&message[..], &[0]].concat());
    }
    // A good header with nonsense behind it, and what no message is as long as.
    garbage.push([&command[..40], &random(200, 7)].concat());
    garbage.push([&report[..40], &vec![0; Command::MAX_LEN + 1]].concat());
    garbage.push(vec![0; 2 << 20]);
    garbage.extend((1..6).map(|seed| random(50 * seed as usize, seed)));
    garbage
}

/// Topics that a car receives.
const TO_CAR: [Topic; 10] = [
    Topic::Clock,
    Topic::Link,
    Topic::Missing,
    Topic::Files,
    Topic::CmdRecord,
    Topic::CmdParams,
    Topic::CmdPose,
    Topic::CmdRelocalize,
    Topic::CmdRates,
    Topic::CmdAuto,
];

/// Topics that a pit wall receives.
const TO_WALL: [Topic; 11] = [
    Topic::Pose,
    Topic::Cloud,
    Topic::Scan,
    Topic::Health,
    Topic::Load,
    Topic::Params,
    Topic::Event,
    Topic::Shadow,
    Topic::RecordedPose,
    Topic::RecordedOdometry,
    Topic::RecordedScan,
];

#[tokio::test(flavor = "multi_thread")]
async fn malformed_messages_are_refused_counted_and_logged_once() {
    let endpoint = free_endpoint();
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    service
        .connection()
        .subscribe_recorded(true)
        .await
        .expect("subscribed");
    let car = CarName::new("car-1").expect("a good name");
    let node = start_real(&car, 0.0, &endpoint, None);
    let updates = || {
        service
            .fleet()
            .car(&car)
            .and_then(|car| car.pose)
            .map_or(0, |(_, pose)| pose.update)
    };
    assert!(
        service
            .wait_until(Duration::from_secs(90), |fleet| {
                fleet
                    .car(&car)
                    .is_some_and(|car| car.params.is_some() && car.pose.is_some())
            })
            .await
    );
    let before = in_force(&service, &car);
    let stranger = stranger(&endpoint).await;
    let garbage = garbage();
    for topic in Topic::all() {
        let key = Key::new(car.clone(), topic).to_string();
        for bytes in &garbage {
            // Nothing may be dropped before it is refused.
            let sent = stranger.put(&key, bytes.clone());
            sent.congestion_control(CongestionControl::Block)
                .await
                .expect("sent");
            let replies = stranger
                .get(&key)
                .payload(bytes.clone())
                .timeout(Duration::from_secs(5))
                .await
                .expect("sent");
            // One after the other: a full queue would drop them unread.
            while let Ok(reply) = replies.recv_async().await {
                assert!(
                    reply.result().is_err() || matches!(topic, Topic::Map | Topic::Info),
                    "{topic} answered to {} bytes",
                    bytes.len()
                );
            }
        }
    }
    // The car counts what it receives, and reports the count with its load.
    let expected = (TO_CAR.len() * garbage.len()) as u64;
    let counted = || {
        let fleet = service.fleet();
        fleet
            .car(&car)
            .and_then(|car| Some(car.load.as_ref()?.drops.payloads))
    };
    wait_until("every one of them is counted", || counted() >= Some(expected)).await;
    assert_eq!(counted(), Some(expected));
    // The pit wall counts what it receives, and logs it once. What has a header is of a run that is not the car's, and dropped.
    let nobodys = garbage
        .iter()
        .filter(|bytes| Header::read(bytes).is_err())
        .count() as u64;
    for topic in TO_WALL {
        wait_until(topic.as_str(), || {
            let views = service.fleet().view(pitwall::unix_now());
            let unreadable = views[0]
                .streams
                .get(topic.as_str())
                .map(|stream| stream.unreadable);
            unreadable >= Some(nobodys)
        })
        .await;
        let word = format!("{topic} cannot be read");
        let fleet = service.fleet();
        let said = fleet
            .log()
            .since(0)
            .filter(|entry| entry.text.starts_with(&word))
            .count();
        assert_eq!(said, 1, "{topic}");
    }
    // The car drives on, on the set that it had, and takes commands.
    let last = updates();
    wait_until("the car drives on", || updates() > last + 40).await;
    assert_eq!(in_force(&service, &car), before);
    let verdict = send_command(&service, &car, "ana", None, Action::Params(ParamsAction::List)).await;
    assert_eq!(verdict.exit_code(), 0, "{verdict:?}");
    node.shutdown("test over");
    service.close().await;
}
