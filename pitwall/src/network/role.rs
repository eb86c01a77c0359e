//! How the pit wall connects to the cars: as a router that they dial, or as a client of a running router.

use std::net::{IpAddr, SocketAddr, TcpStream, ToSocketAddrs};
use std::time::Duration;

use keys::{Protection, Settings, Side};
use zenoh::Config;
use zenoh::config::EndPoint;

use super::error::{ConnectionError, reason};

/// Where a pit wall listens for cars by default, when it is protected.
const DEFAULT_ADDRESS: &str = "0.0.0.0:7447";
/// Where a pit wall on the same laptop listens.
const LOCAL_ADDRESS: &str = "127.0.0.1:7447";
/// The endpoint of a pit wall on the same laptop.
pub const LOCAL_PITWALL: &str = "tcp/127.0.0.1:7447";

/// Longest message from the network \[bytes\]: a map of the largest size.
const LONGEST_MESSAGE: usize = 17 * 1024 * 1024;
/// Longest time from a connection to its first words, and to the end of its login \[ms\].
const HANDSHAKE_MS: u32 = 3000;
/// Most connections at once.
const MOST_SESSIONS: usize = 300;

/// How to connect to the cars.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Role {
    /// Opens a router that the cars dial.
    Router {
        /// Endpoints to listen on, such as `tcp/0.0.0.0:7447`.
        listen: Vec<String>,
        /// Answers cars on the local network that search for a pit wall by multicast.
        discoverable: bool,
    },
    /// Joins a running router.
    Client {
        /// Endpoints to try.
        connect: Vec<String>,
    },
}

impl Role {
    /// The role for the options given.
    ///
    /// Joins the endpoints of `--connect`, or else listens on those of `--listen`. Without either it joins the pit wall
    /// that runs on this laptop, and if none runs, it opens a router.
    /// A router without keys and without a passphrase listens on this machine only, unless `insecure` is set.
    pub fn choose(listen: &[String], connect: &[String], protection: &Protection, insecure: bool) -> Self {
        let scheme = protection.scheme();
        let open = protection.protects() || insecure;
        if !connect.is_empty() {
            Self::Client {
                connect: connect.to_vec(),
            }
        } else if !listen.is_empty() {
            Self::Router {
                listen: listen.to_vec(),
                discoverable: false,
            }
        } else if accepts_connections(LOCAL_ADDRESS) {
            Self::Client {
                connect: vec![format!("{scheme}/{LOCAL_ADDRESS}")],
            }
        } else {
            let address = if open { DEFAULT_ADDRESS } else { LOCAL_ADDRESS };
            Self::Router {
                listen: vec![format!("{scheme}/{address}")],
                discoverable: open,
            }
        }
    }

    /// The endpoints to listen on or to connect to.
    pub fn endpoints(&self) -> &[String] {
        match self {
            Self::Router { listen, .. } => listen,
            Self::Client { connect } => connect,
        }
    }

    /// The first endpoint that others than this machine reach. None for a client, which accepts no connections.
    pub fn reachable_endpoint(&self) -> Option<&str> {
        let Self::Router { listen, .. } = self else {
            return None;
        };
        listen
            .iter()
            .map(String::as_str)
            .find(|endpoint| !on_loopback(endpoint))
    }

    fn discoverable(&self) -> bool {
        matches!(
            self,
            Self::Router {
                discoverable: true,
                ..
            }
        )
    }

    /// The zenoh configuration.
    pub(super) fn config(&self, protection: &Protection) -> Result<(Config, Settings), ConnectionError> {
        let list = |endpoints: &[String]| serde_json::json!(endpoints).to_string();
        let mut entries = vec![
            ("scouting/multicast/enabled", self.discoverable().to_string()),
            ("scouting/gossip/enabled", "false".to_owned()),
            ("transport/link/rx/max_message_size", LONGEST_MESSAGE.to_string()),
            ("transport/unicast/max_sessions", MOST_SESSIONS.to_string()),
            // Sockets that connect and say nothing keep others out for a moment only.
            ("transport/unicast/accept_timeout", HANDSHAKE_MS.to_string()),
            ("transport/unicast/accept_pending", MOST_SESSIONS.to_string()),
        ];
        entries.extend(sockets::zenoh_settings());
        match self {
            Self::Router { listen, .. } => {
                entries.push(("mode", r#""router""#.to_owned()));
                let listen: Vec<_> = listen
                    .iter()
                    .map(|endpoint| patient_for_a_moment(endpoint))
                    .collect();
                entries.push(("listen/endpoints", list(&listen)));
            }
            Self::Client { connect } => {
                entries.push(("mode", r#""client""#.to_owned()));
                entries.push(("connect/endpoints", list(connect)));
                entries.push(("connect/timeout_ms", "3000".to_owned()));
                entries.push(("connect/retry", sockets::RETRY.to_owned()));
            }
        }
        let side = match self {
            Self::Router { .. } => Side::Listener,
            Self::Client { .. } => Side::Client,
        };
        let settings = protection
            .settings(&side)
            .map_err(|error| ConnectionError::Keys(error.to_string()))?;
        sockets::watch();
        let mut config = Config::default();
        for (key, value) in entries {
            config
                .insert_json5(key, &value)
                .map_err(|e| ConnectionError::Config {
                    key,
                    value,
                    reason: reason(&e),
                })?;
        }
        for (key, value) in &settings.entries {
            // The value holds secrets: it is not part of the error.
            config
                .insert_json5(key, value)
                .map_err(|_| ConnectionError::Keys(format!("zenoh refuses its setting {key}")))?;
        }
        Ok((config, settings))
    }

    /// The error for a zenoh session that cannot be opened.
    pub(super) fn open_error(&self, error: &zenoh::Error) -> ConnectionError {
        let attempt = match self {
            Self::Router { listen, .. } => {
                format!("cannot listen on {} (is the port taken?)", listen.join(", "))
            }
            Self::Client { connect } => format!("no pit wall answers at {}", connect.join(", ")),
        };
        ConnectionError::Open {
            attempt,
            reason: reason(error),
        }
    }
}

impl std::fmt::Display for Role {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Router { listen, .. } => write!(f, "listening for cars on {}", listen.join(", ")),
            Self::Client { connect } => write!(f, "joined the pit wall at {}", connect.join(", ")),
        }
    }
}

/// Parses an endpoint that a user typed.
pub(crate) fn endpoint(text: &str) -> Result<String, String> {
    text.parse::<EndPoint>()
        .map(|endpoint| endpoint.to_string())
        .map_err(|_| "expected PROTOCOL/ADDRESS:PORT, such as tcp/192.168.1.10:7447".to_owned())
}

/// The endpoint with a limit on the time of a TLS handshake: sockets that connect and say nothing must not stay.
fn patient_for_a_moment(endpoint: &str) -> String {
    if !endpoint.starts_with("tls/") {
        return endpoint.to_owned();
    }
    let separator = if endpoint.contains('#') { ';' } else { '#' };
    format!("{endpoint}{separator}tls_handshake_timeout_ms={HANDSHAKE_MS}")
}

/// True when only this machine reaches an endpoint.
fn on_loopback(endpoint: &str) -> bool {
    let Ok(endpoint) = endpoint.parse::<EndPoint>() else {
        return false;
    };
    let address = endpoint.address();
    let host = address
        .as_str()
        .rsplit_once(':')
        .map_or(address.as_str(), |(host, _)| host);
    host == "localhost"
        || host
            .trim_matches(['[', ']'])
            .parse::<IpAddr>()
            .is_ok_and(|host| host.is_loopback())
}

/// True when something accepts connections at an address.
fn accepts_connections(address: &str) -> bool {
    let address: Option<SocketAddr> = address.to_socket_addrs().ok().and_then(|mut all| all.next());
    address.is_some_and(|address| TcpStream::connect_timeout(&address, Duration::from_millis(200)).is_ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_loopback_is_out_of_reach() {
        for (endpoint, local) in [
            ("tcp/127.0.0.1:7447", true),
            ("tls/[::1]:7447", true),
            ("tcp/localhost:7447", true),
            ("tcp/127.0.0.1:7447#iface=lo", true),
            ("tcp/0.0.0.0:7447", false),
            ("tcp/[::]:7447", false),
            ("tcp/192.168.1.10:7447", false),
            ("tcp/pit.local:7447", false),
            ("nonsense", false),
        ] {
            assert_eq!(on_loopback(endpoint), local, "{endpoint}");
        }
    }

    #[test]
    fn without_keys_the_default_is_loopback() {
        let role = |insecure| Role::choose(&[], &[], &Protection::None, insecure);
        let Role::Router { listen, discoverable } = role(false) else {
            // A pit wall runs on this machine.
            return;
        };
        assert_eq!((listen, discoverable), (vec![LOCAL_PITWALL.to_owned()], false));
        assert_eq!(role(false).reachable_endpoint(), None);
        assert_eq!(role(true).reachable_endpoint(), Some("tcp/0.0.0.0:7447"));
    }
}
