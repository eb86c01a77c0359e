//! A peer that does harm: refused or bounded, named, and the real cars lose nothing beside it.
//!
//! `PITWALL_ATTACK=10` makes each attack ten times as large.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::Duration;

use keys::Protection;
use pitwall::{Fleet, FleetService, PageOptions, PitWallOptions, PitWallServer, unix_now};
use protocol::{Event, EventKind, Key, Stamps, Topic, encode};
use system_tests::{
    Behaviour, FakeCar, alone, attack_factor as times, free_endpoint, is_named, log_has, named,
    nothing_is_lost, nothing_more_is_lost, received, router, stranger, three_cars, wait_until,
};
use zenoh::qos::CongestionControl;

async fn pit_wall(endpoint: &str) -> Arc<FleetService> {
    FleetService::open(&router(endpoint)).await.expect("a pit wall")
}

async fn real_cars(endpoint: &str, wall: &FleetService) -> Vec<FakeCar> {
    three_cars(endpoint, wall, |_| Protection::None).await
}

#[tokio::test(flavor = "multi_thread")]
async fn announced_cars_are_bounded_and_forgotten() {
    let _alone = alone().await;
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
    nothing_more_is_lost(&wall, &cars).await;
    harm.close().await.expect("closed");
    wait_until("invented cars are forgotten", || {
        wall.fleet().cars().count() == cars.len()
    })
    .await;
    wall.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_car_that_floods_is_named_and_muted() {
    let _alone = alone().await;
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
async fn a_huge_message_is_dropped_and_named() {
    let _alone = alone().await;
    let endpoint = free_endpoint();
    let wall = pit_wall(&endpoint).await;
    let cars = real_cars(&endpoint, &wall).await;
    let harm = stranger(&endpoint).await;
    let key = Key::new(named("mallory"), Topic::Scan).to_string();
    let put = harm.put(&key, vec![0; (40_000_000 * times()).min(100_000_000)]);
    put.congestion_control(CongestionControl::Block).await.ok();
    is_named(&wall, "a host sent a longer message than is allowed").await;
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
    let _alone = alone().await;
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

#[tokio::test(flavor = "multi_thread")]
async fn random_bytes_on_every_key_and_names_that_are_no_names_are_ignored() {
    let _alone = alone().await;
    let endpoint = free_endpoint();
    let wall = pit_wall(&endpoint).await;
    let cars = real_cars(&endpoint, &wall).await;
    let harm = stranger(&endpoint).await;
    for number in 0..10 * times() as u64 {
        let bytes: Vec<u8> = (0..997_u64)
            .map(|at| ((at + number * 997).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56) as u8)
            .collect();
        for topic in Topic::all() {
            let key = Key::new(named("mallory"), topic).to_string();
            harm.put(&key, bytes.clone()).await.expect("sent");
        }
    }
    for name in [
        "<img src=x onerror=alert(1)>",
        "\u{1b}]0;owned\u{7}",
        "\u{202e}1-rac",
    ] {
        let key = format!("{}/{name}/{}", Key::PREFIX, Topic::Pose);
        harm.put(&key, vec![0; 100]).await.expect("sent");
    }
    is_named(&wall, "that is no car's key").await;
    wait_until("unreadable messages are named", || {
        let fleet = wall.fleet();
        let mut log = fleet.log().since(0);
        log.any(|entry| entry.kind == "unreadable" && entry.car == Some(named("mallory")))
    })
    .await;
    nothing_is_lost(&wall, &cars).await;
    let fleet = wall.fleet();
    let shown: String = fleet.log().since(0).map(|entry| entry.text.clone()).collect();
    assert!(
        !shown.chars().any(|c| c.is_control() || c == '\u{202e}'),
        "{shown:?}"
    );
    assert!(
        fleet
            .cars()
            .all(|car| car.name.as_str().starts_with("car-") || car.name == named("mallory"))
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
    let _alone = alone().await;
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
    is_named(&wall, "it said nothing, as half-open connections do").await;
    is_named(
        &wall,
        "127.0.0.1 was refused: what it sends is no message of a car",
    )
    .await;
    is_named(&wall, "connections to the page said nothing").await;
    nothing_is_lost(&wall, &cars).await;
    // A car that comes now is let in, too.
    let late = FakeCar::start("late", &endpoint, Behaviour::default()).await;
    wait_until("the car is seen", || received(&wall, late.name()) > 0).await;
    drop(open);
    server.stop().await;
}
