//! The paper's results, for comparison with ours.

use serde::Serialize;

use super::Quality;

/// A row of table I of *Robustness Evaluation of Localization Techniques for Autonomous Racing* (Lim et al., DATE 2024,
/// arXiv 2401.07658): ten laps of a real car. The speed scaling was the same on both tyres, as [`SPEED_SCALE`](super::SPEED_SCALE)
/// is here.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PaperRow {
    /// The localizer.
    pub localizer: &'static str,
    /// The tyres.
    pub quality: Quality,
    /// Lap time, mean and sigma \[s\].
    pub lap_time_s: [f64; 2],
    /// Mean distance of the estimate from the raceline, mean and sigma over the laps \[m\].
    pub line_error_m: [f64; 2],
    /// Scan alignment, in [0, 1].
    pub alignment: f64,
    /// Load, where the paper reports it [%].
    pub load: Option<f64>,
}

/// The table.
#[rustfmt::skip]
pub const PAPER_ROWS: [PaperRow; 4] = [
    row("SynPF", Quality::Hq, [9.184, 0.153], [8.223, 0.406], 80.603, Some(2.17)),
    row("SynPF", Quality::Lq, [9.280, 0.093], [7.686, 1.179], 79.924, None),
    row("Cartographer", Quality::Hq, [9.167, 0.097], [6.864, 0.264], 69.357, Some(4.2)),
    row("Cartographer", Quality::Lq, [9.428, 0.126], [11.432, 1.134], 61.710, None),
];

/// Makes a row from the paper's units: centimetres and percent.
const fn row(
    localizer: &'static str,
    quality: Quality,
    lap_time_s: [f64; 2],
    line_error_cm: [f64; 2],
    alignment_percent: f64,
    load: Option<f64>,
) -> PaperRow {
    PaperRow {
        localizer,
        quality,
        lap_time_s,
        line_error_m: [line_error_cm[0] / 100.0, line_error_cm[1] / 100.0],
        alignment: alignment_percent / 100.0,
        load,
    }
}
