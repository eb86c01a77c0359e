//! Summaries of a series of numbers.

use serde::Serialize;

/// Summary of an error over a log, in the unit of the error.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ErrorSummary {
    /// Mean magnitude.
    pub mean: f64,
    /// Root of the mean square.
    pub rmse: f64,
    /// The magnitude that 95 % do not exceed.
    pub p95: f64,
    /// The largest magnitude.
    pub max: f64,
}

impl ErrorSummary {
    /// Of signed errors; None without any.
    pub fn of(errors: &[f64]) -> Option<Self> {
        if errors.is_empty() {
            return None;
        }
        let count = errors.len() as f64;
        let magnitudes: Vec<f64> = errors.iter().map(|e| e.abs()).collect();
        Some(Self {
            mean: mean(&magnitudes)?,
            rmse: (errors.iter().map(|e| e * e).sum::<f64>() / count).sqrt(),
            p95: percentile(&magnitudes, 0.95)?,
            max: percentile(&magnitudes, 1.0)?,
        })
    }
}

/// Mean and standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MeanSigma {
    /// Mean.
    pub mean: f64,
    /// Standard deviation of the sample.
    pub sigma: f64,
}

impl MeanSigma {
    /// Of some values; None without any.
    pub fn of(values: &[f64]) -> Option<Self> {
        let mean = mean(values)?;
        let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
        let freedom = (values.len() - 1).max(1) as f64;
        Some(Self {
            mean,
            sigma: (squares / freedom).sqrt(),
        })
    }
}

/// The mean; None without any.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The least value that at least `share` of all do not exceed (nearest rank); NaN counts as the largest. None
/// without any.
pub fn percentile(values: &[f64], share: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.max(1) - 1).copied()
}

/// A number for the wire, where NaN and infinities have no place: they become 0.
pub(crate) fn finite(value: f64) -> f32 {
    let value = value as f32;
    if value.is_finite() { value } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn summary_of_signed_errors() {
        let summary = ErrorSummary::of(&[-3.0, 4.0]).expect("two errors");
        assert_eq!((summary.mean, summary.p95, summary.max), (3.5, 4.0, 4.0));
        assert!((summary.rmse - 12.5_f64.sqrt()).abs() < 1e-12);
        assert!(ErrorSummary::of(&[]).is_none());
    }

    #[test]
    fn percentiles_are_values_that_occurred() {
        let values: Vec<f64> = (1..=100).rev().map(f64::from).collect();
        assert_eq!(percentile(&values, 0.05), Some(5.0));
        assert_eq!(percentile(&values, 0.5), Some(50.0));
        assert_eq!(percentile(&values, 0.0), Some(1.0));
        assert_eq!(percentile(&values, 1.0), Some(100.0));
        assert_eq!(percentile(&[], 0.5), None);
    }

    #[test]
    fn sigma_is_that_of_a_sample() {
        let of = MeanSigma::of(&[1.0, 2.0, 3.0]).expect("three values");
        assert!((of.mean - 2.0).abs() < 1e-12 && (of.sigma - 1.0).abs() < 1e-12);
        let one = MeanSigma::of(&[4.0]).expect("one value");
        assert!(one.sigma.abs() < 1e-12);
        assert!(MeanSigma::of(&[]).is_none());
    }
}
