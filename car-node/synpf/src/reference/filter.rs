//! The reference as a localizer.

use std::collections::VecDeque;
use std::sync::Arc;

use localizer::received::{CARRY, FASTEST_TURN, KEPT, is_possible, keep_yaw_rate};
use localizer::{
    Dropped, HandOver, HandedEstimate, Hypothesis, Localizer, Mode, Odometry, ParameterFault,
    ParameterValues, PoseError, PreparedParameters, Scan, SensorFindings, Stamp, Twist, Update, WeightedPose,
    YawRate,
};
use maps::{Cell, Pose};
use nalgebra::{Matrix3, Vector3};

use super::beams::boxed;
use super::motion::{Motion, Step};
use super::parameters::ReferenceParameters;
use super::particles::Particles;
use super::range_table::{Method, Table, Walls};
use super::sensor_table::SensorTable;
use crate::error::SetUpError;
use crate::quality::Quality;
use crate::track_map::TrackMap;

/// Weight of a particle off the track.
const OFF_TRACK: f64 = 0.01;
/// A search has ended when the particles' spread is less than this \[m\].
const FOUND: f64 = 0.5;
/// Clusters that a search has found, at most.
const MOST_HYPOTHESES: usize = 5;
/// Particles spread wider than this may be in two places \[m\].
const WIDE: f64 = 0.2;

/// The reference, a localizer. One thread owns it; the map is shared.
///
/// Inside, poses are in the grid's frame; see [`TrackMap`].
#[derive(Debug)]
pub struct Reference {
    map: Arc<TrackMap>,
    base_link_from_laser: Pose,
    tuning: ReferenceTuning,
    walls: Arc<Walls>,
    /// The region that the table is for, and the table if it has been built.
    table: Option<(usize, Option<Arc<Table>>)>,
    beams: Beams,
    particles: Particles,
    log_likelihoods: Vec<f64>,
    mode: Mode,
    /// The weighted mean, at `at`, where odometry was at `odom`.
    posterior: Option<Posterior>,
    /// The motion of the tick before.
    before: Pose,
    ess_ratio: f64,
    odometry: VecDeque<Odometry>,
    yaw_rates: VecDeque<YawRate>,
    last_scan: Option<Stamp>,
    updates: u64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Posterior {
    at: Stamp,
    odom: Pose,
    mean: Pose,
    covariance: Matrix3<f64>,
    /// How far the mean moved beyond odometry in the last tick: distance \[m\] and angle \[rad\].
    innovation: [f64; 2],
}

/// A parameter set with its sensor table, made ready away from the filter's thread.
#[derive(Debug, Clone)]
pub struct ReferenceTuning {
    parameters: ReferenceParameters,
    sensor: Arc<SensorTable>,
}

impl ReferenceTuning {
    /// Validates a set and builds its sensor table. Every fault is listed.
    pub fn new(parameters: ReferenceParameters, map: &TrackMap) -> Result<Self, Vec<ParameterFault>> {
        parameters.validate()?;
        let sensor = Arc::new(SensorTable::new(&parameters, map.grid().resolution));
        Ok(Self { parameters, sensor })
    }
}

/// The latest scan's chosen beams.
#[derive(Debug, Default)]
struct Beams {
    /// Number of beams, first angle and increment that `chosen` is for, and the parameters that it depends on.
    geometry: Option<(usize, f64, f64, f64, usize)>,
    chosen: Vec<usize>,
    /// Direction of each chosen beam in the frame of `base_link` \[rad\].
    angles: Vec<f64>,
    /// What each measured, in cells.
    observed: Vec<u16>,
    /// End points of all beams with a return, in the frame of `base_link` \[m\].
    points: Vec<[f32; 2]>,
}

impl Reference {
    /// A localizer on `map` for a laser mounted at `base_link_from_laser`. It has no pose yet.
    pub fn new(
        map: Arc<TrackMap>,
        base_link_from_laser: Pose,
        parameters: ReferenceParameters,
        seed: u64,
    ) -> Result<Self, SetUpError> {
        if !base_link_from_laser.is_finite() {
            return Err(PoseError::NotFinite(base_link_from_laser).into());
        }
        let tuning = ReferenceTuning::new(parameters, &map).map_err(SetUpError::Parameters)?;
        let walls = map.reference_tables().walls(map.grid());
        Ok(Self {
            map,
            base_link_from_laser,
            tuning,
            walls,
            table: None,
            beams: Beams::default(),
            particles: Particles::new(seed),
            log_likelihoods: Vec::new(),
            mode: Mode::Uninitialized,
            posterior: None,
            before: Pose::IDENTITY,
            ess_ratio: 1.0,
            odometry: VecDeque::new(),
            yaw_rates: VecDeque::new(),
            last_scan: None,
            updates: 0,
        })
    }

    /// Builds the range table for the region around a pose in `map`, or, without one, for all that look like tracks, if it
    /// is not there yet and the map's limit of memory allows it. Where there is no table, the localizer casts rays, which gives the same ranges
    /// and takes longer.
    pub fn prepare(map: &TrackMap, map_from_base_link: Option<Pose>, parameters: &ReferenceParameters) {
        let method = Method::new(parameters, map.grid().resolution);
        let regions = match map_from_base_link {
            Some(pose) => map.region_at(map.grid_from_map() * pose).into_iter().collect(),
            None => map.plausible_regions(),
        };
        for region in regions {
            let cells = &map.regions()[region].cells;
            map.reference_tables()
                .build(map.grid(), region, cells, method, map.table_budget());
        }
    }

    /// The set in force.
    pub fn parameters(&self) -> &ReferenceParameters {
        &self.tuning.parameters
    }

    fn per_odometry(&self) -> bool {
        self.tuning.parameters.defects.defect_update_per_odometry
    }

    /// Particles around a pose in the grid's frame, true at the latest odometry.
    fn start(&mut self, pose: Pose, covariance: Matrix3<f64>) {
        let root = covariance.cholesky().map_or_else(
            || Matrix3::from_diagonal(&covariance.diagonal().map(|v| v.max(0.0).sqrt())),
            |cholesky| cholesky.l(),
        );
        self.particles
            .scatter(self.tuning.parameters.max_particles, pose, &root);
        self.mode = Mode::Tracking;
        self.ess_ratio = 1.0;
        self.posterior = self.odometry.back().map(|latest| Posterior {
            at: latest.stamp,
            odom: latest.pose,
            mean: pose,
            covariance,
            innovation: [0.0; 2],
        });
    }

    /// Particles in all free cells, with any heading.
    fn start_everywhere(&mut self) {
        let grid = self.map.grid();
        let free: Vec<usize> = (0..grid.cells.len())
            .filter(|&i| grid.cells[i] == Cell::Free)
            .collect();
        let place = |share: f64| {
            let i = free[((share * free.len() as f64) as usize).min(free.len().saturating_sub(1))];
            [i % grid.width, i / grid.width].map(|v| (v as f64 + 0.5) * grid.resolution)
        };
        self.particles
            .scatter_over(self.tuning.parameters.max_particles, place);
        self.mode = Mode::Searching;
        self.ess_ratio = 1.0;
        let mean = self.particles.mean();
        self.posterior = self.odometry.back().map(|latest| Posterior {
            at: latest.stamp,
            odom: latest.pose,
            mean,
            covariance: self.particles.covariance(mean),
            innovation: [0.0; 2],
        });
    }

    /// One tick of the reference: resample, move, weigh by the latest scan, and take the mean.
    fn tick(&mut self, at: Stamp, odom: Pose, step: &Step) {
        let parameters = &self.tuning.parameters;
        self.particles.resample(parameters.max_particles);
        self.particles.advance(&Motion::new(step, parameters));
        self.reweight();
        let mean = self.particles.mean();
        let spread = self.particles.covariance(mean);
        let before = self.posterior.map_or(mean, |posterior| posterior.mean);
        let off = mean.since(before * step.motion);
        let covariance = if self.tuning.parameters.defects.defect_covariance_about_previous {
            self.particles.covariance(before)
        } else {
            spread
        };
        self.before = step.motion;
        self.ess_ratio = self.particles.ess_ratio();
        if self.mode == Mode::Searching && spread[(0, 0)].max(spread[(1, 1)]) < FOUND * FOUND {
            self.mode = Mode::Tracking;
        }
        self.posterior = Some(Posterior {
            at,
            odom,
            mean,
            covariance,
            innovation: [off.x.hypot(off.y), off.heading.abs()],
        });
    }

    /// Weights by the chosen beams of the latest scan; unchanged before the first.
    fn reweight(&mut self) {
        if self.beams.observed.is_empty() {
            return;
        }
        let parameters = &self.tuning.parameters;
        let grid = self.map.grid();
        let method = Method::new(parameters, grid.resolution);
        let near = self.posterior.map(|posterior| posterior.mean);
        if let Some(region) = near.and_then(|pose| self.map.region_at(pose))
            && self
                .table
                .as_ref()
                .is_none_or(|(known, table)| *known != region || table.is_none())
        {
            self.table = Some((region, self.map.reference_tables().get(region, method)));
        }
        let table = self.table.as_ref().and_then(|(_, table)| table.as_deref());

        let directions = usize::from(method.directions);
        let per_turn = f64::from(method.directions) / std::f64::consts::TAU;
        let rows: Vec<&[f32]> = self
            .beams
            .observed
            .iter()
            .map(|&cell| self.tuning.sensor.row(cell))
            .collect();
        let turn = f64::from(method.directions);
        let offsets: Vec<f64> = self
            .beams
            .angles
            .iter()
            .map(|angle| (angle * per_turn).rem_euclid(turn))
            .collect();
        let cells_per_metre = 1.0 / grid.resolution;
        let [lx, ly] = [self.base_link_from_laser.x, self.base_link_from_laser.y];
        let squash = 1.0 / parameters.squash_factor;
        let inside = |v: f64, cells: usize| (0.0..cells as f64).contains(&v);

        self.log_likelihoods.clear();
        for [x, y, heading] in &self.particles.poses {
            let (sin, cos) = heading.sin_cos();
            let u = (x + lx * cos - ly * sin) * cells_per_metre;
            let v = (y + lx * sin + ly * cos) * cells_per_metre;
            let turned = (heading * per_turn).rem_euclid(turn);
            let direction = |offset: f64| (turned + offset + 0.5) as usize % directions;
            let beams = rows.iter().zip(&offsets);
            let log = if inside(u, grid.width) && inside(v, grid.height) {
                let (column, row) = (u as usize, v as usize);
                if let Some(ranges) = table.and_then(|table| table.row(row * grid.width + column)) {
                    beams
                        .map(|(row, &offset)| row[usize::from(ranges[direction(offset)])])
                        .sum::<f32>()
                } else {
                    let cell = [column as i32, row as i32];
                    beams
                        .map(|(row, &offset)| {
                            row[usize::from(self.walls.cast(cell, direction(offset), method))]
                        })
                        .sum()
                }
            } else {
                let most = usize::from(self.tuning.sensor.most);
                beams.map(|(row, _)| row[most]).sum()
            };
            // Where the car itself is, not its laser; the nearest cell of the map for one outside it.
            let clamped = |v: f64, cells: usize| ((v * cells_per_metre) as usize).min(cells - 1);
            let cell = clamped(*y, grid.height) * grid.width + clamped(*x, grid.width);
            let on_track = grid.cells[cell] == Cell::Free;
            let penalty = if on_track { 0.0 } else { OFF_TRACK.ln() };
            self.log_likelihoods.push(f64::from(log) * squash + penalty);
        }
        self.particles.set_weights(&self.log_likelihoods);
    }

    /// Odometry's pose and velocity at a stamp: between two messages, or carried on by the last for at most `carry` \[s\].
    fn odometry_at(&self, stamp: Stamp, carry: f64) -> Option<(Pose, Twist)> {
        let after = self.odometry.partition_point(|odometry| odometry.stamp <= stamp);
        let from = self.odometry.get(after.saturating_sub(1))?;
        let seconds = stamp.since(from.stamp);
        if let Some(to) = self.odometry.get(after)
            && seconds >= 0.0
        {
            let share = seconds / to.stamp.since(from.stamp);
            return Some((from.pose.interpolate(to.pose, share), from.twist));
        }
        let twist = from.twist;
        let moved = [twist.linear_x, twist.linear_y, twist.angular].map(|rate| rate * seconds);
        (seconds.abs() <= carry).then(|| (from.pose * Pose::exp(moved), twist))
    }

    /// What a scan's chosen beams measured.
    fn load(&mut self, scan: &Scan) {
        let parameters = &self.tuning.parameters;
        let count = scan.ranges.len();
        let geometry = (
            count,
            scan.angle_min,
            scan.angle_increment,
            parameters.lidar_aspect_ratio,
            parameters.des_lidar_beams,
        );
        let beams = &mut self.beams;
        if beams.geometry != Some(geometry) {
            let (_, angle_min, increment, aspect_ratio, wanted) = geometry;
            beams.chosen = boxed(count, angle_min, increment, aspect_ratio, wanted);
            let mount = self.base_link_from_laser.heading;
            let angle = |&i: &usize| mount + angle_min + increment * i as f64;
            beams.angles = beams.chosen.iter().map(angle).collect();
            beams.geometry = Some(geometry);
        }
        let sensor = &self.tuning.sensor;
        beams.observed.clear();
        beams
            .observed
            .extend(beams.chosen.iter().map(|&i| sensor.cell(scan.ranges[i])));
        beams.points.clear();
        let points = end_points(scan, self.base_link_from_laser, parameters.max_range);
        beams.points.extend(points);
    }

    /// One update per scan at its own time: the mended cycle.
    fn tick_at(&mut self, stamp: Stamp) -> Option<Twist> {
        let (odom, twist) = self.odometry_at(stamp, CARRY)?;
        let (before, odom_before) = self
            .posterior
            .map_or((stamp, odom), |posterior| (posterior.at, posterior.odom));
        let step = Step {
            motion: odom.since(odom_before),
            before: self.before,
            // The first scan may be older than the pose that was given.
            seconds: stamp.since(before).max(0.0),
            speed: twist.linear_x,
        };
        self.tick(stamp, odom, &step);
        Some(twist)
    }

    /// How well the scan fits at the posterior, and all else that an update says.
    fn report(&mut self, scan: &Scan, posterior: &Posterior, twist: Twist) -> Update {
        self.updates += 1;
        // The scan belongs to another time than the posterior.
        let seconds = scan.stamp.since(posterior.at);
        let since = [twist.linear_x, twist.linear_y, twist.angular].map(|rate| rate * seconds);
        let at_scan = posterior.mean * Pose::exp(since);
        let points = &self.beams.points;
        let quality = Quality::of_points(&self.map, points, self.base_link_from_laser, at_scan);
        let about_mean = self.particles.covariance(posterior.mean);
        let spread = along_and_across(&about_mean, posterior.mean.heading);
        let second_mode = if spread[0].max(spread[1]) > WIDE {
            match self.particles.clusters(2)[..] {
                [first, second, ..] => second.mass / first.mass,
                _ => 0.0,
            }
        } else {
            0.0
        };
        let map_from_grid = self.map.grid().origin;
        Update {
            stamp: posterior.at,
            number: self.updates,
            pose: map_from_grid * posterior.mean,
            twist,
            covariance: turned(&posterior.covariance, map_from_grid.heading),
            mode: self.mode,
            particles: self.particles.len(),
            ess_ratio: self.ess_ratio,
            spread,
            second_mode,
            alignment: quality.alignment,
            residual: quality.residual,
            short_beams: quality.short,
            long_beams: quality.long,
            no_return: 1.0 - points.len() as f64 / scan.ranges.len() as f64,
            w_ratio: 1.0,
            innovation: posterior.innovation,
            odometry_jump: None,
            slip: 0.0,
            yaw_rate_residual: 0.0,
            doubt: None,
            trust: None,
            sensors: SensorFindings::default(),
        }
    }
}

impl Localizer for Reference {
    fn initialize(&mut self, pose: Pose) -> Result<(), PoseError> {
        if !pose.is_finite() {
            return Err(PoseError::NotFinite(pose));
        }
        if !self.map.covers(pose) {
            return Err(PoseError::OffMap(pose));
        }
        let p = &self.tuning.parameters;
        let sigma = Vector3::new(p.initial_var_x, p.initial_var_y, p.initial_var_theta);
        let covariance = Matrix3::from_diagonal(&sigma.map(|s| s * s));
        self.start(self.map.grid_from_map() * pose, covariance);
        Ok(())
    }

    fn relocalize(&mut self) {
        self.start_everywhere();
    }

    fn on_odometry(&mut self, odometry: &Odometry) -> Result<(), Dropped> {
        if !(odometry.pose.is_finite() && is_possible(odometry, FASTEST_TURN)) {
            return Err(Dropped::Malformed);
        }
        let last = self.odometry.back().copied();
        if last.is_some_and(|last| odometry.stamp <= last.stamp) {
            return Err(Dropped::TimeBackwards);
        }
        self.odometry.push_back(*odometry);
        if self.odometry.len() > KEPT {
            self.odometry.pop_front();
        }
        if self.mode == Mode::Uninitialized {
            return Ok(());
        }
        match (self.posterior, last) {
            // The pose that was given before any odometry is true here.
            (None, _) | (_, None) => {
                let mean = self.particles.mean();
                self.posterior = Some(Posterior {
                    at: odometry.stamp,
                    odom: odometry.pose,
                    mean,
                    covariance: self.particles.covariance(mean),
                    innovation: [0.0; 2],
                });
            }
            (Some(posterior), Some(_)) if self.per_odometry() => {
                let step = Step {
                    motion: odometry.pose.since(posterior.odom),
                    before: self.before,
                    seconds: odometry.stamp.since(posterior.at),
                    speed: odometry.twist.linear_x,
                };
                self.tick(odometry.stamp, odometry.pose, &step);
            }
            _ => {}
        }
        Ok(())
    }

    fn on_yaw_rate(&mut self, yaw_rate: &YawRate) -> Result<(), Dropped> {
        keep_yaw_rate(&mut self.yaw_rates, yaw_rate, FASTEST_TURN)
    }

    fn on_scan(&mut self, scan: &Scan) -> Result<Update, Dropped> {
        if !sound(scan) {
            return Err(Dropped::Malformed);
        }
        if self.last_scan.is_some_and(|last| scan.stamp <= last) {
            return Err(Dropped::TimeBackwards);
        }
        let latest = *self.odometry.back().ok_or(Dropped::NoOdometry)?;
        if scan.stamp.since(latest.stamp) > CARRY {
            return Err(Dropped::StaleOdometry);
        }
        self.last_scan = Some(scan.stamp);
        self.load(scan);
        if self.beams.points.is_empty() {
            return Err(Dropped::NoBeams);
        }
        if self.mode == Mode::Uninitialized {
            return Err(Dropped::NotInitialized);
        }
        let twist = if self.per_odometry() {
            latest.twist
        } else {
            self.tick_at(scan.stamp).ok_or(Dropped::NoOdometry)?
        };
        let posterior = self.posterior.ok_or(Dropped::NoOdometry)?;
        Ok(self.report(scan, &posterior, twist))
    }

    fn predict(&self, stamp: Stamp) -> Option<Pose> {
        let posterior = self.posterior?;
        let (odom, _) = self.odometry_at(stamp, CARRY)?;
        Some(self.map.grid().origin * posterior.mean * odom.since(posterior.odom))
    }

    fn particles(&self, most: usize) -> Vec<WeightedPose> {
        let map_from_grid = self.map.grid().origin;
        let step = self.particles.len().div_ceil(most.max(1)).max(1);
        let particles = self.particles.poses.iter().zip(&self.particles.weights);
        particles
            .step_by(step)
            .map(|([x, y, heading], weight)| WeightedPose {
                pose: map_from_grid * Pose::new(*x, *y, *heading),
                weight: *weight,
            })
            .collect()
    }

    fn hypotheses(&self) -> Vec<Hypothesis> {
        if self.mode != Mode::Searching {
            return Vec::new();
        }
        let map_from_grid = self.map.grid().origin;
        let clusters = self.particles.clusters(MOST_HYPOTHESES).into_iter();
        clusters
            .map(|cluster| {
                let points = &self.beams.points;
                let quality = Quality::of_points(&self.map, points, self.base_link_from_laser, cluster.mean);
                Hypothesis {
                    pose: map_from_grid * cluster.mean,
                    fit: quality.alignment,
                }
            })
            .collect()
    }

    fn set_laser(&mut self, base_link_from_laser: Pose) {
        if base_link_from_laser.is_finite() {
            self.base_link_from_laser = base_link_from_laser;
        }
    }

    fn parameters(&self) -> ParameterValues {
        self.tuning.parameters.to_values()
    }

    fn set_parameters(&mut self, prepared: PreparedParameters) -> Result<(), PreparedParameters> {
        self.tuning = *prepared.downcast::<ReferenceTuning>()?;
        self.table = None;
        // Chosen and measured under the set before.
        self.beams = Beams::default();
        Ok(())
    }

    fn hand_over(&self) -> HandOver {
        let map_from_grid = self.map.grid().origin;
        let estimate = self
            .posterior
            .filter(|_| self.mode == Mode::Tracking)
            .map(|posterior| HandedEstimate {
                stamp: posterior.at,
                pose: map_from_grid * posterior.mean,
                covariance: turned(&self.particles.covariance(posterior.mean), map_from_grid.heading),
            });
        HandOver {
            estimate,
            odometry: self.odometry.iter().copied().collect(),
            yaw_rates: self.yaw_rates.iter().copied().collect(),
            last_scan: self.last_scan,
            updates: self.updates,
        }
    }

    fn take_over(&mut self, from: HandOver) {
        self.odometry = from.odometry.into();
        self.yaw_rates = from.yaw_rates.into();
        self.last_scan = from.last_scan;
        self.updates = from.updates;
        let Some(estimate) = from.estimate else {
            self.start_everywhere();
            return;
        };
        let grid_from_map = self.map.grid_from_map();
        let covariance = turned(&estimate.covariance, grid_from_map.heading);
        let then = grid_from_map * estimate.pose;
        // Particles begin at the latest odometry.
        let moved = self
            .odometry
            .back()
            .and_then(|latest| Some(latest.pose.since(self.odometry_at(estimate.stamp, CARRY)?.0)));
        self.start(then * moved.unwrap_or(Pose::IDENTITY), covariance);
    }
}

/// Most beams of a scanner that we believe in: 0.05 deg all around, twice.
const MOST_BEAMS: usize = 14_400;

/// Whether a scan's geometry makes sense.
fn sound(scan: &Scan) -> bool {
    let count = scan.ranges.len();
    (1..=MOST_BEAMS).contains(&count)
        && scan.angle_min.is_finite()
        && scan.angle_min.abs() < 100.0
        && scan.angle_increment.is_finite()
        && scan.angle_increment.abs() > 1e-6
        && (scan.angle_increment * (count - 1) as f64).abs() < 6.5
        && (0.0..1.0).contains(&(scan.time_increment * count as f64))
        && !scan.range_min.is_nan()
        && !scan.range_max.is_nan()
}

/// End points of the beams with a return, in the frame of `base_link` \[m\].
fn end_points(
    scan: &Scan,
    base_link_from_laser: Pose,
    max_range: f64,
) -> impl Iterator<Item = [f32; 2]> + '_ {
    let valid = scan.range_min.max(0.01)..scan.range_max.min(max_range);
    let point = move |(i, &range): (usize, &f32)| {
        let range = f64::from(range);
        let (sin, cos) = (scan.angle_min + scan.angle_increment * i as f64).sin_cos();
        let end = base_link_from_laser.transform([range * cos, range * sin]);
        valid.contains(&range).then(|| end.map(|v| v as f32))
    };
    scan.ranges.iter().enumerate().filter_map(point)
}

/// A covariance in axes turned by `heading` \[rad\].
fn turned(covariance: &Matrix3<f64>, heading: f64) -> Matrix3<f64> {
    let (sin, cos) = heading.sin_cos();
    let turn = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
    turn * covariance * turn.transpose()
}

/// Standard deviations along and across a heading \[m\].
fn along_and_across(covariance: &Matrix3<f64>, heading: f64) -> [f64; 2] {
    let own = turned(covariance, -heading);
    [own[(0, 0)], own[(1, 1)]].map(|variance| variance.max(0.0).sqrt())
}
