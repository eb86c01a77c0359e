//! The reference's sensor model: a table of probabilities `[observed][predicted]`, both in cells.

use super::parameters::ReferenceParameters;

/// Log-likelihoods by the observed and the predicted range \[cells\].
#[derive(Debug, Clone, PartialEq)]
pub(super) struct SensorTable {
    /// Cells up to the greatest range, which counts as no return.
    pub(super) most: u16,
    cells_per_metre: f32,
    /// `most + 1` rows of `most + 1` values.
    rows: Vec<f32>,
}

impl SensorTable {
    pub(super) fn new(parameters: &ReferenceParameters, resolution: f64) -> Self {
        let most = (parameters.max_range / resolution) as usize;
        let width = most + 1;
        let sigma = parameters.sigma_hit / resolution;
        // Per metre in the file; the reference divides where it should multiply.
        let lambda = if parameters.defects.defect_lambda_short {
            parameters.lambda_short / resolution
        } else {
            parameters.lambda_short * resolution
        };
        let gauss: Vec<f64> = (0..width)
            .map(|z| (-0.5 * (z as f64 / sigma).powi(2)).exp() / (sigma * std::f64::consts::TAU.sqrt()))
            .collect();
        let short: Vec<f64> = (0..width).map(|r| lambda * (-lambda * r as f64).exp()).collect();
        let uniform = parameters.z_rand / most as f64;
        let mut rows = vec![0.0; width * width];
        let mut column = vec![0.0; width];
        for predicted in 0..width {
            let hits: f64 = (0..width)
                .map(|observed| gauss[predicted.abs_diff(observed)])
                .sum();
            let shorts: f64 = short[..=predicted].iter().sum();
            for (observed, value) in column.iter_mut().enumerate() {
                let mut p = parameters.z_hit * gauss[predicted.abs_diff(observed)] / hits;
                if observed <= predicted {
                    p += parameters.z_short * short[observed] / shorts;
                }
                p += if observed == most {
                    parameters.z_max
                } else {
                    uniform
                };
                *value = p;
            }
            let sum: f64 = column.iter().sum();
            for (observed, p) in column.iter().enumerate() {
                // Where no share of no returns is left, a probability of zero stays a number.
                rows[observed * width + predicted] = (p / sum).max(f64::from(f32::MIN_POSITIVE)).ln() as f32;
            }
        }
        Self {
            most: most as u16,
            cells_per_metre: (1.0 / resolution) as f32,
            rows,
        }
    }

    /// A range \[m\] in cells, rounded down; what is no number is no return.
    pub(super) fn cell(&self, range: f32) -> u16 {
        if range.is_nan() {
            return self.most;
        }
        (range * self.cells_per_metre).clamp(0.0, f32::from(self.most)) as u16
    }

    /// Log-likelihoods of an observed range \[cells\] by the predicted one \[cells\].
    pub(super) fn row(&self, observed: u16) -> &[f32] {
        let width = usize::from(self.most) + 1;
        &self.rows[usize::from(observed) * width..][..width]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(defect_lambda_short: bool) -> SensorTable {
        let mut parameters = ReferenceParameters::default();
        parameters.defects.defect_lambda_short = defect_lambda_short;
        SensorTable::new(&parameters, 0.05)
    }

    #[test]
    fn every_column_is_a_distribution() {
        let table = table(true);
        for predicted in [0, 5, 100, 399, 400] {
            let sum: f32 = (0..=table.most)
                .map(|observed| table.row(observed)[predicted].exp())
                .sum();
            assert!((sum - 1.0).abs() < 1e-4, "{predicted}: {sum}");
        }
    }

    #[test]
    fn short_readings_sit_at_zero_unless_mended() {
        let at = |table: &SensorTable, observed: u16| table.row(observed)[200].exp();
        assert!(at(&table(true), 0) > 1000.0 * at(&table(true), 50));
        assert!(at(&table(false), 0) < 10.0 * at(&table(false), 50));
    }

    #[test]
    fn no_return_is_the_last_cell() {
        let table = table(true);
        for range in [f32::NAN, f32::INFINITY, 65.533, 20.0] {
            assert_eq!(table.cell(range), 400, "{range}");
        }
        assert_eq!(
            (table.cell(-1.0), table.cell(0.049), table.cell(0.051)),
            (0, 0, 1)
        );
    }
}
