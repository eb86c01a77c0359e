//! What the paper reports, to stand beside ours.

use serde::Serialize;

use super::Quality;

/// A row of table I of *Robustness Evaluation of Localization Techniques for Autonomous Racing* (Lim et al., DATE 2024,
/// arXiv 2401.07658): ten laps of a real car.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PaperRow {
    /// Which localizer.
    pub localizer: &'static str,
    /// On which tyres.
    pub quality: Quality,
    /// Lap time, mean and sigma [s].
    pub lap_time_s: [f64; 2],
    /// Mean distance of the estimate from the raceline, mean and sigma over the laps [m].
    pub line_error_m: [f64; 2],
    /// Scan alignment, in [0, 1].
    pub alignment: f64,
    /// Load, as the paper gives it, where it does [%].
    pub load: Option<f64>,
}

/// The table.
pub const PAPER_ROWS: [PaperRow; 4] = [
    PaperRow {
        localizer: "SynPF",
        quality: Quality::Hq,
        lap_time_s: [9.184, 0.153],
        line_error_m: [0.082_23, 0.004_06],
        alignment: 0.806_03,
        load: Some(2.17),
    },
    PaperRow {
        localizer: "SynPF",
        quality: Quality::Lq,
        lap_time_s: [9.280, 0.093],
        line_error_m: [0.076_86, 0.011_79],
        alignment: 0.799_24,
        load: None,
    },
    PaperRow {
        localizer: "Cartographer",
        quality: Quality::Hq,
        lap_time_s: [9.167, 0.097],
        line_error_m: [0.068_64, 0.002_64],
        alignment: 0.693_57,
        load: Some(4.2),
    },
    PaperRow {
        localizer: "Cartographer",
        quality: Quality::Lq,
        lap_time_s: [9.428, 0.126],
        line_error_m: [0.114_32, 0.011_34],
        alignment: 0.617_10,
        load: None,
    },
];
