//! `pitwall check`

use std::path::Path;
use std::process::ExitCode;

use super::record::DATA_LOST;
use crate::output;

/// Exit code: nothing is missing but what a car itself has lost.
const LOST_BY_THE_CAR: u8 = 8;

pub(super) fn run(file: &Path, json: bool) -> anyhow::Result<ExitCode> {
    let check = pitwall::check(file)?;
    if json {
        output::print_json(&check)?;
    } else {
        output::print(&check.to_string());
    }
    Ok(match (check.complete, check.all_there_is) {
        (true, _) => ExitCode::SUCCESS,
        (false, true) => ExitCode::from(LOST_BY_THE_CAR),
        (false, false) => ExitCode::from(DATA_LOST),
    })
}
