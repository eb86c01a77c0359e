//! What can be tuned of the search of the whole map.

use serde::{Deserialize, Serialize};

use crate::validation::Check;

/// Parameters of the search.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct SearchParameters {
    /// Distance between the positions that are tried \[m\].
    pub search_step: f64,
    /// Angle between the headings that are tried \[rad\].
    pub search_turn: f64,
    /// Candidates that are followed.
    pub search_candidates: usize,
    /// By how much the best must explain a scan better than the next, in units of log-likelihood.
    pub search_margin: f64,
    /// Distance that the car must have driven before one is confirmed \[m\].
    pub search_distance: f64,
}

impl Default for SearchParameters {
    fn default() -> Self {
        Self {
            search_step: 0.2,
            search_turn: 0.0524,
            search_candidates: 40,
            search_margin: 2.0,
            search_distance: 0.5,
        }
    }
}

impl SearchParameters {
    pub(crate) fn validate(&self, check: &mut Check) {
        check.range("search_step", self.search_step, 0.05, 2.0);
        check.range("search_turn", self.search_turn, 0.01, 0.6);
        check.range("search_candidates", self.search_candidates as f64, 2.0, 1000.0);
        check.range("search_margin", self.search_margin, 0.0, 1000.0);
        check.range("search_distance", self.search_distance, 0.0, 100.0);
    }
}
