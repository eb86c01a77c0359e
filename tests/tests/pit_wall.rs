//! The pit wall with fake cars.

use std::collections::BTreeMap;

use pitwall::{FleetService, Report, Verdict, read_events, unix_now};
use protocol::{CarName, Health, Key, Outcome, Stamps, State, Topic, encode};
use system_tests::{
    Behaviour, DEADLINE, FakeCar, client, free_endpoint, in_force, named, recording, router, select,
    send_command, wait_until,
};

#[tokio::test(flavor = "multi_thread")]
async fn a_car_shows_up_and_is_blind_when_it_leaves() {
    let endpoint = free_endpoint();
    // The car is there before the pit wall: it dials until somebody answers.
    let car = FakeCar::start("car-1", &endpoint, Behaviour::default()).await;
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    assert!(service.wait_for(car.name(), DEADLINE).await);
    let name = car.name().clone();
    let view = || service.fleet().car(&name).map(|car| car.view(unix_now()));
    wait_until("everything that a card shows", || {
        view().is_some_and(|car| {
            car.state == "LOCALIZED"
                && car.pose.is_some()
                && car.set.is_some()
                && car.info.is_some()
                && car.round_trip_s.is_some_and(|s| s < 1.0)
                && car.streams["pose"].rate_hz > 20.0
        })
    })
    .await;
    wait_until("its map", || {
        service.fleet().car(&name).is_some_and(|car| car.map.is_some())
    })
    .await;
    car.leave().await;
    wait_until("the car is blind", || {
        view().is_some_and(|car| car.state == "BLIND" && !car.alive)
    })
    .await;
    service.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_second_program_joins_the_pit_wall_that_is_there() {
    let endpoint = free_endpoint();
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let car = FakeCar::start("car-1", &endpoint, Behaviour::default()).await;
    let viewer = FleetService::open(&client(&endpoint)).await.expect("a link");
    assert!(viewer.wait_for(car.name(), DEADLINE).await);
    let verdict = send_command(&viewer, car.name(), "ana", None, select("lq")).await;
    assert_eq!(verdict.exit_code(), 0, "{verdict:?}");
    assert_eq!(car.set().name, "lq");
    wait_until("both see the switch", || {
        [&service, &viewer].map(|service| in_force(service, car.name()))
            == [Some(("lq".into(), 2)), Some(("lq".into(), 2))]
    })
    .await;
    // An alarm is open on both until one of them acknowledges it.
    car.leave().await;
    let alarms = || [&service, &viewer].map(|service| service.fleet().log().alarms());
    wait_until("both have the alarm", || alarms() == [1, 1]).await;
    viewer.acknowledge("ana").await;
    wait_until("nobody has it any more", || alarms() == [0, 0]).await;
    viewer.close().await;
    service.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn each_outcome_of_a_command_has_its_own_text() {
    let endpoint = free_endpoint();
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let car = FakeCar::start("car-1", &endpoint, Behaviour::default()).await;
    let mute = FakeCar::start_mute(&endpoint).await;
    assert!(service.wait_for(car.name(), DEADLINE).await && service.wait_for(mute.name(), DEADLINE).await);
    let give =
        async |name: &CarName, expect, action| send_command(&service, name, "ana", expect, action).await;

    let done = give(car.name(), Some(1), select("lq")).await;
    assert!(
        matches!(&done, Verdict::Answered { answer, .. } if answer.set.revision == 2),
        "{done:?}"
    );
    let refused = give(car.name(), None, select("wet")).await;
    assert!(
        matches!(&refused, Verdict::Answered { answer, .. } if matches!(answer.outcome, Outcome::Refused { .. }))
    );
    let stale = give(car.name(), Some(1), select("hq")).await;
    // These two wait as long as an operator does.
    let wait = async |name: &CarName| {
        let verdict = service.client().command(name, "ana", None, select("hq")).await;
        verdict.expect("a valid command")
    };
    let none = wait(&named("nobody")).await;
    let silent = wait(mute.name()).await;

    let codes: Vec<_> = [&done, &refused, &stale, &none, &silent]
        .map(Verdict::exit_code)
        .to_vec();
    assert_eq!(codes, [0, 3, 6, 4, 5]);
    let texts: std::collections::BTreeSet<_> = [&done, &refused, &stale, &none, &silent]
        .map(|verdict| verdict.text(car.name()))
        .into();
    assert_eq!(texts.len(), 5, "each reads differently: {texts:?}");
    assert_eq!(car.set().name, "lq", "only the first command changed anything");
    service.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_messages_are_counted_and_logged_once() {
    let endpoint = free_endpoint();
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let malformed = Behaviour {
        malformed_load: true,
        ..Behaviour::default()
    };
    let car = FakeCar::start("car-1", &endpoint, malformed).await;
    wait_until("several payloads were refused", || {
        let view = service.fleet().car(car.name()).map(|car| car.view(unix_now()));
        view.and_then(|car| Some(car.streams.get("load")?.unreadable >= 3))
            .unwrap_or(false)
    })
    .await;
    let said = service
        .fleet()
        .log()
        .since(0)
        .filter(|entry| entry.kind == "unreadable")
        .count();
    assert_eq!(said, 1);
    service.close().await;
}

/// Its state was INIT, "no health message yet", for ever.
#[tokio::test(flavor = "multi_thread")]
async fn a_pit_wall_that_is_too_old_for_a_car_says_so() {
    let endpoint = free_endpoint();
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let newer = Behaviour {
        newer_health: true,
        ..Behaviour::default()
    };
    let car = FakeCar::start("car-1", &endpoint, newer).await;
    let view = || service.fleet().car(car.name()).map(|car| car.view(unix_now()));
    wait_until("the car's messages are not understood", || {
        view().is_some_and(|car| {
            car.state == "UNKNOWN"
                && car.causes[0].starts_with("this pit wall is too old for the car")
                && car.causes[0].contains("version 99")
        })
    })
    .await;
    let view = view().expect("the car is there");
    assert!(view.pose.is_some() && !view.blind, "what can be read is shown");
    assert_eq!(view.streams["health"].missing, 0, "what came is not missing");
    service.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recording_of_three_cars_holds_every_message() {
    let (endpoint, service, _folder, file) = recording().await;
    let mut cars = Vec::new();
    for name in ["car-1", "car-2", "car-3"] {
        cars.push(FakeCar::start(name, &endpoint, Behaviour::default()).await);
    }
    wait_until("two laps", || {
        cars.iter().all(|car| {
            service
                .fleet()
                .car(car.name())
                .is_some_and(|car| car.laps().len() >= 2)
        })
    })
    .await;
    let mut published = BTreeMap::new();
    for car in &mut cars {
        let topics = car.stop_driving().await;
        published.extend(
            topics
                .into_iter()
                .map(|(topic, last)| ((car.name().clone(), topic), last)),
        );
    }
    wait_until("the last message has come", || {
        let status = service.recording().expect("a recording");
        let streams = &status.summary.streams;
        streams.len() == published.len()
            && streams
                .iter()
                .all(|s| s.gaps.last == published[&(s.car.clone(), s.topic)])
    })
    .await;
    let live = service.fleet().view(0);
    let summary = service
        .stop_recording()
        .await
        .expect("a recording")
        .expect("a good file");
    service.close().await;

    // Newest-wins topics begin with the first message that found a route; what a car keeps begins with its first.
    for stream in &summary.streams {
        assert_eq!(stream.gaps.missing, 0, "{summary}");
        if stream.topic.recovered() {
            assert_eq!(stream.gaps.first, 1, "{summary}");
        }
        assert_eq!(stream.gaps.received, stream.gaps.last - stream.gaps.first + 1);
    }

    // Reading it back gives the same fleet.
    let mut replayed = pitwall::Fleet::default();
    for event in read_events(&file).expect("a good file") {
        replayed.apply(&event.expect("a good event"));
    }
    for (car, live) in replayed.view(0).iter().zip(&live) {
        assert_eq!(
            (&car.car, &car.pose, &car.health, &car.set),
            (&live.car, &live.pose, &live.health, &live.set)
        );
        assert_eq!(car.last_lap_s, live.last_lap_s);
    }
    assert_eq!(replayed.cars().count(), 3);

    // The check finds nothing missing.
    let check = pitwall::check(&file).expect("a good file");
    assert!(check.complete && check.cars.len() == 3, "{check}");
    assert!(check.to_string().ends_with("nothing is missing"), "{check}");
    for stream in check.cars.iter().flat_map(|car| &car.streams) {
        assert_eq!(stream.published, stream.received, "{check}");
    }

    // What a report makes of it stands alone.
    let report = Report::of(&file).expect("a good file");
    assert_eq!(report.cars.len(), 3);
    for car in &report.cars {
        assert!(
            car.laps.len() >= 2 && car.table[0].laps == car.laps.len(),
            "{car:?}"
        );
        assert!(
            (car.table[0].time_s.mean - 2.0).abs() < 1e-9,
            "fake cars tell of 2 s"
        );
        assert!(
            car.states["LOCALIZED"] > 0.99 && car.truth.is_none(),
            "{:?}",
            car.states
        );
    }
    let page = report.to_html();
    assert!(page.matches("<svg").count() >= 3 * 5, "figures of each car");
    for foreign in ["src=\"", "href=\"http", "url(", "@import", "import(", "fetch("] {
        assert!(!page.contains(foreign), "{foreign} in the page");
    }
    for figure in page
        .split("<svg")
        .skip(1)
        .filter_map(|rest| rest.split("</svg>").next())
    {
        for bad in ["NaN", "inf"] {
            assert!(!figure.contains(bad), "{bad} in a figure: {figure}");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn all_streams_of_a_car_end_together_and_a_car_that_has_left_is_named() {
    let (endpoint, service, _folder, _) = recording().await;
    let slow = Behaviour {
        withholds_recorded: true,
        ..Behaviour::default()
    };
    let car = FakeCar::start("car-1", &endpoint, slow).await;
    let leaver = FakeCar::start("car-2", &endpoint, Behaviour::default()).await;
    let recorded = |car: &CarName, topic| {
        let streams = service.recording().expect("a recording").summary.streams;
        let mut streams = streams.iter().filter(|s| s.car == *car && s.topic == topic);
        streams.next().map_or(0, |s| s.gaps.received)
    };
    wait_until("both cars are in the file", || {
        let cars = [car.name(), leaver.name()];
        cars.iter().all(|car| recorded(car, Topic::RecordedPose) > 0)
    })
    .await;
    leaver.leave().await;

    // It drives on, so that there is always something that has not come.
    let by_then = car.published();
    let summary = service
        .stop_recording()
        .await
        .expect("a recording")
        .expect("a good file");
    service.close().await;
    assert_eq!(
        summary.unanswered.iter().map(CarName::as_str).collect::<Vec<_>>(),
        ["car-2"],
        "{summary}"
    );
    assert!(summary.to_string().contains("car-2 did not answer at the end"));
    let mut last = BTreeMap::new();
    for stream in summary.streams.iter().filter(|s| s.car == *car.name()) {
        let topic = stream.topic;
        assert_eq!(stream.gaps.missing, 0, "{summary}");
        if topic.recovered() {
            // Some topics had nothing to say by then.
            let by_then = by_then.get(&topic).copied().unwrap_or_default();
            assert!(stream.gaps.last >= by_then, "{topic} lags: {summary}");
            last.insert(topic, stream.gaps.last);
        }
    }
    // The car says so between any two messages: of streams that go out together one may be one ahead.
    let [pose, odometry] = [Topic::RecordedPose, Topic::RecordedOdometry].map(|topic| last[&topic]);
    assert!(
        pose.abs_diff(odometry) <= 1 && pose > last[&Topic::Health],
        "{summary}"
    );
    // Live poses do not go on while the others are waited for: one more is in the file than there are of the others.
    let live = summary
        .streams
        .iter()
        .find(|s| s.car == *car.name() && s.topic == Topic::Pose)
        .expect("live poses");
    assert!(live.gaps.last <= pose + 1, "{summary}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recording_that_was_cut_off_is_recovered() {
    let endpoint = free_endpoint();
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("session.mcap");
    let car = FakeCar::start("car-1", &endpoint, Behaviour::default()).await;
    service.start_recording(&file).await.expect("a new file");
    let poses = |service: &FleetService| {
        let streams = service.recording().expect("a recording").summary.streams;
        streams
            .iter()
            .find(|s| s.topic == Topic::Pose)
            .map_or(0, |s| s.gaps.received)
    };
    wait_until("a second of poses is in the file", || poses(&service) > 40).await;
    let on_disk = poses(&service);
    // What a power cut leaves behind: the file as it is now, without its end, and torn in its last record.
    let mut bytes = std::fs::read(&file).expect("readable");
    bytes.truncate(bytes.len() - 3);
    let torn = folder.path().join("torn.mcap");
    std::fs::write(&torn, bytes).expect("written");
    drop(car);
    service.close().await;

    assert!(
        read_events(&torn).expect("opens").any(|event| event.is_err()),
        "an unfinished file says so"
    );
    let mended = folder.path().join("mended.mcap");
    let recovered = pitwall::recover(&torn, &mended).expect("something is left");
    assert!(!recovered.complete && recovered.has_losses());
    let events: Vec<_> = read_events(&mended)
        .expect("opens")
        .collect::<Result<_, _>>()
        .expect("whole");
    let poses = events
        .iter()
        .filter(|event| {
            matches!(
                event.payload,
                pitwall::EventPayload::Message {
                    topic: Topic::Pose,
                    ..
                }
            )
        })
        .count() as u64;
    assert!(
        poses + 40 >= on_disk,
        "{poses} of {on_disk} poses: more than a second is lost"
    );
    assert!(
        pitwall::recover(&torn, &mended).is_err(),
        "nothing is overwritten"
    );
}

// After a power cut, a car without a clock battery once stayed "LOCALIZED, alive" on its old run, and nothing of the new run was
// recorded.
#[tokio::test(flavor = "multi_thread")]
async fn a_car_that_restarts_with_its_clock_behind_is_shown_and_recorded() {
    for without_run_token in [false, true] {
        let (endpoint, service, _folder, _file) = recording().await;
        let behaviour = |run_id| Behaviour {
            run_id: Some(run_id),
            without_run_token,
            ..Behaviour::default()
        };
        let name = named("car-1");
        let run = || {
            let fleet = service.fleet();
            let (header, pose) = fleet.car(&name)?.pose?;
            (pose.update > 40).then_some(header.run_id)
        };
        let mut car = FakeCar::start("car-1", &endpoint, behaviour(5_000_000_000)).await;
        wait_until("the first run", || run() == Some(5_000_000_000)).await;
        let first = car.stop_driving().await;
        wait_until("all of the first run", || received(&service, &first)).await;
        car.leave().await;
        let mut car = FakeCar::start("car-1", &endpoint, behaviour(7)).await;
        wait_until("the second run", || run() == Some(7)).await;
        let second = car.stop_driving().await;
        wait_until("all of the second run", || received(&service, &second)).await;
        let summary = service
            .stop_recording()
            .await
            .expect("a recording")
            .expect("good");
        for stream in summary.streams.iter().filter(|stream| stream.topic.recovered()) {
            assert_eq!((stream.gaps.missing, stream.rejected), (0, 0), "{summary}");
            let sent = first[&stream.topic] + second[&stream.topic];
            assert_eq!(stream.gaps.received, sent, "{summary}");
        }
        service.close().await;
    }
}

/// True when the recorder has the last message of each recovered topic.
fn received(service: &FleetService, published: &BTreeMap<Topic, u64>) -> bool {
    let status = service.recording().expect("a recording");
    let streams = &status.summary.streams;
    published
        .iter()
        .filter(|(topic, _)| topic.recovered())
        .all(|(topic, last)| {
            streams
                .iter()
                .any(|s| s.topic == *topic && s.gaps.last == *last && s.gaps.missing == 0)
        })
}

// One header with session 2^64-1, or a number far ahead, once stopped a car until the pit wall was restarted.
#[tokio::test(flavor = "multi_thread")]
async fn a_forged_header_stops_no_car() {
    let endpoint = free_endpoint();
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let car = FakeCar::start("car-1", &endpoint, Behaviour::default()).await;
    let newest = || service.fleet().car(car.name())?.health.as_ref().map(|h| h.update);
    wait_until("health messages", || newest().is_some_and(|update| update > 20)).await;
    let run_id = service
        .fleet()
        .car(car.name())
        .and_then(|car| Some(car.pose?.0.run_id));
    let health = Health {
        state: State::Lost,
        since: 0,
        causes: Vec::new(),
        update: 1,
        metrics: None,
        proposal: None,
        auto: false,
    };
    let forger = zenoh::open(forger(&endpoint)).await.expect("a session");
    for (run_id, sequence) in [
        (u64::MAX, 1),
        (run_id.expect("known"), u64::MAX),
        (run_id.expect("known"), 1 << 40),
    ] {
        let stamps = Stamps {
            run_id,
            sequence,
            ..Stamps::default()
        };
        let bytes = encode(&health, stamps).expect("a good message");
        let key = Key::new(car.name().clone(), Topic::Health).to_string();
        forger.put(key, bytes).await.expect("sent");
    }
    let rejected = || {
        let fleet = service.fleet();
        let view = fleet.car(car.name()).map(|car| car.view(unix_now()));
        view.map_or(0, |view| view.streams["health"].rejected)
    };
    wait_until("they are counted", || rejected() == 3).await;
    let before = newest().expect("known");
    wait_until("the car goes on", || {
        newest().is_some_and(|update| update > before + 20)
    })
    .await;
    let view = service.fleet().car(car.name()).map(|car| car.view(unix_now()));
    assert_eq!(view.expect("there").state, "LOCALIZED");
    forger.close().await.expect("closed");
    service.close().await;
}

fn forger(endpoint: &str) -> zenoh::Config {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", r#""client""#.to_owned()),
        ("connect/endpoints", format!(r#"["{endpoint}"]"#)),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).expect("a good setting");
    }
    config
}

// Two cars of one name were once mixed up without a word.
#[tokio::test(flavor = "multi_thread")]
async fn two_cars_of_one_name_are_an_alarm() {
    let endpoint = free_endpoint();
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let car = FakeCar::start("car-1", &endpoint, Behaviour::default()).await;
    assert!(service.wait_for(car.name(), DEADLINE).await);
    let view = || service.fleet().car(car.name()).map(|car| car.view(unix_now()));
    let alarmed = || view().is_some_and(|view| view.causes.iter().any(|cause| cause.starts_with("two cars")));
    wait_until("its pose", || view().is_some_and(|view| view.pose.is_some())).await;
    assert!(!alarmed());
    let other = FakeCar::start("car-1", &endpoint, Behaviour::default()).await;
    wait_until("the alarm", alarmed).await;
    other.leave().await;
    wait_until("the end of the alarm", || !alarmed()).await;
    assert_eq!(service.fleet().log().alarms(), 1);
    service.close().await;
}

// Only the pit wall whose page set a marker once had it in its recording.
#[tokio::test(flavor = "multi_thread")]
async fn markers_are_in_every_recording_and_a_second_recording_misses_nothing() {
    let (endpoint, service, folder, _first) = recording().await;
    let car = FakeCar::start("car-1", &endpoint, Behaviour::default()).await;
    assert!(service.wait_for(car.name(), DEADLINE).await);
    let received = |least: u64| {
        let status = service.recording();
        status.is_some_and(|status| status.summary.messages > least)
    };
    wait_until("messages", || received(200)).await;
    service
        .stop_recording()
        .await
        .expect("a recording")
        .expect("good");

    let other = FleetService::open(&client(&endpoint)).await.expect("a link");
    assert!(other.wait_for(car.name(), DEADLINE).await);
    let files = ["a.mcap", "b.mcap"].map(|name| folder.path().join(name));
    service.start_recording(&files[0]).await.expect("a new file");
    other.start_recording(&files[1]).await.expect("a new file");
    service.mark(car.name(), "ana", "crash in turn 3").await;
    let marked = |service: &FleetService| {
        let fleet = service.fleet();
        fleet.log().since(0).any(|entry| entry.text == "crash in turn 3")
    };
    wait_until("the marker", || marked(&service) && marked(&other)).await;
    wait_until("messages", || received(200)).await;
    let view = service.fleet().car(car.name()).map(|car| car.view(unix_now()));
    let view = view.expect("the car is there");
    assert_eq!(
        view.missing, 0,
        "what was sent between the recordings is not missing"
    );
    for (service, file) in [(&service, &files[0]), (&other, &files[1])] {
        let summary = service
            .stop_recording()
            .await
            .expect("a recording")
            .expect("good");
        assert_eq!(summary.missing(), 0, "{summary}");
        let markers = read_events(file).expect("good").filter(|event| {
            matches!(
                event.as_ref().map(|event| &event.payload),
                Ok(pitwall::EventPayload::Marker { .. })
            )
        });
        assert_eq!(markers.count(), 1);
    }
    other.close().await;
    service.close().await;
}

// A recording whose file was gone once went on without a word.
#[tokio::test(flavor = "multi_thread")]
async fn a_failed_recording_is_an_alarm_and_another_one_can_be_started() {
    let (_endpoint, service, folder, file) = recording().await;
    std::fs::remove_file(&file).expect("removed");
    let error = tokio::time::timeout(DEADLINE, service.recording_failed()).await;
    assert!(error.expect("it fails").contains("session.mcap"));
    assert_eq!(service.fleet().log().alarms(), 1);
    assert!(service.recording().is_none());
    service
        .start_recording(&folder.path().join("again.mcap"))
        .await
        .expect("a new file");
    service
        .stop_recording()
        .await
        .expect("a recording")
        .expect("good");
    service.close().await;
}
