//! The walls of a track as CSV.

use std::fmt::Write;

use maps::MapError;

use crate::{Surface, Wall, Walls};

/// Walls lie within this distance of the first point, along x and along y: the index is a table over all of them \[m\].
const MOST: f64 = 500.0;

impl Walls {
    /// The walls as CSV: a number for each wall, its surface, and its points in order.
    pub fn to_csv(&self) -> String {
        let mut csv = String::from("# wall; surface; x_m; y_m\n");
        for (i, wall) in self.polylines().iter().enumerate() {
            let surface = match wall.surface {
                Surface::Plain => "plain",
                Surface::Black => "black",
            };
            for [x, y] in &wall.points {
                writeln!(csv, "{i}; {surface}; {x:.3}; {y:.3}").expect("a string takes all");
            }
        }
        csv
    }

    /// Reads what [`Walls::to_csv`] writes; `file` names it in errors.
    pub fn parse(file: &str, csv: &str) -> Result<Self, MapError> {
        let mut walls: Vec<Wall> = Vec::new();
        let mut current = None;
        let mut first = None;
        for (line, text) in (1..).zip(csv.lines()) {
            let text = text.trim();
            if text.is_empty() || text.starts_with('#') {
                continue;
            }
            let fault = |fault: String| MapError::Line {
                file: file.to_owned(),
                line,
                fault,
            };
            let fields: Vec<&str> = text.split(';').map(str::trim).collect();
            let &[number, surface, x, y] = fields.as_slice() else {
                return Err(fault(format!(
                    "{} fields where wall; surface; x_m; y_m should be",
                    fields.len()
                )));
            };
            let surface = match surface {
                "plain" => Surface::Plain,
                "black" => Surface::Black,
                other => return Err(fault(format!("surface: {other:?} should be plain or black"))),
            };
            let coordinate = |name: &str, field: &str| match field.parse() {
                Ok(value) if f64::is_finite(value) => Ok(value),
                _ => Err(fault(format!("{name}: {field:?} is not a finite number"))),
            };
            let point = [coordinate("x_m", x)?, coordinate("y_m", y)?];
            if point.iter().any(|v| v.abs() > 1e4) {
                return Err(fault(format!("{point:?} is more than 10 km away")));
            }
            // The index is a table over all the walls' ground.
            let [x0, y0] = *first.get_or_insert(point);
            if (point[0] - x0).abs() > MOST || (point[1] - y0).abs() > MOST {
                return Err(fault(format!(
                    "{point:?} is more than {MOST} m away from the first point"
                )));
            }
            let number = number.to_owned();
            match walls.last_mut() {
                Some(wall) if current.as_ref() == Some(&number) => wall.points.push(point),
                _ => {
                    walls.push(Wall {
                        surface,
                        points: vec![point],
                    });
                    current = Some(number);
                }
            }
        }
        Ok(Self::new(walls))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn csv_reads_back_and_faults_name_the_line() {
        let walls = Walls::new(vec![
            Wall {
                surface: Surface::Plain,
                points: vec![[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0]],
            },
            Wall {
                surface: Surface::Black,
                points: vec![[0.0, 0.0], [1.0, 0.0]],
            },
        ]);
        assert_eq!(
            Walls::parse("walls.csv", &walls.to_csv()).expect("just written"),
            walls
        );
        for (text, expected) in [
            ("0; plain; 1", "walls.csv, line 1: 3 fields"),
            ("#\n0; glass; 1; 2", "walls.csv, line 2: surface: \"glass\""),
            ("0; plain; 1; inf", "walls.csv, line 1: y_m: \"inf\""),
            (
                "0; plain; 1e9; 0",
                "walls.csv, line 1: [1000000000.0, 0.0] is more",
            ),
        ] {
            let error = Walls::parse("walls.csv", text).expect_err("a fault").to_string();
            assert!(error.starts_with(expected), "{error}");
        }
    }
}
