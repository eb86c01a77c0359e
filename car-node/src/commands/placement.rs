//! Which cores the node runs on, and before whom: `--cpus` and `--priority`.
//!
//! The program replaces itself by `taskset` and `nice`, which every Linux has, and which start it again on these cores with this
//! priority. So every thread has them from its start.

use std::env;
use std::os::unix::process::CommandExt;
use std::process::Command;

use anyhow::anyhow;

/// Set in the program that was started again.
const PLACED: &str = "CAR_NODE_PLACED";

/// Starts the program again on `cpus` with the niceness `priority`, if there is one and it has not been done. Returns only
/// when nothing needs to be done or it fails.
pub(crate) fn place(cpus: Option<&str>, priority: Option<i8>) -> anyhow::Result<()> {
    if (cpus.is_none() && priority.is_none()) || env::var_os(PLACED).is_some() {
        return Ok(());
    }
    let words = words(cpus, priority);
    let program = env::current_exe()?;
    let error = Command::new(&words[0])
        .args(&words[1..])
        .arg(program)
        .args(env::args_os().skip(1))
        .env(PLACED, "1")
        .exec();
    Err(anyhow!("{}: {error}: --cpus and --priority need it", words[0]))
}

/// What stands in front of the program.
fn words(cpus: Option<&str>, priority: Option<i8>) -> Vec<String> {
    let mut words = Vec::new();
    if let Some(cpus) = cpus {
        words.extend(["taskset", "--cpu-list", cpus].map(str::to_owned));
    }
    if let Some(priority) = priority {
        words.extend(["nice".to_owned(), format!("--adjustment={priority}")]);
    }
    words
}

/// A list of cores: `3`, `2,3` or `2-3`.
pub(crate) fn cpu_list(text: &str) -> Result<String, String> {
    let core = |text: &str| text.parse::<u16>().is_ok();
    let part = |part: &str| {
        part.split_once('-')
            .map_or_else(|| core(part), |(a, b)| core(a) && core(b))
    };
    if text.split(',').all(part) {
        Ok(text.to_owned())
    } else {
        Err("expected cores, such as 3, 2,3 or 2-3".into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cores_are_lists_and_ranges_and_no_options() {
        for good in ["3", "2,3", "0-3", "0,2-3"] {
            assert_eq!(cpu_list(good), Ok(good.into()));
        }
        for bad in ["", "a", "-1", "1,", "1-", "--all", "1 2"] {
            assert!(cpu_list(bad).is_err(), "{bad}");
        }
        assert_eq!(
            words(Some("2-3"), Some(-10)),
            ["taskset", "--cpu-list", "2-3", "nice", "--adjustment=-10"]
        );
    }
}
