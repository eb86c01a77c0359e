//! Standard normal numbers at the price of a load.

use rand::RngExt;
use rand::rngs::SmallRng;

/// Standard normal numbers in random order; a draw takes consecutive ones from a random place.
///
/// Drawing three numbers per particle and update would cost as much as weighing the particle. The pool costs a load. Its
/// numbers are the quantiles at equal steps, so their distribution is exactly normal. It repeats after 65536 numbers.
#[derive(Debug, Clone)]
pub(crate) struct NormalPool(Vec<f32>);

/// Numbers in the pool.
pub(crate) const POOL: usize = 1 << 16;

impl NormalPool {
    /// Shuffles the numbers.
    pub(crate) fn new(rng: &mut SmallRng) -> Self {
        let mut pool: Vec<f32> = (0..POOL)
            .map(|i| inverse_normal((i as f64 + 0.5) / POOL as f64) as f32)
            .collect();
        for i in (1..POOL).rev() {
            pool.swap(i, rng.random_range(0..=i));
        }
        Self(pool)
    }

    /// `count` numbers, at most [`POOL`] / 2, from a random place.
    pub(crate) fn draw(&self, rng: &mut SmallRng, count: usize) -> &[f32] {
        let start = rng.random_range(0..=POOL - count);
        &self.0[start..start + count]
    }
}

/// The quantile of the standard normal at `p` in (0, 1), to 1e-9 (Acklam's rational approximation).
fn inverse_normal(p: f64) -> f64 {
    const A: [f64; 6] = [
        -39.696_830_286_653_76,
        220.946_098_424_520_5,
        -275.928_510_446_968_7,
        138.357_751_867_269,
        -30.664_798_066_147_16,
        2.506_628_277_459_239,
    ];
    const B: [f64; 5] = [
        -54.476_098_798_224_06,
        161.585_836_858_040_9,
        -155.698_979_859_886_6,
        66.801_311_887_719_72,
        -13.280_681_552_885_72,
    ];
    const C: [f64; 6] = [
        -0.007_784_894_002_430_293,
        -0.322_396_458_041_136_5,
        -2.400_758_277_161_838,
        -2.549_732_539_343_734,
        4.374_664_141_464_968,
        2.938_163_982_698_783,
    ];
    const D: [f64; 4] = [
        0.007_784_695_709_041_462,
        0.322_467_129_070_039_8,
        2.445_134_137_142_996,
        3.754_408_661_907_416,
    ];
    let polynomial = |coefficients: &[f64], x: f64| coefficients.iter().fold(0.0, |sum, c| sum * x + c);
    let tail = |q: f64| polynomial(&C, q) / (polynomial(&D, q) * q + 1.0);
    if p < 0.024_25 {
        tail((-2.0 * p.ln()).sqrt())
    } else if p > 1.0 - 0.024_25 {
        -tail((-2.0 * (1.0 - p).ln()).sqrt())
    } else {
        let q = p - 0.5;
        let r = q * q;
        polynomial(&A, r) * q / (polynomial(&B, r) * r + 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn the_pool_is_standard_normal() {
        let pool = NormalPool::new(&mut SmallRng::seed_from_u64(1));
        let mean = pool.0.iter().map(|&v| f64::from(v)).sum::<f64>() / POOL as f64;
        let variance = pool.0.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>() / POOL as f64;
        assert!(
            mean.abs() < 1e-6 && (variance - 1.0).abs() < 1e-3,
            "{mean} {variance}"
        );
        assert!((inverse_normal(0.975) - 1.959_964).abs() < 1e-6);
    }
}
