//! Raceline files: our CSV, those of `f1tenth_racetracks`, and `race_stack`'s `global_waypoints.json`.
//!
//! Tools disagree on where `psi_rad` is zero (along x, or north with x to the right) and some files were made for a
//! mirrored map, so a file's `psi_rad` is compared with the direction in which its points run: an offset of a
//! multiple of 90 degrees is taken out, and headings that fit no convention are computed from the points instead.

use std::f64::consts::FRAC_PI_2;
use std::fmt::Write;
use std::path::Path;

use serde::Deserialize;

use crate::raceline::Geometry;
use crate::{MapError, Raceline, RacelineFault, RacelinePoint, read_text, wrap_angle};

/// Speed along a line whose file gives none (a centre line) [m/s]: what a careful driver does anywhere.
const DEFAULT_SPEED: f64 = 2.0;

impl Raceline {
    /// Reads a raceline file; its content tells the format.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, MapError> {
        let path = path.as_ref();
        Self::parse(&path.display().to_string(), &read_text(path)?)
    }

    /// Reads a raceline's text, in any of the formats; `file` names it in errors.
    ///
    /// - CSV, separated by `;` or `,`. A header (with or without `#`) names the columns, of which `x_m` and `y_m`
    ///   must be there; `s_m psi_rad kappa_radpm vx_mps` are used, others ignored. Without a header, 6 columns or
    ///   more are `s x y psi kappa vx`, fewer are `x y`.
    /// - JSON with `global_traj_wpnts_iqp.wpnts` (or `global_traj_wpnts_sp.wpnts`).
    ///
    /// What a file does not give is computed from the positions; speed is then 2 m/s.
    pub fn parse(file: &str, text: &str) -> Result<Self, MapError> {
        if text.trim_start().starts_with('{') {
            let rows = json_rows(file, text)?;
            let n = rows.len();
            build(&rows, true).map_err(|fault| {
                let key = match fault.index() {
                    Some(index) => format!("wpnts[{}]", index % n.max(1)),
                    None => "wpnts".to_owned(),
                };
                MapError::key(file, &key, fault.to_string())
            })
        } else {
            let (rows, lines, has_s) = csv_rows(file, text)?;
            build(&rows, has_s).map_err(|fault| match fault.index().and_then(|i| lines.get(i)) {
                Some(&line) => MapError::line(file, line, fault.to_string()),
                None => MapError::format(file, fault.to_string()),
            })
        }
    }

    /// The line as our CSV, which [`Raceline::parse`] reads back.
    pub fn to_csv(&self) -> String {
        let mut csv = String::from("# s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps\n");
        for p in self.points() {
            let RacelinePoint {
                s,
                x,
                y,
                heading,
                curvature,
                speed,
            } = p;
            writeln!(
                csv,
                "{s:.4}; {x:.4}; {y:.4}; {heading:.5}; {curvature:.5}; {speed:.4}"
            )
            .expect("a string takes all");
        }
        csv
    }
}

/// One point as a file gives it.
#[derive(Default, Deserialize)]
struct Row {
    #[serde(rename = "s_m", default)]
    s: f64,
    #[serde(rename = "x_m")]
    x: f64,
    #[serde(rename = "y_m")]
    y: f64,
    #[serde(rename = "psi_rad")]
    psi: Option<f64>,
    #[serde(rename = "kappa_radpm")]
    kappa: Option<f64>,
    #[serde(rename = "vx_mps")]
    speed: Option<f64>,
}

/// Makes a line of rows, and everything that the rows do not say.
fn build(rows: &[Row], has_s: bool) -> Result<Raceline, RacelineFault> {
    let positions: Vec<_> = rows.iter().map(|row| [row.x, row.y]).collect();
    let geometry = Geometry::of(open(&positions));
    let psi: Option<Vec<f64>> = rows.iter().map(|row| row.psi).collect();
    let headings = psi.and_then(|psi| along_travel(&psi, &geometry.heading));
    let mirrored = {
        let pairs = rows.iter().zip(&geometry.curvature);
        pairs.filter_map(|(row, own)| Some(row.kappa? * own)).sum::<f64>() < 0.0
    };
    let n = geometry.heading.len().max(1);
    let points = rows.iter().enumerate().map(|(i, row)| RacelinePoint {
        s: if has_s {
            row.s
        } else {
            // The closing point, if any, comes after a whole lap.
            geometry.s.get(i).copied().unwrap_or_else(|| lap(&positions))
        },
        x: row.x,
        y: row.y,
        heading: match &headings {
            Some(headings) => headings[i],
            None => geometry.heading[i % n],
        },
        curvature: match row.kappa {
            Some(kappa) if mirrored => -kappa,
            Some(kappa) => kappa,
            None => geometry.curvature[i % n],
        },
        speed: row.speed.unwrap_or(DEFAULT_SPEED),
    });
    Raceline::new(points.collect())
}

/// The positions without a last one that repeats the first.
fn open(positions: &[[f64; 2]]) -> &[[f64; 2]] {
    match positions {
        [first, between @ .., last] if !between.is_empty() => {
            let spacing = lap(positions) / positions.len() as f64;
            let gap = (first[0] - last[0]).hypot(first[1] - last[1]);
            if gap < 0.05 * spacing {
                &positions[..positions.len() - 1]
            } else {
                positions
            }
        }
        _ => positions,
    }
}

/// Length of the polyline from the first to the last position [m].
fn lap(positions: &[[f64; 2]]) -> f64 {
    positions
        .windows(2)
        .map(|pair| (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1]))
        .sum()
}

/// `psi` with its zero moved to the x axis, judged by the direction of travel; None if no multiple of 90 degrees
/// makes the two agree.
fn along_travel(psi: &[f64], travel: &[f64]) -> Option<Vec<f64>> {
    let (sin, cos) = psi
        .iter()
        .zip(travel)
        .map(|(psi, travel)| (psi - travel).sin_cos())
        .fold((0.0, 0.0), |sum, v| (sum.0 + v.0, sum.1 + v.1));
    let offset = (sin.atan2(cos) / FRAC_PI_2).round() * FRAC_PI_2;
    let disagreement: f64 = psi
        .iter()
        .zip(travel)
        .map(|(psi, travel)| wrap_angle(psi - offset - travel).abs())
        .sum();
    // A spline's tangents and its chords differ by a few degrees in the sharpest corners.
    (disagreement < 0.2 * psi.len() as f64).then(|| psi.iter().map(|psi| wrap_angle(psi - offset)).collect())
}

#[derive(Deserialize)]
struct GlobalWaypoints {
    global_traj_wpnts_iqp: Option<Waypoints>,
    global_traj_wpnts_sp: Option<Waypoints>,
}

#[derive(Deserialize)]
struct Waypoints {
    wpnts: Vec<Row>,
}

fn json_rows(file: &str, text: &str) -> Result<Vec<Row>, MapError> {
    let all: GlobalWaypoints =
        serde_json::from_str(text).map_err(|e| MapError::format(file, e.to_string()))?;
    all.global_traj_wpnts_iqp
        .or(all.global_traj_wpnts_sp)
        .map(|waypoints| waypoints.wpnts)
        .ok_or_else(|| MapError::key(file, "global_traj_wpnts_iqp", "missing"))
}

/// Rows, the line each stands in, and whether arc length is among the columns.
fn csv_rows(file: &str, text: &str) -> Result<(Vec<Row>, Vec<u64>, bool), MapError> {
    const RACELINE: [&str; 6] = ["s_m", "x_m", "y_m", "psi_rad", "kappa_radpm", "vx_mps"];
    let mut columns: Option<Vec<String>> = None;
    let mut rows = Vec::new();
    let mut lines = Vec::new();
    let mut has_s = false;
    for (line, text) in (1..).zip(text.lines()) {
        let text = text.trim();
        let content = text.trim_start_matches('#').trim();
        let fields: Vec<&str> = content
            .split(if content.contains(';') { ';' } else { ',' })
            .map(str::trim)
            .collect();
        if content.is_empty() {
            continue;
        }
        if fields.contains(&"x_m") && fields.contains(&"y_m") {
            columns = Some(fields.iter().map(ToString::to_string).collect());
            continue;
        }
        if text.starts_with('#') {
            continue;
        }
        let columns = columns.get_or_insert_with(|| {
            let names = if fields.len() >= RACELINE.len() {
                &RACELINE[..]
            } else {
                &RACELINE[1..3]
            };
            names.iter().map(ToString::to_string).collect()
        });
        let value = |name: &str| -> Result<Option<f64>, MapError> {
            let Some(column) = columns.iter().position(|column| column == name) else {
                return Ok(None);
            };
            let field = fields.get(column).copied().unwrap_or_default();
            field
                .parse()
                .map(Some)
                .map_err(|_| MapError::line(file, line, format!("{name}: {field:?} is not a number")))
        };
        let s = value("s_m")?;
        has_s = s.is_some();
        rows.push(Row {
            s: s.unwrap_or_default(),
            x: value("x_m")?.unwrap_or(f64::NAN),
            y: value("y_m")?.unwrap_or(f64::NAN),
            psi: value("psi_rad")?,
            kappa: value("kappa_radpm")?,
            speed: value("vx_mps")?,
        });
        lines.push(line);
    }
    Ok((rows, lines, has_s))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::{PI, TAU};

    /// A counter-clockwise circle of radius 3 m in our own format.
    fn circle(psi: impl Fn(f64) -> f64, kappa: f64) -> String {
        let mut text = String::from("# s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2\n");
        for i in 0..60 {
            let angle = TAU * f64::from(i) / 60.0;
            let (sin, cos) = angle.sin_cos();
            let psi = psi(angle + FRAC_PI_2);
            writeln!(
                text,
                "{}; {}; {}; {psi}; {kappa}; 4.0; 0.0",
                3.0 * angle,
                3.0 * cos,
                3.0 * sin
            )
            .expect("a string takes all");
        }
        text
    }

    fn assert_is_the_circle(line: &Raceline) {
        assert_eq!(line.points().len(), 60);
        for p in line.points() {
            let travel = p.y.atan2(p.x) + FRAC_PI_2;
            assert!(wrap_angle(p.heading - travel).abs() < 1e-3, "{p:?}");
            assert!((p.curvature - 1.0 / 3.0).abs() < 1e-2, "{p:?}");
        }
    }

    #[test]
    fn psi_is_turned_to_the_direction_of_travel() {
        for offset in [0.0, -FRAC_PI_2, FRAC_PI_2, PI] {
            let text = circle(|heading| wrap_angle(heading + offset), 1.0 / 3.0);
            assert_is_the_circle(&Raceline::parse("test", &text).expect("a valid line"));
        }
    }

    #[test]
    fn psi_of_no_convention_is_computed_anew() {
        let text = circle(|heading| -heading, 1.0 / 3.0);
        assert_is_the_circle(&Raceline::parse("test", &text).expect("a valid line"));
    }

    #[test]
    fn curvature_of_a_mirrored_map_changes_its_sign() {
        let text = circle(|heading| heading, -1.0 / 3.0);
        assert_is_the_circle(&Raceline::parse("test", &text).expect("a valid line"));
    }

    #[test]
    fn a_centre_line_gets_its_geometry() {
        let mut text = String::from("# x_m, y_m, w_tr_right_m, w_tr_left_m\n");
        for i in 0..60 {
            let (sin, cos) = (TAU * f64::from(i) / 60.0).sin_cos();
            writeln!(text, "{}, {}, 1.1, 1.1", 3.0 * cos, 3.0 * sin).expect("a string takes all");
        }
        let line = Raceline::parse("test", &text).expect("a valid line");
        assert_is_the_circle(&line);
        assert!((line.length() - 3.0 * TAU).abs() < 0.02);
        let closed = format!("{text}3.0, 0.0, 1.1, 1.1\n");
        assert_is_the_circle(&Raceline::parse("test", &closed).expect("a valid line"));
    }

    #[test]
    fn columns_are_known_without_a_header() {
        let text = circle(|heading| heading, 1.0 / 3.0);
        let (_, bare) = text.split_once('\n').expect("a header");
        assert_is_the_circle(&Raceline::parse("test", bare).expect("a valid line"));
    }

    #[test]
    fn race_stack_waypoints() {
        let points: Vec<_> = (0..60)
            .map(|i| {
                let angle = TAU * f64::from(i) / 60.0;
                serde_json::json!({
                    "id": i, "s_m": 3.0 * angle, "d_m": 0.0, "x_m": 3.0 * angle.cos(), "y_m": 3.0 * angle.sin(),
                    "d_right": 1.0, "d_left": 1.0, "psi_rad": angle + FRAC_PI_2, "kappa_radpm": 1.0 / 3.0,
                    "vx_mps": 4.0, "ax_mps2": 0.0
                })
            })
            .collect();
        let text =
            serde_json::json!({ "map_info_str": {"data": ""}, "global_traj_wpnts_iqp": {"wpnts": points} });
        assert_is_the_circle(&Raceline::parse("test", &text.to_string()).expect("a valid line"));
    }

    #[test]
    fn faults_name_file_and_line() {
        let text = circle(|heading| heading, 1.0 / 3.0);
        let with = |from: &str, to: &str| {
            let error = Raceline::parse("line.csv", &text.replacen(from, to, 1)).expect_err("a fault");
            error.to_string()
        };
        assert!(
            with("\n0; 3", "\n0; three").starts_with("line.csv, line 2: x_m: \"three\""),
            "{}",
            with("\n0; 3", "\n0; three")
        );
        assert!(with("\n0; 3; 0", "\n0; 3; inf").starts_with("line.csv, line 2: "));
        assert!(with("\n0; 3", "\n9; 3").starts_with("line.csv, line 3: "));
        for (text, expected) in [
            ("", "line.csv: 0 points"),
            ("1,2\n", "line.csv: 1 points"),
            ("{", "line.csv: "),
            ("{}", "line.csv: global_traj_wpnts_iqp: missing"),
            (
                "{\"global_traj_wpnts_iqp\": {\"wpnts\": []}}",
                "line.csv: wpnts: 0 points",
            ),
            ("no, line\n", "line.csv, line 1: x_m: \"no\""),
        ] {
            let error = Raceline::parse("line.csv", text).expect_err("a fault");
            assert!(
                error.to_string().starts_with(expected),
                "{error} should start with {expected}"
            );
        }
    }

    #[test]
    fn our_csv_reads_back() {
        let line = Raceline::parse("test", &circle(|heading| heading, 1.0 / 3.0)).expect("a valid line");
        let back = Raceline::parse("test", &line.to_csv()).expect("just written");
        assert_is_the_circle(&back);
        assert!((back.length() - line.length()).abs() < 1e-3);
    }

    proptest! {
        #[test]
        fn no_text_panics(text in "([-0-9.;,#{}a-z_]|\n| |NaN|inf|x_m|y_m){0,80}") {
            drop(Raceline::parse("test", &text));
        }
    }
}
