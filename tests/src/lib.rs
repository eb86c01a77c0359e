//! Harness for whole-system tests.
//!
//! It gives pit walls and cars on private loopback endpoints, and two kinds of car: [`FakeCar`], which only speaks the
//! protocol, and [`start_real`], a whole node on a simulated track. It also records a race ([`RaceSession`]), writes a bag of a drive through a small room
//! ([`write_bag`]), has a link that can be cut ([`Link`]), lets cars drive beside an attack
//! ([`three_cars`]), measures the processor time taken by the host ([`steal_time`]), and waits for conditions with a
//! deadline ([`wait_until`]).

#[cfg(feature = "browser")]
mod browser;
mod bystanders;
mod fake_car;
mod link;
mod race_session;
mod real_car;
mod steal_time;
mod synthetic_bag;

#[cfg(feature = "browser")]
pub use browser::Browser;
pub use bystanders::{
    alone, attack_factor, is_named, log_has, nothing_is_lost, nothing_more_is_lost, received, three_cars,
};
pub use fake_car::{Behaviour, FakeCar};
pub use link::Link;
pub use race_session::RaceSession;
pub use real_car::{start_real, start_real_protected, start_recording};
pub use steal_time::steal_time;
pub use synthetic_bag::{room, true_pose, write_bag};

use std::net::TcpListener;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use pitwall::{FleetService, Role, Verdict, new_command_id};
use protocol::{Action, CarName, Command, ParamsAction};
use tempfile::TempDir;

/// How long a condition or an answer may take before a test fails. It is long, because machines may be busy.
pub const DEADLINE: Duration = Duration::from_mins(1);

/// A program that is neither car nor pit wall.
pub async fn stranger(endpoint: &str) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", r#""client""#.to_owned()),
        ("connect/endpoints", format!(r#"["{endpoint}"]"#)),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).expect("a good setting");
    }
    zenoh::open(config).await.expect("a session")
}

/// A car's name.
pub fn named(name: &str) -> CarName {
    CarName::new(name).expect("a good name")
}

/// The set in force and its revision, as the pit wall knows them.
pub fn in_force(service: &FleetService, car: &CarName) -> Option<(String, u64)> {
    let fleet = service.fleet();
    let params = fleet.car(car)?.params.as_ref()?;
    Some((params.set.name.clone(), params.revision))
}

/// The action that puts a set in force without a fall back.
pub fn select(name: &str) -> Action {
    Action::Params(ParamsAction::Select {
        name: name.into(),
        revert_after_ms: None,
    })
}

/// Sends an action to a car and waits up to [`DEADLINE`] for its answer: on a busy machine, the answer may take longer
/// than an operator would wait.
pub async fn send_command(
    service: &FleetService,
    car: &CarName,
    operator: &str,
    expected_revision: Option<u64>,
    action: Action,
) -> Verdict {
    let command = Command {
        id: new_command_id(),
        operator: operator.to_owned(),
        expected_revision,
        action,
    };
    let verdict = service.client().send(car, &command, DEADLINE).await;
    verdict.expect("a valid command")
}

/// A free endpoint on loopback.
pub fn free_endpoint() -> String {
    // The system gives a free port, and does not give it again soon.
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = listener.local_addr().expect("an address");
    format!("tcp/{address}")
}

/// The role of a pit wall that listens at `endpoint`.
pub fn router(endpoint: &str) -> Role {
    Role::Router {
        listen: vec![endpoint.to_owned()],
        discoverable: false,
    }
}

/// The role of a program that joins the pit wall at `endpoint`.
pub fn client(endpoint: &str) -> Role {
    Role::Client {
        connect: vec![endpoint.to_owned()],
    }
}

/// A pit wall that records. Returns its endpoint, the pit wall, and the folder and path of the recording.
pub async fn recording() -> (String, Arc<FleetService>, TempDir, PathBuf) {
    let endpoint = free_endpoint();
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("session.mcap");
    service.start_recording(&file).await.expect("a new file");
    (endpoint, service, folder, file)
}

/// Waits until `condition` holds. Panics with `what` if it does not within [`DEADLINE`].
pub async fn wait_until(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + DEADLINE;
    while !condition() {
        assert!(Instant::now() < deadline, "not within {DEADLINE:?}: {what}");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}
