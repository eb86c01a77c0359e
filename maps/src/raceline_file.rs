//! Raceline files: our CSV, those of other tools, and `race_stack`'s `global_waypoints.json`.

use std::fmt::Write;
use std::path::Path;

use serde::Deserialize;

use crate::raceline_rows::{Row, build};
use crate::{MapError, Raceline, RacelinePoint, raceline_csv, read_text};

impl Raceline {
    /// Reads a raceline file; its content tells the format.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, MapError> {
        let path = path.as_ref();
        Self::parse(&path.display().to_string(), &read_text(path)?)
    }

    /// Reads a raceline's text, in any of the formats; `file` names it in errors.
    ///
    /// - CSV, separated by `;`, `,` or white space, with a header (with or without `#`) that names the columns. `x_m` and
    ///   `y_m` are needed; `s_m psi_rad kappa_radpm vx_mps` are used; others are ignored. Common other names of
    ///   these columns are known, such as `X Y yaw speed`, and those of TU Munich's local planner (`x_ref_m` and its
    ///   companions). A header without a position is refused.
    /// - CSV without a header. Six columns or more are `s x y psi kappa vx` or `x y z qz qw v`, as their values
    ///   show; values that fit neither are refused. Fewer columns are `x y`.
    /// - JSON with `global_traj_wpnts_iqp.wpnts`, or `global_traj_wpnts_sp.wpnts` where the first is empty.
    ///
    /// A point that repeats the one before it is left out. A line whose end is far from its start is refused. What a
    /// file does not give is computed from the positions; speed is then 2 m/s.
    pub fn parse(file: &str, text: &str) -> Result<Self, MapError> {
        if text.trim_start_matches('\u{feff}').trim_start().starts_with('{') {
            let (key, rows) = json_rows(file, text)?;
            build(rows).map_err(|fault| {
                let key = match fault.place {
                    Some(index) => format!("{key}.wpnts[{index}]"),
                    None => format!("{key}.wpnts"),
                };
                MapError::key(file, &key, fault.fault)
            })
        } else {
            build(raceline_csv::rows(file, text)?).map_err(|fault| match fault.place {
                Some(line) => MapError::line(file, line, fault.fault),
                None => MapError::format(file, fault.fault),
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

#[derive(Deserialize)]
struct GlobalWaypoints {
    global_traj_wpnts_iqp: Option<Waypoints>,
    global_traj_wpnts_sp: Option<Waypoints>,
}

#[derive(Deserialize)]
struct Waypoints {
    wpnts: Vec<Waypoint>,
}

#[derive(Deserialize)]
struct Waypoint {
    s_m: Option<f64>,
    x_m: f64,
    y_m: f64,
    psi_rad: Option<f64>,
    kappa_radpm: Option<f64>,
    vx_mps: Option<f64>,
}

/// The rows of the first trajectory that has any, and its key.
fn json_rows(file: &str, text: &str) -> Result<(&'static str, Vec<Row>), MapError> {
    let text = text.trim_start_matches('\u{feff}');
    let all: GlobalWaypoints =
        serde_json::from_str(text).map_err(|e| MapError::format(file, e.to_string()))?;
    let row = |(place, waypoint): (u64, Waypoint)| Row {
        place,
        s: waypoint.s_m,
        position: [waypoint.x_m, waypoint.y_m],
        psi: waypoint.psi_rad,
        kappa: waypoint.kappa_radpm,
        speed: waypoint.vx_mps,
    };
    [
        ("global_traj_wpnts_iqp", all.global_traj_wpnts_iqp),
        ("global_traj_wpnts_sp", all.global_traj_wpnts_sp),
    ]
    .into_iter()
    .filter_map(|(key, waypoints)| Some((key, waypoints?.wpnts)))
    .find(|(_, waypoints)| !waypoints.is_empty())
    .map(|(key, waypoints)| (key, (0..).zip(waypoints).map(row).collect()))
    .ok_or_else(|| {
        let fault = "no waypoints, nor in global_traj_wpnts_sp";
        MapError::key(file, "global_traj_wpnts_iqp", fault)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wrap_angle;
    use proptest::prelude::*;
    use std::f64::consts::{FRAC_PI_2, PI, TAU};

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
        // Where the optimisation gave nothing, the shortest path counts.
        let text = serde_json::json!({
            "global_traj_wpnts_iqp": {"wpnts": []}, "global_traj_wpnts_sp": {"wpnts": text["global_traj_wpnts_iqp"]["wpnts"]}
        });
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
            ("{}", "line.csv: global_traj_wpnts_iqp: no waypoints"),
            (
                "{\"global_traj_wpnts_iqp\": {\"wpnts\": []}}",
                "line.csv: global_traj_wpnts_iqp: no waypoints",
            ),
            (
                "{\"global_traj_wpnts_sp\": {\"wpnts\": [{\"x_m\": 1, \"y_m\": 2}]}}",
                "line.csv: global_traj_wpnts_sp.wpnts: 1 points",
            ),
            ("1, line\n", "line.csv, line 1: y_m: \"line\""),
        ] {
            let error = Raceline::parse("line.csv", text).expect_err("a fault");
            assert!(
                error.to_string().starts_with(expected),
                "{error} should start with {expected}"
            );
        }
    }

    /// A circle of radius 3 m: a header, and for each of 60 points a row made of its number, angle, x and y.
    fn rows(header: &str, row: impl Fn(usize, f64, f64, f64) -> String) -> String {
        let rows = (0..60).map(|i| {
            let angle = TAU * i as f64 / 60.0;
            row(i, angle, 3.0 * angle.cos(), 3.0 * angle.sin()) + "\n"
        });
        format!("{header}\n{}", rows.collect::<String>())
    }

    #[test]
    fn columns_of_other_tools() {
        let heading = |angle: f64| wrap_angle(angle + FRAC_PI_2);
        for text in [
            rows("X,Y,yaw,speed", |_, a, x, y| {
                format!("{x},{y},{},4.0", heading(a))
            }),
            rows("# s [m], x [m], y [m], v [m/s]", |_, a, x, y| {
                format!("{}, {x}, {y}, 4.0", 3.0 * a)
            }),
            rows("x y v", |_, _, x, y| format!("{x} {y} 4.0")),
            // The local planner of TU Munich: the reference line lies 0.2 m inside, its normals point inwards.
            rows(
                "# 1111-aaaa\n# 2222\n# x_ref_m; y_ref_m; width_right_m; width_left_m; x_normvec_m; y_normvec_m; alpha_m; \
                 s_racetraj_m; psi_racetraj_rad; kappa_racetraj_radpm; vx_racetraj_mps; ax_racetraj_mps2",
                |_, a, x, y| {
                    let (nx, ny) = (-x / 3.0, -y / 3.0);
                    let (rx, ry) = (x + 0.2 * nx, y + 0.2 * ny);
                    format!(
                        "{rx}; {ry}; 1.1; 1.1; {nx}; {ny}; -0.2; {}; {}; 0.3333; 4.0; 0.0",
                        3.0 * a,
                        heading(a) - FRAC_PI_2
                    )
                },
            ),
            // Poses without a header: x, y, z, qz, qw, v, and with the whole quaternion.
            rows("", |_, a, x, y| {
                let (z, w) = (heading(a) / 2.0).sin_cos();
                format!("{x},{y},0.0,{z},{w},4.0")
            }),
            rows("", |_, a, x, y| {
                let (z, w) = (heading(a) / 2.0).sin_cos();
                format!("{x},{y},0.0,0.0,0.0,{z},{w},4.0")
            }),
        ] {
            let line = Raceline::parse("test", &text).expect("a valid line");
            assert_is_the_circle(&line);
            assert!(
                line.points().iter().all(|p| (p.speed - 4.0).abs() < 1e-9),
                "{text}"
            );
        }
    }

    #[test]
    fn unknown_columns_are_refused() {
        for (text, expected) in [
            (
                rows("east, north", |_, _, x, y| format!("{x}, {y}")),
                "line.csv, line 1: x_m and y_m are not among the columns east, north",
            ),
            (
                rows("# made by hand\n# east, north", |_, _, x, y| format!("{x}, {y}")),
                "line.csv, line 2: x_m and y_m are not among the columns east, north",
            ),
            (
                rows("# x_ref_m; y_ref_m; width_m", |_, _, x, y| format!("{x}; {y}; 1")),
                "line.csv, line 1: x_m and y_m are not among the columns x_ref_m, y_ref_m, width_m",
            ),
            (
                rows("", |_, a, x, y| format!("{x},{y},{a},1,2,3")),
                "line.csv, line 2: 6 columns without a header",
            ),
        ] {
            let error = Raceline::parse("line.csv", &text)
                .expect_err("unknown columns")
                .to_string();
            assert!(error.starts_with(expected), "{error}");
        }
    }

    #[test]
    fn a_repeated_point_is_left_out() {
        let text = rows("x_m,y_m", |i, _, x, y| {
            let twice = if i == 7 { 2 } else { 1 };
            format!("{x},{y}\n").repeat(twice)
        });
        assert_is_the_circle(&Raceline::parse("test", &text).expect("a valid line"));
    }

    #[test]
    fn arc_length_that_ends_with_zero_is_that_of_the_first_point() {
        let text = rows("s_m, x_m, y_m", |_, a, x, y| format!("{}, {x}, {y}", 3.0 * a));
        let line = Raceline::parse("test", &format!("{text}0, 3.0, 0.0\n")).expect("a valid line");
        assert_is_the_circle(&line);
        assert!((line.length() - 3.0 * TAU).abs() < 0.02);
    }

    #[test]
    fn half_a_lap_is_refused() {
        let text = rows("x_m,y_m", |_, _, x, y| format!("{x},{y}"));
        let half: Vec<_> = text.lines().take(32).collect();
        let error = Raceline::parse("line.csv", &half.join("\n")).expect_err("half a lap");
        assert_eq!(
            error.to_string(),
            "line.csv, line 32: the line is not closed: 6.00 m from its last point back to its first, after 9.42 m"
        );
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
