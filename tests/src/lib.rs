//! Harness for whole-system tests: sessions on loopback that see nothing but each other, a car made of nothing but
//! protocol, a whole one on a simulated track, a bag of a drive in a drawn room, the processor time that the host takes
//! away, and waiting for conditions.

#[cfg(feature = "browser")]
mod browser;
mod fake_car;
mod real_car;
mod stolen;
mod synthetic_bag;

#[cfg(feature = "browser")]
pub use browser::Browser;
pub use fake_car::{Behaviour, FakeCar};
pub use real_car::start_real;
pub use stolen::stolen;
pub use synthetic_bag::{room, true_pose, write_bag};

use std::net::TcpListener;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use pitwall::{FleetService, Role};
use protocol::{Action, CarName, ParamsAction};
use tempfile::TempDir;

/// How long anything may take before a test gives up.
pub const DEADLINE: Duration = Duration::from_mins(1);

/// A car's name.
pub fn named(name: &str) -> CarName {
    CarName::new(name).expect("a good name")
}

/// The set in force and its revision, as a pit wall knows them.
pub fn in_force(service: &FleetService, car: &CarName) -> Option<(String, u64)> {
    let fleet = service.fleet();
    let params = fleet.car(car)?.params.as_ref()?;
    Some((params.set.name.clone(), params.revision))
}

/// Puts a set in force, for good.
pub fn select(name: &str) -> Action {
    Action::Params(ParamsAction::Select {
        name: name.into(),
        revert_after_ms: None,
    })
}

/// An endpoint on loopback that nobody else uses.
pub fn free_endpoint() -> String {
    // The system hands out a port that is free, and does not hand it out again soon.
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = listener.local_addr().expect("an address");
    format!("tcp/{address}")
}

/// A pit wall that listens there.
pub fn router(endpoint: &str) -> Role {
    Role::Router {
        listen: vec![endpoint.to_owned()],
        discoverable: false,
    }
}

/// A program that joins the pit wall there.
pub fn client(endpoint: &str) -> Role {
    Role::Client {
        connect: vec![endpoint.to_owned()],
    }
}

/// A pit wall that records: where cars dial, and the folder with the file.
pub async fn recording() -> (String, Arc<FleetService>, TempDir, PathBuf) {
    let endpoint = free_endpoint();
    let service = FleetService::open(&router(&endpoint)).await.expect("a link");
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("session.mcap");
    service.start_recording(&file).await.expect("a new file");
    (endpoint, service, folder, file)
}

/// Waits until `condition` holds; panics with `what` when it does not within [`DEADLINE`].
pub async fn wait_until(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + DEADLINE;
    while !condition() {
        assert!(Instant::now() < deadline, "not within {DEADLINE:?}: {what}");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}
