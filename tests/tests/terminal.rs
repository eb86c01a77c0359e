//! The programs as processes: their output and exit codes, and the state after one was killed.

use std::path::Path;
use std::process::{Child, Command as Process, Output, Stdio};
use std::time::{Duration, Instant};

use pitwall::{FleetService, Verdict, new_command_id};
use protocol::{Action, CarName, Command, EventKind, Outcome, ParamsAction, Telemetry};
use system_tests::{FakeCar, free_endpoint, named, router, select, send_command, wait_until};

/// A child that does not outlive the test.
struct Killed(Child);

impl Killed {
    /// SIGKILL, as a power cut: the child gets no say.
    fn kill(&mut self) {
        self.0.kill().expect("it is ours");
        self.0.wait().expect("it has ended");
    }
}

impl Drop for Killed {
    fn drop(&mut self) {
        drop(self.0.kill());
        drop(self.0.wait());
    }
}

/// A real node in a process of its own.
fn car(name: &str, endpoint: &str, state: &Path) -> Killed {
    let child = Process::new(env!("CARGO_BIN_EXE_test-car"))
        .args(["race", name, "0", endpoint])
        .arg(state)
        .stdin(Stdio::null())
        .spawn()
        .expect("a car");
    Killed(child)
}

/// The pit wall's program with these words.
fn wall(endpoint: &str, words: &[&str]) -> Process {
    let mut process = Process::new(env!("CARGO_BIN_EXE_test-wall"));
    process
        .args(["--connect", endpoint, "--operator", "ana"])
        .args(words)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    process
}

/// Runs it to its end: exit code, and all that it said.
async fn say(endpoint: &str, words: &[&str]) -> (i32, String) {
    let mut process = wall(endpoint, words);
    let Output {
        status,
        stdout,
        stderr,
    } = tokio::task::spawn_blocking(move || process.output().expect("it runs"))
        .await
        .expect("no panic");
    let said = [stdout, stderr]
        .map(|bytes| String::from_utf8(bytes).expect("UTF-8"))
        .concat();
    (status.code().expect("an exit code"), said)
}

fn command(name: &str) -> Command {
    Command {
        id: new_command_id(),
        operator: "ana".into(),
        expected_revision: None,
        action: select(name),
    }
}

/// The set in force and its revision, of a car that is there.
fn in_force(service: &FleetService, car: &CarName) -> Option<(String, u64)> {
    service.fleet().car(car).filter(|car| car.alive)?;
    system_tests::in_force(service, car)
}

/// Waits for a car in a process of its own, which takes its time on a busy machine.
async fn driving(service: &FleetService, car: &CarName) {
    let deadline = Instant::now() + Duration::from_secs(90);
    while in_force(service, car).is_none() {
        assert!(Instant::now() < deadline, "{car} did not come");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[expect(
    clippy::too_many_lines,
    reason = "a table of command lines, which reads best in one piece"
)]
#[tokio::test(flavor = "multi_thread")]
async fn each_outcome_has_its_exit_code_and_text() {
    let endpoint = free_endpoint();
    let folder = tempfile::tempdir().expect("a folder");
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let real = named("car-1");
    let _car = car("car-1", &endpoint, folder.path());
    let mute = FakeCar::start_mute(&endpoint).await;
    assert!(service.wait_for(mute.name(), system_tests::DEADLINE).await);
    driving(&service, &real).await;
    let file = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).expect("written");
        path.to_str().expect("UTF-8").to_owned()
    };
    let good = file("mine.yaml", "sigma_hit: 0.12\n");
    let bad = file("bad.yaml", "sigma_hit: -1\nno_such_thing: 3\n");
    let broken = file("broken.yaml", "sigma_hit: [\n");
    let empty = file("empty.yaml", "");
    let missing = folder.path().join("nowhere.yaml");
    let missing = missing.to_str().expect("UTF-8");
    // In this order: later lines build on the earlier.
    let table: &[(&[&str], i32, &[&str])] = &[
        (&["params", "car-1"], 0, &["hq (revision", "sigma_hit"]),
        (
            &["params", "car-1", "list"],
            0,
            &["hq", "lq", "adaptive", "synpf-baseline"],
        ),
        (&["params", "car-1", "diff", "hq", "lq"], 0, &["hq", "lq"]),
        (&["params", "car-1", "diff", "hq", "wet"], 3, &["wet"]),
        (
            &["params", "car-1", "select", "lq"],
            0,
            &["done from update", "set in force is lq"],
        ),
        (
            &["params", "car-1", "select", "wet"],
            3,
            &["REFUSED, nothing has changed", "no set"],
        ),
        (
            &["params", "car-1", "select", "hq", "--expect", "999"],
            6,
            &["REVISION CONFLICT", "ana"],
        ),
        (&["params", "car-1", "confirm"], 3, &["nothing to confirm"]),
        (
            &["params", "car-1", "put", &good, "--revert-after", "10m"],
            0,
            &["set in force is mine"],
        ),
        (&["params", "car-1", "delete", "mine"], 3, &["mine"]),
        (&["params", "car-1", "confirm"], 0, &["done"]),
        (&["params", "car-1", "revert"], 0, &["set in force is lq"]),
        (&["params", "car-1", "delete", "mine"], 0, &["done"]),
        (&["params", "car-1", "delete", "hq"], 3, &["built in"]),
        (
            &["params", "car-1", "put", &bad],
            3,
            &["sigma_hit", "no_such_thing", "nothing has changed"],
        ),
        (
            &["params", "car-1", "put", &broken],
            2,
            &["broken.yaml", "line 1"],
        ),
        (&["params", "car-1", "put", missing], 2, &["nowhere.yaml"]),
        (
            &["params", "car-1", "put", &empty],
            2,
            &["empty.yaml", "no parameter"],
        ),
        (&["record", "-o", &good], 2, &["mine.yaml exists already"]),
        (&["replay", missing], 2, &["nowhere.yaml"]),
        (&["replay", &good, "--speed", "51"], 2, &["0.1 to 50"]),
        (&["report", &good], 2, &["mine.yaml is not a recording"]),
        (&["export", &empty], 2, &["empty.yaml is not a recording"]),
        (&["recover", missing], 2, &["nowhere.yaml"]),
        (&["params", "car-1", "slect", "hq"], 2, &["slect"]),
        (&["params", "Car 1"], 2, &["Car 1"]),
        (&["params", "ghost", "select", "hq"], 4, &["ghost", "car-1"]),
        (&["params", "mute", "select", "lq"], 5, &["NO ANSWER", "harmless"]),
        (
            &["rates", "car-1", "--pose", "20", "--recorded", "off"],
            0,
            &["pose 20 Hz", "full-rate streams off"],
        ),
        (&["rates", "car-1", "--pose", "-1"], 2, &["pose"]),
        (&["rates", "mute"], 5, &["NO ANSWER"]),
        (&["auto", "car-1", "on"], 0, &["done"]),
        (&["auto", "car-1", "perhaps"], 2, &["on or off"]),
        (&["locate", "car-1"], 2, &["--global"]),
        (&["locate", "car-1", "--pose", "1,2"], 2, &["X,Y,HEADING"]),
        (
            &["locate", "car-1", "--pose", "1e9,0,0"],
            3,
            &["off the map", "nothing has changed"],
        ),
        (&["locate", "car-1", "--pick", "9999"], 3, &["candidate"]),
        (&["locate", "car-1", "--global"], 0, &["done from update"]),
        (&["locate", "ghost", "--global"], 4, &["ghost"]),
        (&["events", "car-1"], 0, &["car-1", "lq", "mine", "[ana]"]),
        (&["events", "ghost"], 4, &["ghost"]),
        (&["cars", "--wait", "2s"], 0, &["car-1", "mute"]),
        (
            &["watch", "ghost", "--wait", "4s"],
            4,
            &["waiting for ghost", "no such car: ghost"],
        ),
        (&["watch", "car-1", "--for", "2s"], 0, &["car-1"]),
    ];
    let mut wrong = Vec::new();
    for (words, expected, phrases) in table {
        let (code, said) = say(&endpoint, words).await;
        if code != *expected || !phrases.iter().all(|phrase| said.contains(phrase)) {
            wrong.push(format!(
                "{words:?} ended with {code}, not {expected}, and said: {said}"
            ));
        }
        assert!(!said.contains("panicked"), "{words:?}: {said}");
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    // In JSON too: the outcome on stdout, the same code.
    let (code, said) = say(&endpoint, &["--json", "params", "car-1", "select", "wet"]).await;
    let verdict: serde_json::Value = serde_json::from_str(&said).expect("JSON alone");
    assert_eq!((code, &verdict["verdict"]), (3, &"answered".into()), "{said}");
    // On a busy machine a car may send nothing for longer than `cars` listens by itself.
    wait_until("the car is heard", || {
        service.fleet().car(&real).is_some_and(|car| car.pose.is_some())
    })
    .await;
    let (code, said) = say(&endpoint, &["--json", "cars", "--wait", "8"]).await;
    let cars: serde_json::Value = serde_json::from_str(&said).expect("JSON alone");
    let car = cars
        .as_array()
        .expect("a list")
        .iter()
        .find(|car| car["car"] == "car-1")
        .expect("car-1");
    assert_eq!(code, 0);
    for noun in ["round_trip_s", "clock_offset_s", "clock_uncertainty_s"] {
        assert!(car[noun].is_number(), "{noun}: {said}");
    }
    assert!(car["blind"].is_boolean(), "{said}");
    for noun in ["rate_hz", "age_s", "missing", "filled_late"] {
        assert!(car["streams"]["pose"][noun].is_number(), "{noun}: {said}");
    }
    drop(mute);
    service.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_laptop_killed_mid_command_leaves_the_set_before_or_the_set_after() {
    let endpoint = free_endpoint();
    let folder = tempfile::tempdir().expect("a folder");
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let events = service.subscribe();
    let real = named("car-1");
    let _car = car("car-1", &endpoint, folder.path());
    driving(&service, &real).await;
    for (round, name) in ["lq", "hq", "lq", "hq"].into_iter().enumerate() {
        let before = in_force(&service, &real).expect("known");
        while events.try_recv().is_ok() {}
        let mut laptop = Killed(
            wall(&endpoint, &["params", "car-1", "select", name])
                .spawn()
                .expect("it runs"),
        );
        // Killed while it finds the car, or as soon as the car says that the set has changed.
        if round.is_multiple_of(2) {
            wait_until("the set has changed", || {
                events.try_iter().any(|event| match &event.payload {
                    pitwall::EventPayload::Message { telemetry, .. } => matches!(
                        &**telemetry,
                        Telemetry::Event(event) if matches!(event.kind, EventKind::ParametersChanged { .. })
                    ),
                    _ => false,
                })
            })
            .await;
        }
        laptop.kill();
        // The next one is told what is in force, and what it is told is what the car does.
        let verdict = send_command(&service, &real, "ben", None, Action::Params(ParamsAction::List)).await;
        let Verdict::Answered { answer, .. } = verdict else {
            panic!("{verdict:?}");
        };
        let now = (answer.set.name, answer.set.revision);
        let after = (name.to_owned(), before.1 + 1);
        assert!(now == before || now == after, "{before:?} became {now:?}");
        assert!(!round.is_multiple_of(2) || now == after, "{now:?}");
        // Given again, it ends in the set that was wanted.
        let again = service
            .client()
            .send(&real, &command(name), system_tests::DEADLINE)
            .await
            .expect("good");
        assert_eq!(again.exit_code(), 0, "{again:?}");
        let Verdict::Answered { answer, .. } = again else {
            panic!("{again:?}");
        };
        assert_eq!(answer.set.name, name);
        // Its revision too: selecting the same set again is a change of its own.
        wait_until("the set that was wanted", || {
            in_force(&service, &real) == Some((name.to_owned(), answer.set.revision))
        })
        .await;
    }
    // The log names the operator.
    let said = service
        .fleet()
        .log()
        .since(0)
        .any(|entry| entry.who.as_deref() == Some("ana"));
    assert!(said);
    service.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_car_killed_mid_command_comes_back_in_a_known_set_and_the_operator_is_told() {
    let endpoint = free_endpoint();
    let folder = tempfile::tempdir().expect("a folder");
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let real = named("car-1");
    let mut node = car("car-1", &endpoint, folder.path());
    driving(&service, &real).await;
    // Killed when the command has just left, and later and later in its way.
    for (name, microseconds) in [("lq", 0), ("hq", 2_000), ("lq", 20_000)] {
        let before = in_force(&service, &real).expect("known");
        let command = command(name);
        let (verdict, ()) = tokio::join!(
            service.client().send(&real, &command, pitwall::REPLY_TIMEOUT),
            async {
                // Not a wait for anything: the moment is what is tried.
                tokio::time::sleep(Duration::from_micros(microseconds)).await;
                node.kill();
            }
        );
        let verdict = verdict.expect("a good command");
        let text = verdict.text(&real);
        match &verdict {
            Verdict::Answered { answer, .. } => {
                assert!(matches!(answer.outcome, Outcome::Done { .. }), "{text}");
            }
            Verdict::NoAnswer { .. } => assert!(text.contains("may or may not have been done"), "{text}"),
            // It was gone before it was asked again.
            Verdict::NoSuchCar => assert!(text.contains("NO SUCH CAR"), "{text}"),
            Verdict::Unreadable { .. } => panic!("{text}"),
        }
        wait_until("the car is gone", || in_force(&service, &real).is_none()).await;
        node = car("car-1", &endpoint, folder.path());
        driving(&service, &real).await;
        let known = send_command(&service, &real, "ben", None, Action::Params(ParamsAction::List)).await;
        let Verdict::Answered { answer, .. } = known else {
            panic!("{known:?}");
        };
        let now = answer.set.name;
        assert!(now == before.0 || now == name, "{before:?} became {now}");
        if matches!(verdict, Verdict::Answered { .. }) {
            assert_eq!(now, name, "what was acknowledged is kept");
        }
        // The same command once more: done now, or answered as it was done then.
        let again = service
            .client()
            .send(&real, &command, system_tests::DEADLINE)
            .await
            .expect("good");
        assert_eq!(again.exit_code(), 0, "{}", again.text(&real));
        wait_until("the set that was wanted", || {
            in_force(&service, &real).is_some_and(|(set, _)| set == name)
        })
        .await;
    }
    service.close().await;
}
