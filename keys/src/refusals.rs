//! Connections and messages that were refused because of keys, in plain words.
//!
//! zenoh reports a failed handshake in its log only, in the words of the TLS library, and a message that the access rules drop in
//! its own. A [`Watch`] layer reads these entries, and [`take`] returns what they mean, each sentence once a minute.

use std::collections::VecDeque;
use std::fmt::{self, Write};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use tracing::field::{Field, Visit};
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::FilterFn;
use tracing_subscriber::layer::Context;
use tracing_subscriber::registry::LookupSpan;

use crate::forgeries;

/// The same sentence is repeated after this time.
const AGAIN: Duration = Duration::from_mins(1);
/// Sentences that are remembered, and that wait to be taken.
const MOST: usize = 32;

/// Which part of zenoh wrote a log entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    /// The connection was accepted here.
    Listener,
    /// The connection was opened from here.
    Dialer,
    /// The login of a connection that was accepted here, and what comes after it.
    Login,
    /// The access rules.
    Rules,
}

/// Reads zenoh's log entries about handshakes, logins and dropped messages.
#[derive(Debug, Clone, Copy, Default)]
pub struct Watch;

/// The layer with the filter that it needs: handshakes are logged at debug level, dropped messages at trace level.
pub fn watch<S>() -> impl Layer<S>
where
    S: Subscriber + for<'span> LookupSpan<'span>,
{
    let concerned = |metadata: &Metadata<'_>| match end(metadata) {
        Some(End::Rules) => true,
        // Too many connections, and too long messages.
        Some(End::Login) if metadata.target().ends_with("manager") || metadata.target() == MESSAGES => true,
        Some(_) => *metadata.level() <= Level::DEBUG,
        None => false,
    };
    Watch.with_filter(FilterFn::new(concerned).with_max_level_hint(Level::TRACE))
}

/// Where zenoh puts the pieces of a message together.
const MESSAGES: &str = "zenoh_transport::unicast::universal::rx";
/// How its entry about a message begins that is too long.
const TOO_LONG: &str = "Defragmentation buffer full";

/// Where zenoh logs in whoever has connected, and receives messages.
const LOGIN: [&str; 4] = [
    "zenoh_transport::unicast::establishment::accept",
    "zenoh_transport::unicast::manager",
    "zenoh_transport::unicast::universal::link",
    MESSAGES,
];

fn end(metadata: &Metadata<'_>) -> Option<End> {
    match metadata.target() {
        target if target.starts_with("zenoh_link_tls") => Some(End::Listener),
        target if target.starts_with("zenoh::net::runtime::orchestrator") => Some(End::Dialer),
        target if target == forgeries::TARGET => Some(End::Rules),
        target if LOGIN.contains(&target) => Some(End::Login),
        _ => None,
    }
}

impl<S: Subscriber> Layer<S> for Watch {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let Some(end) = end(event.metadata()) else {
            return;
        };
        let of_no_interest: fn(&str, &str) -> bool = match event.metadata().target() {
            forgeries::TARGET => |_, part| forgeries::is_allowed(part),
            MESSAGES => |text, part| text.is_empty() && !part.starts_with(TOO_LONG),
            _ => |_, _| false,
        };
        let mut message = Message {
            text: String::new(),
            of_no_interest,
        };
        event.record(&mut message);
        if end == End::Rules {
            if let Some(forgery) = forgeries::meaning(&message.text) {
                note(forgery.deed, forgery.text, Instant::now());
            }
        } else if let Some(meaning) = meaning(end, &message.text) {
            note(meaning.clone(), meaning, Instant::now());
        }
    }
}

/// The text of an entry. There may be one for each message that arrives, so what is of no interest is not formatted to its end.
struct Message {
    text: String,
    /// Of the text so far and the next part.
    of_no_interest: fn(&str, &str) -> bool,
}

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        if field.name() == "message" {
            // Writing fails where the text is of no interest.
            write!(self, "{value:?}").ok();
        }
    }
}

impl Write for Message {
    fn write_str(&mut self, part: &str) -> fmt::Result {
        if (self.of_no_interest)(&self.text, part) {
            return Err(fmt::Error);
        }
        self.text.push_str(part);
        Ok(())
    }
}

/// What an entry means; None when it is not about keys.
fn meaning(end: End, entry: &str) -> Option<String> {
    let peer = match end {
        End::Rules => return None,
        End::Login => return login(entry),
        End::Listener => "a host that connected was refused".to_owned(),
        End::Dialer => {
            let peer = entry.split_once("configured peer ")?.1;
            // The settings of the endpoint hold keys.
            let address = peer.split(['!', '#', '?', ' ']).next().unwrap_or_default();
            format!("no connection to {address}")
        }
    };
    let why = if let Some((_, alert)) = entry.split_once("received fatal alert: ") {
        // The other side refuses our certificate.
        let alert = alert.trim_start();
        if alert.starts_with("CertificateExpired") {
            "the other side says that this host's certificate has expired: renew it, and check both clocks"
        } else if alert.starts_with("UnknownCA") || alert.starts_with("DecryptError") {
            "the other side does not know the authority of this host's keys: both need keys of the same team"
        } else if alert.starts_with("CertificateRequired") || alert.starts_with("NoCertificate") {
            "the other side wants a certificate, and this host has none: give --keys"
        } else if alert.starts_with("Certificate") || alert.starts_with("BadCertificate") {
            "the other side refuses this host's certificate"
        } else {
            return None;
        }
    } else if entry.contains("certificate expired") || entry.contains("Expired") {
        "its certificate has expired: renew it, and check both clocks"
    } else if entry.contains("NotValidYet") || entry.contains("not valid yet") {
        "its certificate is not valid yet: check both clocks"
    } else if entry.contains("UnknownIssuer") || entry.contains("BadSignature") {
        "its certificate is of an authority that is unknown here: both need keys of the same team"
    } else if entry.contains("peer sent no certificates") || entry.contains("NoCertificatesPresented") {
        "it has no certificate"
    } else if entry.contains("InvalidContentType") || entry.contains("corrupt message") {
        match end {
            End::Dialer => "the other side does not speak TLS: it may have no keys",
            _ => "it does not speak TLS: it may have no keys, or be no car at all",
        }
    } else if end == End::Listener && entry.contains("Timeout during TLS handshake") {
        "it said nothing, as half-open connections do"
    } else if entry.contains("in response to an OpenSyn") && entry.contains("GENERIC") {
        "the other side refuses the login: it may have another passphrase"
    } else if entry.contains("in response to an InitSyn") && entry.contains("GENERIC") {
        "the other side refuses the login: it may want a passphrase"
    } else {
        return None;
    };
    Some(format!("{peer}: {why}"))
}

/// What an entry about a login means.
fn login(entry: &str) -> Option<String> {
    let why = if entry.starts_with(TOO_LONG) {
        return Some("a host sent a longer message than is allowed: it was dropped".into());
    } else if entry.contains("Invalid user") || entry.contains("Invalid password") {
        "it has another passphrase"
    } else if entry.contains("Recv InitSyn. Expected extension") {
        "it has no passphrase"
    } else if entry.starts_with("Failed to accept link before deadline") {
        "it said nothing, as half-open connections do"
    } else if entry.starts_with("Closing link for preventing potential DoS") {
        "too many connect at once and say nothing"
    } else if [
        "Read error from link",
        "Decode error on link",
        "Received invalid message instead",
    ]
    .iter()
    .any(|begin| entry.starts_with(begin))
    {
        // The far end without its port, which differs each time.
        let far = entry.split_once(" => ")?.1.split_once('/')?.1;
        let end = if far.starts_with('[') {
            far.find(']')? + 1
        } else {
            far.find(':')?
        };
        let address = far.get(..end)?;
        return Some(format!(
            "a host that connected from {address} was refused: what it sends is no message of a car"
        ));
    } else {
        return None;
    };
    Some(format!("a host that connected was refused: {why}"))
}

#[derive(Default)]
struct Notes {
    waiting: VecDeque<String>,
    said: VecDeque<(String, Instant)>,
}

static NOTES: Mutex<Option<Notes>> = Mutex::new(None);

/// Notes a sentence, unless another one about the same was noted in the last minute.
fn note(about: String, text: String, now: Instant) {
    let mut notes = NOTES.lock().unwrap_or_else(PoisonError::into_inner);
    let notes = notes.get_or_insert_default();
    notes.said.retain(|(_, at)| now.duration_since(*at) < AGAIN);
    if notes.said.iter().any(|(said, _)| *said == about) || notes.said.len() >= MOST {
        return;
    }
    notes.said.push_back((about, now));
    if notes.waiting.len() < MOST {
        notes.waiting.push_back(text);
    }
}

/// Adds a refusal that zenoh does not log. Like all others, one about the same is said once a minute.
pub fn add(about: &str, text: String) {
    note(about.to_owned(), text, Instant::now());
}

/// Forgets what was said, so that it is said again at once: for tests, which share the process.
pub fn forget() {
    *NOTES.lock().unwrap_or_else(PoisonError::into_inner) = None;
}

/// The refusals since the last call, as sentences.
pub fn take() -> Vec<String> {
    let mut notes = NOTES.lock().unwrap_or_else(PoisonError::into_inner);
    notes
        .as_mut()
        .map(|notes| notes.waiting.drain(..).collect())
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_of_the_log_are_put_in_plain_words() {
        for (end, entry, expected) in [
            (
                End::Listener,
                "invalid peer certificate: certificate expired: verification time 5 (UNIX). Hint: increase the system open file limit.",
                "a host that connected was refused: its certificate has expired: renew it, and check both clocks",
            ),
            (
                End::Listener,
                "invalid peer certificate: UnknownIssuer. Hint: increase the system open file limit.",
                "a host that connected was refused: its certificate is of an authority that is unknown here: both need keys of the same team",
            ),
            (
                End::Listener,
                "peer sent no certificates. Hint: increase the system open file limit.",
                "a host that connected was refused: it has no certificate",
            ),
            (
                End::Listener,
                "Timeout during TLS handshake. Hint: increase the system open file limit.",
                "a host that connected was refused: it said nothing, as half-open connections do",
            ),
            (
                End::Login,
                "UsrPwd extension - Recv OpenSyn. Invalid password. at usrpwd.rs:424.",
                "a host that connected was refused: it has another passphrase",
            ),
            (
                End::Login,
                "Decode error on link: tcp/10.0.0.1:7447 => tcp/[fe80::1]:42168:TransportLinkUnicastConfig { mtu: 49152 } at link.rs:331.",
                "a host that connected from [fe80::1] was refused: what it sends is no message of a car",
            ),
            (
                End::Login,
                "Received invalid message instead of an InitSyn on tcp/127.0.0.1:17447 => tcp/127.0.0.1:60874: OAM(Oam { id: 0 })",
                "a host that connected from 127.0.0.1 was refused: what it sends is no message of a car",
            ),
            (
                End::Login,
                "Defragmentation buffer full: 17825793 bytes. Capacity: 17825792. at defragmentation.rs:79.",
                "a host sent a longer message than is allowed: it was dropped",
            ),
            (
                End::Dialer,
                "Unable to connect to configured peer tls/10.0.0.2:7447#root_ca=abc! received fatal alert: CertificateExpired. Retry in 1s.",
                "no connection to tls/10.0.0.2:7447: the other side says that this host's certificate has expired: renew it, and check \
                 both clocks",
            ),
            (
                End::Dialer,
                "Unable to connect to configured peer tls/pit:7447! invalid peer certificate: UnknownIssuer at x.rs. Retry in 1s.",
                "no connection to tls/pit:7447: its certificate is of an authority that is unknown here: both need keys of the same team",
            ),
        ] {
            assert_eq!(meaning(end, entry).as_deref(), Some(expected));
        }
        let refused = "Unable to connect to configured peer tls/pit:7447! Connection refused. Retry in 1s.";
        assert_eq!(meaning(End::Dialer, refused), None);
        assert_eq!(
            meaning(End::Listener, "Accepted TLS connection on 1.2.3.4:5"),
            None
        );
    }

    #[test]
    fn a_sentence_is_said_once_a_minute_and_few_wait() {
        let start = Instant::now();
        let say = |text: &str, now| note(text.into(), text.into(), now);
        say("said once", start);
        say("said once", start + Duration::from_secs(59));
        for number in 0..1000 {
            say(&format!("flood {number}"), start);
        }
        let taken = take();
        assert_eq!(taken.iter().filter(|text| *text == "said once").count(), 1);
        assert!(taken.len() <= MOST);
        say("said once", start + Duration::from_mins(2));
        assert_eq!(take(), ["said once"]);
    }
}
