//! Prints results on stdout and everything else on stderr.
#![expect(clippy::print_stderr, reason = "this module prints for the whole program")]

use std::io::{ErrorKind, IsTerminal, Write};

use anyhow::Context;
use serde::Serialize;

/// Prints a result.
pub(crate) fn print(text: &str) {
    // Names and texts may come from the network.
    let lines: Vec<_> = text.split('\n').map(protocol::plain_text).collect();
    write(&format!("{}\n", lines.join("\n")));
}

/// Ends the program quietly when the reader is gone, as after `| head`; `println!` would panic.
fn write(text: &str) {
    let mut out = std::io::stdout().lock();
    if let Err(error) = out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        if error.kind() != ErrorKind::BrokenPipe {
            print_error(&format!("stdout: {error}"));
        }
        std::process::exit(1);
    }
}

/// Prints a result as JSON on one line.
pub(crate) fn print_json(value: &impl Serialize) -> anyhow::Result<()> {
    let text = serde_json::to_string(value).context("writing JSON")?;
    print(&text);
    Ok(())
}

/// Prints a note for the user.
pub(crate) fn print_note(text: &str) {
    eprintln!("{text}");
}

/// Prints a failure.
pub(crate) fn print_error(text: &str) {
    eprintln!("pitwall: {text}");
}

/// True when stdout is a terminal.
pub(crate) fn on_terminal() -> bool {
    std::io::stdout().is_terminal()
}
