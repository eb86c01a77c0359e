//! `car-node import`.

use std::fs::OpenOptions;
use std::io::{ErrorKind, Write};
use std::path::PathBuf;

use anyhow::{Context, bail};
use car_node::import::{Import, Outcome, import, import_lua, to_yaml};
use serde::Serialize;
use serde_json::Value;

use super::BadUsage;
use crate::cli;

#[derive(Serialize)]
struct Report<'a> {
    file: &'a PathBuf,
    written: &'a PathBuf,
    #[serde(flatten)]
    import: &'a Import,
}

pub(crate) fn run(arguments: &cli::Import) -> anyhow::Result<()> {
    let file = &arguments.file;
    let text = maps::read_text(file)?;
    let lua = file
        .extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("lua"));
    let import = if lua {
        import_lua(&text)
    } else {
        import(&text, arguments.resolution)
    };
    let import = import.with_context(|| file.display().to_string())?;
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    let out = arguments.out.clone().unwrap_or_else(|| {
        let stem = file.file_stem().unwrap_or_default().to_string_lossy();
        PathBuf::from(format!("{stem}_set.yaml"))
    });
    let mut open = OpenOptions::new();
    open.write(true).create(true);
    if arguments.force {
        open.truncate(true);
    } else {
        open.create_new(true);
    }
    let mut written = match open.open(&out) {
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            let text = format!(
                "{} exists: --force overwrites it, --out names another file",
                out.display()
            );
            bail!(BadUsage(text));
        }
        opened => opened.with_context(|| out.display().to_string())?,
    };
    written
        .write_all(to_yaml(&import, &name).as_bytes())
        .with_context(|| out.display().to_string())?;
    if arguments.json {
        let report = Report {
            file,
            written: &out,
            import: &import,
        };
        say!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print(&import, &name, &out);
    }
    Ok(())
}

fn print(import: &Import, name: &str, out: &std::path::Path) {
    say!("{name}: parameters of {}", import.dialect.name());
    let width = import
        .values
        .iter()
        .map(|value| value.key.len())
        .max()
        .unwrap_or(0);
    for value in &import.values {
        let given = text(&value.value);
        let pairs = |to: &std::collections::BTreeMap<String, Value>| {
            let pairs = to.iter().map(|(key, value)| format!("{key}: {}", text(value)));
            pairs.collect::<Vec<_>>().join(", ")
        };
        let became = match &value.outcome {
            Outcome::Taken { to } => format!("taken           {}", pairs(to)),
            Outcome::Converted { to, why } => format!("converted       {}  ({why})", pairs(to)),
            Outcome::Option { option } => format!("option          {option}"),
            Outcome::NoCounterpart { why } => format!("no counterpart  {why}"),
            Outcome::Unknown => "unknown         left out".to_owned(),
        };
        say!("  {:<width$}  {given:<18} {became}", value.key);
    }
    let count = import.set.len();
    say!(
        "{count} values differ from {}: {}. Use it with --params {}",
        import.base(),
        out.display(),
        out.display()
    );
}

fn text(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}
