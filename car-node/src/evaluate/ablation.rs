//! What each improvement over the reference brings: sets between `synpf-baseline` and ours.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;
use synpf::{ParameterFault, Parameters};

/// Improvements in the order in which they are made, each with the keys that it changes. What a set changes beyond
/// these comes last, so that the last row is always the set itself.
const IMPROVEMENTS: [(&str, &[&str]); 15] = [
    ("turns keep their sign", &["defect_unsigned_rotation"]),
    ("translation noise has mean zero", &["defect_biased_translation"]),
    ("slow motion counts", &["defect_deadband"]),
    ("lambda_short in metres", &["defect_lambda_short"]),
    (
        "one update per scan, at its own time",
        &["defect_update_per_odometry", "deskew"],
    ),
    ("noise per time, not per message", &["defect_noise_per_message"]),
    (
        "ranges unbiased, in 256 directions",
        &["defect_long_ranges", "theta_discretization"],
    ),
    (
        "motion noise tuned",
        &[
            "alpha_1_tum",
            "alpha_2_tum",
            "alpha_3_tum",
            "alpha_4_tum",
            "diffusion_xy",
            "diffusion_heading",
            "odometry_speed_error",
            "odometry_side_error",
            "odometry_yaw_error",
        ],
    ),
    ("noise grows with slip", &["adaptive"]),
    ("resampled when ESS is low", &["resample_ess_ratio"]),
    (
        "as many particles as needed (KLD)",
        &["max_particles", "min_particles", "kld_error", "kld_quantile"],
    ),
    (
        "whole scan fitted to the distance field",
        &[
            "refine",
            "refine_beams",
            "refine_iterations",
            "refine_sigma",
            "refine_reach",
            "refine_correlation",
            "refine_feedback",
        ],
    ),
    ("slip learned and taken out of odometry", &["learn_slip"]),
    (
        "offset of the walls and scatter about them learned",
        &["wall_offset_distance"],
    ),
    ("injection and search when in doubt", &["injection", "recover"]),
];

/// How a row's set is made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Change {
    /// The reference as it is, or the set as it is.
    None,
    /// The improvement on top of all those before.
    Added,
    /// The set with this improvement taken back.
    LeftOut,
}

/// One set to try.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// What changes, for people.
    pub name: String,
    /// How.
    pub change: Change,
    /// The keys that change, with the value that they get.
    pub values: BTreeMap<String, Value>,
    /// The set.
    pub parameters: Parameters,
}

/// The sets from `synpf-baseline` to `target`, one improvement after the other, and then `target` without each.
/// Improvements that `target` does not make are left out. Fails where a set in between contradicts itself.
pub fn steps(target: &Parameters) -> Result<Vec<Step>, Vec<ParameterFault>> {
    let baseline = Parameters::named("synpf-baseline").unwrap_or_default();
    let (from, to) = (baseline.to_values(), target.to_values());
    let changed = |key: &str| from.get(key) != to.get(key);
    let mut groups: Vec<(&str, Vec<&str>)> = IMPROVEMENTS
        .iter()
        .map(|(name, keys)| (*name, keys.iter().copied().filter(|key| changed(key)).collect()))
        .collect();
    let named = |key: &str| IMPROVEMENTS.iter().any(|(_, keys)| keys.contains(&key));
    let rest = to
        .keys()
        .map(String::as_str)
        .filter(|key| changed(key) && !named(key));
    groups.push(("all else that the set changes", rest.collect()));
    groups.retain(|(_, keys)| !keys.is_empty());

    let some = |keys: &[&str], of: &BTreeMap<String, Value>| -> BTreeMap<String, Value> {
        keys.iter()
            .map(|key| ((*key).to_owned(), of[*key].clone()))
            .collect()
    };
    let mut steps = vec![Step {
        name: "synpf-baseline".into(),
        change: Change::None,
        values: BTreeMap::new(),
        parameters: baseline,
    }];
    for (name, keys) in &groups {
        let values = some(keys, &to);
        let before = steps.last().map_or(target, |step| &step.parameters);
        let (parameters, _) = before.with_values(values.clone())?;
        steps.push(Step {
            name: (*name).into(),
            change: Change::Added,
            values,
            parameters,
        });
    }
    for (name, keys) in &groups {
        let values = some(keys, &from);
        let (parameters, _) = target.with_values(values.clone())?;
        steps.push(Step {
            name: (*name).into(),
            change: Change::LeftOut,
            values,
            parameters,
        });
    }
    Ok(steps)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_steps_lead_from_the_baseline_to_each_set() {
        for name in ["hq", "lq", "adaptive"] {
            let target = Parameters::named(name).expect("ships");
            let steps = steps(&target).expect("sound");
            let added: Vec<&Step> = steps.iter().filter(|step| step.change == Change::Added).collect();
            assert_eq!(
                Some(&steps[0].parameters),
                Parameters::named("synpf-baseline").as_ref()
            );
            assert_eq!(added.last().map(|step| &step.parameters), Some(&target), "{name}");
            let left_out = steps.iter().filter(|step| step.change == Change::LeftOut);
            assert_eq!(left_out.clone().count(), added.len());
            assert!(left_out.into_iter().all(|step| step.parameters != target));
            // Every step changes something.
            assert!(
                steps
                    .windows(2)
                    .all(|pair| pair[0].parameters != pair[1].parameters)
            );
        }
    }

    #[test]
    fn every_key_that_is_named_exists() {
        let known = Parameters::default().to_values();
        for key in IMPROVEMENTS.iter().flat_map(|(_, keys)| *keys) {
            assert!(known.contains_key(*key), "{key}");
        }
    }

    #[test]
    fn what_no_improvement_names_comes_last() {
        let hq = Parameters::default();
        let (target, _) = hq
            .with_values([("z_hit".to_owned(), Value::from(0.8))])
            .expect("sound");
        let steps = steps(&target).expect("sound");
        let last = steps
            .iter()
            .rfind(|step| step.change == Change::Added)
            .expect("some");
        assert_eq!(last.values.keys().collect::<Vec<_>>(), ["z_hit"]);
        assert_eq!(last.parameters, target);
    }
}
