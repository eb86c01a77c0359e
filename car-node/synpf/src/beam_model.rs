//! The beam model (Probabilistic Robotics, table 6.1): a measured range against the one that the map predicts.

use maps::{DistanceField, Pose};
use wide::f32x8;

use crate::beam_layout::MOST_BEAMS;
use crate::cddt::DIRECTIONS;
use crate::particles::Particles;
use crate::pose_array::{PoseArray, load};
use crate::preprocessed_scan::Beam;
use crate::range_table::{RangeTable, UNIT};
use crate::ranges::Ranges;
use crate::sensor_parameters::SensorParameters;

/// A step of the model is this power of two of the range table's units: 2 cm.
const STEP_SHIFT: u32 = 3;

/// Length of a step \[m\].
const STEP: f64 = UNIT as f64 * (1 << STEP_SHIFT) as f64;

/// Possible lengths of a row: up to 20 m, 41 m, and the most that 16 bits hold. A length known at compile time saves the
/// bounds check of each look-up.
const ROW_LENGTHS: [usize; 3] = [1024, 2048, 1 << (16 - STEP_SHIFT)];

/// The beam model as a table of log-likelihoods, `[measured][predicted]` in steps of 2 cm.
#[derive(Debug, Clone)]
pub(crate) struct BeamModel {
    /// Steps up to the greatest range, which is the last.
    steps: usize,
    /// Length of a row: one of [`ROW_LENGTHS`], the rest filled with the last step's value.
    length: usize,
    rows: Vec<f32>,
    /// The log-likelihood per beam of a particle outside the track: a tenth of that of a random range.
    off_track: f32,
}

impl BeamModel {
    /// Computes the table.
    pub(crate) fn new(parameters: &SensorParameters) -> Self {
        let steps = (parameters.max_range / STEP).round() as usize + 1;
        let [z_hit, z_short, z_max, z_rand] = parameters.mixture();
        let sigma_hit = parameters.sigma_hit;
        let lambda = parameters.lambda_short;
        let squash = 1.0 / parameters.squash_factor;
        // Probabilities per step, so that the four modes can be added up.
        let gauss: Vec<f64> = (0..steps)
            .map(|k| {
                let deviation = k as f64 * STEP / sigma_hit;
                (-0.5 * deviation * deviation).exp() * STEP / (sigma_hit * std::f64::consts::TAU.sqrt())
            })
            .collect();
        let short: Vec<f64> = (0..steps)
            .map(|k| lambda * STEP * (-lambda * k as f64 * STEP).exp())
            .collect();
        // Normalisers per predicted range: a hit is somewhere in [0, max], a short reading in [0, predicted].
        let mut below = vec![0.0; steps + 1];
        for (k, value) in gauss.iter().enumerate() {
            below[k + 1] = below[k] + value;
        }
        let hit_scale: Vec<f64> = (0..steps)
            .map(|predicted| z_hit / (below[predicted + 1] + below[steps - predicted] - gauss[0]).max(1e-9))
            .collect();
        let mut nearer = 0.0;
        let short_scale: Vec<f64> = short
            .iter()
            .map(|value| {
                nearer += value;
                z_short / nearer
            })
            .collect();
        let uniform = z_rand / steps as f64;
        let length = ROW_LENGTHS.into_iter().find(|length| steps <= *length);
        let length = length.unwrap_or(ROW_LENGTHS[2]);
        let mut rows = vec![0.0f32; steps * length];
        for (measured, row) in rows.chunks_exact_mut(length).enumerate() {
            let none = if measured + 1 == steps { z_max } else { 0.0 };
            for (predicted, value) in row[..steps].iter_mut().enumerate() {
                let mut p = uniform + none + hit_scale[predicted] * gauss[measured.abs_diff(predicted)];
                if measured <= predicted {
                    p += short_scale[predicted] * short[measured];
                }
                *value = (p as f32).ln() * squash as f32;
            }
            let last = row[steps - 1];
            row[steps..].fill(last);
        }
        let off_track = (uniform * 0.1).ln() * squash;
        Self {
            steps,
            length,
            rows,
            off_track: off_track as f32,
        }
    }

    /// Adds the log-likelihood of `beams`, at most [`MOST_BEAMS`], to every particle's log-weight.
    pub(crate) fn reweight(
        &self,
        particles: &mut Particles,
        beams: &[Beam],
        field: &DistanceField,
        ranges: &Ranges,
        base_link_from_laser: Pose,
    ) {
        let laser = Laser::new(base_link_from_laser, field.resolution());
        match ranges {
            Ranges::Table(table) => match self.row_length() {
                1024 => reweight_by_table::<1024>(particles, beams, &laser, table, self),
                2048 => reweight_by_table::<2048>(particles, beams, &laser, table, self),
                _ => reweight_by_table::<{ ROW_LENGTHS[2] }>(particles, beams, &laser, table, self),
            },
            Ranges::RayMarching | Ranges::Interim => {
                reweight_by_casting(particles, beams, &laser, field, self, |from, angle, longest| {
                    field.trace(from, [angle.cos(), angle.sin()], longest)
                });
            }
            Ranges::Exact(grid) => {
                let resolution = grid.resolution;
                reweight_by_casting(particles, beams, &laser, field, self, |from, angle, longest| {
                    let [x, y] = from.map(|cells| f64::from(cells) * resolution);
                    let laser = grid.origin * Pose::new(x, y, angle.into());
                    (grid.cast(laser, f64::from(longest) * resolution) / resolution) as f32
                });
            }
            #[cfg(feature = "gpu")]
            Ranges::Gpu(map) => {
                if self.reweight_by_gpu(particles, beams, &laser, map).is_err() {
                    // The card has failed since the set was accepted. From now on the rays are marched here.
                    self.reweight(
                        particles,
                        beams,
                        field,
                        &Ranges::RayMarching,
                        base_link_from_laser,
                    );
                }
            }
            Ranges::Cddt(cddt) => {
                reweight_by_casting(particles, beams, &laser, field, self, |from, angle, longest| {
                    cddt.range(from, angle, longest)
                });
            }
        }
    }

    /// Adds the log-likelihoods that a graphics card computes; nothing if it fails.
    #[cfg(feature = "gpu")]
    fn reweight_by_gpu(
        &self,
        particles: &mut Particles,
        beams: &[Beam],
        laser: &Laser,
        map: &crate::gpu::GpuMap,
    ) -> Result<(), crate::gpu::GpuError> {
        let direction = |beam: &Beam| {
            let (sin, cos) = (beam.angle + laser.heading).sin_cos();
            [cos, sin]
        };
        let weighed = crate::gpu::WeighedBeams {
            directions: beams.iter().map(direction).collect(),
            rows: beams
                .iter()
                .map(|beam| &self.row(beam.range)[..self.steps])
                .collect(),
            off_track: self.off_track * beams.len() as f32,
            laser: laser.at,
            longest: self.reach() * laser.cells,
            steps_per_cell: 1.0 / (laser.cells * STEP as f32),
        };
        let poses = &particles.poses;
        let pose = |i: usize| {
            let (c, s) = (poses.cos()[i], poses.sin()[i]);
            [poses.x()[i] * laser.cells, poses.y()[i] * laser.cells, c, s]
        };
        let mut sums = Vec::with_capacity(poses.len());
        map.weigh(poses.len(), pose, &weighed, |part| sums.extend_from_slice(part))?;
        for (log_weight, sum) in particles.log_weight.iter_mut().zip(sums) {
            *log_weight += sum;
        }
        Ok(())
    }

    /// The density of a measured range where the map predicts `predicted` \[m\]: ranges \[m\] with the density \[1/m\], without
    /// `squash`; the last one is no return.
    pub(crate) fn density(&self, predicted: f64, squash: f64) -> Vec<[f64; 2]> {
        let column = ((predicted / STEP) as usize).min(self.steps - 1);
        let density = |step: usize| (f64::from(self.rows[step * self.length + column]) * squash).exp() / STEP;
        (0..self.steps)
            .map(|step| [step as f64 * STEP, density(step)])
            .collect()
    }

    /// The row for a measured range \[m\]; infinite for no return. `N` is [`BeamModel::row_length`].
    fn fixed_row<const N: usize>(&self, measured: f32) -> &[f32; N] {
        self.row(measured).try_into().expect("N is the rows' length")
    }

    /// The row for a measured range \[m\]; infinite for no return.
    fn row(&self, measured: f32) -> &[f32] {
        let step = ((f64::from(measured) / STEP).round() as usize).min(self.steps - 1);
        &self.rows[step * self.length..(step + 1) * self.length]
    }

    /// The length of a row.
    fn row_length(&self) -> usize {
        self.length
    }

    /// The greatest range that differs from no return \[m\].
    fn reach(&self) -> f32 {
        ((self.steps - 1) as f64 * STEP) as f32
    }

    /// The step of a predicted range in cells of `resolution` \[m\].
    fn step_of(&self, cells: f32, resolution: f32) -> usize {
        ((cells * resolution / STEP as f32) as usize).min(self.steps - 1)
    }
}

/// The mount of the laser on `base_link`, in cells.
struct Laser {
    /// Cells per metre.
    cells: f32,
    /// Position \[cells\].
    at: [f32; 2],
    /// Heading \[rad\].
    heading: f32,
}

impl Laser {
    fn new(base_link_from_laser: Pose, resolution: f64) -> Self {
        let cells = 1.0 / resolution as f32;
        Self {
            cells,
            at: [
                base_link_from_laser.x as f32 * cells,
                base_link_from_laser.y as f32 * cells,
            ],
            heading: base_link_from_laser.heading as f32,
        }
    }

    /// Position of the laser of particle `i` in the grid \[cells\].
    #[inline]
    fn of(&self, poses: &PoseArray, i: usize) -> [f32; 2] {
        let (c, s) = (poses.cos()[i], poses.sin()[i]);
        let [x, y] = self.at;
        [
            poses.x()[i] * self.cells + x * c - y * s,
            poses.y()[i] * self.cells + x * s + y * c,
        ]
    }
}

/// Adds the log-likelihoods of ranges from the table. `N` is the length of the model's rows.
fn reweight_by_table<const N: usize>(
    particles: &mut Particles,
    beams: &[Beam],
    laser: &Laser,
    table: &RangeTable,
    model: &BeamModel,
) {
    let per_turn = DIRECTIONS as f32 / std::f32::consts::TAU;
    let mut rows = [model.fixed_row::<N>(0.0); MOST_BEAMS];
    let mut offsets = [0usize; MOST_BEAMS];
    for ((row, offset), beam) in rows.iter_mut().zip(&mut offsets).zip(beams) {
        *row = model.fixed_row(beam.range);
        // Rounded here; the particle's own part is rounded in the loop.
        *offset = ((beam.angle + laser.heading) * per_turn)
            .round()
            .rem_euclid(DIRECTIONS as f32) as usize;
    }
    let (pairs, odd_row) = rows[..beams.len()].as_chunks::<2>();
    let (pair_offsets, odd_offset) = offsets[..beams.len()].as_chunks::<2>();
    let odd = odd_row.first().zip(odd_offset.first());
    let off_track = model.off_track * beams.len() as f32;
    let (poses, log_weights) = (&particles.poses, &mut particles.log_weight);
    // Rows and directions are computed for eight particles at once.
    for begin in (0..poses.len()).step_by(8) {
        let lanes = 8.min(poses.len() - begin);
        let (c, s) = (
            load(&poses.cos()[begin..], lanes),
            load(&poses.sin()[begin..], lanes),
        );
        let (x, y) = (load(&poses.x()[begin..], lanes), load(&poses.y()[begin..], lanes));
        let [lx, ly] = laser.at.map(f32x8::splat);
        let cells = f32x8::splat(laser.cells);
        let rows_at = table.rows_at(x * cells + lx * c - ly * s, y * cells + lx * s + ly * c);
        let turned = load(&poses.heading()[begin..], lanes) * f32x8::splat(per_turn);
        let bases = (turned + f32x8::splat(DIRECTIONS as f32 + 0.5))
            .fast_trunc_int()
            .to_array();
        for (k, log_weight) in log_weights[begin..begin + lanes].iter_mut().enumerate() {
            let Some(ranges) = table.row(rows_at[k]) else {
                *log_weight += off_track;
                continue;
            };
            let base = bases[k] as usize;
            let likelihood = |row: &[f32; N], offset: usize| {
                let range = ranges[(base + offset) & (DIRECTIONS - 1)] >> STEP_SHIFT;
                row[usize::from(range).min(N - 1)]
            };
            // Two sums, so that consecutive additions do not depend on each other.
            let mut sums = [0.0; 2];
            for (rows, offsets) in pairs.iter().zip(pair_offsets) {
                sums[0] += likelihood(rows[0], offsets[0]);
                sums[1] += likelihood(rows[1], offsets[1]);
            }
            if let Some((row, offset)) = odd {
                sums[0] += likelihood(row, *offset);
            }
            *log_weight += sums[0] + sums[1];
        }
    }
}

/// Adds the log-likelihoods of ranges that `cast` computes from a point \[cells\] along an angle \[rad\], up to a longest
/// range \[cells\].
fn reweight_by_casting(
    particles: &mut Particles,
    beams: &[Beam],
    laser: &Laser,
    field: &DistanceField,
    model: &BeamModel,
    cast: impl Fn([f32; 2], f32, f32) -> f32,
) {
    let resolution = 1.0 / laser.cells;
    let longest = model.reach() * laser.cells;
    let mut rows = [model.row(0.0); MOST_BEAMS];
    for (row, beam) in rows.iter_mut().zip(beams) {
        *row = model.row(beam.range);
    }
    for i in 0..particles.len() {
        let at = laser.of(&particles.poses, i);
        let inside = field.nearest(at[0], at[1]).is_some_and(|distance| distance > 0.0);
        particles.log_weight[i] += if inside {
            let heading = particles.poses.heading()[i] + laser.heading;
            let likelihood = |(row, beam): (&&[f32], &Beam)| {
                row[model.step_of(cast(at, heading + beam.angle, longest), resolution)]
            };
            rows.iter().zip(beams).map(likelihood).sum::<f32>()
        } else {
            model.off_track * beams.len() as f32
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> BeamModel {
        let parameters = SensorParameters {
            squash_factor: 1.0,
            ..SensorParameters::default()
        };
        BeamModel::new(&parameters)
    }

    #[test]
    fn every_column_is_a_distribution() {
        let model = model();
        for predicted in [0, 5, 100, 500, model.steps - 1] {
            let sum: f32 = (0..model.steps)
                .map(|measured| model.rows[measured * model.length + predicted].exp())
                .sum();
            assert!((sum - 1.0).abs() < 0.01, "{predicted}: {sum}");
        }
    }

    #[test]
    fn the_wall_is_likelier_than_before_it_and_that_than_behind_it() {
        let model = model();
        let at = |measured: f32| model.row(measured)[model.step_of(100.0, 0.05)];
        assert!(at(5.0) > at(3.0) && at(3.0) > at(7.0));
        assert!(at(f32::INFINITY) > at(7.0), "no return has a share of its own");
    }
}
