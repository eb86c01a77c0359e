//! Single parts of the filter on their own: for figures, benchmarks and comparisons. A localizer needs none of this.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use maps::{Cell, Pose, wrap_angle};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

use crate::beam_layout::{BeamParameters, MOST_BEAMS, chosen_beams};
use crate::beam_model::BeamModel;
use crate::motion_model::{Motion, MotionParameters};
use crate::particles::Particles;
use crate::preprocessed_scan::Beam;
use crate::ranges::Ranges;
use crate::sensor_parameters::SensorParameters;
use crate::track_map::TrackMap;

/// Where `count` particles go that start at the origin and follow the motions of odometry, each with its duration \[s\].
pub fn moved_particles(
    parameters: &MotionParameters,
    motions: &[(Pose, f64)],
    count: usize,
    seed: u64,
) -> Vec<Pose> {
    let mut particles = Particles::new(seed, count);
    particles.scatter(count, Pose::IDENTITY, [0.0; 3]);
    for (delta, seconds) in motions {
        particles.advance(&Motion::new(*delta, *seconds, 1.0, parameters));
    }
    (0..count).map(|i| particles.poses.get(i)).collect()
}

/// The indices of the beams that the sensor model weighs, of a scan of `count` beams from `angle_min` on, `increment` apart
/// \[rad\]. None for a scan without beams.
pub fn weighed_beams(count: usize, angle_min: f64, increment: f64, parameters: &BeamParameters) -> Vec<u32> {
    if count == 0 {
        return Vec::new();
    }
    chosen_beams(count, angle_min, increment, parameters)
}

/// The beam model's density of a measured range where the map predicts `predicted` \[m\]: ranges \[m\] with densities \[1/m\]. The
/// last one is no return. Without the exponent of `squash_factor`.
pub fn beam_density(parameters: &SensorParameters, predicted: f64) -> Vec<[f64; 2]> {
    BeamModel::new(parameters).density(predicted, parameters.squash_factor)
}

/// Lasers for comparing range sources: at random places in free cells, at least 0.2 m from a wall, facing anywhere. Fewer than
/// `count` where there is hardly such a place.
pub fn free_lasers(map: &TrackMap, count: usize, seed: u64) -> Vec<Pose> {
    let mut random = SmallRng::seed_from_u64(seed);
    let grid = map.grid();
    let size = [grid.width, grid.height].map(|cells| cells as f64 * grid.resolution);
    let anywhere = (0..1000 * count).map(|_| {
        let [x, y] = size.map(|length| random.random_range(0.0..length));
        grid.origin * Pose::new(x, y, random.random_range(-PI..PI))
    });
    let free =
        |laser: &Pose| grid.at([laser.x, laser.y]) == Cell::Free && map.distance([laser.x, laser.y]) > 0.2;
    anywhere.filter(free).take(count).collect()
}

/// What range sources are compared with: the range of each laser along its x axis to the first face of a wall \[m\], by cutting the
/// ray with every face; None for a ray that meets none.
pub fn ranges_to_faces(map: &TrackMap, lasers: &[Pose]) -> Vec<Option<f64>> {
    let faces = map.field().contour();
    let resolution = map.grid().resolution;
    let range = |laser: &Pose| {
        let at = map.grid_from_map() * *laser;
        let (sin, cos) = at.heading.sin_cos();
        // In a frame that has the ray along its x axis.
        let turned = |p: [f32; 2]| {
            let dx = f64::from(p[0]) - at.x / resolution;
            let dy = f64::from(p[1]) - at.y / resolution;
            [dx * cos + dy * sin, dy * cos - dx * sin]
        };
        faces
            .iter()
            .filter_map(|face| {
                let [a, b] = face.map(turned);
                let crosses = (a[1] < 0.0) != (b[1] < 0.0);
                crosses.then(|| a[0] - a[1] * (b[0] - a[0]) / (b[1] - a[1]))
            })
            .filter(|range| *range > 0.0)
            .reduce(f64::min)
            .map(|range| range * resolution)
    };
    lasers.iter().map(range).collect()
}

/// What predicts ranges.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RangeSource {
    /// Looked up in the table.
    Lut,
    /// Searched for in the sorted crossings with walls.
    Cddt,
    /// Marched on the distance field.
    RayMarching,
    /// Cast on the grid, cell by cell, on the CPU.
    Exact,
    /// Cast on the grid, cell by cell, on a graphics card.
    Gpu,
}

impl RangeSource {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Lut, Self::Cddt, Self::RayMarching, Self::Exact, Self::Gpu];

    /// The name, as in a parameter set where there is one.
    pub fn name(self) -> &'static str {
        match self {
            Self::Lut => "lut",
            Self::Cddt => "cddt",
            Self::RayMarching => "ray_marching",
            Self::Exact => "exact",
            Self::Gpu => "gpu",
        }
    }
}

/// Why a range source cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Unavailable(String);

/// Predicts ranges on a map.
#[derive(Debug, Clone)]
pub struct RangeCaster {
    map: Arc<TrackMap>,
    ranges: Ranges,
    bytes: usize,
    adapter: Option<String>,
}

impl RangeCaster {
    /// Builds what the source needs: the table of the largest region, the crossings, or the map on the graphics card.
    pub fn new(map: &Arc<TrackMap>, source: RangeSource) -> Result<Self, Unavailable> {
        let field_bytes = size_of_val(map.field().values());
        let missing = || Unavailable("the table is not built".into());
        let mut adapter = None;
        let (ranges, bytes) = match source {
            RangeSource::Lut => {
                let region = (0..map.regions().len()).max_by_key(|i| map.regions()[*i].cells.len());
                let region = region.ok_or_else(missing)?;
                let parameters = SensorParameters::default().table_parameters();
                let table = map.range_table(region, parameters).ok_or_else(missing)?;
                let bytes = table.bytes();
                (Ranges::Table(table), bytes)
            }
            RangeSource::Cddt => {
                let cddt = map.cddt().ok_or_else(missing)?;
                let bytes = cddt.bytes();
                (Ranges::Cddt(cddt), bytes)
            }
            RangeSource::RayMarching => (Ranges::RayMarching, field_bytes),
            RangeSource::Exact => (Ranges::Exact(map.shared().0), map.grid().cells.len()),
            RangeSource::Gpu => {
                let (ranges, bytes, name) = gpu(map)?;
                adapter = Some(name);
                (ranges, bytes)
            }
        };
        Ok(Self {
            map: Arc::clone(map),
            ranges,
            bytes,
            adapter,
        })
    }

    /// Memory of what was built, or else of the grid or the distance field that it works on \[bytes\].
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// The graphics adapter that the ranges come from.
    pub fn adapter(&self) -> Option<&str> {
        self.adapter.as_deref()
    }

    /// Ranges of lasers in `map` along their x axes \[m\], at most `max_range` \[m\].
    pub fn ranges(&self, lasers: &[Pose], max_range: f64) -> Result<Vec<f64>, Unavailable> {
        let resolution = self.map.grid().resolution;
        let longest = (max_range / resolution) as f32;
        let start = |laser: &Pose| {
            let at = self.map.grid_from_map() * *laser;
            let cells = [(at.x / resolution) as f32, (at.y / resolution) as f32];
            (cells, at.heading as f32)
        };
        let metres = |cells: f32| (f64::from(cells) * resolution).min(max_range);
        let each = |range: &dyn Fn([f32; 2], f32) -> f64| {
            let of = |laser: &Pose| {
                let (from, angle) = start(laser);
                range(from, angle)
            };
            lasers.iter().map(of).collect()
        };
        Ok(match &self.ranges {
            Ranges::Exact(grid) => {
                let cast = |laser: &Pose| grid.cast(*laser, max_range);
                lasers.iter().map(cast).collect()
            }
            Ranges::Table(table) => each(&|from, angle| {
                let range = table.range(from, angle, 0.0).unwrap_or(0.0);
                f64::from(range).min(max_range)
            }),
            Ranges::Cddt(cddt) => each(&|from, angle| metres(cddt.range(from, angle, longest))),
            Ranges::RayMarching | Ranges::Interim => each(&|from, angle| {
                let direction = [angle.cos(), angle.sin()];
                metres(self.map.field().trace(from, direction, longest))
            }),
            #[cfg(feature = "gpu")]
            Ranges::Gpu(gpu) => {
                let ray = |laser: &Pose| {
                    let ([x, y], _) = start(laser);
                    let heading = (self.map.grid_from_map() * *laser).heading;
                    [x, y, heading.cos() as f32, heading.sin() as f32]
                };
                let rays: Vec<[f32; 4]> = lasers.iter().map(ray).collect();
                let ranges = gpu.ranges(&rays, longest);
                let ranges = ranges.map_err(|error| Unavailable(error.to_string()))?;
                ranges.into_iter().map(metres).collect()
            }
        })
    }
}

/// Ranges of lasers in `map` along their x axes, cast on a graphics card \[m\]; on any grid, also on one that no car fits in.
#[cfg(feature = "gpu")]
pub fn gpu_ranges(
    grid: &maps::OccupancyGrid,
    lasers: &[Pose],
    max_range: f64,
) -> Result<Vec<f64>, Unavailable> {
    let unavailable = |error: crate::gpu::GpuError| Unavailable(error.to_string());
    let map = crate::gpu::GpuMap::new(grid).map_err(unavailable)?;
    let grid_from_map = grid.origin.inverse();
    let ray = |laser: &Pose| {
        let at = grid_from_map * *laser;
        [
            (at.x / grid.resolution) as f32,
            (at.y / grid.resolution) as f32,
            at.heading.cos() as f32,
            at.heading.sin() as f32,
        ]
    };
    let rays: Vec<[f32; 4]> = lasers.iter().map(ray).collect();
    let ranges = map.ranges(&rays, (max_range / grid.resolution) as f32);
    let metres = |cells: f32| (f64::from(cells) * grid.resolution).min(max_range);
    Ok(ranges.map_err(unavailable)?.into_iter().map(metres).collect())
}

/// The graphics adapter of this process.
#[cfg(feature = "gpu")]
pub fn gpu_adapter() -> Result<String, Unavailable> {
    let gpu = crate::gpu::Gpu::shared().map_err(|error| Unavailable(error.to_string()))?;
    Ok(gpu.adapter().to_owned())
}

#[cfg(feature = "gpu")]
fn gpu(map: &TrackMap) -> Result<(Ranges, usize, String), Unavailable> {
    let gpu = map.gpu().map_err(|error| Unavailable(error.to_string()))?;
    let (bytes, adapter) = (gpu.bytes(), gpu.adapter().to_owned());
    Ok((Ranges::Gpu(gpu), bytes, adapter))
}

#[cfg(not(feature = "gpu"))]
fn gpu(_: &TrackMap) -> Result<(Ranges, usize, String), Unavailable> {
    Err(Unavailable("built without the cargo feature gpu".into()))
}

/// Weighs particles by one scan, again and again.
#[derive(Debug, Clone)]
pub struct ScanWeigher {
    map: Arc<TrackMap>,
    model: BeamModel,
    ranges: Ranges,
    beams: Vec<Beam>,
    particles: Particles,
}

impl ScanWeigher {
    /// `count` particles around a pose in `map`, and the beams that a laser on `base_link` measures there: at even angles over
    /// three quarters of a turn, at most 128 of them.
    pub fn new(
        map: &Arc<TrackMap>,
        source: RangeSource,
        count: usize,
        beams: usize,
        map_from_base_link: Pose,
    ) -> Result<Self, Unavailable> {
        let ranges = RangeCaster::new(map, source)?.ranges;
        let parameters = SensorParameters::default();
        let last = (beams.clamp(2, MOST_BEAMS) - 1) as f64;
        let beams = (0..beams.clamp(2, MOST_BEAMS))
            .map(|k| {
                let angle = wrap_angle(0.75 * TAU * (k as f64 / last - 0.5));
                let range = map.range(
                    map_from_base_link * Pose::new(0.0, 0.0, angle),
                    parameters.max_range,
                );
                Beam {
                    angle: angle as f32,
                    range: range as f32,
                }
            })
            .collect();
        let mut particles = Particles::new(1, count);
        particles.scatter(count, map.grid_from_map() * map_from_base_link, [0.2, 0.2, 0.1]);
        Ok(Self {
            map: Arc::clone(map),
            model: BeamModel::new(&parameters),
            ranges,
            beams,
            particles,
        })
    }

    /// Weighs all particles, and returns their log-likelihoods.
    pub fn weigh(&mut self) -> &[f32] {
        self.particles.log_weight.fill(0.0);
        let (particles, beams) = (&mut self.particles, &self.beams);
        self.model
            .reweight(particles, beams, self.map.field(), &self.ranges, Pose::IDENTITY);
        &self.particles.log_weight
    }
}
