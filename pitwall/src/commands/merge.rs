//! `pitwall merge`

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use pitwall::Merged;

use crate::output;

/// Exit code: something is missing in the new file.
const MISSING: u8 = 7;

pub(super) fn run(inputs: &[PathBuf], to: &Path, json: bool) -> anyhow::Result<ExitCode> {
    let merged = pitwall::merge(inputs, to)?;
    if json {
        output::print_json(&merged)?;
    } else {
        output::print(&describe(&merged, to));
    }
    Ok(if merged.summary.missing() > 0 {
        ExitCode::from(MISSING)
    } else {
        ExitCode::SUCCESS
    })
}

fn describe(merged: &Merged, to: &Path) -> String {
    let mut lines = Vec::new();
    for input in &merged.inputs {
        let by = if input.on_car {
            "on the car"
        } else {
            "at the pit wall"
        };
        lines.push(format!(
            "{}: recorded {by}, {} messages, {} of them added",
            input.file.display(),
            input.messages,
            input.added
        ));
        lines.extend(input.damage.iter().map(|damage| format!("  damaged: {damage}")));
    }
    lines.push(merged.summary.to_string());
    lines.push(format!("merged into {}", to.display()));
    lines.join("\n")
}
