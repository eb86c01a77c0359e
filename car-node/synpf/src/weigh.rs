//! The kernel: how well each particle explains the scan.

use std::sync::Arc;

use maps::{DistanceField, Pose};

use crate::TrackMap;
use crate::beams::ReadyScan;
use crate::cddt::Cddt;
use crate::defects::Defects;
use crate::parameters::Parameters;
use crate::particles::Particles;
use crate::range_table::{DIRECTIONS, RangeTable};
use crate::sensor::{BeamModel, LikelihoodField, RangeMethod, STEP_SHIFT, SensorModel};

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
                weigh_beams(particles, scan, map, ranges, base_link_from_laser, model);
            }
            Self::Field { model } => weigh_field(particles, scan, map.field(), model),
        }
    }
}

fn weigh_beams(
    particles: &mut Particles,
    scan: &ReadyScan,
    map: &TrackMap,
    ranges: &Ranges,
    base_link_from_laser: Pose,
    model: &BeamModel,
) {
    let mut rows: [&[f32]; MOST] = [&[]; MOST];
    let mut offsets = [0usize; MOST];
    let count = scan.beams.len().min(MOST);
    let per_turn = DIRECTIONS as f32 / std::f32::consts::TAU;
    for (k, beam) in scan.beams[..count].iter().enumerate() {
        rows[k] = model.row(beam.range);
        // Rounded here; the particle's own part is rounded in the loop.
        offsets[k] = ((beam.angle + base_link_from_laser.heading as f32) * per_turn)
            .round()
            .rem_euclid(DIRECTIONS as f32) as usize;
    }
    let (rows, offsets) = (&rows[..count], &offsets[..count]);
    let cells = 1.0 / map.grid().resolution as f32;
    let resolution = map.grid().resolution as f32;
    let (lx, ly) = (
        base_link_from_laser.x as f32 * cells,
        base_link_from_laser.y as f32 * cells,
    );
    let off_track = model.off_track * count as f32;
    let last = model.last();
    for i in 0..particles.len() {
        let (c, s) = (particles.cos[i], particles.sin[i]);
        let u = particles.x[i] * cells + lx * c - ly * s;
        let v = particles.y[i] * cells + lx * s + ly * c;
        let sum = match ranges {
            Ranges::Table(table) => table.row(u, v).map(|table_row| {
                let base = (particles.heading[i] * per_turn + DIRECTIONS as f32 + 0.5) as usize;
                let mut sum = 0.0;
                for (row, offset) in rows.iter().zip(offsets) {
                    let range = u32::from(table_row[(base + offset) & (DIRECTIONS - 1)]) >> STEP_SHIFT;
                    sum += row[range.min(last) as usize];
                }
                sum
            }),
            Ranges::March | Ranges::Cddt(_) => map
                .field()
                .nearest(u, v)
                .filter(|&distance| distance > 0.0)
                .map(|_| {
                    let mut sum = 0.0;
                    for (row, beam) in rows.iter().zip(&scan.beams) {
                        let angle = particles.heading[i] + base_link_from_laser.heading as f32 + beam.angle;
                        let longest = last as f32 * 0.02 * cells;
                        let range = match ranges {
                            Ranges::Cddt(cddt) => cddt.range([u, v], angle, longest),
                            _ => map.field().trace([u, v], [angle.cos(), angle.sin()], longest),
                        };
                        sum += row[model.step_of(range, resolution)];
                    }
                    sum
                }),
        };
        particles.log_weight[i] += sum.unwrap_or(off_track);
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
