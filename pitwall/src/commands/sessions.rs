//! `pitwall sessions`

use std::path::Path;
use std::process::ExitCode;

use pitwall::{Session, SessionIndex};
use protocol::UtcTime;

use crate::output;

pub(super) fn run(folder: &Path, words: &[String], rebuild: bool, json: bool) -> anyhow::Result<ExitCode> {
    let mut index = SessionIndex::open(folder)?;
    if rebuild {
        index.clear()?;
    }
    index.refresh(None, |file| {
        output::print_note(&format!("reading {}", file.display()));
    })?;
    let sessions = index.search(&words.join(" "))?;
    if json {
        output::print_json(&sessions)?;
    } else {
        output::print(&table(&sessions));
    }
    Ok(ExitCode::SUCCESS)
}

fn table(sessions: &[Session]) -> String {
    let mut lines = vec![format!(
        "{:<19} {:>8} {:<12} {:>4} {:>5} {:<20} {:<16} {:<12} file",
        "date (UTC)", "length", "track", "cars", "laps", "best lap", "sets", "missing"
    )];
    for session in sessions {
        let minutes = (session.duration_s / 60.0).floor();
        let length = format!("{minutes:.0}:{:04.1}", session.duration_s - 60.0 * minutes);
        let best = session
            .best_lap
            .as_ref()
            .map_or_else(|| "-".to_owned(), |(car, time)| format!("{time:.2} s {car}"));
        let missing = match (&session.error, session.complete, session.missing) {
            (Some(_), _, _) => "DAMAGED".to_owned(),
            (None, false, _) => "not ended".to_owned(),
            (None, true, 0) => "nothing".to_owned(),
            (None, true, missing) => missing.to_string(),
        };
        lines.push(format!(
            "{:<19} {length:>8} {:<12} {:>4} {:>5} {best:<20} {:<16} {missing:<12} {}",
            UtcTime(session.started),
            session.track.as_deref().unwrap_or("-"),
            session.cars.len(),
            session.laps,
            session.sets.join(","),
            session.file.display()
        ));
    }
    lines.push(match sessions.len() {
        1 => "1 session".to_owned(),
        count => format!("{count} sessions"),
    });
    lines.join("\n")
}
