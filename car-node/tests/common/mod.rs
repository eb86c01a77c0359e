//! What tests of a node share.

use std::net::TcpListener;

use zenoh::{Config, Session, Wait};

/// A zenoh router with nothing around it, and its endpoint.
pub(crate) fn router() -> (Session, String) {
    // The port is free when this looks; another test taking it meanwhile would fail loudly.
    let port = TcpListener::bind("127.0.0.1:0")
        .and_then(|listener| listener.local_addr())
        .expect("a free port")
        .port();
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let mut config = Config::default();
    for (key, value) in [
        ("mode", r#""router""#.to_owned()),
        ("listen/endpoints", format!("[{endpoint:?}]")),
        ("scouting/multicast/enabled", "false".into()),
        ("scouting/gossip/enabled", "false".into()),
        // What a publisher keeps for those who come late needs stamps.
        ("timestamping/enabled", "true".into()),
    ] {
        config.insert_json5(key, &value).expect("a setting");
    }
    (zenoh::open(config).wait().expect("a router"), endpoint)
}
