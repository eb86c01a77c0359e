//! `pitwall params`

use std::collections::BTreeMap;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use pitwall::{Car, Fleet};
use protocol::{
    Action, CarName, Comparison, Fitness, ParameterSet, Params, ParamsAction, Reply, Shadow, StoredSet, Value,
};
use serde::Deserialize;

use super::control::{reply, report, send_command};
use super::{BadUsage, FIND, no_such_car, open};
use crate::cli::{NetworkOptions, ParamsVerb};
use crate::output;

/// Exit code: the car refused.
const REFUSED: u8 = 3;

/// Exit code: no answer in time.
const NO_ANSWER: u8 = 5;

pub(super) async fn run(
    network: &NetworkOptions,
    car: &CarName,
    verb: Option<ParamsVerb>,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let millis = |time: Duration| {
        let fault = |_| BadUsage("--revert-after: that is too long".to_owned());
        u32::try_from(time.as_millis()).map_err(fault)
    };
    let (action, expect) = match verb {
        None | Some(ParamsVerb::Get) => return get(network, car, json).await,
        Some(ParamsVerb::List) => return list(network, car, None, json).await,
        Some(ParamsVerb::Diff { a, b }) => return list(network, car, Some((a, b)), json).await,
        Some(ParamsVerb::Shadow { name: None }) => return shadow(network, car, json).await,
        Some(ParamsVerb::Shadow { name }) => {
            let name = name.filter(|name| name != "off");
            let begun = name.clone();
            let action = Action::Params(ParamsAction::Shadow { name });
            let code = send_command(network, car, action, None, json).await?;
            if let Some(name) = begun.filter(|_| code == ExitCode::SUCCESS && !json) {
                output::print(&format!(
                    "{name} runs in its shadow; `pitwall params {car} shadow` compares the two"
                ));
            }
            return Ok(code);
        }
        Some(ParamsVerb::Select { name, change }) => {
            let revert_after_ms = change.revert_after.map(millis).transpose()?;
            (
                ParamsAction::Select {
                    name,
                    revert_after_ms,
                },
                change.expect,
            )
        }
        Some(ParamsVerb::Put { file, name, change }) => {
            let set = read_set(&file, name)?;
            let revert_after_ms = change.revert_after.map(millis).transpose()?;
            (ParamsAction::Put { set, revert_after_ms }, change.expect)
        }
        Some(ParamsVerb::Confirm { change }) => (ParamsAction::Confirm, change),
        Some(ParamsVerb::Revert { change }) => (ParamsAction::Revert, change),
        Some(ParamsVerb::Delete { name, change }) => (ParamsAction::Delete { name }, change),
    };
    send_command(network, car, Action::Params(action), expect.expect, json).await
}

/// The set in force, from the last message of the car.
async fn get(network: &NetworkOptions, car: &CarName, json: bool) -> anyhow::Result<ExitCode> {
    let params = match last_value(network, car, "which set is in force", |car| car.params.clone()).await? {
        Ok(params) => params,
        Err(code) => return Ok(code),
    };
    if json {
        output::print_json(&params)?;
    } else {
        output::print(&describe(&params));
    }
    Ok(ExitCode::SUCCESS)
}

/// Waits for a value from a car and returns it. Without one, prints why and returns the exit code.
async fn last_value<T>(
    network: &NetworkOptions,
    car: &CarName,
    of: &str,
    find: impl Fn(&Car) -> Option<T>,
) -> anyhow::Result<Result<T, ExitCode>> {
    let service = open(network).await?;
    if !service.wait_for(car, FIND).await {
        return Ok(Err(no_such_car(&service, car).await));
    }
    let find = |fleet: &Fleet| fleet.car(car).and_then(&find);
    service.wait_until(FIND, |fleet| find(fleet).is_some()).await;
    let value = find(&service.fleet());
    service.close().await;
    Ok(value.ok_or_else(|| {
        output::print_error(&format!(
            "{car}: NO ANSWER: it has not published {of}. Is its node older than this program?"
        ));
        ExitCode::from(NO_ANSWER)
    }))
}

fn describe(params: &Params) -> String {
    let Params {
        set,
        revision,
        who,
        since_update,
        ..
    } = params;
    let mut lines = vec![format!(
        "{} (revision {revision}), put in force by {who} from update {since_update}",
        set.name
    )];
    if let Some(revert) = &params.pending_revert {
        lines.push(format!("falls back to {} unless confirmed", revert.to));
    }
    lines.push(format!("on the car: {}", params.available.join(", ")));
    lines.extend(values(set));
    lines.join("\n")
}

fn values(set: &ParameterSet) -> Vec<String> {
    let width = set.values.iter().map(|(name, _)| name.len()).max().unwrap_or(0);
    let line = |(name, value): &(String, Value)| format!("  {name:<width$}  {value}");
    set.values.iter().map(line).collect()
}

/// Compares the shadow set with the set in force.
async fn shadow(network: &NetworkOptions, car: &CarName, json: bool) -> anyhow::Result<ExitCode> {
    let of = "whether a set runs in the shadow";
    let shadow = match last_value(network, car, of, |car| car.shadow.clone()).await? {
        Ok(shadow) => shadow,
        Err(code) => return Ok(code),
    };
    if json {
        output::print_json(&shadow)?;
    } else {
        output::print(&compare(car, &shadow));
    }
    Ok(ExitCode::SUCCESS)
}

fn compare(car: &CarName, shadow: &Shadow) -> String {
    let Shadow {
        set, who, comparison, ..
    } = shadow;
    let Some(set) = set else {
        return match who.as_str() {
            "load" => {
                format!("no set runs in the shadow: {car} dropped it to save CPU, see `pitwall events {car}`")
            }
            _ => format!("no set runs in the shadow; `pitwall params {car} shadow NAME` starts one"),
        };
    };
    let Some(comparison) = comparison else {
        return format!("{set} runs in the shadow for {who}; nothing to compare yet");
    };
    let Comparison {
        in_force,
        window,
        scans,
        skipped,
        force,
        shadow: other,
        distance,
        distance_max,
        angle,
        force_better,
        shadow_better,
    } = comparison;
    let row = |what: &str, of: &dyn Fn(&Fitness) -> String| {
        format!("{what:<26} {:>14} {:>14}", of(force), of(other))
    };
    [
        format!("{:<26} {:>14} {set:>14}", "", in_force.name),
        row("alignment", &|f| format!("{:.3}", f.alignment)),
        row("residual [m]", &|f| format!("{:.4}", f.residual)),
        row("innovation [m]", &|f| format!("{:.4}", f.innovation)),
        row("spread along, across [m]", &|f| {
            format!("{:.3}, {:.3}", f.spread_along, f.spread_across)
        }),
        row("update p50, p99 [ms]", &|f| {
            format!("{:.2}, {:.2}", f.update_us.p50 / 1e3, f.update_us.p99 / 1e3)
        }),
        format!(
            "{:<26} {:>12.0} % {:>12.0} %",
            "fits better",
            force_better * 100.0,
            shadow_better * 100.0
        ),
        format!(
            "poses apart by {distance:.3} m (at most {distance_max:.3} m) and {:.2} deg; {scans} scans in {window:.1} s, \
             {skipped} left out in the shadow",
            angle.to_degrees()
        ),
    ]
    .join("\n")
}

/// Lists all sets, or the differences of two.
async fn list(
    network: &NetworkOptions,
    car: &CarName,
    diff: Option<(String, String)>,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let service = open(network).await?;
    if !service.wait_for(car, FIND).await {
        return Ok(no_such_car(&service, car).await);
    }
    let action = Action::Params(ParamsAction::List);
    let verdict = service
        .client()
        .command(car, &network.operator(), None, action)
        .await?;
    let Some(Reply::Sets(sets)) = reply(&verdict) else {
        return report(&service, car, &verdict, json).await;
    };
    service.close().await;
    let Some((a, b)) = diff else {
        if json {
            output::print_json(sets)?;
        } else {
            for StoredSet { set, built_in, who } in sets {
                let origin = match who {
                    Some(who) => format!("put by {who}"),
                    None if *built_in => "ships with the car".to_owned(),
                    None => String::new(),
                };
                output::print(&format!(
                    "{:<20} {:>3} values  {origin}",
                    set.name,
                    set.values.len()
                ));
            }
        }
        return Ok(ExitCode::SUCCESS);
    };
    let find = |name: &str| sets.iter().map(|stored| &stored.set).find(|set| set.name == name);
    let (Some(of_a), Some(of_b)) = (find(&a), find(&b)) else {
        let unknown = if find(&a).is_none() { &a } else { &b };
        let known: Vec<_> = sets.iter().map(|stored| stored.set.name.as_str()).collect();
        output::print_error(&format!(
            "{car}: no set {unknown}; there are {}",
            known.join(", ")
        ));
        return Ok(ExitCode::from(REFUSED));
    };
    let differences = differences(of_a, of_b);
    if json {
        output::print_json(&differences)?;
    } else if differences.is_empty() {
        output::print(&format!("{a} and {b} are the same"));
    } else {
        output::print(&format!("{:<32} {a:>16} {b:>16}", "parameter"));
        let show = |value: &Option<Value>| value.as_ref().map_or("-".to_owned(), ToString::to_string);
        for (name, [a, b]) in &differences {
            output::print(&format!("{name:<32} {:>16} {:>16}", show(a), show(b)));
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// The values in which two sets differ.
fn differences(a: &ParameterSet, b: &ParameterSet) -> BTreeMap<String, [Option<Value>; 2]> {
    let mut all: BTreeMap<String, [Option<Value>; 2]> = BTreeMap::new();
    for (at, set) in [a, b].into_iter().enumerate() {
        for (name, value) in &set.values {
            all.entry(name.clone()).or_default()[at] = Some(value.clone());
        }
    }
    all.retain(|_, [a, b]| a != b);
    all
}

/// A value as text.
#[derive(Deserialize)]
#[serde(untagged)]
enum Scalar {
    Bool(bool),
    Int(i64),
    Float(f64),
    Text(String),
}

/// Reads a set from a YAML or JSON file.
fn read_set(file: &Path, name: Option<String>) -> Result<ParameterSet, BadUsage> {
    let fault = |fault: &dyn std::fmt::Display| BadUsage(format!("{}: {fault}", file.display()));
    let text = std::fs::read_to_string(file).map_err(|error| fault(&error))?;
    let name = name
        .or_else(|| Some(file.file_stem()?.to_str()?.to_owned()))
        .ok_or_else(|| fault(&"send_command the set a --name"))?;
    let scalars: BTreeMap<String, Scalar> = serde_saphyr::from_str(&text).map_err(|error| fault(&error))?;
    if scalars.is_empty() {
        return Err(fault(
            &"it names no parameter; write `parameter: value`, one a line",
        ));
    }
    let values = scalars
        .into_iter()
        .map(|(name, scalar)| {
            let value = match scalar {
                Scalar::Bool(value) => Value::Bool(value),
                Scalar::Int(value) => Value::Int(value),
                Scalar::Float(value) => Value::Float(value),
                Scalar::Text(value) => Value::Text(value),
            };
            (name, value)
        })
        .collect();
    Ok(ParameterSet { name, values })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_set_is_read_as_people_write_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("wet.yaml");
        std::fs::write(
            &file,
            "max_particles: 2000\nsigma_hit: 0.1\nmotion_model: tum\ndeskew: true\n",
        )
        .expect("written");
        let set = read_set(&file, None).expect("a good file");
        assert_eq!(set.name, "wet");
        assert_eq!(
            set.values,
            [
                ("deskew".into(), Value::Bool(true)),
                ("max_particles".into(), Value::Int(2000)),
                ("motion_model".into(), Value::Text("tum".into())),
                ("sigma_hit".into(), Value::Float(0.1)),
            ]
        );
    }

    #[test]
    fn a_bad_file_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("wet.yaml");
        for (text, expected) in [
            ("sigma_hit: 0.1\nz_hit: [1, 2]\n", "line 2"),
            ("sigma_hit: 0.1\nz_hit:\n", "line 2"),
            ("sigma_hit: [\n", "line 1"),
            ("# nothing\n", "it names no parameter"),
        ] {
            std::fs::write(&file, text).expect("written");
            let error = read_set(&file, None).expect_err(text).to_string();
            assert!(error.contains("wet.yaml") && error.contains(expected), "{error}");
        }
    }

    #[test]
    fn only_what_differs_is_shown() {
        let set = |values: &[(&str, i64)]| ParameterSet {
            name: "x".into(),
            values: values
                .iter()
                .map(|&(name, value)| (name.to_owned(), Value::Int(value)))
                .collect(),
        };
        let found = differences(&set(&[("a", 1), ("b", 2)]), &set(&[("a", 1), ("b", 3), ("c", 4)]));
        let expected = BTreeMap::from([
            ("b".to_owned(), [Some(Value::Int(2)), Some(Value::Int(3))]),
            ("c".to_owned(), [None, Some(Value::Int(4))]),
        ]);
        assert_eq!(found, expected);
    }
}
