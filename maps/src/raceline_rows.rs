//! A raceline from the rows of a file: what the file does not give is computed from the positions.
//!
//! Tools disagree on where `psi_rad` is zero (along x, or north with x to the right), and some files were made for a
//! mirrored map. A file's headings are therefore compared with the direction in which its points run. An offset of a
//! multiple of 90 degrees is taken out; headings that fit no convention are replaced by computed ones.

use std::f64::consts::FRAC_PI_2;

use crate::raceline::Geometry;
use crate::{Raceline, RacelineFault, RacelinePoint, wrap_angle};

/// Speed along a line whose file gives none, such as a centre line \[m/s\].
const DEFAULT_SPEED: f64 = 2.0;

/// Points nearer to each other than this are one point \[m\].
const SAME_POINT: f64 = 1e-4;

/// A line is open where the gap from its last point to its first is longer than this share of the line, and longer
/// than `OPEN_SPACINGS` times its largest spacing.
const OPEN_SHARE: f64 = 0.1;
const OPEN_SPACINGS: f64 = 3.0;

/// One point as a file gives it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Row {
    /// Where it stands in the file: a line from 1, or an index from 0.
    pub(crate) place: u64,
    /// Arc length \[m\].
    pub(crate) s: Option<f64>,
    /// Position in `map` \[m\].
    pub(crate) position: [f64; 2],
    /// Heading \[rad\].
    pub(crate) psi: Option<f64>,
    /// Curvature \[1/m\].
    pub(crate) kappa: Option<f64>,
    /// Speed \[m/s\].
    pub(crate) speed: Option<f64>,
}

/// What is wrong with rows.
#[derive(Debug, PartialEq)]
pub(crate) struct RowFault {
    /// The row's [`Row::place`], if it is one row's fault.
    pub(crate) place: Option<u64>,
    /// What is wrong.
    pub(crate) fault: String,
}

/// Makes a raceline of rows.
pub(crate) fn build(mut rows: Vec<Row>) -> Result<Raceline, RowFault> {
    rows.dedup_by(|row, before| gap(row.position, before.position) < SAME_POINT);
    drop_restarted_end(&mut rows);
    let at = |fault: RacelineFault| RowFault {
        place: fault.index().and_then(|i| rows.get(i)).map(|row| row.place),
        fault: fault.to_string(),
    };
    let positions: Vec<_> = rows.iter().map(|row| row.position).collect();
    let line = Raceline::new(points(&rows, &positions)).map_err(at)?;
    match opening(&positions) {
        None => Ok(line),
        Some(gap) => Err(RowFault {
            place: rows.last().map(|row| row.place),
            fault: format!(
                "the line is not closed: {gap:.2} m from its last point back to its first, after {:.2} m",
                length(&positions)
            ),
        }),
    }
}

/// Drops a last row that repeats the first with the arc length 0 in place of the lap's length.
fn drop_restarted_end(rows: &mut Vec<Row>) {
    if let [first, .., before, last] = rows.as_slice()
        && let (Some(s_before), Some(s_last)) = (before.s, last.s)
        && s_last <= s_before
        && gap(first.position, last.position) < SAME_POINT
    {
        rows.pop();
    }
}

/// The gap from the last point to the first \[m\], if it is too long to be the end of a lap.
fn opening(positions: &[[f64; 2]]) -> Option<f64> {
    let (first, last) = (positions.first()?, positions.last()?);
    let gap_to_first = gap(*first, *last);
    let spacing = positions
        .windows(2)
        .map(|pair| gap(pair[0], pair[1]))
        .fold(0.0, f64::max);
    let open = gap_to_first > OPEN_SHARE * length(positions) && gap_to_first > OPEN_SPACINGS * spacing;
    open.then_some(gap_to_first)
}

/// The points of a line, with everything that the rows do not give.
fn points(rows: &[Row], positions: &[[f64; 2]]) -> Vec<RacelinePoint> {
    let geometry = Geometry::of(without_end(positions));
    let psi: Option<Vec<f64>> = rows.iter().map(|row| row.psi).collect();
    let headings = psi.and_then(|psi| along_travel(&psi, &geometry.heading));
    let mirrored = {
        let pairs = rows.iter().zip(&geometry.curvature);
        pairs.filter_map(|(row, own)| Some(row.kappa? * own)).sum::<f64>() < 0.0
    };
    let has_s = rows.iter().all(|row| row.s.is_some());
    let n = geometry.heading.len().max(1);
    let point = |(i, row): (usize, &Row)| RacelinePoint {
        // The closing point, if any, comes after a whole lap.
        s: row
            .s
            .filter(|_| has_s)
            .or_else(|| geometry.s.get(i).copied())
            .unwrap_or_else(|| length(positions)),
        x: row.position[0],
        y: row.position[1],
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
    };
    rows.iter().enumerate().map(point).collect()
}

/// The positions without a last one that repeats the first.
fn without_end(positions: &[[f64; 2]]) -> &[[f64; 2]] {
    match positions {
        [first, between @ .., last] if !between.is_empty() => {
            let spacing = length(positions) / positions.len() as f64;
            if gap(*first, *last) < 0.05 * spacing {
                &positions[..positions.len() - 1]
            } else {
                positions
            }
        }
        _ => positions,
    }
}

/// Length of the polyline from the first to the last position \[m\].
fn length(positions: &[[f64; 2]]) -> f64 {
    positions.windows(2).map(|pair| gap(pair[0], pair[1])).sum()
}

/// Distance between two positions \[m\].
pub(crate) fn gap(from: [f64; 2], to: [f64; 2]) -> f64 {
    (to[0] - from[0]).hypot(to[1] - from[1])
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
