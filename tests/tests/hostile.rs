//! A peer that does harm: refused or bounded, named, and the real cars lose nothing beside it.
//!
//! `PITWALL_ATTACK=10` makes each attack ten times as large.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::Duration;

use keys::Protection;
use pitwall::{Fleet, FleetService, PageOptions, PitWallOptions, PitWallServer, unix_now};
use protocol::{CarName, Event, EventKind, Key, Stamps, Topic, encode};
use system_tests::{Behaviour, FakeCar, free_endpoint, named, router, stranger, wait_until};
use zenoh::qos::CongestionControl;

async fn pit_wall(endpoint: &str) -> Arc<FleetService> {
    FleetService::open(&router(endpoint)).await.expect("a pit wall")
}

/// How many times as large each attack is.
fn times() -> usize {
    std::env::var("PITWALL_ATTACK")
        .ok()
        .and_then(|factor| factor.parse().ok())
        .unwrap_or(1)
}

async fn real_cars(endpoint: &str, wall: &FleetService) -> Vec<FakeCar> {
    let mut cars = Vec::new();
    for name in ["car-1", "car-2", "car-3"] {
        cars.push(FakeCar::start(name, endpoint, Behaviour::default()).await);
    }
    for car in &cars {
        wait_until("the car is seen", || received(wall, car.name()) > 0).await;
    }
    cars
}

/// Poses that have arrived from a car.
fn received(wall: &FleetService, car: &CarName) -> u64 {
    stream(wall, car, Topic::Pose).0
}

/// Messages that arrived, and that are missing.
fn stream(wall: &FleetService, car: &CarName, topic: Topic) -> (u64, u64) {
    let fleet = wall.fleet();
    let view = fleet.car(car).map(|car| car.view(unix_now()));
    view.and_then(|view| {
        let stream = view.streams.get(topic.as_str())?;
        Some((stream.received, stream.missing))
    })
    .unwrap_or_default()
}

/// Waits for forty more poses of each car, and checks that none is missing of what must be complete.
async fn nothing_is_lost(wall: &FleetService, cars: &[FakeCar]) {
    for car in cars {
        let before = received(wall, car.name());
        wait_until("the car goes on", || received(wall, car.name()) >= before + 40).await;
        for topic in [Topic::Pose, Topic::Health, Topic::Event] {
            wait_until("nothing is missing", || stream(wall, car.name(), topic).1 == 0).await;
        }
    }
}

fn log_has(wall: &FleetService, text: &str) -> bool {
    wall.fleet().log().since(0).any(|entry| entry.text.contains(text))
}

#[tokio::test(flavor = "multi_thread")]
async fn announced_cars_are_bounded_and_forgotten() {
    let endpoint = free_endpoint();
    let wall = pit_wall(&endpoint).await;
    let harm = stranger(&endpoint).await;
    let mut tokens = Vec::new();
    for number in 0..1000 * times() {
        let key = Key::new(named(&format!("mallory-{number}")), Topic::Alive).to_string();
        tokens.push(harm.liveliness().declare_token(key).await.expect("a token"));
    }
    wait_until("it is named", || log_has(&wall, "more than 300 cars: mallory")).await;
    // A real car makes room for itself.
    let cars = real_cars(&endpoint, &wall).await;
    assert!(wall.fleet().cars().count() <= Fleet::MOST_CARS);
    nothing_is_lost(&wall, &cars).await;
    harm.close().await.expect("closed");
    wait_until("invented cars are forgotten", || {
        wall.fleet().cars().count() == cars.len()
    })
    .await;
    wall.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_car_that_floods_is_named_and_muted() {
    let endpoint = free_endpoint();
    let wall = pit_wall(&endpoint).await;
    let cars = real_cars(&endpoint, &wall).await;
    let harm = stranger(&endpoint).await;
    let key = Key::new(named("mallory"), Topic::Cloud).to_string();
    // However busy the machine is, it carries more of these than a car may send.
    let payload = vec![0xff; 4_000_000];
    let named_it = || log_has(&wall, "floods: more than 20 MB a second");
    for _ in 0..300 * times() {
        let put = harm.put(&key, payload.clone());
        put.congestion_control(CongestionControl::Block)
            .await
            .expect("sent");
        if named_it() && times() == 1 {
            break;
        }
    }
    wait_until("it is named", named_it).await;
    nothing_is_lost(&wall, &cars).await;
    let muted =
        wall.fleet().log().since(0).any(|entry| {
            entry.kind == "flood" && entry.car.as_ref().is_some_and(|car| *car != named("mallory"))
        });
    assert!(!muted);
    wall.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_huge_message_disconnects_its_sender_alone() {
    let endpoint = free_endpoint();
    let wall = pit_wall(&endpoint).await;
    let cars = real_cars(&endpoint, &wall).await;
    let harm = stranger(&endpoint).await;
    let key = Key::new(named("mallory"), Topic::Scan).to_string();
    let put = harm.put(&key, vec![0; (40_000_000 * times()).min(100_000_000)]);
    put.congestion_control(CongestionControl::Block).await.ok();
    nothing_is_lost(&wall, &cars).await;
    assert!(
        wall.fleet()
            .car(&named("mallory"))
            .is_none_or(|car| car.scan.is_none())
    );
    wall.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn text_from_the_network_cannot_control_what_shows_it() {
    let endpoint = free_endpoint();
    let wall = pit_wall(&endpoint).await;
    let harm = stranger(&endpoint).await;
    let event = Event {
        kind: EventKind::Warning {
            text: "\u{1b}]0;owned\u{7}<script>\u{202e}gnorw\r\nLOCALIZED".into(),
        },
        update: 1,
        who: Some("\u{1b}[2Jana".into()),
        command: None,
    };
    let stamps = Stamps {
        run_id: 1,
        sequence: 1,
        sensor: unix_now(),
        published: unix_now(),
    };
    let bytes = encode(&event, stamps).expect("a good message");
    let key = Key::new(named("mallory"), Topic::Event).to_string();
    harm.put(&key, bytes).await.expect("sent");
    wait_until("it is logged", || log_has(&wall, "owned")).await;
    let fleet = wall.fleet();
    let entry = fleet
        .log()
        .since(0)
        .find(|entry| entry.text.contains("owned"))
        .expect("logged");
    let shown = format!("{}{}", entry.text, entry.who.as_deref().unwrap_or_default());
    assert!(
        !shown.chars().any(|c| c.is_control() || c == '\u{202e}'),
        "{shown:?}"
    );
    drop(fleet);
    wall.close().await;
}

/// Status line of a request to the page.
fn get(address: SocketAddr) -> Option<String> {
    let mut stream = TcpStream::connect_timeout(&address, Duration::from_secs(5)).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(20))).ok()?;
    write!(
        stream,
        "GET / HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n"
    )
    .ok()?;
    let mut reply = String::new();
    stream.read_to_string(&mut reply).ok()?;
    reply.lines().next().map(str::to_owned)
}

#[tokio::test(flavor = "multi_thread")]
async fn half_open_sockets_and_noise_shut_nobody_out() {
    let endpoint = free_endpoint();
    let server = PitWallServer::start(PitWallOptions {
        role: router(&endpoint),
        protection: Protection::None,
        page: PageOptions {
            address: ([127, 0, 0, 1], 0).into(),
            ..PageOptions::default()
        },
    })
    .await
    .expect("a pit wall");
    let wall = server.service().clone();
    let page: SocketAddr = server
        .url()
        .trim_start_matches("http://")
        .trim_end_matches('/')
        .parse()
        .expect("an address");
    let cars = real_cars(&endpoint, &wall).await;
    let zenoh: SocketAddr = endpoint.trim_start_matches("tcp/").parse().expect("an address");
    let mut open = Vec::new();
    for number in 0..200 * times() as u32 {
        for address in [page, zenoh] {
            let mut socket = TcpStream::connect(address).expect("connects");
            // Some say nothing, some half a request, some noise.
            let noise = match number % 3 {
                0 => Vec::new(),
                1 => b"GET / HTTP/1.1\r\nHo".to_vec(),
                _ => number.to_le_bytes().repeat(50),
            };
            socket.write_all(&noise).ok();
            open.push(socket);
        }
    }
    let status = tokio::task::spawn_blocking(move || get(page))
        .await
        .expect("no panic");
    assert_eq!(status.as_deref(), Some("HTTP/1.1 200 OK"));
    nothing_is_lost(&wall, &cars).await;
    // A car that comes now is let in, too.
    let late = FakeCar::start("late", &endpoint, Behaviour::default()).await;
    wait_until("the car is seen", || received(&wall, late.name()) > 0).await;
    drop(open);
    server.stop().await;
}
