//! The localizer: sensors in, poses out.

use std::sync::Arc;

use localizer::received::CARRY;
use localizer::{
    Dropped, HandOver, HandedEstimate, Hypothesis, Job, JobOutcome, Localizer, Mode, Odometry,
    ParameterFault, ParameterValues, PoseError, PreparedParameters, Scan, ScanFit, SensorFindings, Stamp,
    Update, WeightedPose, YawRate,
};
use maps::{Pose, wrap_angle};
use nalgebra::Matrix3;

use crate::back_end::{BackEndOutcome, BackEndWork, PendingMatch};
use crate::constraint_builder::Search;
use crate::frozen_map::{FrozenMap, Walls};
use crate::graph::Graph;
use crate::local_trajectory_builder::{LocalMatch, LocalTrajectoryBuilder};
use crate::match_errors::MatchErrors;
use crate::parameters::PoseGraphParameters;
use crate::pose_extrapolator::PoseExtrapolator;
use crate::range_data::Points;
use crate::sampler::FixedRatioSampler;
use crate::slip::SlipMeter;
use crate::voxel_filter::adaptive_voxel_filter;
use crate::wall_offset::WallOffset;

/// Why a localizer could not be set up.
#[derive(Debug, thiserror::Error)]
pub enum SetUpError {
    /// A parameter set with faults, all of them.
    #[error("parameter set refused: {}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))]
    Parameters(Vec<ParameterFault>),
    /// A mount that cannot be.
    #[error(transparent)]
    Pose(#[from] PoseError),
}

/// A parameter set that was found sound, for [`Localizer::set_parameters`].
#[derive(Debug, Clone)]
pub struct PoseGraphTuning(PoseGraphParameters);

impl PoseGraphTuning {
    /// Validates a set. Every fault is listed.
    pub fn new(parameters: PoseGraphParameters) -> Result<Self, Vec<ParameterFault>> {
        parameters.validate()?;
        Ok(Self(parameters))
    }
}

/// Nodes that wait to be matched, at most: the oldest are given up.
const MOST_PENDING: usize = 32;

/// During a search, a node is matched with the whole map this often \[s\].
const SEARCH_EVERY: f64 = 0.3;

/// A car that is slower stands [m/s].
const STANDS: f64 = 0.05;

/// A scan that is older than the pose that was set by more than this is dropped \[s\].
const LATE: f64 = 0.5;

/// Time constants of the two averages of the alignment \[s\].
const AVERAGED_OVER: [f64; 2] = [0.5, 5.0];

/// Pose-graph localization. One thread owns it; the map is shared.
///
/// Inside, global poses are in the map's grid frame.
#[derive(Debug)]
pub struct PoseGraph {
    map: Arc<FrozenMap>,
    walls: Arc<Walls>,
    wall_offset: WallOffset,
    base_link_from_laser: Pose,
    parameters: PoseGraphParameters,
    extrapolator: PoseExtrapolator,
    local: LocalTrajectoryBuilder,
    graph: Graph,
    mode: Mode,
    /// A pose that was set before there was odometry, true at the first scan.
    waiting: Option<Pose>,
    sampler: FixedRatioSampler,
    global_sampler: FixedRatioSampler,
    pending: Vec<PendingMatch>,
    nodes_since_optimization: usize,
    /// The back end has something to do.
    wanted: bool,
    /// Number of the work that somebody does elsewhere.
    in_flight: Option<u64>,
    works: u64,
    /// For how long the car has driven since a node matched the map, or the pose was set \[s\].
    unmatched: f64,
    last_node: Option<Stamp>,
    last_search: Option<Stamp>,
    errors: MatchErrors,
    slip: SlipMeter,
    /// Short-term and long-term average of the alignment.
    averages: Option<[f64; 2]>,
    /// The pose that was given out last, and when.
    last: Option<(Stamp, Pose)>,
    last_scan: Option<Stamp>,
    updates: u64,
}

impl PoseGraph {
    /// A localizer on `map` for a laser mounted at `base_link_from_laser`. It has no pose yet.
    pub fn new(
        map: Arc<FrozenMap>,
        base_link_from_laser: Pose,
        parameters: PoseGraphParameters,
    ) -> Result<Self, SetUpError> {
        if !base_link_from_laser.is_finite() {
            return Err(PoseError::NotFinite(base_link_from_laser).into());
        }
        parameters.validate().map_err(SetUpError::Parameters)?;
        Ok(Self {
            local: LocalTrajectoryBuilder::new(0, &parameters),
            graph: Graph::new(Pose::IDENTITY, 0),
            walls: map.walls(0),
            wall_offset: WallOffset::default(),
            map,
            base_link_from_laser,
            parameters,
            extrapolator: PoseExtrapolator::default(),
            mode: Mode::Uninitialized,
            waiting: None,
            sampler: FixedRatioSampler::default(),
            global_sampler: FixedRatioSampler::default(),
            pending: Vec::new(),
            nodes_since_optimization: 0,
            wanted: false,
            in_flight: None,
            works: 0,
            unmatched: 0.0,
            last_node: None,
            last_search: None,
            errors: MatchErrors::default(),
            slip: SlipMeter::default(),
            averages: None,
            last: None,
            last_scan: None,
            updates: 0,
        })
    }

    /// Begins a new trajectory at a pose in the grid's frame, true at `stamp`, or at the first scan.
    fn start(&mut self, stamp: Option<Stamp>, pose: Pose, mode: Mode, errors: MatchErrors) {
        self.local = LocalTrajectoryBuilder::new(self.local.next_submap(), &self.parameters);
        self.graph = Graph::new(Pose::IDENTITY, self.graph.next_id());
        self.pending.clear();
        self.nodes_since_optimization = 0;
        self.wanted = false;
        self.in_flight = None;
        self.mode = mode;
        self.errors = errors;
        self.unmatched = 0.0;
        self.last_node = stamp;
        self.last_search = None;
        self.slip.clear();
        self.averages = None;
        self.last = None;
        self.waiting = None;
        match stamp {
            Some(stamp) => self.extrapolator.add_pose(stamp, pose),
            None => self.waiting = Some(pose),
        }
    }

    /// Begins a search of the whole map.
    fn start_search(&mut self) {
        let occupancy = &self.map.occupancy;
        let middle =
            [occupancy.width, occupancy.height].map(|cells| 0.5 * cells as f64 * occupancy.resolution);
        let sigma = middle[0].hypot(middle[1]).max(1.0);
        let errors = MatchErrors::with([sigma, sigma, 2.0]);
        let pose = Pose::new(middle[0], middle[1], 0.0);
        self.start(self.extrapolator.latest(), pose, Mode::Searching, errors);
    }

    /// What the back end is to do.
    fn work(&mut self) -> BackEndWork {
        self.wanted = false;
        self.works += 1;
        self.in_flight = Some(self.works);
        let optimize = self.nodes_since_optimization >= self.parameters.optimize_every_n_nodes;
        if optimize {
            self.nodes_since_optimization = 0;
        }
        BackEndWork {
            number: self.works,
            map: Arc::clone(&self.map),
            walls: Arc::clone(&self.walls),
            wall_offset: self.wall_offset,
            graph: self.graph.clone(),
            pending: std::mem::take(&mut self.pending),
            optimize,
            parameters: self.parameters.clone(),
        }
    }

    fn finish(&mut self, outcome: &BackEndOutcome) {
        if self.in_flight != Some(outcome.number) {
            return;
        }
        self.in_flight = None;
        self.graph.adopt(&outcome.graph);
        self.walls = Arc::clone(&outcome.walls);
        self.wall_offset = outcome.wall_offset;
        for matched in &outcome.matches {
            if self.mode == Mode::Searching {
                self.errors = MatchErrors::default();
                self.mode = Mode::Tracking;
                self.last = None;
            } else {
                self.errors.add(matched.predicted, matched.found.pose);
            }
            self.unmatched = 0.0;
        }
    }

    /// Adds a node to the graph, and notes it for matching if its turn has come.
    fn add_node(&mut self, stamp: Stamp, odom: Pose, matched: &LocalMatch) {
        let Some(submaps) = &matched.inserted else { return };
        let parameters = &self.parameters;
        // A car that stands has few nodes, and its pose does not drift.
        if let Some((last, pose)) = self.last_node.zip(self.graph.last_local()) {
            let pause = stamp.since(last);
            if pose.distance(matched.pose) > STANDS * pause {
                self.unmatched += pause;
            }
        }
        self.last_node = Some(stamp);
        let (node, global) = self
            .graph
            .add(matched.pose, odom, submaps, parameters.max_submaps_to_keep);
        self.nodes_since_optimization += 1;
        let lost = self.unmatched > parameters.global_constraint_search_after_n_seconds;
        let search = match self.mode {
            Mode::Searching => None,
            _ if lost && self.global_sampler.pulse(parameters.global_sampling_ratio) => {
                Some(Search::Anywhere)
            }
            _ => (0..parameters.frozen_submaps_in_reach)
                .fold(false, |any, _| {
                    self.sampler.pulse(parameters.sampling_ratio) || any
                })
                .then_some(Search::Around(global)),
        };
        let due = self
            .last_search
            .is_none_or(|last| stamp.since(last) >= SEARCH_EVERY);
        let search = if self.mode == Mode::Searching && due && self.in_flight.is_none() {
            self.last_search = Some(stamp);
            self.wanted = true;
            Some(Search::Anywhere)
        } else {
            search
        };
        if let Some(search) = search {
            if self.pending.len() >= MOST_PENDING {
                self.pending.remove(0);
            }
            let points = adaptive_voxel_filter(
                &matched.points,
                parameters.loop_closure_voxel_max_length,
                parameters.loop_closure_voxel_min_num_points,
                parameters.loop_closure_voxel_max_range,
            );
            self.pending.push(PendingMatch {
                node,
                search,
                predicted: global,
                points,
            });
        }
        if self.nodes_since_optimization >= parameters.optimize_every_n_nodes {
            self.wanted = true;
        }
    }

    /// Checks a scan against those before, and brings its beams to its stamp.
    fn preprocess(&mut self, scan: &Scan) -> Result<(Points, Pose), Dropped> {
        if self.last_scan.is_some_and(|last| scan.stamp <= last) {
            return Err(Dropped::TimeBackwards);
        }
        let latest = self.extrapolator.latest().ok_or(Dropped::NoOdometry)?;
        if scan.stamp.since(latest) > CARRY {
            return Err(Dropped::StaleOdometry);
        }
        let odom = self
            .extrapolator
            .odometry_at(scan.stamp, CARRY)
            .ok_or(Dropped::StaleOdometry)?;
        let carry = CARRY + 1.0;
        let moved = |stamp| Some(self.extrapolator.odometry_at(stamp, carry)?.since(odom));
        let points = Points::read(scan, self.base_link_from_laser, &self.parameters, moved)?;
        self.last_scan = Some(scan.stamp);
        if self.mode == Mode::Uninitialized {
            return Err(Dropped::NotInitialized);
        }
        if let Some(pose) = self.waiting.take() {
            self.extrapolator.add_pose(scan.stamp, pose);
        }
        if self
            .extrapolator
            .last_pose()
            .is_some_and(|(at, _)| scan.stamp.since(at) < -LATE)
        {
            return Err(Dropped::TimeBackwards);
        }
        Ok((points, odom))
    }

    /// How well a scan fits the map at a pose in the grid's frame.
    fn fit(&self, points: &Points, pose: Pose) -> ScanFit {
        let (grid, field) = (&self.map.occupancy, &self.map.field);
        ScanFit::measure(grid, field, &points.returns, self.base_link_from_laser, pose)
    }

    /// Ratio of the short-term to the long-term average of the alignment.
    fn w_ratio(&mut self, fit: &ScanFit, seconds: f64) -> f64 {
        let aligned = fit.clear_alignment();
        let averages = self.averages.get_or_insert([aligned; 2]);
        for (average, over) in averages.iter_mut().zip(AVERAGED_OVER) {
            *average += (1.0 - (-seconds.max(0.0) / over).exp()) * (aligned - *average);
        }
        if averages[1] > 0.0 {
            averages[0] / averages[1]
        } else {
            1.0
        }
    }
}

impl Localizer for PoseGraph {
    fn initialize(&mut self, pose: Pose) -> Result<(), PoseError> {
        if !pose.is_finite() {
            return Err(PoseError::NotFinite(pose));
        }
        let occupancy = &self.map.occupancy;
        let at = occupancy.origin.inverse() * pose;
        let inside = |v: f64, cells: usize| (0.0..=cells as f64 * occupancy.resolution).contains(&v);
        if !(inside(at.x, occupancy.width) && inside(at.y, occupancy.height)) {
            return Err(PoseError::OffMap(pose));
        }
        self.start(
            self.extrapolator.latest(),
            at,
            Mode::Tracking,
            MatchErrors::default(),
        );
        Ok(())
    }

    fn relocalize(&mut self) {
        self.start_search();
    }

    fn on_odometry(&mut self, odometry: &Odometry) -> Result<(), Dropped> {
        self.extrapolator.add_odometry(odometry, &self.parameters)
    }

    fn on_yaw_rate(&mut self, yaw_rate: &YawRate) -> Result<(), Dropped> {
        self.extrapolator.add_yaw_rate(yaw_rate)
    }

    fn on_scan(&mut self, scan: &Scan) -> Result<Update, Dropped> {
        if self.wanted && self.in_flight.is_none() {
            // Nobody took it.
            let outcome = self.work().run();
            self.finish(&outcome);
        }
        let (points, odom) = self.preprocess(scan)?;
        let stamp = scan.stamp;
        let prediction = self
            .extrapolator
            .extrapolate(stamp, CARRY, self.parameters.use_imu_data)
            .ok_or(Dropped::StaleOdometry)?;
        let before = self.extrapolator.last_pose();
        let predicted = self
            .predict_global(before, prediction)
            .unwrap_or_else(|| self.graph.global_from_local() * prediction);
        let matched = self.local.add(
            stamp,
            &points,
            self.base_link_from_laser,
            prediction,
            &self.parameters,
        );
        self.extrapolator.add_pose(stamp, matched.pose);
        let way = before.map_or(0.0, |(_, pose)| pose.distance(matched.pose));
        self.errors.drive(way);
        self.add_node(stamp, odom, &matched);

        let pose = self.graph.global_from_local() * matched.pose;
        let fit = self.fit(&points, pose);
        let [slip, yaw_rate_residual] = self.slip.add(stamp, matched.pose, odom);
        let seconds = self.last.map_or(0.0, |(at, _)| stamp.since(at));
        let w_ratio = self.w_ratio(&fit, seconds);
        let innovation = if self.mode == Mode::Tracking {
            [
                pose.distance(predicted),
                wrap_angle(pose.heading - predicted.heading).abs(),
            ]
        } else {
            [0.0; 2]
        };
        self.last = Some((stamp, pose));
        self.updates += 1;
        let map_from_base_link = self.map.occupancy.origin * pose;
        Ok(Update {
            stamp,
            number: self.updates,
            pose: map_from_base_link,
            twist: self.extrapolator.twist(stamp),
            covariance: self.errors.covariance(map_from_base_link.heading),
            mode: self.mode,
            particles: 0,
            ess_ratio: 1.0,
            spread: self.errors.along_and_across(),
            second_mode: 0.0,
            alignment: fit.alignment,
            residual: fit.residual,
            short_beams: fit.short_beams,
            long_beams: fit.long_beams,
            no_return: points.no_return,
            w_ratio,
            innovation,
            odometry_jump: self.extrapolator.take_jump(),
            slip,
            yaw_rate_residual,
            sensors: SensorFindings::default(),
            doubt: None,
            trust: None,
        })
    }

    fn predict(&self, stamp: Stamp) -> Option<Pose> {
        self.last?;
        let local = self
            .extrapolator
            .extrapolate(stamp, CARRY, self.parameters.use_imu_data)?;
        Some(self.map.occupancy.origin * self.graph.global_from_local() * local)
    }

    fn particles(&self, _most: usize) -> Vec<WeightedPose> {
        Vec::new()
    }

    fn hypotheses(&self) -> Vec<Hypothesis> {
        Vec::new()
    }

    fn take_job(&mut self) -> Option<Job> {
        if !self.wanted || self.in_flight.is_some() {
            return None;
        }
        let work = self.work();
        Some(Box::new(move || Box::new(work.run())))
    }

    fn finish_job(&mut self, outcome: JobOutcome) {
        if let Ok(outcome) = outcome.downcast::<BackEndOutcome>() {
            self.finish(&outcome);
        }
    }

    fn set_laser(&mut self, base_link_from_laser: Pose) {
        if base_link_from_laser.is_finite() {
            self.base_link_from_laser = base_link_from_laser;
        }
    }

    fn parameters(&self) -> ParameterValues {
        self.parameters.to_values()
    }

    fn set_parameters(&mut self, prepared: PreparedParameters) -> Result<(), PreparedParameters> {
        let PoseGraphTuning(parameters) = *prepared.downcast::<PoseGraphTuning>()?;
        self.parameters = parameters;
        Ok(())
    }

    fn hand_over(&self) -> HandOver {
        let estimate = self
            .last
            .filter(|_| self.mode == Mode::Tracking)
            .map(|(stamp, pose)| {
                let pose = self.map.occupancy.origin * pose;
                HandedEstimate {
                    stamp,
                    pose,
                    covariance: self.errors.covariance(pose.heading),
                }
            });
        HandOver {
            estimate,
            odometry: self.extrapolator.received(),
            yaw_rates: self.extrapolator.yaw_rates(),
            last_scan: self.last_scan,
            updates: self.updates,
        }
    }

    fn take_over(&mut self, from: HandOver) {
        // What was received once was sound, or is left out again.
        for odometry in &from.odometry {
            self.extrapolator.add_odometry(odometry, &self.parameters).ok();
        }
        for yaw_rate in &from.yaw_rates {
            self.extrapolator.add_yaw_rate(yaw_rate).ok();
        }
        self.extrapolator.take_jump();
        self.last_scan = from.last_scan;
        self.updates = from.updates;
        let Some(estimate) = from.estimate else {
            self.start_search();
            return;
        };
        let pose = self.map.occupancy.origin.inverse() * estimate.pose;
        let sigma = own_sigma(&estimate.covariance, estimate.pose.heading);
        let stamp = Some(estimate.stamp);
        self.start(stamp, pose, Mode::Tracking, MatchErrors::with(sigma));
        // There is a pose to predict from before the next scan.
        self.last = Some((estimate.stamp, pose));
    }
}

impl PoseGraph {
    /// The pose that was given out, carried on to a local prediction: what a correction is held against.
    fn predict_global(&self, before: Option<(Stamp, Pose)>, prediction: Pose) -> Option<Pose> {
        let (_, local) = before?;
        let (_, pose) = self.last?;
        Some(pose * prediction.since(local))
    }
}

/// Standard deviations along and across a heading, and of the heading.
fn own_sigma(covariance: &Matrix3<f64>, heading: f64) -> [f64; 3] {
    let (sin, cos) = heading.sin_cos();
    let turn = Matrix3::new(cos, sin, 0.0, -sin, cos, 0.0, 0.0, 0.0, 1.0);
    let own = turn * covariance * turn.transpose();
    [0, 1, 2].map(|k| own[(k, k)].max(0.0).sqrt())
}
