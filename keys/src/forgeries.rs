//! Messages that the access rules drop, in plain words: who sent what in whose name.
//!
//! zenoh reports them in its log only:
//! `ZID on Interface(wlan0)+CertCommonName(car/car-2/01ab..)+tls+ZID is unauthorized to Put (ingress) on synpf/v1/car-1/pose`.

use protocol::{CarName, Key, Topic};

use crate::identity::Identity;

/// Where zenoh applies the access rules.
pub(crate) const TARGET: &str = "zenoh::net::routing::interceptor::access_control";
/// What stands between who and what in the entry about a dropped message.
const DROPPED: &str = " is unauthorized to ";

/// A message that was dropped.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Forgery {
    /// Who did what in whose name. It is the same for all topics.
    pub(crate) deed: String,
    /// The whole sentence.
    pub(crate) text: String,
}

/// What an entry of the log means; None when nothing was dropped that its sender meant to send.
///
/// When a peer declares a key, zenoh looks up every right under it. So an entry counts only if such a message makes sense under its
/// topic.
pub(crate) fn meaning(entry: &str) -> Option<Forgery> {
    let (subject, what) = entry.split_once(DROPPED)?;
    let (message, key) = what.split_once(" (ingress) on ")?;
    let who = subject
        .split(['+', ' '])
        .find_map(|part| part.strip_prefix("CertCommonName(")?.strip_suffix(')'))?
        .parse::<Identity>()
        .ok()?;
    let (car, topic) = named_in(key)?;
    // A car declares its own keys, and has no right to ask under them.
    if message == "Query" && car == who.name.as_str() {
        return None;
    }
    let asked = matches!(topic, Topic::Map | Topic::Info | Topic::Clock | Topic::Missing);
    let commanded = topic == Topic::Files || topic.as_str().starts_with("cmd/");
    let deed = match message {
        "Query" if commanded => format!("commanded {car}"),
        "Query" if asked => format!("asked {car}"),
        "Declare Queryable" if asked || commanded => format!("would answer in the name of {car}"),
        "Put" | "Delete" if topic == Topic::Link => format!("sent {car} a report"),
        // Nothing is published there: a token that zenoh passes on and withdraws looks like it.
        "Put" | "Delete" if topic == Topic::Alive => return None,
        "Put" | "Delete" if !asked && !commanded => format!("published in the name of {car}"),
        "Liveliness Token" => format!("announced itself as {car}"),
        _ => return None,
    };
    let deed = format!("{} {} {deed}", who.role, who.name);
    let text = format!("{deed} ({topic}): its keys do not allow that, it was dropped");
    Some(Forgery { deed, text })
}

/// The car, `every car` for a key with wildcards, and the topic of a key.
fn named_in(key: &str) -> Option<(String, Topic)> {
    if let Some((car, _)) = Key::parse_run_token(key) {
        return Some((car.to_string(), Topic::Alive));
    }
    let (car, topic) = key
        .strip_prefix(Key::PREFIX)?
        .strip_prefix('/')?
        .split_once('/')?;
    let topic = topic.parse().ok()?;
    let car = match car {
        "*" | "**" => "every car".to_owned(),
        car => car.parse::<CarName>().ok()?.to_string(),
    };
    Some((car, topic))
}

/// True for a part of an entry that is not about a dropped message. Most entries say that something is allowed.
pub(crate) fn is_allowed(text: &str) -> bool {
    text.starts_with("Using cached result")
        || text.starts_with("ACL (")
        || text.contains(" is authorized to ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(name: &str, what: &str) -> String {
        format!("3f on Interface(lo)+CertCommonName({name})+tls+3f is unauthorized to {what}")
    }

    #[test]
    fn who_did_what_in_whose_name() {
        for (what, expected) in [
            (
                "Put (ingress) on synpf/v1/car-1/pose",
                "car car-2 published in the name of car-1 (pose)",
            ),
            (
                "Put (ingress) on synpf/v1/*/event",
                "car car-2 published in the name of every car (event)",
            ),
            (
                "Put (ingress) on synpf/v1/car-1/link",
                "car car-2 sent car-1 a report (link)",
            ),
            (
                "Query (ingress) on synpf/v1/car-1/cmd/pose",
                "car car-2 commanded car-1 (cmd/pose)",
            ),
            (
                "Query (ingress) on synpf/v1/car-1/map",
                "car car-2 asked car-1 (map)",
            ),
            (
                "Declare Queryable (ingress) on synpf/v1/car-1/clock",
                "car car-2 would answer in the name of car-1 (clock)",
            ),
            (
                "Liveliness Token (ingress) on synpf/v1/car-1/alive/7",
                "car car-2 announced itself as car-1 (alive)",
            ),
        ] {
            let forgery = meaning(&entry("car/car-2/000000000000001f", what)).expect(what);
            assert_eq!(
                forgery.text,
                format!("{expected}: its keys do not allow that, it was dropped")
            );
            assert!(forgery.text.starts_with(&forgery.deed));
        }
    }

    #[test]
    fn rights_that_are_only_looked_up_are_no_forgery() {
        for what in [
            "Query (ingress) on synpf/v1/car-1/pose",
            "Query (ingress) on synpf/v1/fan/cmd/pose",
            "Reply (ingress) on synpf/v1/car-1/pose",
            "Put (ingress) on synpf/v1/car-1/cmd/pose",
            "Put (ingress) on synpf/v1/_pitwall/recorder",
            "Put (ingress) on synpf/v1/car-1/alive",
            "Delete (ingress) on synpf/v1/car-1/alive/7",
            "Declare/Undeclare Queryable (ingress) on synpf/v1/car-1/map",
            "Put (egress) on synpf/v1/car-1/pose",
            "Put (ingress) on synpf/v1",
        ] {
            assert_eq!(
                meaning(&entry("viewer/fan/000000000000001f", what)),
                None,
                "{what}"
            );
        }
        let foreign = entry("\u{1b}[2J/x", "Put (ingress) on synpf/v1/car-1/pose");
        assert_eq!(meaning(&foreign), None);
        assert!(is_allowed("3f on Interface(lo) is authorized to "));
        assert!(!is_allowed("3f on Interface(lo) is unauthorized to "));
    }
}
