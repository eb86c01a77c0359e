//! The kernel: how well each particle explains the scan.

use std::sync::Arc;

use maps::{DistanceField, Pose};
use wide::f32x8;

use crate::TrackMap;
use crate::beams::{Beam, ReadyScan};
use crate::cddt::Cddt;
use crate::defects::Defects;
use crate::parameters::Parameters;
use crate::particles::{Particles, load};
use crate::range_table::{DIRECTIONS, RangeTable};
use crate::sensor::{BeamModel, LikelihoodField, ROW_LENGTHS, RangeMethod, STEP_SHIFT, SensorModel};

/// A sensor model with its tables; built once per parameter set, away from the filter's loop.
#[derive(Debug, Clone)]
pub(crate) enum Weigher {
    Beam {
        model: Arc<BeamModel>,
        method: RangeMethod,
    },
    Field {
        model: Arc<LikelihoodField>,
    },
}

/// Where ranges come from in the region that the particles are in.
#[derive(Debug, Clone)]
pub(crate) enum Ranges {
    Table(Arc<RangeTable>),
    March,
    Cddt(Arc<Cddt>),
}

/// Beams beyond this are left out; their angles and rows fit on the stack.
const MOST: usize = 128;

impl Weigher {
    pub(crate) fn new(parameters: &Parameters, resolution: f64) -> Self {
        match parameters.sensor.sensor_model {
            SensorModel::Beam => Self::Beam {
                model: Arc::new(BeamModel::new(&parameters.sensor, resolution, parameters.defects)),
                method: parameters.sensor.range_method,
            },
            SensorModel::LikelihoodField => Self::Field {
                model: Arc::new(LikelihoodField::new(&parameters.sensor)),
            },
        }
    }

    /// What predicts ranges in a region of the map.
    pub(crate) fn ranges(&self, map: &TrackMap, region: Option<usize>, parameters: &Parameters) -> Ranges {
        let defects: Defects = parameters.defects;
        match (self, region) {
            (
                Self::Beam {
                    method: RangeMethod::Lut,
                    ..
                },
                Some(region),
            ) => Ranges::Table(map.table(region, parameters.sensor.table_parameters(defects))),
            (
                Self::Beam {
                    method: RangeMethod::Cddt,
                    ..
                },
                _,
            ) => Ranges::Cddt(map.cddt()),
            _ => Ranges::March,
        }
    }

    /// Adds the squashed log-likelihood of the scan to every particle's log-weight.
    pub(crate) fn weigh(
        &self,
        particles: &mut Particles,
        scan: &ReadyScan,
        map: &TrackMap,
        ranges: &Ranges,
        base_link_from_laser: Pose,
    ) {
        match self {
            Self::Beam { model, .. } => {
                let laser = Laser::new(base_link_from_laser, map.grid().resolution);
                let beams = &scan.beams[..scan.beams.len().min(MOST)];
                let field = map.field();
                match ranges {
                    Ranges::Table(table) => match model.row_length() {
                        1024 => look_up::<1024>(particles, beams, &laser, table, model),
                        2048 => look_up::<2048>(particles, beams, &laser, table, model),
                        _ => look_up::<{ ROW_LENGTHS[2] }>(particles, beams, &laser, table, model),
                    },
                    Ranges::March => {
                        cast_each(particles, beams, &laser, field, model, |at, angle, longest| {
                            field.trace(at, [angle.cos(), angle.sin()], longest)
                        });
                    }
                    Ranges::Cddt(cddt) => {
                        cast_each(particles, beams, &laser, field, model, |at, angle, longest| {
                            cddt.range(at, angle, longest)
                        });
                    }
                }
            }
            Self::Field { model } => weigh_field(particles, scan, map.field(), model),
        }
    }
}

/// The laser on `base_link`, for ranges in cells.
struct Laser {
    /// Cells per metre.
    cells: f32,
    /// Its place [cells].
    at: [f32; 2],
    /// Its heading [rad].
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

    /// Where the laser of a particle is in the grid [cells].
    #[inline]
    fn of(&self, particles: &Particles, i: usize) -> [f32; 2] {
        let (c, s) = (particles.cos[i], particles.sin[i]);
        let [x, y] = self.at;
        [
            particles.x[i] * self.cells + x * c - y * s,
            particles.y[i] * self.cells + x * s + y * c,
        ]
    }
}

/// Ranges from the table. `N` is the length of the model's rows.
fn look_up<const N: usize>(
    particles: &mut Particles,
    beams: &[Beam],
    laser: &Laser,
    table: &RangeTable,
    model: &BeamModel,
) {
    let per_turn = DIRECTIONS as f32 / std::f32::consts::TAU;
    let mut rows = [model.fixed_row::<N>(0.0); MOST];
    let mut offsets = [0usize; MOST];
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
    // Where the ranges are is worked out for eight particles at once.
    for begin in (0..particles.len()).step_by(8) {
        let lanes = 8.min(particles.len() - begin);
        let (c, s) = (
            load(&particles.cos[begin..], lanes),
            load(&particles.sin[begin..], lanes),
        );
        let (x, y) = (
            load(&particles.x[begin..], lanes),
            load(&particles.y[begin..], lanes),
        );
        let [lx, ly] = laser.at.map(f32x8::splat);
        let cells = f32x8::splat(laser.cells);
        let rows_at = table.rows_at(x * cells + lx * c - ly * s, y * cells + lx * s + ly * c);
        let turned = load(&particles.heading[begin..], lanes) * f32x8::splat(per_turn);
        let bases = (turned + f32x8::splat(DIRECTIONS as f32 + 0.5))
            .fast_trunc_int()
            .to_array();
        for (k, log_weight) in particles.log_weight[begin..begin + lanes].iter_mut().enumerate() {
            let Some(ranges) = table.row(rows_at[k]) else {
                *log_weight += off_track;
                continue;
            };
            let base = bases[k] as usize;
            let likelihood = |row: &[f32; N], offset: usize| {
                let range = ranges[(base + offset) & (DIRECTIONS - 1)] >> STEP_SHIFT;
                row[usize::from(range).min(N - 1)]
            };
            // Two sums, so that an addition need not wait for the one before.
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

/// Ranges cast one by one, by `cast` from a place [cells] along an angle [rad], in cells.
fn cast_each(
    particles: &mut Particles,
    beams: &[Beam],
    laser: &Laser,
    field: &DistanceField,
    model: &BeamModel,
    cast: impl Fn([f32; 2], f32, f32) -> f32,
) {
    let resolution = 1.0 / laser.cells;
    let longest = model.reach() * laser.cells;
    let mut rows = [model.row(0.0); MOST];
    for (row, beam) in rows.iter_mut().zip(beams) {
        *row = model.row(beam.range);
    }
    for i in 0..particles.len() {
        let at = laser.of(particles, i);
        let inside = field.nearest(at[0], at[1]).is_some_and(|distance| distance > 0.0);
        particles.log_weight[i] += if inside {
            let heading = particles.heading[i] + laser.heading;
            let likelihood = |(row, beam): (&&[f32], &Beam)| {
                row[model.step_of(cast(at, heading + beam.angle, longest), resolution)]
            };
            rows.iter().zip(beams).map(likelihood).sum::<f32>()
        } else {
            model.off_track * beams.len() as f32
        };
    }
}

fn weigh_field(particles: &mut Particles, scan: &ReadyScan, field: &DistanceField, model: &LikelihoodField) {
    let cells = 1.0 / field.resolution() as f32;
    let mut points = [[0.0f32; 2]; MOST];
    let mut count = 0;
    for point in scan.weighed_points().take(MOST) {
        points[count] = point.map(|v| v * cells);
        count += 1;
    }
    for i in 0..particles.len() {
        let (c, s) = (particles.cos[i], particles.sin[i]);
        let (x, y) = (particles.x[i] * cells, particles.y[i] * cells);
        let inside = field.nearest(x, y).is_some_and(|distance| distance > 0.0);
        let mut sum = if inside { 0.0 } else { model.off_track * 5.0 };
        for [px, py] in &points[..count] {
            sum += model.at(field, x + c * px - s * py, y + s * px + c * py);
        }
        particles.log_weight[i] += sum;
    }
}
