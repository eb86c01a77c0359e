//! zenoh's access rules for each role.

use std::collections::BTreeMap;

use protocol::{CarName, Key, Topic};
use serde_json::{Value, json};

use crate::bundle::Bundle;
use crate::identity::Role;
use crate::passphrase::Passphrase;

/// Which end of a link a session is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Side {
    /// Accepts connections: the pit wall.
    Listener,
    /// Connects to a pit wall.
    Client,
    /// A car, which connects to a pit wall and writes under its own name.
    Car(CarName),
}

/// Every kind of message that the rules know.
const ALL: [&str; 9] = [
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "declare_liveliness_subscriber",
    "liveliness_query",
];

/// Rules for certificates, by their common names. What no rule allows is dropped.
pub(crate) fn by_certificate(bundle: &Bundle, side: &Side) -> Value {
    let mut rules = Rules::default();
    // Both may stand at the other end of a link; only a pit wall can sign commands.
    let pits: Vec<_> = bundle
        .common_names(Role::Pit)
        .chain(bundle.common_names(Role::Router))
        .collect();
    match side {
        Side::Client => rules.add(
            "pit",
            &json!({"cert_common_names": pits}),
            !pits.is_empty(),
            everything(),
        ),
        Side::Car(car) => rules.add(
            "pit",
            &json!({"cert_common_names": pits}),
            !pits.is_empty(),
            own(car),
        ),
        Side::Listener => {
            rules.add(
                "pit",
                &json!({"cert_common_names": pits}),
                !pits.is_empty(),
                everything(),
            );
            let viewers: Vec<_> = bundle.common_names(Role::Viewer).collect();
            let some = !viewers.is_empty();
            rules.add("viewer", &json!({"cert_common_names": viewers}), some, reading());
            let mut cars = BTreeMap::<_, Vec<_>>::new();
            for member in bundle.members.iter().filter(|member| member.role == Role::Car) {
                cars.entry(&member.name).or_default().push(&member.common_name);
            }
            for (car, names) in cars {
                let name = format!("car {car}");
                rules.add(&name, &json!({"cert_common_names": names}), true, publishing(car));
            }
        }
    }
    rules.finish()
}

/// Rules for those who know the passphrase: they may do everything, and others nothing.
pub(crate) fn by_passphrase() -> Value {
    let mut rules = Rules::default();
    let team = json!({"usernames": [Passphrase::USER]});
    rules.add("team", &team, true, everything());
    rules.finish()
}

/// Messages, flows and keys that are allowed.
struct Allowed {
    messages: Vec<&'static str>,
    flows: Vec<&'static str>,
    keys: Vec<String>,
}

fn allowed(messages: &[&'static str], flows: &[&'static str], keys: Vec<String>) -> Allowed {
    Allowed {
        messages: messages.to_vec(),
        flows: flows.to_vec(),
        keys,
    }
}

fn everywhere() -> Vec<String> {
    vec![format!("{}/**", Key::PREFIX)]
}

fn under(car: &CarName) -> Vec<String> {
    vec![format!("{}/{car}/**", Key::PREFIX)]
}

/// What a pit wall may do.
fn everything() -> Vec<Allowed> {
    vec![allowed(&ALL, &["ingress", "egress"], everywhere())]
}

/// What passes between a car and its pit wall, seen from the car. The pit wall's subscriptions name all cars.
fn own(car: &CarName) -> Vec<Allowed> {
    let interest = [
        "declare_subscriber",
        "declare_liveliness_subscriber",
        "liveliness_query",
    ];
    vec![
        allowed(&ALL, &["ingress", "egress"], under(car)),
        allowed(&interest, &["ingress"], everywhere()),
    ]
}

/// What a car may do, seen from the pit wall.
fn publishing(car: &CarName) -> Vec<Allowed> {
    let interest = [
        "declare_subscriber",
        "declare_liveliness_subscriber",
        "liveliness_query",
    ];
    let out = ["put", "delete", "declare_queryable", "reply", "liveliness_token"];
    let link = vec![Key::new(car.clone(), Topic::Link).to_string()];
    vec![
        allowed(&out, &["ingress"], under(car)),
        allowed(&["declare_subscriber"], &["ingress"], link.clone()),
        // It looks for another car of its name.
        allowed(
            &["declare_liveliness_subscriber", "liveliness_query"],
            &["ingress"],
            under(car),
        ),
        allowed(&["liveliness_token"], &["egress"], under(car)),
        allowed(&interest, &["egress"], everywhere()),
        allowed(&["query"], &["egress"], under(car)),
        allowed(&["put"], &["egress"], link),
    ]
}

/// What a viewer may do, seen from the pit wall: everything but commands and messages of its own.
fn reading() -> Vec<Allowed> {
    let interest = [
        "declare_subscriber",
        "declare_liveliness_subscriber",
        "liveliness_query",
    ];
    let news = ["put", "delete", "declare_queryable", "reply", "liveliness_token"];
    let queries = [Topic::Map, Topic::Info, Topic::Clock, Topic::Missing];
    vec![
        allowed(&interest, &["ingress"], everywhere()),
        allowed(&["query"], &["ingress"], queries.map(Topic::of_all_cars).to_vec()),
        allowed(&news, &["egress"], everywhere()),
    ]
}

/// The lists that zenoh reads.
#[derive(Default)]
struct Rules {
    allowed: Vec<Value>,
    subjects: Vec<Value>,
    policies: Vec<Value>,
}

impl Rules {
    /// Allows a subject something; nothing to nobody when there is `some`.
    fn add(&mut self, name: &str, subject: &Value, some: bool, what: Vec<Allowed>) {
        if !some {
            return;
        }
        let mut subject = subject.clone();
        subject["id"] = name.into();
        self.subjects.push(subject);
        let mut ids = Vec::new();
        for (
            index,
            Allowed {
                messages,
                flows,
                keys,
            },
        ) in what.into_iter().enumerate()
        {
            let id = format!("{name} {index}");
            self.allowed.push(json!({
                "id": id, "messages": messages, "flows": flows, "permission": "allow", "key_exprs": keys,
            }));
            ids.push(id);
        }
        self.policies.push(json!({"rules": ids, "subjects": [name]}));
    }

    fn finish(self) -> Value {
        json!({
            "enabled": true,
            "default_permission": "deny",
            "rules": self.allowed,
            "subjects": self.subjects,
            "policies": self.policies,
        })
    }
}
