//! TCP options for connections over a radio, on sockets that a library opened.
//!
//! zenoh opens its own sockets and has no setting for these options. A thread of this crate finds new sockets of the process and
//! sets them:
//!
//! - **User timeout.** When a link is cut, TCP sends again after 0.2 s, 0.4 s, 0.8 s and so on, and gives up after 15 minutes. zenoh
//!   waits for that while it closes an encrypted link, and refuses the same peer until it is closed. So a car was not heard for
//!   up to a minute after a cut of 30 s. With a user timeout the connection ends, and a new one begins.
//! - **Little unsent data.** What the operating system has taken cannot be overtaken by a newer pose, or dropped. It takes
//!   more only when it can send soon, whatever the rate of the link.
//! - **Retransmission without growing pauses**, as long as few packets are under way.
//!
//! Connections within the machine are left alone. On systems other than Linux this crate does nothing.

use std::time::Duration;

/// A connection ends when the other side has acknowledged nothing for this long. It is also the lease of a zenoh session, after which the
/// receiver ends it.
pub const LEASE: Duration = Duration::from_millis(2500);
/// The longest attempt to connect, from the first packet to the end of the login. A new one sends new packets; an old one waits
/// longer and longer before it repeats them.
pub const CONNECT: Duration = Duration::from_millis(2500);

/// Settings of zenoh that go with it, as keys and JSON.
pub fn zenoh_settings() -> [(&'static str, String); 2] {
    [
        ("transport/link/tx/lease", LEASE.as_millis().to_string()),
        ("transport/unicast/open_timeout", CONNECT.as_millis().to_string()),
    ]
}

/// The pauses between attempts to connect, as zenoh's `connect/retry`.
pub const RETRY: &str = r#"{"period_init_ms":200,"period_max_ms":500,"period_increase_factor":2}"#;

#[cfg(not(target_os = "linux"))]
/// Does nothing on this system.
pub fn watch() {}

#[cfg(target_os = "linux")]
pub use linux::watch;

#[cfg(target_os = "linux")]
mod linux;
