//! Symmetric linear equations around a closed line. Each unknown is coupled with the two on either side of it.

/// Fewest unknowns. With fewer, the neighbours on both sides would be the same.
pub(crate) const LEAST: usize = 5;

/// A symmetric matrix with two diagonals on either side of the main one, closed to a ring.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Ring {
    /// `[i][k]`: the entry of row `i` and column `(i + k) % n`.
    rows: Vec<[f64; 3]>,
}

impl Ring {
    /// `value` times the identity, of `n` rows, at least [`LEAST`].
    pub(crate) fn diagonal(n: usize, value: f64) -> Self {
        assert!(n >= LEAST, "{n} unknowns are no ring");
        Self {
            rows: vec![[value, 0.0, 0.0]; n],
        }
    }

    /// Adds `w w^T` for the row vector that has the values `w` at `first` and the two after it.
    pub(crate) fn add_square(&mut self, first: usize, w: [f64; 3]) {
        let n = self.rows.len();
        for a in 0..3 {
            for b in a..3 {
                self.rows[(first + a) % n][b - a] += w[a] * w[b];
            }
        }
    }

    /// The matrix times a vector.
    pub(crate) fn times(&self, x: &[f64]) -> Vec<f64> {
        let n = self.rows.len();
        (0..n)
            .map(|i| {
                let (one, two) = ((i + n - 1) % n, (i + n - 2) % n);
                self.rows[i][0] * x[i]
                    + self.rows[i][1] * x[(i + 1) % n]
                    + self.rows[i][2] * x[(i + 2) % n]
                    + self.rows[one][1] * x[one]
                    + self.rows[two][2] * x[two]
            })
            .collect()
    }

    /// Solves for the unknowns that are not `held`; held ones are zero. None unless the matrix is positive definite.
    ///
    /// The last two unknowns close the ring. Without them the matrix is banded, and so is its Cholesky factor. The two
    /// follow from the Schur complement (Golub and Van Loan, *Matrix Computations*, sections 4.3 and 3.2). The number of
    /// steps grows with the number of unknowns.
    pub(crate) fn solve(&self, right: &[f64], held: &[bool]) -> Option<Vec<f64>> {
        let n = self.rows.len();
        let m = n - 2;
        let entry = |i: usize, k: usize| match (held[i], held[(i + k) % n]) {
            (true, _) if k == 0 => 1.0,
            (false, false) => self.rows[i][k],
            _ => 0.0,
        };
        // The band's factor, by rows: L[i][i], L[i][i-1], L[i][i-2].
        let mut factor: Vec<[f64; 3]> = Vec::with_capacity(m);
        for i in 0..m {
            let two = if i >= 2 {
                entry(i - 2, 2) / factor[i - 2][0]
            } else {
                0.0
            };
            let one = if i >= 1 {
                (entry(i - 1, 1) - two * factor[i - 1][1]) / factor[i - 1][0]
            } else {
                0.0
            };
            let square = entry(i, 0) - one * one - two * two;
            factor.push([root(square)?, one, two]);
        }
        let band = |mut x: Vec<f64>| {
            for i in 0..m {
                let [own, one, two] = factor[i];
                let back = |k: usize, l: f64| if i >= k { l * x[i - k] } else { 0.0 };
                x[i] = (x[i] - back(1, one) - back(2, two)) / own;
            }
            for i in (0..m).rev() {
                let ahead = |k: usize| {
                    if i + k < m {
                        factor[i + k][k] * x[i + k]
                    } else {
                        0.0
                    }
                };
                x[i] = (x[i] - ahead(1) - ahead(2)) / factor[i][0];
            }
            x
        };
        let right: Vec<f64> = (0..n).map(|i| if held[i] { 0.0 } else { right[i] }).collect();
        // Columns that couple the band with the last two.
        let couple = [m, m + 1].map(|last| {
            let mut column = vec![0.0; m];
            for k in 1..=2 {
                if last - k < m {
                    column[last - k] += entry(last - k, k);
                }
                if (last + k) % n < m {
                    column[(last + k) % n] += entry(last, k);
                }
            }
            column
        });
        let through = couple.clone().map(band);
        let alone = band(right[..m].to_vec());
        let dot = |a: &[f64], b: &[f64]| -> f64 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
        let s00 = entry(m, 0) - dot(&couple[0], &through[0]);
        let s01 = entry(m, 1) - dot(&couple[0], &through[1]);
        let s11 = entry(m + 1, 0) - dot(&couple[1], &through[1]);
        let [t0, t1] = [0, 1].map(|k| right[m + k] - dot(&couple[k], &alone));
        let determinant = s00 * s11 - s01 * s01;
        root(s00.min(determinant))?;
        let last = [
            (s11 * t0 - s01 * t1) / determinant,
            (s00 * t1 - s01 * t0) / determinant,
        ];
        let mut solution: Vec<f64> = (0..m)
            .map(|i| alone[i] - through[0][i] * last[0] - through[1][i] * last[1])
            .collect();
        solution.extend(last);
        Some(solution)
    }
}

/// The root of a number that is positive.
fn root(square: f64) -> Option<f64> {
    (square > 0.0).then(|| square.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use rand::rngs::StdRng;
    use rand::{RngExt, SeedableRng};

    /// A ring of random squares, and the same as a dense matrix.
    fn random(n: usize, rng: &mut StdRng) -> (Ring, DMatrix<f64>) {
        let mut ring = Ring::diagonal(n, 1e-3);
        let mut dense = DMatrix::identity(n, n) * 1e-3;
        for first in 0..n {
            let w: [f64; 3] = std::array::from_fn(|_| rng.random::<f64>() - 0.5);
            ring.add_square(first, w);
            for a in 0..3 {
                for b in 0..3 {
                    dense[((first + a) % n, (first + b) % n)] += w[a] * w[b];
                }
            }
        }
        (ring, dense)
    }

    #[test]
    fn solves_what_a_dense_solver_solves() {
        let mut rng = StdRng::seed_from_u64(3);
        for n in [5, 6, 7, 8, 50] {
            for share_held in [0.0, 0.3, 1.0] {
                let (ring, dense) = random(n, &mut rng);
                let right: Vec<f64> = (0..n).map(|_| rng.random::<f64>() - 0.5).collect();
                let held: Vec<bool> = (0..n).map(|_| rng.random::<f64>() < share_held).collect();
                let product = &dense * DVector::from_vec(right.clone());
                for (a, b) in ring.times(&right).iter().zip(&product) {
                    assert!((a - b).abs() < 1e-12, "{n}: {a} {b}");
                }
                let free: Vec<usize> = (0..n).filter(|&i| !held[i]).collect();
                let reduced = DMatrix::from_fn(free.len(), free.len(), |a, b| dense[(free[a], free[b])]);
                let reduced_right = DVector::from_fn(free.len(), |a, _| right[free[a]]);
                let expected = reduced
                    .cholesky()
                    .expect("positive definite")
                    .solve(&reduced_right);
                let found = ring.solve(&right, &held).expect("positive definite");
                for (a, &i) in free.iter().enumerate() {
                    assert!(
                        (found[i] - expected[a]).abs() < 1e-9,
                        "{n}: {} {}",
                        found[i],
                        expected[a]
                    );
                }
                assert!((0..n).all(|i| !held[i] || found[i] == 0.0));
            }
        }
    }

    #[test]
    fn what_has_no_solution_says_so() {
        let nothing = Ring::diagonal(6, 0.0);
        assert_eq!(nothing.solve(&[1.0; 6], &[false; 6]), None);
        let negative = Ring::diagonal(6, -1.0);
        assert_eq!(negative.solve(&[1.0; 6], &[false; 6]), None);
    }
}
