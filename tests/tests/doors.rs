//! Who gets in, and what they may do: keys, passphrase, and attacks on both.

use std::io::Write;
use std::net::{SocketAddr, TcpStream};
use std::process::{Child, Command as Process, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use keys::{Authority, Protection, Role, Side, Signer};
use pitwall::{FleetService, unix_now};
use protocol::{Action, Answer, CarName, Command, CommandId, Key, Outcome, Stamps, Topic, decode, encode};
use system_tests::{
    Behaviour, DEADLINE, FakeCar, alone, attack_factor as times, client, free_endpoint, in_force, is_named,
    log_has, named, nothing_is_lost, router, select, send_command, start_real_protected, three_cars,
    wait_until,
};
use zenoh::Session;
use zenoh::qos::CongestionControl;

/// A team with a laptop, three cars, one that does harm, and a viewer.
fn team() -> Authority {
    let mut authority = Authority::create(30).expect("an authority");
    for (role, name) in [
        (Role::Pit, "laptop"),
        (Role::Car, "car-1"),
        (Role::Car, "car-2"),
        (Role::Car, "car-3"),
        (Role::Car, "thief"),
        (Role::Viewer, "fan"),
    ] {
        authority.issue(role, named(name), &[]).expect("issued");
    }
    authority
}

fn keys_of(authority: &Authority, role: Role, name: &str) -> Protection {
    Protection::Keys(Arc::new(authority.bundle(role, &named(name)).expect("in force")))
}

/// A free endpoint for links with keys.
fn free_tls_endpoint() -> String {
    free_endpoint().replace("tcp/", "tls/")
}

async fn pit_wall(authority: &Authority, endpoint: &str) -> Arc<FleetService> {
    let keys = keys_of(authority, Role::Pit, "laptop");
    FleetService::open_protected(&router(endpoint), &keys)
        .await
        .expect("a pit wall")
}

/// A session that follows no rules but those of the other side. None when it is not let in.
async fn session(endpoint: &str, protection: &Protection) -> Option<Session> {
    session_with(client_of(endpoint), protection).await
}

/// The same of somebody who must be let in: a busy machine may need several attempts.
async fn let_in(endpoint: &str, protection: &Protection) -> Session {
    let deadline = Instant::now() + DEADLINE;
    loop {
        if let Some(session) = session(endpoint, protection).await {
            return session;
        }
        assert!(Instant::now() < deadline, "not let in within {DEADLINE:?}");
    }
}

async fn session_with<const N: usize>(
    settings: [(&'static str, String); N],
    protection: &Protection,
) -> Option<Session> {
    let protected = protection.settings(&Side::Client).expect("settings");
    let rules = protected
        .entries
        .into_iter()
        .filter(|(key, _)| *key != "access_control");
    open(settings.into_iter().chain(rules)).await
}

/// The same, encrypted for a host of the team, which shows no certificate.
async fn session_without_certificate(endpoint: &str, authority: &Authority) -> Option<Session> {
    let team = BASE64_STANDARD.encode(authority.certificate());
    let tls = serde_json::json!({"root_ca_certificate_base64": team, "verify_name_on_connect": false});
    open(
        client_of(endpoint)
            .into_iter()
            .chain([("transport/link/tls", tls.to_string())]),
    )
    .await
}

fn client_of(endpoint: &str) -> [(&'static str, String); 4] {
    [
        ("mode", r#""client""#.to_owned()),
        ("connect/endpoints", format!(r#"["{endpoint}"]"#)),
        ("connect/timeout_ms", "1500".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
    ]
}

async fn open(settings: impl Iterator<Item = (&'static str, String)>) -> Option<Session> {
    let mut config = zenoh::Config::default();
    for (key, value) in settings {
        config.insert_json5(key, &value).expect("a good setting");
    }
    zenoh::open(config).await.ok()
}

fn command(operator: &str, action: Action) -> Command {
    Command {
        id: pitwall::new_command_id(),
        operator: operator.into(),
        expected_revision: None,
        action,
    }
}

fn bytes(command: &Command) -> Vec<u8> {
    let stamps = Stamps {
        published: unix_now(),
        ..Stamps::default()
    };
    encode(command, stamps).expect("a good message")
}

/// Sends a command past our own client. Returns the answer, if any.
async fn send_raw(
    session: &Session,
    car: &CarName,
    topic: Topic,
    command: Vec<u8>,
    signature: Option<Vec<u8>>,
) -> Option<Answer> {
    let replies = session
        .get(Key::new(car.clone(), topic).to_string())
        .payload(command)
        .attachment(signature)
        .timeout(Duration::from_secs(5))
        .await
        .expect("sent");
    let reply = replies.recv_async().await.ok()?;
    let sample = reply.into_result().ok()?;
    let (_, answer) = decode::<Answer>(&sample.payload().to_bytes()).expect("an answer");
    Some(answer)
}

fn faults(answer: Option<Answer>) -> String {
    match answer.expect("an answer").outcome {
        Outcome::Refused { faults } => faults.join("; "),
        outcome => panic!("not refused: {outcome:?}"),
    }
}

async fn seen(wall: &FleetService, car: &CarName) {
    wait_until("the car is seen", || {
        wall.fleet()
            .car(car)
            .is_some_and(|car| car.alive && car.pose.is_some())
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
#[expect(
    clippy::too_many_lines,
    reason = "one team and one car, and everybody who tries to command it"
)]
async fn keys_decide_who_commands() {
    let _alone = alone().await;
    let authority = team();
    let endpoint = free_tls_endpoint();
    let wall = pit_wall(&authority, &endpoint).await;
    let car = named("car-1");
    let node = start_real_protected(
        &car,
        0.0,
        &endpoint,
        None,
        keys_of(&authority, Role::Car, "car-1"),
    );
    seen(&wall, &car).await;
    let run_id = wall
        .fleet()
        .car(&car)
        .and_then(|car| car.info.clone())
        .map(|info| info.started);

    // The pit wall commands; the car logs who, and whose keys.
    let verdict = send_command(&wall, &car, "ana", None, select("lq")).await;
    assert_eq!(verdict.exit_code(), 0, "{verdict:?}");
    wait_until("the car says who it was", || {
        let fleet = wall.fleet();
        fleet
            .log()
            .since(0)
            .any(|entry| entry.who.as_deref() == Some("ana@laptop"))
    })
    .await;

    // So does a second program with the same keys.
    let laptop = keys_of(&authority, Role::Pit, "laptop");
    let second = FleetService::open_protected(&client(&endpoint), &laptop)
        .await
        .expect("joined");
    seen(&second, &car).await;
    let verdict = send_command(&second, &car, "ben", None, select("hq")).await;
    assert_eq!(verdict.exit_code(), 0, "{verdict:?}");

    // A viewer sees everything and commands nothing, with our program or without.
    let fan = keys_of(&authority, Role::Viewer, "fan");
    let viewer = FleetService::open_protected(&client(&endpoint), &fan)
        .await
        .expect("joined");
    seen(&viewer, &car).await;
    let verdict = send_command(&viewer, &car, "fan", None, select("lq")).await;
    assert_eq!(verdict.exit_code(), 3, "{verdict:?}");
    let run_id = match run_id {
        Some(run_id) => run_id,
        None => wall.client().fetch_info(&car).await.expect("an answer").started,
    };
    let forged = bytes(&command("fan", select("lq")));
    let key = Key::new(car.clone(), Topic::CmdParams).to_string();
    let raw = let_in(&endpoint, &fan).await;
    let bundle = authority.bundle(Role::Viewer, &named("fan")).expect("in force");
    let signature = Signer::new(&bundle)
        .expect("a key")
        .sign(&key, run_id, &forged)
        .expect("signed");
    assert_eq!(
        send_raw(
            &raw,
            &car,
            Topic::CmdParams,
            forged.clone(),
            Some(signature.clone())
        )
        .await,
        None
    );
    // All three pit walls are in this process.
    wait_until("the viewer is named", || {
        let text = "viewer fan commanded car-1 (cmd/params)";
        [&wall, &second, &viewer].iter().any(|wall| log_has(wall, text))
    })
    .await;

    // Past the router's rules the car refuses by itself: no signature, a viewer's, that of another command.
    let raw = let_in(&endpoint, &laptop).await;
    let unsigned = send_raw(&raw, &car, Topic::CmdParams, forged.clone(), None).await;
    assert!(faults(unsigned).contains("not signed"));
    let viewers = send_raw(&raw, &car, Topic::CmdParams, forged.clone(), Some(signature)).await;
    assert!(faults(viewers).contains("viewer fan may not command"));
    let bundle = authority.bundle(Role::Pit, &named("laptop")).expect("in force");
    let signer = Signer::new(&bundle).expect("a key");
    let other = signer.sign(&key, run_id, b"another command").expect("signed");
    let wrong = send_raw(&raw, &car, Topic::CmdParams, forged.clone(), Some(other)).await;
    assert!(faults(wrong).contains("does not belong"));
    wait_until("ben's set stays in force", || {
        in_force(&wall, &car).is_some_and(|set| set.0 == "hq")
    })
    .await;

    // A recorded command gets the answer that it got, and has no further effect.
    let good = bytes(&command("ana", select("lq")));
    let signature = signer.sign(&key, run_id, &good).expect("signed");
    let first = send_raw(
        &raw,
        &car,
        Topic::CmdParams,
        good.clone(),
        Some(signature.clone()),
    )
    .await;
    let again = send_raw(
        &raw,
        &car,
        Topic::CmdParams,
        good.clone(),
        Some(signature.clone()),
    )
    .await;
    assert_eq!(
        first.as_ref().map(|answer| &answer.outcome),
        again.as_ref().map(|answer| &answer.outcome)
    );
    assert!(first.is_some());

    // After the car's restart it is void.
    node.shutdown("restart");
    let node = start_real_protected(
        &car,
        0.0,
        &endpoint,
        None,
        keys_of(&authority, Role::Car, "car-1"),
    );
    wait_until("the car is back", || {
        let fleet = wall.fleet();
        fleet.car(&car).is_some_and(|car| car.alive)
    })
    .await;
    let mut replayed = None;
    while replayed.is_none() {
        replayed = send_raw(
            &raw,
            &car,
            Topic::CmdParams,
            good.clone(),
            Some(signature.clone()),
        )
        .await;
    }
    assert!(faults(replayed).contains("does not belong"));
    is_named(&wall, "does not belong").await;
    node.shutdown("the test is over");
    for service in [second, viewer, wall] {
        service.close().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn strangers_stay_outside_and_cars_write_under_their_own_name() {
    let _alone = alone().await;
    let mut authority = team();
    let endpoint = free_tls_endpoint();
    authority.issue(Role::Car, named("stolen"), &[]).expect("issued");
    let stolen = keys_of(&authority, Role::Car, "stolen");
    authority.revoke(Role::Car, &named("stolen")).expect("revoked");
    let wall = pit_wall(&authority, &endpoint).await;
    let cars = three_cars(&endpoint, &wall, |name| keys_of(&authority, Role::Car, name)).await;

    // No encryption, no certificate, an expired one, one of another authority.
    let plain = endpoint.replace("tls/", "tcp/");
    assert!(session(&plain, &Protection::None).await.is_none());
    is_named(&wall, "it does not speak TLS").await;
    assert!(session(&endpoint, &Protection::None).await.is_none());
    assert!(session_without_certificate(&endpoint, &authority).await.is_none());
    is_named(&wall, "it has no certificate").await;
    let mut late = authority.clone();
    late.issue_until(
        Role::Car,
        named("late"),
        Vec::new(),
        time::OffsetDateTime::UNIX_EPOCH,
    )
    .expect("issued");
    let expired = keys_of(&late, Role::Car, "late");
    assert!(session(&endpoint, &expired).await.is_none());
    is_named(&wall, "has expired").await;
    let foreign = keys_of(&team(), Role::Car, "car-1");
    assert!(session(&endpoint, &foreign).await.is_none());
    is_named(&wall, "does not know the authority").await;
    nothing_is_lost(&wall, &cars).await;

    // Another car's keys, and revoked ones, connect and are not heard.
    let thief = keys_of(&authority, Role::Car, "thief");
    for (protection, name, named) in [
        (&thief, "ghost", "car thief published in the name of ghost"),
        (
            &stolen,
            "stolen",
            "car stolen is connected with keys that were revoked",
        ),
    ] {
        let forger = FakeCar::start_protected(name, &endpoint, Behaviour::default(), protection).await;
        is_named(&wall, named).await;
        nothing_is_lost(&wall, &cars).await;
        assert!(wall.fleet().car(forger.name()).is_none(), "{name}");
        forger.leave().await;
    }
    // Neither is a message in the name of a car that drives, or of all cars.
    let raw = let_in(&endpoint, &thief).await;
    for car in ["car-1", "*"] {
        let key = format!("{}/{car}/{}", Key::PREFIX, Topic::Event);
        raw.put(&key, vec![0xff; 60]).await.expect("sent");
    }
    is_named(&wall, "car thief published in the name of car-1 (event)").await;
    is_named(&wall, "car thief published in the name of every car (event)").await;
    // With its own name it is heard. So what it sent before has arrived.
    let own = FakeCar::start_protected("thief", &endpoint, Behaviour::default(), &thief).await;
    seen(&wall, own.name()).await;
    nothing_is_lost(&wall, &cars).await;
    let fleet = wall.fleet();
    assert!(!fleet.log().since(0).any(|entry| entry.kind == "unreadable"));
    // Nobody else is accused.
    for car in &cars {
        let accused = format!("car {} ", car.name());
        let mut refused = fleet.log().since(0).filter(|entry| entry.kind == "refused");
        let entry = refused.find(|entry| entry.text.starts_with(&accused));
        assert_eq!(entry.map(|entry| entry.text.clone()), None);
    }
    drop(fleet);
    wall.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn half_open_connections_and_noise_shut_no_car_out() {
    let _alone = alone().await;
    let authority = team();
    let endpoint = free_tls_endpoint();
    let wall = pit_wall(&authority, &endpoint).await;
    let cars = three_cars(&endpoint, &wall, |name| keys_of(&authority, Role::Car, name)).await;
    let address: SocketAddr = endpoint.trim_start_matches("tls/").parse().expect("an address");
    let open: Vec<_> = (0..200 * times())
        .map(|number| {
            let mut socket = TcpStream::connect(address).expect("connects");
            if number % 2 == 0 {
                socket.write_all(b"GET / HTTP/1.1\r\n\r\n").ok();
            }
            socket
        })
        .collect();
    is_named(&wall, "it said nothing, as half-open connections do").await;
    is_named(&wall, "it does not speak TLS").await;
    nothing_is_lost(&wall, &cars).await;
    // A car that comes now is let in.
    let thief = keys_of(&authority, Role::Car, "thief");
    let late = FakeCar::start_protected("thief", &endpoint, Behaviour::default(), &thief).await;
    seen(&wall, late.name()).await;
    drop(open);
    wall.close().await;
}

/// zenoh's listener pauses after each failed handshake. With its own pause of 0.1 s the car would be let in after the deadline.
#[tokio::test(flavor = "multi_thread")]
async fn failed_handshakes_hold_nobody_up() {
    let _alone = alone().await;
    let authority = team();
    let endpoint = free_tls_endpoint();
    let wall = pit_wall(&authority, &endpoint).await;
    let address: SocketAddr = endpoint.trim_start_matches("tls/").parse().expect("an address");
    for _ in 0..700 {
        let mut socket = TcpStream::connect(address).expect("connects");
        socket.write_all(b"GET / HTTP/1.1\r\n\r\n").ok();
    }
    let keys = keys_of(&authority, Role::Car, "car-1");
    let car = FakeCar::start_protected("car-1", &endpoint, Behaviour::default(), &keys).await;
    seen(&wall, car.name()).await;
    wall.close().await;
}

/// A pit wall with few file handles, and somebody who holds more connections than it has.
#[tokio::test(flavor = "multi_thread")]
async fn a_lack_of_file_handles_shuts_nobody_out() {
    let _alone = alone().await;
    let authority = team();
    let endpoint = free_tls_endpoint();
    let folder = tempfile::tempdir().expect("a folder");
    let keys = folder.path().join("laptop.keys");
    let bundle = authority.bundle(Role::Pit, &named("laptop")).expect("in force");
    bundle.write(&keys).expect("written");
    let wall = Process::new("sh")
        .args([
            "-c",
            r#"ulimit -n 64; exec "$0" "$@""#,
            env!("CARGO_BIN_EXE_test-wall"),
            "--keys",
        ])
        .arg(&keys)
        .args(["--listen", &endpoint, "watch"])
        .stdout(Stdio::null())
        .spawn();
    let wall = Killed(wall.expect("a pit wall"));
    let car = keys_of(&authority, Role::Car, "car-1");
    drop(let_in(&endpoint, &car).await);
    let address: SocketAddr = endpoint.trim_start_matches("tls/").parse().expect("an address");
    let held: Vec<_> = (0..100)
        .map(|_| TcpStream::connect(address).expect("connects"))
        .collect();
    drop(let_in(&endpoint, &car).await);
    drop((held, wall));
}

/// A process that is killed when it is dropped.
struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        drop(self.0.kill());
        drop(self.0.wait());
    }
}

/// Reading and writing share one TLS session, which broke where both happened at once: the link ended, and messages were lost.
#[tokio::test(flavor = "multi_thread")]
async fn a_link_with_keys_carries_both_ways_at_once() {
    const SENT: usize = 100_000;
    let _alone = alone().await;
    let authority = team();
    let endpoint = free_tls_endpoint();
    let listen = [
        ("mode", r#""router""#.to_owned()),
        ("listen/endpoints", format!(r#"["{endpoint}"]"#)),
        ("scouting/multicast/enabled", "false".to_owned()),
    ];
    let laptop = keys_of(&authority, Role::Pit, "laptop");
    let near = session_with(listen, &laptop).await.expect("a router");
    let far = let_in(&endpoint, &keys_of(&authority, Role::Car, "car-1")).await;
    let mut arrived = Vec::new();
    for (session, key) in [(&near, "up"), (&far, "down")] {
        let count = Arc::new(AtomicUsize::new(0));
        arrived.push(count.clone());
        session
            .declare_subscriber(key)
            .callback(move |_| {
                count.fetch_add(1, Ordering::Relaxed);
            })
            .background()
            .await
            .expect("subscribed");
    }
    for (session, key) in [(&far, "up"), (&near, "down")] {
        let publisher = session
            .declare_publisher(key)
            .congestion_control(CongestionControl::Block)
            .await
            .expect("a publisher");
        let matched = async || publisher.matching_status().await.expect("a status").matching();
        while !matched().await {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        tokio::spawn(async move {
            for _ in 0..SENT {
                publisher.put([0; 100]).await.expect("sent");
            }
        });
    }
    wait_until("everything has arrived", || {
        arrived.iter().all(|count| count.load(Ordering::Relaxed) == SENT)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_passphrase_lets_in_whoever_knows_it() {
    let _alone = alone().await;
    let with = |words| Protection::Passphrase(Arc::new(keys::Passphrase::new(words).expect("long enough")));
    let (right, wrong) = (
        with("four words for a club day"),
        with("four words for another day"),
    );
    let endpoint = free_endpoint();
    let wall = FleetService::open_protected(&router(&endpoint), &right)
        .await
        .expect("a pit wall");
    assert!(wall.warning().is_none());
    let car = named("car-1");
    let node = start_real_protected(&car, 0.0, &endpoint, None, right.clone());
    seen(&wall, &car).await;
    let verdict = send_command(&wall, &car, "ana", None, select("lq")).await;
    assert_eq!(verdict.exit_code(), 0, "{verdict:?}");
    assert!(session(&endpoint, &wrong).await.is_none());
    is_named(&wall, "it has another passphrase").await;
    assert!(session(&endpoint, &Protection::None).await.is_none());
    is_named(&wall, "it has no passphrase").await;
    // Whoever gets past the pit wall still needs the passphrase.
    let inside = let_in(&endpoint, &right).await;
    let forged = bytes(&command("mallory", select("hq")));
    let answer = send_raw(&inside, &car, Topic::CmdParams, forged, None).await;
    assert!(faults(answer).contains("not signed"));
    node.shutdown("the test is over");
    wall.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flood_of_commands_is_named_and_others_are_served() {
    let _alone = alone().await;
    let mut authority = team();
    authority.issue(Role::Car, named("target"), &[]).expect("issued");
    let endpoint = free_tls_endpoint();
    let wall = pit_wall(&authority, &endpoint).await;
    let cars = three_cars(&endpoint, &wall, |name| keys_of(&authority, Role::Car, name)).await;
    let car = named("target");
    let node = start_real_protected(
        &car,
        0.0,
        &endpoint,
        None,
        keys_of(&authority, Role::Car, "target"),
    );
    seen(&wall, &car).await;
    let raw = let_in(&endpoint, &keys_of(&authority, Role::Pit, "laptop")).await;
    let key = Key::new(car.clone(), Topic::CmdAuto).to_string();
    let began = Instant::now();
    for number in 0..1000_u32 {
        let mut flood = command("mallory", Action::Auto(number % 2 == 0));
        flood.id = CommandId(u128::from(number) + 1);
        raw.get(&key)
            .payload(bytes(&flood))
            .callback(|_| {})
            .await
            .expect("sent");
    }
    nothing_is_lost(&wall, &cars).await;
    let verdict = send_command(&wall, &car, "ana", None, select("lq")).await;
    assert_eq!(verdict.exit_code(), 0, "{verdict:?}");
    is_named(&wall, "unknown sends more than 20 commands a second").await;
    let refused = wall
        .fleet()
        .log()
        .since(0)
        .filter(|entry| entry.text.contains("not signed"))
        .count();
    // Twenty a second are answered and told, for as long as this machine took to send them.
    let answered = 20.0 * (began.elapsed().as_secs_f64() + 3.0);
    assert!((refused as f64) < answered, "{refused} of {answered:.0} events");
    node.shutdown("the test is over");
    wall.close().await;
}
