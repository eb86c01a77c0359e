//! The pit wall's program as a process of its own, so that a test can see its exit codes and kill it.

use std::process::ExitCode;

fn main() -> ExitCode {
    pitwall::program()
}
