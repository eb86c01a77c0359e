//! Connections that were refused because of keys, in plain words.
//!
//! zenoh reports a failed handshake in its log only, in the words of the TLS library. A [`Watch`] layer reads these entries,
//! and [`take`] returns what they mean, each sentence once a minute.

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

/// The same sentence is repeated after this time.
const AGAIN: Duration = Duration::from_mins(1);
/// Sentences that are remembered, and that wait to be taken.
const MOST: usize = 32;

/// Which end of the connection the log entry is from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    /// It was accepted here.
    Listener,
    /// It was opened from here.
    Dialer,
}

/// Reads zenoh's log entries about handshakes.
#[derive(Debug, Clone, Copy, Default)]
pub struct Watch;

/// The layer with the filter that it needs: handshakes are logged at debug level.
pub fn watch<S>() -> impl Layer<S>
where
    S: Subscriber + for<'span> LookupSpan<'span>,
{
    let concerned = |metadata: &Metadata<'_>| *metadata.level() <= Level::DEBUG && end(metadata).is_some();
    Watch.with_filter(FilterFn::new(concerned).with_max_level_hint(Level::DEBUG))
}

fn end(metadata: &Metadata<'_>) -> Option<End> {
    match metadata.target() {
        target if target.starts_with("zenoh_link_tls") => Some(End::Listener),
        target if target.starts_with("zenoh::net::runtime::orchestrator") => Some(End::Dialer),
        _ => None,
    }
}

impl<S: Subscriber> Layer<S> for Watch {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let Some(end) = end(event.metadata()) else {
            return;
        };
        let mut message = Message::default();
        event.record(&mut message);
        if let Some(meaning) = meaning(end, &message.0) {
            note(meaning, Instant::now());
        }
    }
}

#[derive(Default)]
struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        if field.name() == "message" {
            // Writing to a string does not fail.
            write!(self.0, "{value:?}").ok();
        }
    }
}

/// What an entry means; None when it is not about keys.
fn meaning(end: End, entry: &str) -> Option<String> {
    let peer = match end {
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
            End::Listener => "it does not speak TLS: it may have no keys, or be no car at all",
            End::Dialer => "the other side does not speak TLS: it may have no keys",
        }
    } else {
        return None;
    };
    Some(format!("{peer}: {why}"))
}

#[derive(Default)]
struct Notes {
    waiting: VecDeque<String>,
    said: VecDeque<(String, Instant)>,
}

static NOTES: Mutex<Option<Notes>> = Mutex::new(None);

fn note(text: String, now: Instant) {
    let mut notes = NOTES.lock().unwrap_or_else(PoisonError::into_inner);
    let notes = notes.get_or_insert_default();
    notes.said.retain(|(_, at)| now.duration_since(*at) < AGAIN);
    if notes.said.iter().any(|(said, _)| *said == text) || notes.said.len() >= MOST {
        return;
    }
    notes.said.push_back((text.clone(), now));
    if notes.waiting.len() < MOST {
        notes.waiting.push_back(text);
    }
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
        note("said once".into(), start);
        note("said once".into(), start + Duration::from_secs(59));
        for number in 0..1000 {
            note(format!("flood {number}"), start);
        }
        let taken = take();
        assert_eq!(taken.iter().filter(|text| *text == "said once").count(), 1);
        assert!(taken.len() <= MOST);
        note("said once".into(), start + Duration::from_mins(2));
        assert_eq!(take(), ["said once"]);
    }
}
