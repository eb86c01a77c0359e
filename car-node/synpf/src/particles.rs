//! The particles: moved, weighed, resampled, summed up.

use maps::Pose;
use nalgebra::Matrix3;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use serde::{Deserialize, Serialize};
use wide::f32x8;

use crate::motion::Motion;
use crate::parameters::Check;

/// How many particles, and when they are resampled.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ParticleParameters {
    /// Most particles in use.
    pub max_particles: usize,
    /// Fewest particles in use.
    pub min_particles: usize,
    /// KLD-sampling: error between the sampled and the true posterior that is allowed (Fox, IJRR 2003).
    pub kld_error: f64,
    /// KLD-sampling: quantile of the standard normal for the probability that it is kept; 2.33 is 99 %.
    pub kld_quantile: f64,
    /// Resample when the effective sample size falls below this share of the particles.
    pub resample_ess_ratio: f64,
    /// Standard deviation of a given initial pose along x [m].
    pub initial_std_x: f64,
    /// Standard deviation of a given initial pose along y [m].
    pub initial_std_y: f64,
    /// Standard deviation of a given initial heading [rad].
    pub initial_std_heading: f64,
}

impl Default for ParticleParameters {
    fn default() -> Self {
        Self {
            max_particles: 1500,
            min_particles: 600,
            kld_error: 0.05,
            kld_quantile: 2.33,
            resample_ess_ratio: 0.5,
            initial_std_x: 0.5,
            initial_std_y: 0.5,
            initial_std_heading: 0.4,
        }
    }
}

impl ParticleParameters {
    pub(crate) fn validate(&self, check: &mut Check) {
        check.range("max_particles", self.max_particles as f64, 10.0, 100_000.0);
        check.range("min_particles", self.min_particles as f64, 10.0, 100_000.0);
        check.that("min_particles", self.min_particles <= self.max_particles, || {
            format!(
                "{} is more than max_particles, {}",
                self.min_particles, self.max_particles
            )
        });
        check.range("kld_error", self.kld_error, 1e-4, 1.0);
        check.range("kld_quantile", self.kld_quantile, 0.0, 6.0);
        check.range("resample_ess_ratio", self.resample_ess_ratio, 0.0, 1.0);
        check.range("initial_std_x", self.initial_std_x, 0.0, 100.0);
        check.range("initial_std_y", self.initial_std_y, 0.0, 100.0);
        check.range("initial_std_heading", self.initial_std_heading, 0.0, 10.0);
    }
}

/// Standard normal numbers in random order, drawn from by stepping through from a random place. Three numbers per
/// particle and update would cost as much as weighing it; the pool costs a load. Its marginal is exactly normal
/// (the inverse of the distribution at equal steps); it repeats after 64 Ki numbers, in another phase each time.
#[derive(Debug, Clone)]
struct NormalPool(Vec<f32>);

const POOL: usize = 1 << 16;

impl NormalPool {
    fn new(rng: &mut SmallRng) -> Self {
        let mut pool: Vec<f32> = (0..POOL)
            .map(|i| inverse_normal((i as f64 + 0.5) / POOL as f64) as f32)
            .collect();
        for i in (1..POOL).rev() {
            pool.swap(i, rng.random_range(0..=i));
        }
        Self(pool)
    }

    /// `count` numbers, at most [`POOL`] / 2, from a random place.
    fn draw(&self, rng: &mut SmallRng, count: usize) -> &[f32] {
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

/// Poses with weights, one array per component, in the grid's frame [m], [rad].
#[derive(Debug, Clone)]
pub(crate) struct Particles {
    pub(crate) x: Vec<f32>,
    pub(crate) y: Vec<f32>,
    pub(crate) heading: Vec<f32>,
    /// Cosine and sine of the heading, kept by [`Particles::advance`].
    pub(crate) cos: Vec<f32>,
    pub(crate) sin: Vec<f32>,
    /// Log-weights; what is weighed is added.
    pub(crate) log_weight: Vec<f32>,
    /// Weights with sum 1, kept by [`Particles::normalize`].
    pub(crate) weight: Vec<f32>,
    pub(crate) rng: SmallRng,
    pool: NormalPool,
    spare: [Vec<f32>; 3],
    /// For resampling: which particle each new one is a copy of.
    copies: Vec<u32>,
    bins: Bins,
}

/// What the particles say together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Belief {
    /// Weighted mean.
    pub(crate) mean: Pose,
    /// Weighted covariance of x, y, heading.
    pub(crate) covariance: Matrix3<f64>,
    /// Effective sample size over the number of particles.
    pub(crate) ess_ratio: f64,
}

impl Particles {
    pub(crate) fn new(seed: u64, capacity: usize) -> Self {
        let mut rng = SmallRng::seed_from_u64(seed);
        let pool = NormalPool::new(&mut rng);
        let array = || Vec::with_capacity(capacity);
        Self {
            x: array(),
            y: array(),
            heading: array(),
            cos: array(),
            sin: array(),
            log_weight: array(),
            weight: array(),
            rng,
            pool,
            spare: [array(), array(), array()],
            copies: Vec::with_capacity(capacity + 4),
            bins: Bins::new(),
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.x.len()
    }

    fn resize(&mut self, count: usize) {
        for array in [
            &mut self.x,
            &mut self.y,
            &mut self.heading,
            &mut self.cos,
            &mut self.sin,
        ] {
            array.resize(count, 0.0);
        }
        self.log_weight.resize(count, 0.0);
        self.weight.resize(count, 1.0 / count as f32);
    }

    /// `count` particles around a pose, with the given standard deviations of x, y [m] and heading [rad].
    pub(crate) fn scatter(&mut self, count: usize, pose: Pose, sigma: [f64; 3]) {
        self.resize(count);
        for i in 0..count {
            let noise = self.pool.draw(&mut self.rng, 3);
            self.x[i] = (pose.x + sigma[0] * f64::from(noise[0])) as f32;
            self.y[i] = (pose.y + sigma[1] * f64::from(noise[1])) as f32;
            self.heading[i] = maps::wrap_angle(pose.heading + sigma[2] * f64::from(noise[2])) as f32;
        }
        self.even_weights();
    }

    fn even_weights(&mut self) {
        self.log_weight.fill(0.0);
        let even = 1.0 / self.len().max(1) as f32;
        self.weight.fill(even);
    }

    /// Moves every particle by its own draw from `motion`.
    pub(crate) fn advance(&mut self, motion: &Motion) {
        const LANES: usize = 8;
        let count = self.len();
        let (Motion::Polar { mean, sigma } | Motion::Body { mean, sigma }) = *motion;
        let polar = matches!(motion, Motion::Polar { .. });
        let mut begin = 0;
        while begin < count {
            // The pool holds enough for a part of the particles at a time.
            let part = (count - begin).min(POOL / 8);
            let draws = part.next_multiple_of(LANES);
            let noise = self.pool.draw(&mut self.rng, 3 * draws);
            for at in (0..part).step_by(LANES) {
                let lanes = LANES.min(part - at);
                let i = begin + at;
                let draw = |component: usize| {
                    let from = component * draws + at;
                    let numbers: [f32; LANES] = noise[from..from + LANES].try_into().expect("eight lanes");
                    f32x8::splat(mean[component]) + f32x8::splat(sigma[component]) * f32x8::from(numbers)
                };
                let (a, b, c) = (draw(0), draw(1), draw(2));
                let heading = load(&self.heading[i..], lanes);
                let (x, y) = (load(&self.x[i..], lanes), load(&self.y[i..], lanes));
                let (x, y, turned) = if polar {
                    let (sin, cos) = (heading + a).sin_cos();
                    (x + b * cos, y + b * sin, heading + a + c)
                } else {
                    let (sin, cos) = heading.sin_cos();
                    (x + a * cos - b * sin, y + a * sin + b * cos, heading + c)
                };
                let turn = f32x8::splat(std::f32::consts::TAU);
                let turns = (turned * f32x8::splat(1.0 / std::f32::consts::TAU)).fast_round_int();
                let wrapped = turned - turn * f32x8::from_i32x8(turns);
                let (sin, cos) = wrapped.sin_cos();
                store(x, &mut self.x[i..], lanes);
                store(y, &mut self.y[i..], lanes);
                store(wrapped, &mut self.heading[i..], lanes);
                store(cos, &mut self.cos[i..], lanes);
                store(sin, &mut self.sin[i..], lanes);
            }
            begin += part;
        }
    }

    /// Weights from log-weights, with sum 1. If every weight is zero, or not a number, all become equal and the
    /// answer is false.
    pub(crate) fn normalize(&mut self) -> bool {
        let greatest = greatest(&self.log_weight);
        if !greatest.is_finite() {
            self.even_weights();
            return false;
        }
        let mut sum = f32x8::ZERO;
        let top = f32x8::splat(greatest);
        let count = self.len();
        for i in (0..count).step_by(8) {
            let lanes = 8.min(count - i);
            // Below e^-80 a weight is nothing; it also keeps infinities out.
            let log = load(&self.log_weight[i..], lanes) - top;
            let mut weight = log.max(f32x8::splat(-80.0)).exp();
            if lanes < 8 {
                let mut kept = weight.to_array();
                kept[lanes..].fill(0.0);
                weight = f32x8::from(kept);
            }
            sum += weight;
            store(weight, &mut self.weight[i..], lanes);
        }
        let scale = 1.0 / sum.reduce_add();
        self.weight.iter_mut().for_each(|weight| *weight *= scale);
        true
    }

    /// Mean, covariance and effective sample size; headings by sine and cosine.
    pub(crate) fn belief(&self) -> Belief {
        // Sums of eight lanes about the first particle, so that f32 is enough for a track of kilometres.
        let [x0, y0] = [self.x[0], self.y[0]];
        let mut sums = [f32x8::ZERO; 9];
        let count = self.len();
        for i in (0..count).step_by(8) {
            let lanes = 8.min(count - i);
            let w = load(&self.weight[i..], lanes);
            let (x, y) = (
                load(&self.x[i..], lanes) - f32x8::splat(x0),
                load(&self.y[i..], lanes) - f32x8::splat(y0),
            );
            let (c, s) = (load(&self.cos[i..], lanes), load(&self.sin[i..], lanes));
            let (wx, wy) = (w * x, w * y);
            for (sum, term) in sums
                .iter_mut()
                .zip([w, wx, wy, w * c, w * s, wx * x, wy * y, wx * y, w * w])
            {
                *sum += term;
            }
        }
        let [w, x, y, c, s, xx, yy, xy, ww] = sums.map(|sum| f64::from(sum.reduce_add()));
        let w = w.max(1e-12);
        let (mx, my) = (x / w, y / w);
        let mean = Pose::new(mx + f64::from(x0), my + f64::from(y0), s.atan2(c));
        // Headings about their mean, as sines: for what is localized the sine of a deviation is the deviation.
        let (sin, cos) = (
            f32x8::splat(mean.heading.sin() as f32),
            f32x8::splat(mean.heading.cos() as f32),
        );
        let (fx, fy) = (f32x8::splat(mean.x as f32), f32x8::splat(mean.y as f32));
        let mut about = [f32x8::ZERO; 3];
        for i in (0..count).step_by(8) {
            let lanes = 8.min(count - i);
            let off = load(&self.sin[i..], lanes) * cos - load(&self.cos[i..], lanes) * sin;
            let weighed = off * load(&self.weight[i..], lanes);
            about[0] += weighed * (load(&self.x[i..], lanes) - fx);
            about[1] += weighed * (load(&self.y[i..], lanes) - fy);
            about[2] += weighed * off;
        }
        let [xh, yh, hh] = about.map(|sum| f64::from(sum.reduce_add()) / w);
        // For a cloud that looks everywhere, the circular variance.
        let resultant = (c.hypot(s) / w).max(1e-6);
        let heading_variance = if resultant > 0.98 {
            hh
        } else {
            -2.0 * resultant.ln()
        };
        let (xx, yy, xy) = (
            (xx / w - mx * mx).max(0.0),
            (yy / w - my * my).max(0.0),
            xy / w - mx * my,
        );
        let covariance = Matrix3::new(xx, xy, xh, xy, yy, yh, xh, yh, heading_variance);
        Belief {
            mean,
            covariance,
            ess_ratio: (w * w / (ww.max(1e-12) * count as f64)).clamp(0.0, 1.0),
        }
    }

    /// How many particles the spread asks for (KLD-sampling; Fox, IJRR 2003, equation 7).
    pub(crate) fn wanted(&mut self, parameters: &ParticleParameters) -> usize {
        if parameters.min_particles == parameters.max_particles {
            return parameters.max_particles;
        }
        let most = parameters.max_particles;
        let occupied = self.bins.count(&self.x, &self.y, &self.heading, &self.weight);
        if occupied < 2 {
            return parameters.min_particles;
        }
        let free = (occupied - 1) as f64;
        let a = 2.0 / (9.0 * free);
        let root = 1.0 - a + a.sqrt() * parameters.kld_quantile;
        let wanted = (free / (2.0 * parameters.kld_error) * root.powi(3)).ceil() as usize;
        wanted.clamp(parameters.min_particles, most)
    }

    /// Systematic resampling (Probabilistic Robotics, table 4.4) to `count` particles of equal weight.
    pub(crate) fn resample(&mut self, count: usize) {
        // Particle i gets the copies up to where its share of the sum ends. Which particle each copy is of is written
        // four at a time and then overwritten, because most particles get fewer, and a loop would be guessed wrongly.
        const AT_ONCE: usize = 4;
        self.copies.clear();
        self.copies.resize(count + AT_ONCE, 0);
        let offset = self.rng.random::<f64>();
        let (mut sum, mut begin) = (0.0, 0);
        for (i, &weight) in self.weight.iter().enumerate() {
            sum += f64::from(weight);
            let end = ((sum * count as f64 - offset + 1.0) as usize).min(count);
            let some: &mut [u32; AT_ONCE] = (&mut self.copies[begin..begin + AT_ONCE])
                .try_into()
                .expect("as many as asked for");
            *some = [i as u32; AT_ONCE];
            if end > begin + AT_ONCE {
                self.copies[begin + AT_ONCE..end].fill(i as u32);
            }
            begin = end.max(begin);
        }
        // What rounding leaves over is the last one's.
        let last = self.len() as u32 - 1;
        self.copies[begin..].fill(last);
        let [x, y, heading] = &mut self.spare;
        for (to, from) in [
            (&mut *x, &self.x),
            (&mut *y, &self.y),
            (&mut *heading, &self.heading),
        ] {
            to.clear();
            to.extend(self.copies[..count].iter().map(|&i| from[i as usize]));
        }
        std::mem::swap(&mut self.x, x);
        std::mem::swap(&mut self.y, y);
        std::mem::swap(&mut self.heading, heading);
        self.resize(count);
        self.even_weights();
    }

    /// Replaces particle `i`; its weight becomes the mean weight.
    pub(crate) fn replace(&mut self, i: usize, pose: Pose) {
        self.x[i] = pose.x as f32;
        self.y[i] = pose.y as f32;
        self.heading[i] = pose.heading as f32;
        self.cos[i] = pose.heading.cos() as f32;
        self.sin[i] = pose.heading.sin() as f32;
    }

    /// Draws from a normal distribution around a pose, by the lower triangular root of its covariance.
    pub(crate) fn draw(&mut self, pose: Pose, root: &Matrix3<f64>) -> Pose {
        let noise = self.pool.draw(&mut self.rng, 3);
        let off = root * nalgebra::Vector3::new(noise[0].into(), noise[1].into(), noise[2].into());
        Pose::new(pose.x + off[0], pose.y + off[1], pose.heading + off[2])
    }

    /// Mass of the second cluster over that of the first, among clusters of 0.5 m and 20 deg.
    pub(crate) fn second_mode(&mut self) -> f64 {
        self.bins
            .second_mode(&self.x, &self.y, &self.heading, &self.weight)
    }
}

/// The greatest of the values that are numbers; minus infinity of none.
fn greatest(values: &[f32]) -> f32 {
    let (eights, rest) = values.as_chunks::<8>();
    let mut most = [f32::NEG_INFINITY; 8];
    for eight in eights {
        for (most, &value) in most.iter_mut().zip(eight) {
            // Not `f32::max`: this compiles to one instruction for four, and leaves NaN out as well.
            *most = if value > *most { value } else { *most };
        }
    }
    most.into_iter()
        .chain(rest.iter().copied())
        .fold(f32::NEG_INFINITY, f32::max)
}

/// Eight lanes of which the first `lanes` are the values' and the rest 0.
#[inline]
pub(crate) fn load(values: &[f32], lanes: usize) -> f32x8 {
    if lanes == 8 {
        f32x8::from(<[f32; 8]>::try_from(&values[..8]).expect("eight lanes"))
    } else {
        let mut some = [0.0; 8];
        some[..lanes].copy_from_slice(&values[..lanes]);
        f32x8::from(some)
    }
}

#[inline]
fn store(value: f32x8, to: &mut [f32], lanes: usize) {
    // A length that is known is a store; one that is not, a call.
    if lanes == 8 {
        to[..8].copy_from_slice(value.as_array());
    } else {
        to[..lanes].copy_from_slice(&value.as_array()[..lanes]);
    }
}

/// A hash table of the bins that particles fall into, emptied by counting up.
#[derive(Debug, Clone)]
struct Bins {
    /// The bin, the generation and the mass.
    slots: Vec<(u64, u32, f32)>,
    generation: u32,
}

const SLOTS: usize = 1 << 13;

impl Bins {
    fn new() -> Self {
        Self {
            slots: vec![(0, 0, 0.0); SLOTS],
            generation: 0,
        }
    }

    fn clear(&mut self) {
        self.generation = self.generation.wrapping_add(1);
        if self.generation == 0 {
            self.slots.fill((0, 0, 0.0));
            self.generation = 1;
        }
    }

    /// Adds mass to a bin; true if it is new. A full table takes no more.
    fn add(&mut self, key: u64, mass: f32) -> bool {
        let mut slot = (key.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 51) as usize % SLOTS;
        for _ in 0..64 {
            let entry = &mut self.slots[slot];
            if entry.1 != self.generation {
                *entry = (key, self.generation, mass);
                return true;
            }
            if entry.0 == key {
                entry.2 += mass;
                return false;
            }
            slot = (slot + 1) % SLOTS;
        }
        false
    }

    /// Bins of 0.25 m and 10 deg with particles that weigh something.
    fn count(&mut self, x: &[f32], y: &[f32], heading: &[f32], weight: &[f32]) -> usize {
        self.clear();
        let least = 1e-3 / x.len() as f32;
        let mut occupied = 0;
        for i in (0..x.len()).filter(|&i| weight[i] > least) {
            let key = bin_key(x[i] / 0.25, y[i] / 0.25, heading[i] / 10f32.to_radians());
            occupied += usize::from(self.add(key, weight[i]));
        }
        occupied
    }

    fn second_mode(&mut self, x: &[f32], y: &[f32], heading: &[f32], weight: &[f32]) -> f64 {
        self.clear();
        for i in 0..x.len() {
            self.add(
                bin_key(x[i] / 0.5, y[i] / 0.5, heading[i] / 20f32.to_radians()),
                weight[i],
            );
        }
        let generation = self.generation;
        let full = |slot: &&(u64, u32, f32)| slot.1 == generation;
        // A cluster is a heaviest bin with those that touch it: its mass falls into all of them.
        let heaviest = |without: Option<u64>| {
            let free = |key: u64| without.is_none_or(|taken| !touch(key, taken));
            let bins = || self.slots.iter().filter(full).filter(|slot| free(slot.0));
            let centre = bins().max_by(|a, b| a.2.total_cmp(&b.2))?.0;
            let mass: f32 = bins()
                .filter(|slot| touch(slot.0, centre))
                .map(|slot| slot.2)
                .sum();
            Some((centre, mass))
        };
        let Some((centre, first)) = heaviest(None) else {
            return 0.0;
        };
        let second = heaviest(Some(centre)).map_or(0.0, |(_, mass)| mass);
        f64::from(first.min(second) / first.max(second).max(1e-9))
    }
}

/// Whether two bins are one or neighbours; headings come around after 18 bins of 20 deg.
fn touch(a: u64, b: u64) -> bool {
    let parts = |key: u64| [key >> 40, (key >> 16) & 0xFF_FFFF, key & 0xFFFF].map(|v| v as i64);
    let (a, b) = (parts(a), parts(b));
    let turn = (a[2] - b[2]).rem_euclid(18).min((b[2] - a[2]).rem_euclid(18));
    (a[0] - b[0]).abs() <= 1 && (a[1] - b[1]).abs() <= 1 && turn <= 1
}

fn bin_key(x: f32, y: f32, heading: f32) -> u64 {
    let place = |v: f32| (v.floor() as i64 + (1 << 22)) as u64 & 0xFF_FFFF;
    (place(x) << 40) | (place(y) << 16) | ((heading.floor() as i64 + (1 << 14)) as u64 & 0xFFFF)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(count: usize, pose: Pose, sigma: [f64; 3]) -> Particles {
        let mut particles = Particles::new(7, count);
        particles.scatter(count, pose, sigma);
        particles.advance(&Motion::Body {
            mean: [0.0; 3],
            sigma: [0.0; 3],
        });
        particles
    }

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

    /// 20000 draws: the mean is known to sigma / 141, the variance to 1 %; tolerances are four times that.
    #[test]
    fn the_belief_is_what_was_drawn() {
        let pose = Pose::new(120.0, 40.0, 3.1);
        let belief = cloud(20_000, pose, [0.3, 0.2, 0.1]).belief();
        assert!(belief.mean.distance(pose) < 0.01);
        assert!(maps::wrap_angle(belief.mean.heading - pose.heading).abs() < 0.003);
        for (got, sigma) in belief.covariance.diagonal().iter().zip([0.3f64, 0.2, 0.1]) {
            assert!((got / (sigma * sigma) - 1.0).abs() < 0.04, "{got} {sigma}");
        }
        assert!((belief.ess_ratio - 1.0).abs() < 1e-3);
    }

    #[test]
    fn motion_has_the_mean_and_the_noise_asked_for() {
        let mut particles = cloud(20_001, Pose::new(5.0, 5.0, 1.0), [0.0; 3]);
        particles.advance(&Motion::Polar {
            mean: [0.1, 0.5, 0.2],
            sigma: [0.0, 0.05, 0.02],
        });
        let belief = particles.belief();
        let expected = Pose::new(5.0 + 0.5 * 1.1f64.cos(), 5.0 + 0.5 * 1.1f64.sin(), 1.3);
        assert!(belief.mean.distance(expected) < 0.002, "{belief:?}");
        let along = nalgebra::Vector3::new(1.1f64.cos(), 1.1f64.sin(), 0.0);
        let variance = (along.transpose() * belief.covariance * along)[0];
        assert!((variance.sqrt() / 0.05 - 1.0).abs() < 0.04);
        assert!((belief.covariance[(2, 2)].sqrt() / 0.02 - 1.0).abs() < 0.04);
    }

    #[test]
    fn systematic_resampling_keeps_shares_to_within_one() {
        let mut particles = cloud(4, Pose::IDENTITY, [0.0; 3]);
        for i in 0..4 {
            particles.replace(i, Pose::new(i as f64, 0.0, 0.0));
        }
        particles.weight.copy_from_slice(&[0.1, 0.2, 0.3, 0.4]);
        particles.resample(1000);
        for (i, share) in [100.0, 200.0, 300.0, 400.0].into_iter().enumerate() {
            let count = particles
                .x
                .iter()
                .filter(|&&x| (x - i as f32).abs() < 1e-6)
                .count() as f64;
            assert!((count - share).abs() <= 1.0, "{i}: {count}");
        }
    }

    #[test]
    fn weights_that_mean_nothing_become_even() {
        let mut particles = cloud(100, Pose::IDENTITY, [0.1; 3]);
        for nothing in [f32::NEG_INFINITY, f32::NAN] {
            particles.log_weight.fill(nothing);
            assert!(!particles.normalize());
            assert!(particles.weight.iter().all(|&w| (w - 0.01).abs() < 1e-6));
        }
        particles.log_weight.fill(-1e30);
        particles.log_weight[3] = 0.0;
        assert!(particles.normalize());
        assert!((particles.weight[3] - 1.0).abs() < 1e-3);
    }

    #[test]
    fn a_wide_cloud_asks_for_more_particles() {
        let parameters = ParticleParameters {
            max_particles: 3000,
            ..ParticleParameters::default()
        };
        let narrow = cloud(3000, Pose::IDENTITY, [0.02, 0.02, 0.01]).wanted(&parameters);
        let wide = cloud(3000, Pose::IDENTITY, [1.0, 1.0, 0.5]).wanted(&parameters);
        assert_eq!((narrow, wide), (parameters.min_particles, 3000));
    }

    #[test]
    fn two_clusters_are_seen() {
        let mut particles = cloud(1000, Pose::new(3.0, 3.0, 0.0), [0.02; 3]);
        assert!(particles.second_mode() < 0.01);
        for i in 0..400 {
            particles.replace(i, Pose::new(8.3, 3.3, 0.1));
        }
        assert!((particles.second_mode() - 400.0 / 600.0).abs() < 0.05);
    }
}
