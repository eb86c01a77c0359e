//! The columns of raceline CSV files, as different tools write them.

use crate::MapError;
use crate::raceline_rows::{Row, gap};

/// Names of a column, in lower case; the first is our own.
const S: &[&str] = &["s_m", "s", "s_racetraj_m"];
const X: &[&str] = &["x_m", "x", "pos_x", "x_pos"];
const Y: &[&str] = &["y_m", "y", "pos_y", "y_pos"];
const PSI: &[&str] = &[
    "psi_rad",
    "psi",
    "yaw",
    "yaw_rad",
    "heading",
    "heading_rad",
    "theta",
    "psi_racetraj_rad",
];
const KAPPA: &[&str] = &["kappa_radpm", "kappa", "curvature", "kappa_racetraj_radpm"];
const SPEED: &[&str] = &[
    "vx_mps",
    "vx",
    "v",
    "v_mps",
    "speed",
    "speed_mps",
    "velocity",
    "vx_racetraj_mps",
];

/// Reads the rows of a CSV file, separated by `;`, by `,` or by white space. `file` names it in errors.
pub(crate) fn rows(file: &str, text: &str) -> Result<Vec<Row>, MapError> {
    let text = text.trim_start_matches('\u{feff}');
    let mut columns = None;
    let mut comment: Option<Line> = None;
    let mut data: Vec<Line> = Vec::new();
    for (number, text) in (1..).zip(text.lines()) {
        let text = text.trim();
        let content = text.trim_start_matches('#').trim();
        if content.is_empty() {
            continue;
        }
        let line = Line::new(number, content);
        if let Some(named) = Columns::named(&line) {
            columns = Some(named);
        } else if text.starts_with('#') {
            comment = Some(line);
        } else if data.is_empty() && columns.is_none() && line.is_header() {
            return Err(unknown_header(file, &line));
        } else {
            data.push(line);
        }
    }
    let Some(first) = data.first() else {
        return Ok(Vec::new());
    };
    let columns = if let Some(columns) = columns {
        columns
    } else {
        // A comment with a name for each column is a header, too. Words with spaces between them are prose.
        if let Some(header) = comment.filter(|line| {
            line.number < first.number
                && line.is_header()
                && line.separator.is_some()
                && line.fields.len() == first.fields.len()
        }) {
            return Err(unknown_header(file, &header));
        }
        guess(file, &data)?
    };
    data.iter().map(|line| columns.row(file, line)).collect()
}

fn unknown_header(file: &str, header: &Line) -> MapError {
    let names = header.fields.join(", ");
    MapError::line(
        file,
        header.number,
        format!("x_m and y_m are not among the columns {names}"),
    )
}

/// A line with something in it, in fields.
struct Line<'a> {
    number: u64,
    /// What separates its fields; None for white space.
    separator: Option<char>,
    fields: Vec<&'a str>,
}

impl<'a> Line<'a> {
    fn new(number: u64, content: &'a str) -> Self {
        let separator = [';', ',']
            .into_iter()
            .find(|&separator| content.contains(separator));
        let fields = match separator {
            Some(separator) => content.split(separator).map(str::trim).collect(),
            None => content.split_whitespace().collect(),
        };
        Self {
            number,
            separator,
            fields,
        }
    }

    /// True for at least two words of which none is a number.
    fn is_header(&self) -> bool {
        let word = |field: &&str| field.parse::<f64>().is_err() && !field.is_empty();
        self.fields.len() >= 2 && self.fields.iter().all(word)
    }

    fn value(&self, file: &str, name: &str, column: usize) -> Result<f64, MapError> {
        let field = self.fields.get(column).copied().unwrap_or_default();
        match field.parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(value),
            _ => {
                let fault = format!("{name}: {field:?} is not a finite number");
                Err(MapError::line(file, self.number, fault))
            }
        }
    }
}

/// Which column holds what.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Columns {
    s: Option<usize>,
    position: Position,
    psi: Option<Heading>,
    kappa: Option<usize>,
    speed: Option<usize>,
}

/// How a row gives a position.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Position {
    /// x and y.
    Direct([usize; 2]),
    /// A reference line's point, its unit normal, and the distance from the point along the normal, as the planner of TU
    /// Munich writes them (`x_ref_m`, `y_ref_m`, `x_normvec_m`, `y_normvec_m`, `alpha_m`).
    Beside {
        reference: [usize; 2],
        normal: [usize; 2],
        alpha: usize,
    },
}

/// How a row gives a heading.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Heading {
    /// As an angle.
    Angle(usize),
    /// As the z and w parts of a quaternion.
    Quaternion([usize; 2]),
}

impl Columns {
    /// The columns that a header names; None if it names no position.
    fn named(header: &Line) -> Option<Self> {
        if !header.is_header() {
            return None;
        }
        let names: Vec<String> = header.fields.iter().map(|field| plain_name(field)).collect();
        // In the order of the names, so that our own come before others.
        let find = |known: &[&str]| {
            known
                .iter()
                .find_map(|known| names.iter().position(|name| name == known))
        };
        let both = |a: &[&str], b: &[&str]| Some([find(a)?, find(b)?]);
        let beside = || {
            Some(Position::Beside {
                reference: both(&["x_ref_m"], &["y_ref_m"])?,
                normal: both(&["x_normvec_m"], &["y_normvec_m"])?,
                alpha: find(&["alpha_m"])?,
            })
        };
        Some(Self {
            position: both(X, Y).map(Position::Direct).or_else(beside)?,
            s: find(S),
            psi: find(PSI)
                .map(Heading::Angle)
                .or_else(|| both(&["qz"], &["qw"]).map(Heading::Quaternion)),
            kappa: find(KAPPA),
            speed: find(SPEED),
        })
    }

    fn row(&self, file: &str, line: &Line) -> Result<Row, MapError> {
        let value = |name, column| line.value(file, name, column);
        let maybe = |name, column: Option<usize>| column.map(|column| value(name, column)).transpose();
        Ok(Row {
            place: line.number,
            s: maybe("s_m", self.s)?,
            position: match self.position {
                Position::Direct([x, y]) => [value("x_m", x)?, value("y_m", y)?],
                Position::Beside {
                    reference: [x, y],
                    normal: [nx, ny],
                    alpha,
                } => {
                    let alpha = value("alpha_m", alpha)?;
                    [
                        value("x_ref_m", x)? + alpha * value("x_normvec_m", nx)?,
                        value("y_ref_m", y)? + alpha * value("y_normvec_m", ny)?,
                    ]
                }
            },
            psi: match self.psi {
                None => None,
                Some(Heading::Angle(column)) => Some(value("psi_rad", column)?),
                Some(Heading::Quaternion([z, w])) => Some(2.0 * value("qz", z)?.atan2(value("qw", w)?)),
            },
            kappa: maybe("kappa_radpm", self.kappa)?,
            speed: maybe("vx_mps", self.speed)?,
        })
    }
}

/// A column's name in lower case, without a unit in brackets behind it.
fn plain_name(field: &str) -> String {
    let name = field.split(['[', '(']).next().unwrap_or_default();
    name.trim().trim_matches('"').to_ascii_lowercase()
}

/// Columns of a file without a header: up to five are `x y` and more; six or more are what their values allow.
fn guess(file: &str, data: &[Line]) -> Result<Columns, MapError> {
    let first = &data[0];
    let known = Columns {
        s: None,
        position: Position::Direct([0, 1]),
        psi: None,
        kappa: None,
        speed: None,
    };
    let count = first.fields.len();
    if count < 6 {
        return Ok(known);
    }
    // Lines that do not read as numbers are named later, by the columns that are chosen here.
    let column = |i: usize| -> Vec<f64> {
        let read = |line: &Line| line.fields.get(i).and_then(|field| field.parse().ok());
        data.iter().filter_map(read).collect()
    };
    let ours = Columns {
        s: Some(0),
        position: Position::Direct([1, 2]),
        psi: Some(Heading::Angle(3)),
        kappa: Some(4),
        speed: Some(5),
    };
    if is_arc_length(&column(0), &column(1), &column(2)) {
        return Ok(ours);
    }
    // x y z, a quaternion's z and w or all of it, and the speed.
    for [z, w, speed] in [[3, 4, 5], [5, 6, 7]] {
        if count == speed + 1 && is_unit(&column(z), &column(w)) {
            return Ok(Columns {
                psi: Some(Heading::Quaternion([z, w])),
                speed: Some(speed),
                ..known
            });
        }
    }
    Err(MapError::line(
        file,
        first.number,
        format!(
            "{count} columns without a header are neither s x y psi kappa vx (s is no arc length of x and y) nor x y z qz qw \
             v (qz and qw are no part of a unit quaternion); name them in a header"
        ),
    ))
}

/// True if `s` grows as the way along the positions does.
fn is_arc_length(s: &[f64], x: &[f64], y: &[f64]) -> bool {
    let positions: Vec<[f64; 2]> = x.iter().zip(y).map(|(&x, &y)| [x, y]).collect();
    let (mut way, mut off) = (0.0, 0.0);
    for (steps, pair) in s.windows(2).zip(positions.windows(2)) {
        let step = gap(pair[0], pair[1]);
        way += step;
        off += (steps[1] - steps[0] - step).abs();
    }
    // Chords cut bends; positions are rounded.
    off <= 0.2 * way
}

/// True if every heading's quaternion has the length 1.
fn is_unit(z: &[f64], w: &[f64]) -> bool {
    z.iter().zip(w).all(|(z, w)| (z.hypot(*w) - 1.0).abs() < 0.01)
}
