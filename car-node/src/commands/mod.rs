//! One file per subcommand.
#![allow(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "commands print: results on stdout, the rest on stderr"
)]

pub(crate) mod evaluate;

/// Says why a command failed: each cause once, though some libraries repeat their source's words in their own.
pub(crate) fn complain(error: &anyhow::Error) {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if !text.ends_with(&cause) {
            if !text.is_empty() {
                text += ": ";
            }
            text += &cause;
        }
    }
    eprintln!("car-node: {text}");
}
