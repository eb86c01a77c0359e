//! What is measured and drawn for the paper (docs/paper.md): forces on the tyres, and figures.

use std::process::Command;

#[test]
fn the_grip_test_gives_the_paper_s_forces() {
    let ended = Command::new(env!("CARGO_BIN_EXE_car-node"))
        .args(["grip-test", "--json"])
        .output()
        .expect("it starts");
    let rows: Vec<serde_json::Value> = serde_json::from_slice(&ended.stdout).expect("JSON");
    for (row, paper) in rows.iter().zip([26.0, 19.0]) {
        let held = row["held_n"].as_f64().expect("a number");
        assert!((held - paper).abs() < 0.2, "{row}");
    }
    assert_eq!(rows.len(), 2);
}

/// An SVG file, element by element.
struct Svg {
    elements: Vec<Element>,
}

struct Element {
    name: String,
    attributes: Vec<(String, String)>,
    /// Up to the next tag.
    text: String,
}

impl Element {
    fn attribute(&self, key: &str) -> Option<&str> {
        let found = self.attributes.iter().find(|(name, _)| name == key);
        found.map(|(_, value)| value.as_str())
    }
}

/// Draws a figure and reads it. Fails if the XML is not well-formed.
fn figure(kind: &str) -> Svg {
    let file = std::env::temp_dir().join(format!("figure-{}-{kind}.svg", std::process::id()));
    let ended = Command::new(env!("CARGO_BIN_EXE_car-node"))
        .args(["figure", kind, "-o"])
        .arg(&file)
        .output()
        .expect("it starts");
    assert!(
        ended.status.success(),
        "{kind}: {}",
        String::from_utf8_lossy(&ended.stderr)
    );
    let text = std::fs::read_to_string(&file).expect("it was written");
    std::fs::remove_file(&file).ok();
    let (mut open, mut elements) = (Vec::new(), Vec::new());
    for part in text.strip_prefix('<').expect("a tag").split('<') {
        let (tag, after) = part.split_once('>').expect("every tag ends");
        assert!(!after.contains('>'), "{kind}: {after}");
        let entities = after.matches('&').count();
        let known = ["&amp;", "&lt;", "&gt;"].map(|entity| after.matches(entity).count());
        assert_eq!(entities, known.iter().sum::<usize>(), "{kind}: {after}");
        if let Some(name) = tag.strip_prefix('/') {
            assert_eq!(open.pop().as_deref(), Some(name), "{kind}");
            continue;
        }
        let (tag, closed) = tag.strip_suffix('/').map_or((tag, false), |tag| (tag, true));
        let (name, mut rest) = tag.split_once(' ').unwrap_or((tag, ""));
        let mut attributes = Vec::new();
        while let Some((key, value)) = rest.trim_start().split_once("=\"") {
            let (value, next) = value.split_once('"').expect("a quoted value");
            assert!(
                !value.contains("NaN") && !value.contains("inf"),
                "{kind}: {value}"
            );
            attributes.push((key.to_owned(), value.to_owned()));
            rest = next;
        }
        assert_eq!(rest.trim(), "", "{kind}");
        if !closed {
            open.push(name.to_owned());
        }
        elements.push(Element {
            name: name.to_owned(),
            attributes,
            text: after.trim().to_owned(),
        });
    }
    assert!(open.is_empty(), "{kind}: {open:?}");
    assert_eq!(elements[0].name, "svg");
    Svg { elements }
}

impl Svg {
    /// The texts that contain a word.
    fn texts(&self, word: &str) -> Vec<&str> {
        let texts = self.elements.iter().filter(|element| element.name == "text");
        texts
            .map(|element| element.text.as_str())
            .filter(|text| text.contains(word))
            .collect()
    }

    /// The numbers in the only text that contains a word.
    fn numbers(&self, word: &str) -> Vec<f64> {
        let [text] = self.texts(word)[..] else {
            panic!("{word}: {:?}", self.texts(word))
        };
        numbers(text)
    }

    /// The points of all lines and dots, path by path.
    fn paths(&self) -> Vec<Vec<[f64; 2]>> {
        let point = |point: &str| {
            let (x, y) = point.trim_end_matches("h0").split_once(' ')?;
            Some([x.parse().ok()?, y.parse().ok()?])
        };
        let points = |data: &str| data.split(['M', 'L']).filter_map(point).collect();
        let data = self.elements.iter().filter_map(|element| element.attribute("d"));
        data.map(points).collect()
    }

    /// The paths of so many points.
    fn paths_of(&self, points: usize) -> Vec<Vec<[f64; 2]>> {
        let mut paths = self.paths();
        paths.retain(|path| path.len() == points);
        paths
    }
}

fn numbers(text: &str) -> Vec<f64> {
    text.split(|c: char| !c.is_ascii_digit() && c != '.')
        .filter_map(|number| number.parse().ok())
        .collect()
}

#[test]
fn the_race_car_s_motion_model_spreads_less_at_speed() {
    let svg = figure("motion-models");
    // Four clouds of a thousand, and the heading of every tenth.
    assert_eq!(svg.paths_of(1000).len(), 4);
    let spread: Vec<f64> = svg.texts("across ").iter().map(|text| numbers(text)[1]).collect();
    let turned: Vec<f64> = svg
        .texts("heading ")
        .iter()
        .map(|text| numbers(text)[0])
        .collect();
    // Column by column: amcl and tum at 1 m/s, then at 7 m/s.
    let [_, tum_slow, amcl_fast, tum_fast] = spread[..] else {
        panic!("{spread:?}")
    };
    assert!(amcl_fast > 2.0 * tum_fast && tum_fast > tum_slow, "{spread:?}");
    let [_, tum_slow, amcl_fast, tum_fast] = turned[..] else {
        panic!("{turned:?}")
    };
    assert!(amcl_fast > 2.0 * tum_fast && tum_fast < tum_slow, "{turned:?}");
}

#[test]
fn more_beams_of_the_boxed_layout_look_along_the_corridor() {
    let svg = figure("beam-layouts");
    assert_eq!(svg.paths_of(61).len(), 2);
    let beyond: Vec<Vec<f64>> = svg
        .texts("beams end beyond")
        .iter()
        .map(|text| numbers(text))
        .collect();
    // Beams beyond 2 m, of how many, "2", beyond 5 m, "5".
    let [uniform, boxed] = &beyond[..] else {
        panic!("{beyond:?}")
    };
    assert!(
        boxed[0] > 1.5 * uniform[0] && boxed[3] > 1.5 * uniform[3],
        "{beyond:?}"
    );
    // All beams end on the corridor's walls, which are two heights in each panel, but for the one straight ahead.
    for ends in svg.paths_of(61) {
        let on_wall = |end: &&[f64; 2]| {
            ends.iter()
                .filter(|other| (other[1] - end[1]).abs() < 0.11)
                .count()
                > 5
        };
        assert!(ends.iter().filter(on_wall).count() >= 60);
    }
}

#[test]
fn the_sensor_model_is_drawn_with_its_peak_where_the_map_predicts() {
    let svg = figure("sensor-model");
    let paths = svg.paths();
    let density = paths.iter().max_by_key(|path| path.len()).expect("curves");
    let [first, last] = [density[0], density[density.len() - 1]];
    let peak = density
        .iter()
        .min_by(|a, b| a[1].total_cmp(&b[1]))
        .expect("points");
    let predicted = svg.numbers("the map predicts")[0];
    // From the label of the axis to pixels.
    let label = |text: &str| {
        let found =
            |element: &&Element| element.text == text && element.attribute("text-anchor") == Some("middle");
        let label = svg.elements.iter().find(found).expect("a label");
        label
            .attribute("x")
            .and_then(|x| x.parse::<f64>().ok())
            .expect("a place")
    };
    let per_metre = (label("10") - label("0")) / 10.0;
    let at = (peak[0] - label("0")) / per_metre;
    assert!((at - predicted).abs() < 0.05, "{at}");
    assert!(first[0] < peak[0] && peak[0] < last[0]);
    // Short of the wall a range is more likely the nearer it is.
    assert!(first[1] < density[density.len() / 8][1]);
}

#[test]
fn range_errors_of_all_methods_are_distributions() {
    let svg = figure("range-methods");
    let curves = svg.paths_of(401);
    assert_eq!(curves.len(), 4);
    for curve in &curves {
        let grows = |pair: &[[f64; 2]]| pair[0][0] <= pair[1][0] && pair[0][1] > pair[1][1];
        assert!(curve.windows(2).all(grows));
    }
    let median = |method: &str| svg.numbers(&format!("{method}: median"))[0];
    for method in ["lut", "cddt", "ray_marching", "exact"] {
        assert!(
            median(method) > 0.0 && median(method) < 5.0,
            "{method}: {}",
            median(method)
        );
    }
    // Crossings with the faces themselves are nearer to them than rays on cells.
    assert!(median("cddt") < median("exact"));
}
