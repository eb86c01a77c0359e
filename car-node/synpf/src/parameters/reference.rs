//! The reference's own file, `pf2_params.yaml`: what its keys are called here.

use serde_json::{Map, Value};

/// Keys of the reference that mean the same here under another name.
const RENAMED: [(&str, &str); 6] = [
    ("des_lidar_beams", "beams"),
    // Called variances there, but used as standard deviations.
    ("initial_var_x", "initial_std_x"),
    ("initial_var_y", "initial_std_y"),
    ("initial_var_theta", "initial_std_heading"),
    ("range_method", "range_method"),
    ("motion_model", "motion_model"),
];

/// Values of the reference that have another name here.
const METHODS: [(&str, &str); 7] = [
    ("glt", "lut"),
    ("bl", "ray_marching"),
    ("rm", "ray_marching"),
    ("rmgpu", "ray_marching"),
    ("pcddt", "cddt"),
    ("default", "mit"),
    ("mit", "mit"),
];

/// The table of parameters in a file: the file itself, or what is under `<node>: ros__parameters:`.
pub(super) fn parameter_table(file: &Value) -> Option<&Map<String, Value>> {
    let table = file.as_object()?;
    let node = (table.len() == 1).then(|| table.values().next()).flatten();
    Some(
        node.and_then(|node| node.get("ros__parameters"))
            .and_then(Value::as_object)
            .unwrap_or(table),
    )
}

/// A key and value of the reference in our terms; ours pass unchanged.
pub(super) fn translate(key: &str, value: &Value) -> Vec<(String, Value)> {
    let name = RENAMED
        .iter()
        .find(|(theirs, _)| *theirs == key)
        .map_or(key, |(_, ours)| ours);
    let value = match (name, value.as_str()) {
        ("range_method" | "motion_model", Some(text)) => METHODS
            .iter()
            .find(|(theirs, _)| *theirs == text)
            .map_or_else(|| value.clone(), |(_, ours)| Value::from(*ours)),
        _ => value.clone(),
    };
    vec![(name.to_owned(), value)]
}

#[cfg(test)]
mod tests {
    use crate::Parameters;
    use crate::motion_model::MotionModel;
    use crate::sensor_parameters::RangeMethod;

    #[test]
    fn the_references_keys_are_understood() {
        let text = "pf2:\n  ros__parameters:\n    des_lidar_beams: 33\n    range_method: pcddt\n    \
                    motion_model: default\n    initial_var_theta: 0.3\n    alpha_3_tum: 0.7\n    \
                    max_range: 20\n    rangelib_variant: 3\n    max_viz_particles: 50\n";
        let (set, unknown) = Parameters::from_yaml(text).expect("sound");
        assert_eq!(set.beams.beams, 33);
        assert_eq!(set.sensor.range_method, RangeMethod::Cddt);
        assert_eq!(set.motion.motion_model, MotionModel::Mit);
        assert!((set.particles.initial_std_heading - 0.3).abs() < 1e-12);
        assert!((set.motion.noise.alpha_3_tum - 0.7).abs() < 1e-12);
        assert_eq!(unknown, ["max_viz_particles", "rangelib_variant"]);
    }

    #[test]
    fn bare_keys_need_no_node() {
        let (set, unknown) = Parameters::from_yaml("max_particles: 300\n").expect("sound");
        assert_eq!(
            (set.particles.max_particles, set.particles.min_particles),
            (300, 300)
        );
        assert!(unknown.is_empty());
    }

    #[test]
    fn what_is_no_table_is_refused() {
        for text in ["- 1\n- 2\n", "a: b: c:", "just words"] {
            assert!(Parameters::from_yaml(text).is_err(), "{text}");
        }
    }
}
