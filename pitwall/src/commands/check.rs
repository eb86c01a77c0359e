//! `pitwall check`

use std::path::Path;
use std::process::ExitCode;

use super::record::DATA_LOST;
use crate::output;

pub(super) fn run(file: &Path, json: bool) -> anyhow::Result<ExitCode> {
    let check = pitwall::check(file)?;
    if json {
        output::print_json(&check)?;
    } else {
        output::print(&check.to_string());
    }
    Ok(if check.complete {
        ExitCode::SUCCESS
    } else {
        ExitCode::from(DATA_LOST)
    })
}
