//! Ablation: the sets between `synpf-baseline` and ours, one improvement apart.
//!
//! The reference is a localizer of its own, so there are two parts. The first is the reference, with its defects repaired one
//! by one. The second is SynPF: first with the reference's noise and number of particles and without its own features, then
//! with one improvement after the other.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;
use synpf::{ParameterFault, Parameters, ReferenceParameters};

use crate::localization::{KIND_KEY, LocalizerParameters};

/// An improvement, and the keys that it changes.
type Improvement = (&'static str, &'static [&'static str]);

/// The reference's defects, in the order in which they are repaired.
const MENDED: [Improvement; 8] = [
    ("turns keep their sign", &["defect_unsigned_rotation"]),
    ("translation noise has mean zero", &["defect_biased_translation"]),
    ("slow motion counts", &["defect_deadband"]),
    ("lambda_short in metres", &["defect_lambda_short"]),
    (
        "one update per scan, at its own time",
        &["defect_update_per_odometry"],
    ),
    ("noise per time, not per message", &["defect_noise_per_message"]),
    ("ranges unbiased", &["defect_long_ranges"]),
    ("ranges in 256 directions", &["theta_discretization"]),
];

/// The features of SynPF, in the order in which they are added. Other changes of a set come last, so that the last row is
/// the set itself.
const IMPROVEMENTS: [Improvement; 9] = [
    ("beams brought to the scan's time", &["deskew"]),
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
    /// The reference as it is.
    None,
    /// The improvement on top of all the ones before.
    Added,
    /// SynPF in place of the repaired reference.
    Replaced,
    /// The set with this improvement taken back.
    LeftOut,
}

/// One set to try.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// A description of the change.
    pub name: String,
    /// The kind of the change.
    pub change: Change,
    /// The keys that change, with their new values.
    pub values: BTreeMap<String, Value>,
    /// The set.
    pub parameters: LocalizerParameters,
}

/// The sets from `synpf-baseline` to `target`, one improvement after the other, and then `target` without each.
/// Improvements that `target` does not make are left out. Fails when a set between them is invalid.
pub fn steps(target: &LocalizerParameters) -> Result<Vec<Step>, Vec<ParameterFault>> {
    let shipped = LocalizerParameters::from(ReferenceParameters::default());
    let mut steps = vec![Step {
        name: "synpf-baseline".into(),
        change: Change::None,
        values: BTreeMap::new(),
        parameters: shipped.clone(),
    }];
    let (plain, groups) = match target {
        LocalizerParameters::Reference(_) => {
            let groups = groups(&shipped, target, &MENDED);
            (shipped, groups)
        }
        LocalizerParameters::SynPf(_) => {
            let mended = LocalizerParameters::from(repaired());
            add(&mut steps, &groups(&shipped, &mended, &MENDED), &mended)?;
            let plain = LocalizerParameters::from(plain());
            steps.push(Step {
                name: "in SynPF, without anything new".into(),
                change: Change::Replaced,
                values: BTreeMap::new(),
                parameters: plain.clone(),
            });
            let groups = groups(&plain, target, &IMPROVEMENTS);
            (plain, groups)
        }
        LocalizerParameters::External(_) | LocalizerParameters::PoseGraph(_) => {
            return Err(vec![ParameterFault {
                key: KIND_KEY.into(),
                fault: format!("{} is no improvement of the reference", target.kind()),
            }]);
        }
    };
    add(&mut steps, &groups, target)?;
    let from = plain.to_values();
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

/// The reference without the defects that have an effect under its shipped parameters.
fn repaired() -> ReferenceParameters {
    let mut set = ReferenceParameters {
        theta_discretization: 256,
        ..ReferenceParameters::default()
    };
    set.defects.defect_unsigned_rotation = false;
    set.defects.defect_biased_translation = false;
    set.defects.defect_deadband = false;
    set.defects.defect_lambda_short = false;
    set.defects.defect_update_per_odometry = false;
    set.defects.defect_noise_per_message = false;
    set.defects.defect_long_ranges = false;
    set
}

/// SynPF as similar to the repaired reference as possible: its noise and number of particles, resampling in every update, and
/// neither fit nor recovery.
fn plain() -> Parameters {
    let reference = ReferenceParameters::default();
    let mut set = Parameters::default();
    set.particles.max_particles = reference.max_particles;
    set.particles.min_particles = reference.max_particles;
    set.particles.resample_ess_ratio = 1.0;
    set.beams.deskew = false;
    set.motion.noise.alpha_1_tum = reference.noise.alpha_1_tum;
    set.motion.noise.alpha_2_tum = reference.noise.alpha_2_tum;
    set.motion.noise.alpha_3_tum = reference.noise.alpha_3_tum;
    set.motion.noise.alpha_4_tum = reference.noise.alpha_4_tum;
    set.motion.diffusion_xy = 0.0;
    set.motion.diffusion_heading = 0.0;
    set.motion.learn_slip = false;
    set.refinement.refine = false;
    set.refinement.wall_offset_distance = 0.0;
    set.recovery.injection = false;
    set.recovery.recover = false;
    set
}

/// The improvements that lead from one set to another, with the keys that change; last, all keys that none of them names.
fn groups(
    from: &LocalizerParameters,
    to: &LocalizerParameters,
    improvements: &[Improvement],
) -> Vec<(&'static str, Vec<String>)> {
    let (from, to) = (from.to_values(), to.to_values());
    let changed = |key: &str| from.get(key) != to.get(key);
    let named = |key: &str| improvements.iter().any(|(_, keys)| keys.contains(&key));
    let mut groups: Vec<(&str, Vec<String>)> = improvements
        .iter()
        .map(|(name, keys)| {
            let keys = keys.iter().filter(|key| changed(key));
            (*name, keys.map(|key| (*key).to_owned()).collect())
        })
        .collect();
    let rest = to.keys().filter(|key| changed(key) && !named(key)).cloned();
    groups.push(("all else that the set changes", rest.collect()));
    groups.retain(|(_, keys)| !keys.is_empty());
    groups
}

/// Adds one improvement after the other, on top of the last step.
fn add(
    steps: &mut Vec<Step>,
    groups: &[(&str, Vec<String>)],
    to: &LocalizerParameters,
) -> Result<(), Vec<ParameterFault>> {
    let to_values = to.to_values();
    for (name, keys) in groups {
        let values = some(keys, &to_values);
        let before = steps.last().map_or(to, |step| &step.parameters);
        let (parameters, _) = before.with_values(values.clone())?;
        steps.push(Step {
            name: (*name).into(),
            change: Change::Added,
            values,
            parameters,
        });
    }
    Ok(())
}

fn some(keys: &[String], of: &BTreeMap<String, Value>) -> BTreeMap<String, Value> {
    keys.iter()
        .filter_map(|key| Some((key.clone(), of.get(key)?.clone())))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(name: &str) -> LocalizerParameters {
        LocalizerParameters::named(name).expect("ships")
    }

    fn rows(steps: &[Step], change: Change) -> Vec<&Step> {
        steps.iter().filter(|step| step.change == change).collect()
    }

    #[test]
    fn the_steps_lead_from_the_reference_over_to_each_set() {
        for name in ["hq", "lq", "adaptive"] {
            let target = named(name);
            let steps = steps(&target).expect("sound");
            assert_eq!(steps[0].parameters, named("synpf-baseline"));
            let replaced = steps.iter().position(|step| step.change == Change::Replaced);
            let (reference, synpf) = steps.split_at(replaced.expect("one"));
            assert!(reference.iter().all(|step| step.parameters.kind() == "reference"));
            assert!(synpf.iter().all(|step| step.parameters.kind() == "synpf"));
            assert_eq!(reference.len(), 1 + MENDED.len());
            let added = rows(synpf, Change::Added);
            assert_eq!(added.last().map(|step| &step.parameters), Some(&target), "{name}");
            let left_out = rows(&steps, Change::LeftOut);
            assert_eq!(left_out.len(), added.len());
            assert!(left_out.iter().all(|step| step.parameters != target));
            // Every step changes something.
            assert!(
                steps
                    .windows(2)
                    .all(|pair| pair[0].parameters != pair[1].parameters)
            );
        }
    }

    #[test]
    fn steps_to_a_set_of_the_reference_do_not_use_synpf() {
        let values = [("defect_deadband", Value::from(false)), ("z_hit", 0.8.into())];
        let values = values.map(|(key, value)| (key.to_owned(), value));
        let (target, _) = named("synpf-baseline").with_values(values).expect("sound");
        let steps = steps(&target).expect("sound");
        let names: Vec<&str> = steps.iter().map(|step| step.name.as_str()).collect();
        let changes = ["slow motion counts", "all else that the set changes"];
        assert_eq!(
            names,
            [["synpf-baseline"].as_slice(), &changes, &changes].concat()
        );
        assert_eq!(steps[2].parameters, target);
    }

    #[test]
    fn every_key_exists() {
        for (set, improvements) in [
            ("synpf-baseline", MENDED.as_slice()),
            ("hq", IMPROVEMENTS.as_slice()),
        ] {
            let known = named(set).to_values();
            for key in improvements.iter().flat_map(|(_, keys)| *keys) {
                assert!(known.contains_key(*key), "{key}");
            }
        }
    }

    #[test]
    fn changes_that_belong_to_no_improvement_come_last() {
        let (target, _) = named("hq")
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
