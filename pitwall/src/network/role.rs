//! How the pit wall connects to the cars: as a router that they dial, or as a client of a running router.

use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::time::Duration;

use zenoh::Config;
use zenoh::config::EndPoint;

use super::error::{ConnectionError, reason};

/// Where a pit wall listens for cars by default.
pub const DEFAULT_LISTEN: &str = "tcp/0.0.0.0:7447";
/// The endpoint of a pit wall on the same laptop.
pub const LOCAL_PITWALL: &str = "tcp/127.0.0.1:7447";

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
    pub fn choose(listen: &[String], connect: &[String]) -> Self {
        if !connect.is_empty() {
            Self::Client {
                connect: connect.to_vec(),
            }
        } else if !listen.is_empty() {
            Self::Router {
                listen: listen.to_vec(),
                discoverable: false,
            }
        } else if accepts_connections(LOCAL_PITWALL) {
            Self::Client {
                connect: vec![LOCAL_PITWALL.to_owned()],
            }
        } else {
            Self::Router {
                listen: vec![DEFAULT_LISTEN.to_owned()],
                discoverable: true,
            }
        }
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
    pub(super) fn config(&self) -> Result<Config, ConnectionError> {
        let list = |endpoints: &[String]| serde_json::json!(endpoints).to_string();
        let mut entries = vec![
            ("scouting/multicast/enabled", self.discoverable().to_string()),
            ("scouting/gossip/enabled", "false".to_owned()),
            ("transport/link/tx/lease", "4000".to_owned()),
        ];
        match self {
            Self::Router { listen, .. } => {
                entries.push(("mode", r#""router""#.to_owned()));
                entries.push(("listen/endpoints", list(listen)));
            }
            Self::Client { connect } => {
                entries.push(("mode", r#""client""#.to_owned()));
                entries.push(("connect/endpoints", list(connect)));
                entries.push(("connect/timeout_ms", "3000".to_owned()));
                let retry = r#"{"period_init_ms":200,"period_max_ms":1000,"period_increase_factor":2}"#;
                entries.push(("connect/retry", retry.to_owned()));
            }
        }
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
        Ok(config)
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

/// True when something accepts connections at a `tcp/` endpoint.
fn accepts_connections(endpoint: &str) -> bool {
    let address: Option<SocketAddr> = endpoint
        .strip_prefix("tcp/")
        .and_then(|address| address.to_socket_addrs().ok()?.next());
    address.is_some_and(|address| TcpStream::connect_timeout(&address, Duration::from_millis(200)).is_ok())
}
