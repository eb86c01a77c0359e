//! The pit wall's program.

use std::process::ExitCode;

fn main() -> ExitCode {
    pitwall::program()
}
