//! The localizer: sensors in, poses out.

mod stages;

use std::sync::Arc;

use maps::Pose;
use nalgebra::{Matrix3, Vector3};

#[doc(hidden)]
pub use self::stages::Stage;
use crate::motion_model::Motion;
use crate::odometry_track::OdometryTrack;
use crate::particle_estimate::ParticleEstimate;
use crate::particles::Particles;
use crate::preprocessed_scan::PreprocessedScan;
use crate::quality::Quality;
use crate::ranges::Ranges;
use crate::recovery::Doubt;
use crate::refine::{Estimate, fit, refine};
use crate::resampling::Proposal;
use crate::search::{INDEPENDENT, Search, fit_of};
use crate::sensor_model::SensorModel;
use crate::slip::{Slip, SlipWindow};
use crate::slip_model::SlipModel;
use crate::surprise::Surprise;
use crate::walls::Walls;
use crate::{
    Dropped, HandOver, Hypothesis, Localizer, Mode, Odometry, ParameterFault, ParameterValues, Parameters,
    PoseError, PreparedParameters, Scan, Stamp, TrackMap, Twist, Update, WeightedPose, YawRate,
};

/// Why a localizer could not be set up.
#[derive(Debug, thiserror::Error)]
pub enum SetUpError {
    /// The map has no free cell, so there is nowhere to be.
    #[error("the map has no free cell ({width} x {height} cells)")]
    NoFreeSpace {
        /// Cells along x.
        width: usize,
        /// Cells along y.
        height: usize,
    },
    /// A parameter set with faults, all of them.
    #[error("parameter set refused: {}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))]
    Parameters(Vec<ParameterFault>),
    /// A mount or a pose that cannot be.
    #[error(transparent)]
    Pose(#[from] PoseError),
}

/// Longest that odometry is carried on beyond its last message [s]; a scan later than that is dropped.
const CARRY: f64 = 0.25;

/// A pause between scans after which the motion is uncertain beyond its tuning [s].
const GAP: f64 = 0.5;

/// By how much the noise is wider after such a pause.
const AFTER_GAP: f64 = 2.0;

/// How far the speed of wheels that spin or lock may be off, as a share of it.
const SPINNING_SPEED_ERROR: f64 = 0.6;

/// Reach at which predictions are compared by their fit [m].
const FIT_REACH: f32 = 0.15;

/// By how much the particles' mean must fit better than the estimate's own prediction to be preferred.
const FIT_MARGIN: f64 = 0.08;

/// SynPF. One thread owns it; the map is shared.
///
/// Inside, poses are in the grid's frame; see [`TrackMap`].
#[derive(Debug, Clone)]
pub struct SynPf {
    map: Arc<TrackMap>,
    base_link_from_laser: Pose,
    parameters: Parameters,
    sensor_model: SensorModel,
    ranges: Option<(usize, Ranges)>,
    track: OdometryTrack,
    scan: PreprocessedScan,
    particles: Particles,
    mode: Mode,
    /// The posterior at `at`, and odometry's pose there.
    estimate: Estimate,
    at: Option<(Stamp, Pose)>,
    last_scan: Option<Stamp>,
    number: u64,
    search: Search,
    doubt: Doubt,
    surprise: Surprise,
    slip_window: SlipWindow,
    slip: Slip,
    slip_model: SlipModel,
    /// See [`Update::odometry_jump`].
    odometry_jump: Option<[f64; 2]>,
    /// The walls as the laser sees them, as learned so far.
    walls: Walls,
    w_ratio: f64,
    /// Updates since the pose was set or found, while the doubt is not yet to be trusted.
    settled: u32,
    per_odometry: PerOdometry,
}

/// What `defect_update_per_odometry` keeps: odometry is applied one message late.
#[derive(Debug, Clone, Default)]
struct PerOdometry {
    last: Option<Odometry>,
    delayed: Pose,
    have_scan: bool,
}

impl SynPf {
    /// A localizer on `map` for a laser mounted at `base_link_from_laser`. It has no pose yet.
    pub fn new(
        map: Arc<TrackMap>,
        base_link_from_laser: Pose,
        parameters: Parameters,
        seed: u64,
    ) -> Result<Self, SetUpError> {
        if !base_link_from_laser.is_finite() {
            return Err(PoseError::NotFinite(base_link_from_laser).into());
        }
        parameters.validate().map_err(SetUpError::Parameters)?;
        let sensor_model = SensorModel::new(&parameters, map.grid().resolution);
        let particles = Particles::new(seed, parameters.particles.max_particles);
        Ok(Self {
            map,
            base_link_from_laser,
            parameters,
            sensor_model,
            ranges: None,
            track: OdometryTrack::default(),
            scan: PreprocessedScan::default(),
            particles,
            mode: Mode::Uninitialized,
            estimate: Estimate {
                pose: Pose::IDENTITY,
                covariance: Matrix3::zeros(),
            },
            at: None,
            last_scan: None,
            number: 0,
            search: Search::default(),
            doubt: Doubt::default(),
            surprise: Surprise::default(),
            slip_window: SlipWindow::default(),
            slip: Slip::default(),
            slip_model: SlipModel::default(),
            odometry_jump: None,
            walls: Walls::default(),
            w_ratio: 1.0,
            settled: 0,
            per_odometry: PerOdometry::default(),
        })
    }

    /// Starts from a pose of `base_link` in `map`, true at the latest odometry (or, before there is any, at the
    /// first scan), with the set's initial spread. Fails for a pose that is not finite or not on the map's image.
    pub fn initialize(&mut self, pose: Pose) -> Result<(), PoseError> {
        if !pose.is_finite() {
            return Err(PoseError::NotFinite(pose));
        }
        if !self.map.covers(pose) {
            return Err(PoseError::OffMap(pose));
        }
        self.map.prepare(Some(pose), &self.parameters);
        let particles = &self.parameters.particles;
        let sigma = [
            particles.initial_std_x,
            particles.initial_std_y,
            particles.initial_std_heading,
        ];
        let pose = self.map.grid_from_map() * pose;
        let covariance = Matrix3::from_diagonal(&Vector3::from(sigma.map(|s| s * s + 1e-8)));
        self.start(Estimate { pose, covariance }, sigma);
        self.at = self
            .track
            .latest()
            .and_then(|stamp| Some((stamp, self.track.at(stamp, 0.0)?.0)));
        Ok(())
    }

    /// Takes an estimate in the grid's frame as the truth, with particles spread around it.
    fn start(&mut self, estimate: Estimate, sigma: [f64; 3]) {
        self.estimate = estimate;
        self.particles
            .scatter(self.parameters.particles.max_particles, estimate.pose, sigma);
        self.mode = Mode::Tracking;
        self.search = Search::default();
        self.doubt.clear();
        self.surprise = Surprise::default();
        self.slip_window.clear();
        self.slip = Slip::default();
        self.slip_model.forget_pose();
        self.settled = 0;
    }

    /// Forgets the pose and searches the whole map with the next scans.
    pub fn relocalize(&mut self) {
        self.mode = Mode::Searching;
        self.search = Search::default();
        self.doubt.clear();
        self.surprise = Surprise::default();
        self.slip_window.clear();
    }

    /// The poses that a search under way has found, best first; empty when none is.
    pub fn hypotheses(&self) -> Vec<Hypothesis> {
        let map_from_grid = self.map.grid().origin;
        let public = |candidate: &crate::search::Candidate| Hypothesis {
            pose: map_from_grid * candidate.estimate.pose,
            fit: (candidate.score / INDEPENDENT).exp(),
        };
        self.search.candidates.iter().map(public).collect()
    }

    /// Swaps the parameter set between two updates; the particles stay. On `Err` nothing has changed. Builds the
    /// tables of the sensor model, which takes some milliseconds; see [`SynPf::tune`] to have that done elsewhere.
    pub fn set_parameters(&mut self, parameters: Parameters) -> Result<(), Vec<ParameterFault>> {
        self.tune(Tuning::new(parameters, &self.map)?);
        Ok(())
    }

    /// Swaps in a parameter set made ready on another thread; takes no time.
    pub fn tune(&mut self, tuning: Tuning) {
        self.parameters = tuning.parameters;
        self.sensor_model = tuning.sensor_model;
        self.ranges = None;
    }

    /// The set in force.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// The map it localizes on.
    pub fn map(&self) -> &Arc<TrackMap> {
        &self.map
    }

    /// Takes in odometry. Cheap.
    pub fn on_odometry(&mut self, odometry: &Odometry) -> Result<(), Dropped> {
        self.track
            .push(odometry, self.parameters.motion.use_imu, &self.slip_model)?;
        if self.parameters.defects.defect_update_per_odometry {
            self.update_per_odometry(odometry);
        }
        Ok(())
    }

    /// Takes in a gyroscope's reading; used in place of odometry's yaw rate where the set says so. Cheap.
    pub fn on_yaw_rate(&mut self, yaw_rate: &YawRate) -> Result<(), Dropped> {
        self.track.push_yaw_rate(yaw_rate)
    }

    /// The whole update: move, weigh, refine, judge, resample.
    pub fn on_scan(&mut self, scan: &Scan) -> Result<Update, Dropped> {
        if self.last_scan.is_some_and(|last| scan.stamp <= last) {
            return Err(Dropped::TimeBackwards);
        }
        let latest = self.track.latest().ok_or(Dropped::NoOdometry)?;
        if scan.stamp.since(latest) > CARRY {
            return Err(Dropped::StaleOdometry);
        }
        let (odom, twist) = self.track.at(scan.stamp, CARRY).ok_or(Dropped::NoOdometry)?;
        let max_range = self.parameters.sensor.max_range;
        self.scan.load(
            scan,
            &self.track,
            self.slip,
            self.base_link_from_laser,
            max_range,
            &self.parameters.beams,
        )?;
        self.last_scan = Some(scan.stamp);
        if self.parameters.defects.defect_update_per_odometry && self.mode == Mode::Tracking {
            return self.latest_of_odometry();
        }
        let (before, odom_before) = self.at.unwrap_or((scan.stamp, odom));
        let seconds = scan.stamp.since(before);
        if seconds < 0.0 {
            return Err(Dropped::TimeBackwards);
        }
        let motion = odom.since(odom_before);
        let leap = self.track.take_leap();
        self.odometry_jump =
            leap.map(|leap| [odom.distance(leap * odom), maps::wrap_angle(leap.heading).abs()]);
        match self.mode {
            Mode::Uninitialized => return Err(Dropped::NotInitialized),
            Mode::Tracking => {
                let moved = leap.filter(|_| self.parameters.recovery.recover).map(|leap| {
                    let from = self.estimate.pose;
                    [from * motion, from * (leap * odom).since(odom_before)]
                });
                if let Some(poses) = moved
                    && let Some(search) = Search::after_jump(&self.map, &self.scan, poses, &self.parameters)
                {
                    self.relocalize();
                    self.search = search;
                    self.estimate.pose = poses[0];
                    self.at = Some((scan.stamp, odom));
                    return Ok(self.report(scan.stamp, twist, None, Pose::IDENTITY));
                }
            }
            Mode::Searching => {
                self.at = Some((scan.stamp, odom));
                let found = self
                    .search
                    .update(&self.map, &self.scan, motion, seconds, &self.parameters);
                if let Some(estimate) = found {
                    let spread = |i: usize, least: f64| estimate.covariance[(i, i)].sqrt().max(least);
                    self.start(estimate, [spread(0, 0.1), spread(1, 0.1), spread(2, 0.05)]);
                    return Ok(self.report(scan.stamp, twist, None, Pose::IDENTITY));
                }
                if let Some(best) = self.search.candidates.first() {
                    self.estimate = best.estimate;
                }
                return Ok(self.report(scan.stamp, twist, None, Pose::IDENTITY));
            }
        }
        let update = self.follow(scan.stamp, seconds, motion, twist);
        self.at = Some((scan.stamp, odom));
        Ok(update)
    }

    /// One update of the pose that is followed.
    fn follow(&mut self, stamp: Stamp, seconds: f64, motion: Pose, twist: Twist) -> Update {
        let widen = self.widen(seconds);
        let parameters = &self.parameters;
        let noise = self.noise(motion, seconds, widen);
        let mut predicted = self.estimate.moved(motion, &noise);
        let learns = parameters.motion.learn_slip && parameters.refinement.refine;
        let drive = self.track.drive();
        if learns {
            self.slip_model
                .advance(self.estimate.pose, &mut predicted, motion.x, drive, seconds);
        } else {
            self.slip_model = SlipModel::default();
        }
        let wheels = motion.x / (1.0 - self.slip_model.share(drive));

        self.particles.advance(&Motion::new(
            motion,
            seconds,
            widen,
            &parameters.motion,
            parameters.defects,
        ));
        self.weigh(predicted.pose);
        let sound = self.particles.normalize();
        let belief = self.particles.estimate();

        let before = self.estimate.pose;
        if self.parameters.refinement.refine && sound {
            let (estimate, followed) = self.refined(&predicted, &belief);
            self.estimate = estimate;
            if learns && followed {
                self.slip_model.learn(&predicted, &estimate);
            } else {
                self.slip_model.forget_pose();
            }
        } else {
            self.estimate = Estimate {
                pose: belief.mean,
                covariance: belief.covariance,
            };
        }
        self.learn_walls(motion);
        let innovation = self.estimate.pose.since(predicted.pose);
        if seconds > 0.0 {
            self.slip_window
                .push(stamp, seconds, wheels, motion, self.estimate.pose.since(before));
            self.slip = self.slip_window.slip();
        }
        self.report(stamp, twist, Some((belief, seconds)), innovation)
    }

    /// Learns how the walls stand, and how end points scatter about them, by the scan at the estimate.
    fn learn_walls(&mut self, motion: Pose) {
        let parameters = &self.parameters.refinement;
        if !parameters.refine || parameters.wall_offset_distance <= 0.0 {
            self.walls = Walls::default();
            return;
        }
        let seen = Walls::seen(
            self.map.field(),
            &self.scan.points,
            self.estimate.pose,
            self.walls,
        );
        if let Some(seen) = seen {
            self.walls.learn(seen, motion.x, parameters);
        }
    }

    /// By how much the noise is wider than tuned: after a pause, or with slip where the set adapts. The larger of the two: the
    /// noise grows with the way as it is, and a prediction that allows everything is as easily pulled to a wrong place.
    fn widen(&self, seconds: f64) -> f64 {
        let pause = if seconds > GAP { AFTER_GAP } else { 1.0 };
        if !self.parameters.motion.adaptive {
            return pause;
        }
        let slip = self.slip.unexplained.abs() / 0.05 + self.slip.yaw_rate.abs() / 0.5;
        (1.0 + slip).min(4.0).max(pause)
    }

    /// Uncertainty of a motion in the frame of its start, for the refined estimate.
    fn noise(&self, motion: Pose, seconds: f64, widen: f64) -> Matrix3<f64> {
        let p = &self.parameters.motion;
        let distance = motion.x.hypot(motion.y);
        let steady = [
            p.diffusion_xy.powi(2) * seconds,
            p.diffusion_heading.powi(2) * seconds,
        ];
        let along = if self.slip_model.spinning() {
            // Wheels that lock stand still, and the car slides on.
            let way = distance.max(self.slip_window.speed().abs() * seconds);
            p.odometry_speed_error.max(SPINNING_SPEED_ERROR) * way
        } else {
            p.odometry_speed_error * distance
        };
        let along = (along * widen).powi(2) + steady[0];
        let across = (p.odometry_side_error * distance * widen).powi(2) + steady[0];
        let turn = (p.odometry_yaw_error * motion.heading * widen).powi(2) + steady[1];
        Matrix3::from_diagonal(&Vector3::new(along, across, turn))
    }

    /// Adds the scan's log-likelihood to the particles, with the ranges of the region that the car is in.
    fn weigh(&mut self, near: Pose) {
        let region = self.map.region_at(near);
        let known = self.ranges.as_ref().map(|(of, _)| *of);
        let index = region.unwrap_or_else(|| known.unwrap_or(usize::MAX));
        if known != Some(index) {
            self.ranges = Some((
                index,
                self.sensor_model.ranges(&self.map, region, &self.parameters),
            ));
        }
        if let Some((_, ranges)) = &self.ranges {
            self.sensor_model.reweight(
                &mut self.particles,
                &self.scan,
                &self.map,
                ranges,
                self.base_link_from_laser,
            );
        }
    }

    /// The scan fitted around the prediction, or around the particles where they explain the scan better. Says whether
    /// the prediction was followed.
    fn refined(&self, predicted: &Estimate, belief: &ParticleEstimate) -> (Estimate, bool) {
        let parameters = &self.parameters.refinement;
        let field = self.map.field();
        let fit = |pose| fit(field, &self.scan.points, 60, pose, FIT_REACH);
        let particles = Estimate {
            pose: belief.mean,
            covariance: belief.covariance + Matrix3::identity() * 1e-4,
        };
        let own = fit(predicted.pose);
        let from_predicted = refine(
            field,
            &self.scan.points,
            predicted.pose,
            predicted,
            self.walls,
            parameters,
        );
        let own_refined = fit(from_predicted.pose);
        if fit(particles.pose) > own.max(own_refined) + FIT_MARGIN {
            let from_particles = refine(
                field,
                &self.scan.points,
                particles.pose,
                &particles,
                self.walls,
                parameters,
            );
            if fit(from_particles.pose) > own_refined + FIT_MARGIN {
                return (from_particles, false);
            }
        }
        // A fit that made things worse has run away.
        if own_refined + FIT_MARGIN < own {
            (*predicted, true)
        } else {
            (from_predicted, true)
        }
    }

    /// Judges the estimate, decides on searching and resampling, and says how it went.
    fn report(
        &mut self,
        stamp: Stamp,
        twist: Twist,
        belief: Option<(ParticleEstimate, f64)>,
        innovation: Pose,
    ) -> Update {
        self.number += 1;
        let quality = Quality::new(&self.map, &self.scan, self.estimate.pose);
        let (mut spread, mut ess_ratio, mut second_mode) = ([0.0; 2], 1.0, 0.0);
        if let Some((belief, seconds)) = belief {
            spread = along_and_across(&belief.covariance, belief.mean.heading);
            ess_ratio = belief.ess_ratio;
            if spread[0].max(spread[1]) > 0.2 {
                second_mode = self.particles.second_mode();
            }
            self.settled = self.settled.saturating_add(1);
            let recovery = &self.parameters.recovery;
            self.w_ratio = self
                .doubt
                .push(quality.clear_alignment().max(0.02), quality.alignment, recovery);
            // The mean of the particles jitters too much for a slight fall to say anything.
            if self.parameters.refinement.refine {
                let correction = [innovation.y.abs(), innovation.heading.abs()];
                let fit = fit_of(&self.map, &self.scan, self.estimate.pose);
                self.surprise.push(fit, correction, recovery);
            }
            let lost = self.settled > 10
                && self.doubt.lost(
                    quality.clear_alignment(),
                    quality.long,
                    quality.short,
                    seconds,
                    recovery,
                );
            if recovery.recover && lost {
                self.relocalize();
            } else if !(recovery.recover && self.settled > 10 && self.better_elsewhere(&quality, seconds)) {
                self.resample(ess_ratio);
            }
        }
        let map_from_grid = self.map.grid().origin;
        let (sin, cos) = map_from_grid.heading.sin_cos();
        let turn = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
        Update {
            stamp,
            number: self.number,
            pose: map_from_grid * self.estimate.pose,
            twist,
            covariance: turn * self.estimate.covariance * turn.transpose(),
            mode: self.mode,
            particles: self.particles.len(),
            ess_ratio,
            spread,
            second_mode,
            alignment: quality.alignment,
            residual: quality.residual,
            short_beams: quality.short,
            long_beams: quality.long,
            no_return: self.scan.no_return,
            w_ratio: self.w_ratio,
            innovation: [innovation.x.hypot(innovation.y), innovation.heading.abs()],
            odometry_jump: self.odometry_jump,
            slip: self.slip.ratio,
            yaw_rate_residual: self.slip.yaw_rate,
        }
    }

    /// Whether the scan fits another place of the map clearly better; if so, the search has begun.
    fn better_elsewhere(&mut self, quality: &Quality, seconds: f64) -> bool {
        if !self.doubt.asks(
            quality.clear_alignment(),
            self.w_ratio,
            self.surprise.fall().is_some(),
            seconds,
            &self.parameters.recovery,
        ) {
            return false;
        }
        match Search::second_opinion(
            &self.map,
            &self.scan,
            self.estimate.pose,
            self.doubt.sudden(),
            self.surprise.fall(),
            &self.parameters,
        ) {
            Some(search) => {
                self.relocalize();
                self.search = search;
                true
            }
            None => false,
        }
    }

    /// Resamples when the weights have become uneven, feeding the refined estimate back, and injecting particles
    /// along the track when the fit has fallen.
    fn resample(&mut self, ess_ratio: f64) {
        let parameters = &self.parameters;
        if ess_ratio > parameters.particles.resample_ess_ratio {
            return;
        }
        let count = self.particles.kld_sample_size(&parameters.particles);
        self.particles.resample(count);
        let feedback = parameters.refinement.refine.then(|| {
            let floor = Matrix3::from_diagonal(&Vector3::new(1e-4, 1e-4, 1e-5));
            (self.estimate.covariance + floor).cholesky()
        });
        let feedback = feedback.flatten().map(|root| Proposal {
            mean: self.estimate.pose,
            root: root.l(),
            share: parameters.refinement.refine_feedback,
        });
        let recovery = &parameters.recovery;
        let injected = (recovery.injection && self.w_ratio < recovery.injection_ratio).then(|| {
            // Along the track the estimate is most often wrong: slip, and walls without features.
            let along = Matrix3::from_diagonal(&Vector3::new(1.0, 0.2, 0.1));
            let (sin, cos) = self.estimate.pose.heading.sin_cos();
            let turn = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
            Proposal {
                mean: self.estimate.pose,
                root: turn * along,
                share: recovery.injection_share * (1.0 - self.w_ratio),
            }
        });
        self.particles
            .replace_at_random(feedback.into_iter().chain(injected));
    }

    /// The reference's cycle: one update per odometry message, with the latest scan and the motion before the last.
    fn update_per_odometry(&mut self, odometry: &Odometry) {
        let last = self.per_odometry.last.replace(*odometry);
        let Some(last) = last else { return };
        let motion = std::mem::replace(&mut self.per_odometry.delayed, odometry.pose.since(last.pose));
        if self.mode != Mode::Tracking || !self.per_odometry.have_scan {
            return;
        }
        let seconds = odometry.stamp.since(last.stamp);
        let still = self.parameters.defects.defect_deadband && motion.x.hypot(motion.y) < 0.01;
        if !still {
            let parameters = &self.parameters;
            self.particles.advance(&Motion::new(
                motion,
                seconds,
                1.0,
                &parameters.motion,
                parameters.defects,
            ));
        }
        self.particles.log_weight.fill(0.0);
        self.weigh(self.estimate.pose);
        self.particles.normalize();
        let belief = self.particles.estimate();
        self.estimate = Estimate {
            pose: belief.mean,
            covariance: belief.covariance,
        };
        let count = self.parameters.particles.max_particles;
        self.particles.resample(count);
        self.at = Some((odometry.stamp, odometry.pose));
    }

    /// What the reference would publish at a scan: the result of the latest odometry.
    fn latest_of_odometry(&mut self) -> Result<Update, Dropped> {
        self.per_odometry.have_scan = true;
        let last = self.per_odometry.last.ok_or(Dropped::NoOdometry)?;
        Ok(self.report(last.stamp, last.twist, None, Pose::IDENTITY))
    }

    /// The latest posterior carried forward to `stamp` by the odometry since, for publishing at odometry rate.
    /// None before the first update.
    pub fn predict(&self, stamp: Stamp) -> Option<Pose> {
        let (_, odom_then) = self.at?;
        let (odom, _) = self.track.at(stamp, CARRY)?;
        Some(self.map.grid().origin * self.estimate.pose * odom.since(odom_then))
    }

    /// The particles with their weights, at the latest update's stamp.
    pub fn particles(&self) -> impl Iterator<Item = WeightedPose> + '_ {
        let map_from_grid = self.map.grid().origin;
        let p = &self.particles;
        (0..p.len()).map(move |i| WeightedPose {
            pose: map_from_grid * p.poses.get(i),
            weight: p.weight[i].into(),
        })
    }
}

impl Localizer for SynPf {
    fn initialize(&mut self, pose: Pose) -> Result<(), PoseError> {
        Self::initialize(self, pose)
    }

    fn relocalize(&mut self) {
        Self::relocalize(self);
    }

    fn on_odometry(&mut self, odometry: &Odometry) -> Result<(), Dropped> {
        Self::on_odometry(self, odometry)
    }

    fn on_yaw_rate(&mut self, yaw_rate: &YawRate) -> Result<(), Dropped> {
        Self::on_yaw_rate(self, yaw_rate)
    }

    fn on_scan(&mut self, scan: &Scan) -> Result<Update, Dropped> {
        Self::on_scan(self, scan)
    }

    fn predict(&self, stamp: Stamp) -> Option<Pose> {
        Self::predict(self, stamp)
    }

    fn particles(&self, most: usize) -> Vec<WeightedPose> {
        let step = self.particles.len().div_ceil(most.max(1)).max(1);
        Self::particles(self).step_by(step).collect()
    }

    fn hypotheses(&self) -> Vec<Hypothesis> {
        Self::hypotheses(self)
    }

    fn parameters(&self) -> ParameterValues {
        self.parameters.to_values()
    }

    fn set_parameters(&mut self, prepared: PreparedParameters) -> Result<(), PreparedParameters> {
        self.tune(*prepared.downcast::<Tuning>()?);
        Ok(())
    }

    fn hand_over(&self) -> HandOver {
        HandOver {
            estimate: None,
            odometry: Vec::new(),
            yaw_rates: Vec::new(),
            last_scan: self.last_scan,
            updates: self.number,
        }
    }

    fn take_over(&mut self, from: HandOver) {
        self.number = from.updates;
        self.last_scan = from.last_scan;
    }
}

/// A parameter set with the tables that it needs, made ready away from the filter's loop.
#[derive(Debug, Clone)]
pub struct Tuning {
    parameters: Parameters,
    sensor_model: SensorModel,
}

impl Tuning {
    /// Validates a set and builds its tables. Every fault is listed.
    pub fn new(parameters: Parameters, map: &TrackMap) -> Result<Self, Vec<ParameterFault>> {
        parameters.validate()?;
        let sensor_model = SensorModel::new(&parameters, map.grid().resolution);
        Ok(Self {
            parameters,
            sensor_model,
        })
    }
}

/// Standard deviations along and across a heading [m].
fn along_and_across(covariance: &Matrix3<f64>, heading: f64) -> [f64; 2] {
    let (sin, cos) = heading.sin_cos();
    let (xx, xy, yy) = (covariance[(0, 0)], covariance[(0, 1)], covariance[(1, 1)]);
    let along = cos * cos * xx + 2.0 * sin * cos * xy + sin * sin * yy;
    let across = sin * sin * xx - 2.0 * sin * cos * xy + cos * cos * yy;
    [along.max(0.0).sqrt(), across.max(0.0).sqrt()]
}
