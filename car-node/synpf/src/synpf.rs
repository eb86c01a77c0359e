//! The localizer: sensors in, poses out.
//!
//! [`SynPf::on_scan`] is the algorithm; each step of it is a function below it.

mod sensor_hooks;
pub(crate) mod stages;

use std::sync::Arc;

use localizer::received::CARRY;
use localizer::{
    Doubt, Dropped, HandOver, HandedEstimate, Hypothesis, Job, JobOutcome, Localizer, Mode, Odometry,
    ParameterFault, ParameterValues, PoseError, PreparedParameters, Scan, Stamp, Twist, Update, WeightedPose,
    YawRate,
};
use maps::{Pose, wrap_angle};
use nalgebra::{Matrix3, Vector3};

use crate::calibration::{Calibration, SlipModel};
use crate::error::SetUpError;
use crate::estimate::{Estimate, rotation};
use crate::global_search::{GlobalCheck, GlobalCheckOutcome, SearchSettings};
use crate::motion_model::Motion;
use crate::odometry_track::OdometryTrack;
use crate::parameters::Parameters;
use crate::particle_filter::{ParticleFilter, Weighted};
use crate::preprocessed_scan::PreprocessedScan;
use crate::quality::Quality;
use crate::recovery::{Decision, Evidence, Recovery};
use crate::sensor_check::{SensorCheck, Silence};
use crate::track_map::TrackMap;
use crate::tracker::{Tracker, Uncertainty};
use crate::tuning::Tuning;

/// SynPF. One thread owns it; the map is shared.
///
/// Inside, poses are in the grid's frame; see [`TrackMap`].
#[derive(Debug, Clone)]
pub struct SynPf {
    map: Arc<TrackMap>,
    base_link_from_laser: Pose,
    parameters: Parameters,
    odometry: OdometryTrack,
    scan: PreprocessedScan,
    /// The same, read as a sweep while it is not known whether it is one; empty otherwise.
    as_sweep: PreprocessedScan,
    sensors: SensorCheck,
    filter: ParticleFilter,
    tracker: Tracker,
    calibration: Calibration,
    recovery: Recovery,
    mode: Mode,
    last_scan: Option<Stamp>,
    /// Updates so far.
    number: u64,
}

/// What one scan brings: its time, and the motion since the estimate.
#[derive(Debug, Clone, Copy)]
struct Step {
    stamp: Stamp,
    /// Time since the estimate \[s\].
    seconds: f64,
    /// Time from the first beam to the last \[s\].
    sweep: f64,
    /// Calibrated odometry's pose at the stamp.
    odom: Pose,
    twist: Twist,
    /// Motion of `base_link` since the estimate, without odometry's discontinuities.
    motion: Pose,
    /// Odometry has just been found to stand still while the car moves: the motion is that by the scans.
    silence: Option<Silence>,
    /// Where the estimate would be carried with them; None without any.
    displaced: Option<Pose>,
    /// See [`Update::odometry_jump`].
    odometry_jump: Option<[f64; 2]>,
}

/// A scan that is older than the pose that was set by more than this is dropped \[s\].
const LATE: f64 = 0.5;

/// A pause between scans after which the motion is uncertain beyond its tuning \[s\].
const PAUSE: f64 = 0.5;

/// By how much the noise is wider after such a pause.
const AFTER_PAUSE: f64 = 2.0;

/// Slip is taken to go on as it was for so long after a scan \[s\].
const AHEAD: f64 = 0.1;

/// Least standard deviations of the particles around a pose that a search has found \[m\], \[m\], \[rad\].
const FOUND_SPREAD: [f64; 3] = [0.1, 0.1, 0.05];

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
        let Tuning {
            parameters,
            sensor_model,
        } = Tuning::new(parameters).map_err(SetUpError::Parameters)?;
        #[cfg(feature = "gpu")]
        if parameters.sensor.range_method == crate::RangeMethod::Gpu {
            map.gpu()
                .map_err(|error| SetUpError::Parameters(vec![crate::tuning::gpu_fault(&error)]))?;
        }
        Ok(Self {
            base_link_from_laser,
            odometry: OdometryTrack::default(),
            scan: PreprocessedScan::default(),
            as_sweep: PreprocessedScan::default(),
            sensors: SensorCheck::default(),
            filter: ParticleFilter::new(seed, parameters.particles.max_particles, sensor_model),
            tracker: Tracker::unknown(&map),
            calibration: Calibration::default(),
            recovery: Recovery::new(parameters.recovery.clone(), search_settings(&parameters)),
            mode: Mode::Uninitialized,
            last_scan: None,
            number: 0,
            map,
            parameters,
        })
    }

    /// Takes in a scan and updates the pose.
    pub fn on_scan(&mut self, scan: &Scan) -> Result<Update, Dropped> {
        let step = self.preprocess(scan)?;
        let predicted = self.predict(&step);
        let weighted = self.reweight(&predicted);
        let correction = self.fit(&step, &predicted, weighted.as_ref());
        let quality = self.assess();
        let mut quality = self.recover(&step, correction, quality);
        if step.silence.is_some_and(|silence| silence.lost) && self.mode == Mode::Tracking {
            self.relocalize();
            quality = self.assess();
        }
        self.resample(weighted.as_ref());
        Ok(self.update(&step, &predicted, weighted.as_ref(), &quality))
    }

    /// Checks the scan, brings its beams to its stamp, and works out the motion since the estimate.
    fn preprocess(&mut self, scan: &Scan) -> Result<Step, Dropped> {
        if self.last_scan.is_some_and(|last| scan.stamp <= last) {
            return Err(Dropped::TimeBackwards);
        }
        let latest = self.odometry.latest().ok_or(Dropped::NoOdometry)?;
        if scan.stamp.since(latest) > CARRY {
            return Err(Dropped::StaleOdometry);
        }
        let geometry = self.check_scan(scan)?;
        // By odometry's clock.
        let stamp = scan.stamp.plus(-geometry.lag);
        let (odom, twist) = self.odometry.at(stamp, CARRY).ok_or(Dropped::NoOdometry)?;
        let silence = self.check_silence(scan, &geometry);
        self.load_scan(scan, &geometry)?;
        self.last_scan = Some(scan.stamp);
        let (before, odom_before) = self.tracker.at.unwrap_or((scan.stamp, odom));
        // A pose that was just set is true at the latest odometry, and the next scan was taken before that.
        let seconds = scan.stamp.since(before);
        if seconds < -LATE {
            return Err(Dropped::TimeBackwards);
        }
        let discontinuity = self.odometry.take_discontinuity();
        if self.mode == Mode::Uninitialized {
            return Err(Dropped::NotInitialized);
        }
        Ok(Step {
            stamp: scan.stamp,
            seconds: seconds.abs(),
            sweep: geometry.time_increment * scan.ranges.len() as f64,
            odom,
            twist,
            motion: silence.and_then(|silence| silence.pose).map_or_else(
                || odom.since(odom_before),
                |pose| pose.since(self.tracker.estimate.pose),
            ),
            silence,
            displaced: discontinuity.map(|by| self.tracker.estimate.pose * (by * odom).since(odom_before)),
            odometry_jump: discontinuity.map(|by| [odom.distance(by * odom), wrap_angle(by.heading).abs()]),
        })
    }

    /// Carries the estimate and the particles on by odometry.
    fn predict(&mut self, step: &Step) -> Estimate {
        let Step { seconds, motion, .. } = *step;
        let parameters = &self.parameters;
        let calibration = &mut self.calibration;
        let factor = noise_factor(seconds, calibration, parameters.motion.adaptive);
        let slides =
            calibration.slip_model.spinning() || self.odometry.wheels_slide() || step.silence.is_some();
        let sliding = slides.then(|| calibration.speed());
        let uncertainty = Uncertainty {
            factor,
            sliding,
            carried: self.odometry.is_carried(),
        };
        let mut predicted = self
            .tracker
            .predict(motion, seconds, uncertainty, &parameters.motion);
        if self.mode == Mode::Tracking {
            if learns_slip(parameters) {
                let (from, drive) = (self.tracker.estimate.pose, self.odometry.drive());
                calibration
                    .slip_model
                    .advance(from, &mut predicted, motion.x, drive, seconds);
            } else {
                calibration.slip_model = SlipModel::default();
            }
            let motion = Motion::new(motion, seconds, factor, &parameters.motion);
            self.filter.predict(&motion);
        }
        predicted
    }

    /// Weighs the particles by the scan; None during a search, when they follow nothing.
    fn reweight(&mut self, predicted: &Estimate) -> Option<Weighted> {
        let Self {
            map,
            scan,
            parameters,
            ..
        } = self;
        (self.mode == Mode::Tracking).then(|| self.filter.reweight(map, scan, predicted.pose, parameters))
    }

    /// Fits the whole scan to the map around the prediction, and calibrates by the result. Returns the correction, in the
    /// prediction's frame; None where nothing was fitted.
    fn fit(&mut self, step: &Step, predicted: &Estimate, weighted: Option<&Weighted>) -> Option<Pose> {
        self.tracker.at = Some((step.stamp, step.odom));
        let Some(weighted) = weighted else {
            self.tracker.set(*predicted);
            return None;
        };
        let Self {
            parameters,
            calibration,
            ..
        } = self;
        let (field, points) = (self.map.field(), &self.scan.points);
        let before = self.tracker.estimate;
        let fit = self.tracker.fit_scan(
            field,
            points,
            predicted,
            weighted,
            calibration.walls,
            &parameters.refinement,
        );
        let estimate = fit.estimate;
        self.tracker.update(predicted, &fit);
        let turn = rotation(estimate.pose.heading);
        self.tracker.sweep_error = turn * calibration.sweep_error(step.sweep) * turn.transpose();

        let drive = self.odometry.drive();
        let wheel_distance = step.motion.x / (1.0 - calibration.slip_model.share(drive));
        let refused = fit.refused.map(|pose| pose.since(predicted.pose));
        let since_before = self.tracker.since_before;
        let acceleration = drive.acceleration.hypot(drive.lateral);
        self.tracker
            .gate
            .note(refused, fit.held, since_before, acceleration);
        self.tracker.gate.learn_drift(
            estimate.pose,
            fit.on_walls,
            (fit.held, fit.believed),
            since_before,
        );
        if !fit.held {
            self.tracker.gate.learn_fit(fit.on_walls, step.motion.x);
        }
        if learns_slip(parameters)
            && fit.from_prediction
            && !fit.held
            && !self.odometry.wheels_slide()
            && !self.odometry.is_carried()
        {
            calibration.slip_model.learn(predicted, &estimate);
        } else {
            calibration.slip_model.forget_pose();
        }
        let moved = estimate.pose.since(before.pose);
        calibration.learn_slip(step.stamp, step.seconds, wheel_distance, step.motion, moved);
        let refined = parameters.refinement.refine;
        let distance = if refined {
            parameters.refinement.wall_offset_distance
        } else {
            0.0
        };
        if !fit.held {
            calibration.learn_walls(field, points, &estimate, step.motion.x, distance);
        }
        self.learn_sensors(step, predicted, moved);
        refined.then(|| estimate.pose.since(predicted.pose))
    }

    /// Judges how the scan fits the map at the estimate.
    fn assess(&self) -> Quality {
        Quality::new(&self.map, &self.scan, self.tracker.estimate.pose)
    }

    /// Decides whether the estimate is believed, and where the car is if it is not. Returns how the scan fits at the estimate
    /// that stands.
    fn recover(&mut self, step: &Step, correction: Option<Pose>, quality: Quality) -> Quality {
        let decision = self.recovery.update(&Evidence {
            map: &self.map,
            scan: &self.scan,
            estimate: &self.tracker.estimate,
            quality: &quality,
            correction,
            motion: step.motion,
            displaced: step.displaced,
            seconds: step.seconds,
            scatter: self.calibration.walls.scatter,
        });
        match decision {
            Decision::Keep => return quality,
            Decision::Found(estimate) => {
                let sigma = Vector3::from_fn(|i, _| estimate.covariance[(i, i)].sqrt().max(FOUND_SPREAD[i]));
                let covariance = Matrix3::from_diagonal(&sigma.map(|sigma| sigma * sigma));
                self.start(
                    estimate,
                    &Estimate {
                        covariance,
                        ..estimate
                    },
                );
                self.recovery.follow_found();
            }
            Decision::Searching(best) => {
                self.mode = Mode::Searching;
                self.calibration.forget_pose();
                self.sensors.forget_pose();
                match best {
                    Some(best) => self.tracker.set(best),
                    None => self.tracker.forget(&self.map),
                }
            }
        }
        self.assess()
    }

    /// Resamples the particles when their weights have become uneven.
    fn resample(&mut self, weighted: Option<&Weighted>) {
        if let Some(weighted) = weighted
            && self.mode == Mode::Tracking
        {
            self.filter.resample(
                weighted.particles.ess_ratio,
                &self.tracker.estimate,
                self.recovery.w_ratio(),
                &self.parameters,
            );
        }
    }

    /// Sums the scan up.
    fn update(
        &mut self,
        step: &Step,
        predicted: &Estimate,
        weighted: Option<&Weighted>,
        quality: &Quality,
    ) -> Update {
        self.number += 1;
        let map_from_grid = self.map.grid().origin;
        let mut estimate = self.tracker.posterior();
        let doubt = self
            .recovery
            .doubt()
            .or_else(|| self.tracker.gate.doubt(estimate.pose));
        if let Some(doubt) = doubt {
            estimate.covariance = doubt.widened(&estimate);
        }
        let estimate = estimate.transformed(map_from_grid);
        let (mut spread, mut ess_ratio, mut second_mode) = ([0.0; 2], 1.0, 0.0);
        let mut innovation = Pose::IDENTITY;
        if let Some(Weighted { particles, .. }) = weighted {
            let cloud = Estimate {
                pose: particles.mean,
                covariance: particles.covariance,
            };
            let (of_cloud, own) = (
                cloud.along_and_across(),
                self.tracker.posterior().along_and_across(),
            );
            spread = [of_cloud[0].max(own[0]), of_cloud[1].max(own[1])];
            ess_ratio = particles.ess_ratio;
            if self.mode == Mode::Tracking {
                innovation = self.tracker.estimate.pose.since(predicted.pose);
            }
            if spread[0].max(spread[1]) > 0.2 {
                second_mode = self.filter.particles.second_mode();
            }
        }
        Update {
            stamp: step.stamp,
            number: self.number,
            pose: estimate.pose,
            twist: step.twist,
            covariance: estimate.covariance,
            mode: self.mode,
            particles: self.filter.particles.len(),
            ess_ratio,
            spread,
            second_mode,
            alignment: quality.alignment,
            residual: quality.residual,
            short_beams: quality.short,
            long_beams: quality.long,
            no_return: self.scan.no_return,
            w_ratio: self.recovery.w_ratio(),
            innovation: [innovation.x.hypot(innovation.y), innovation.heading.abs()],
            odometry_jump: step.odometry_jump,
            slip: self.calibration.slip.ratio,
            yaw_rate_residual: self.calibration.slip.yaw_rate,
            doubt: doubt.map(|doubt| Doubt {
                probability: doubt.probability,
                rival: doubt.rival.map(|pose| map_from_grid * pose),
            }),
            trust: Some(self.recovery.trust()),
            sensors: self.sensor_findings(),
        }
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
        self.map.request_tables(Some(pose), &self.parameters);
        let particles = &self.parameters.particles;
        let sigma = [
            particles.initial_std_x,
            particles.initial_std_y,
            particles.initial_std_heading,
        ];
        let estimate = Estimate {
            pose: self.map.grid_from_map() * pose,
            covariance: Matrix3::from_diagonal(&Vector3::from(sigma.map(|s| s * s + 1e-8))),
        };
        self.start(estimate, &estimate);
        self.tracker.at = self
            .odometry
            .latest()
            .and_then(|stamp| Some((stamp, self.odometry.at(stamp, 0.0)?.0)));
        Ok(())
    }

    /// Follows an estimate from now on, with particles drawn from `cloud`.
    fn start(&mut self, estimate: Estimate, cloud: &Estimate) {
        self.mode = Mode::Tracking;
        self.tracker.set(estimate);
        self.filter
            .scatter(self.parameters.particles.max_particles, cloud);
        self.recovery.follow();
        self.calibration.forget_pose();
        self.sensors.forget_pose();
    }

    /// Forgets the pose and searches the whole map with the next scans. The last pose stays in the updates until a candidate
    /// is found, with a covariance that allows the whole map.
    pub fn relocalize(&mut self) {
        self.mode = Mode::Searching;
        self.tracker.forget(&self.map);
        self.recovery.start_search();
        self.calibration.forget_pose();
        self.sensors.forget_pose();
    }

    /// The poses that a search under way has found, best first; empty when none is.
    pub fn hypotheses(&self) -> Vec<Hypothesis> {
        let map_from_grid = self.map.grid().origin;
        let candidates = self.recovery.candidates().iter();
        candidates
            .map(|candidate| Hypothesis {
                pose: map_from_grid * candidate.estimate.pose,
                fit: candidate.fit(),
            })
            .collect()
    }

    /// The look at the whole map that the latest scan has asked for; None when none is wanted. It takes as long as many
    /// updates: a caller with a thread to spare runs it there and hands the outcome in with [`SynPf::finish_global_check`].
    /// The next scan does what nobody has taken.
    pub fn take_global_check(&mut self) -> Option<GlobalCheck> {
        self.recovery.take_check(&self.map)
    }

    /// Takes in what a look at the whole map has found. The odometry since is applied to it. An outcome that is no longer asked
    /// for is ignored.
    pub fn finish_global_check(&mut self, outcome: GlobalCheckOutcome) {
        self.recovery.finish_check(outcome);
    }

    /// Swaps the parameter set between two updates; the particles stay. On `Err` nothing has changed. Builds the
    /// tables of the sensor model, which takes some milliseconds; see [`SynPf::tune`] to have that done elsewhere.
    pub fn set_parameters(&mut self, parameters: Parameters) -> Result<(), Vec<ParameterFault>> {
        self.tune(Tuning::new(parameters)?);
        Ok(())
    }

    /// Swaps in a parameter set made ready on another thread; takes no time.
    pub fn tune(&mut self, tuning: Tuning) {
        let Tuning {
            parameters,
            sensor_model,
        } = tuning;
        self.filter.set_sensor_model(sensor_model);
        self.recovery
            .set_parameters(parameters.recovery.clone(), search_settings(&parameters));
        self.parameters = parameters;
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
        let use_imu = self.parameters.motion.use_imu;
        self.odometry
            .push(odometry, use_imu, &self.calibration.slip_model)
    }

    /// Takes in a gyroscope's reading; used in place of odometry's yaw rate where the set says so. Cheap.
    pub fn on_yaw_rate(&mut self, yaw_rate: &YawRate) -> Result<(), Dropped> {
        self.odometry.push_yaw_rate(yaw_rate)
    }

    /// The particles with their weights, at the latest update's stamp.
    pub fn particles(&self) -> impl Iterator<Item = WeightedPose> + '_ {
        let map_from_grid = self.map.grid().origin;
        let p = &self.filter.particles;
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
        let (then, odom_then) = self.tracker.at?;
        let (odom, _) = self.odometry.at(stamp, CARRY)?;
        let motion = odom.since(odom_then);
        // What odometry got wrong just now it still gets wrong for a moment.
        let seconds = stamp.since(then);
        let motion = if (0.0..AHEAD).contains(&seconds) {
            self.calibration.slip.corrected(motion, seconds)
        } else {
            motion
        };
        Some(self.map.grid().origin * self.tracker.estimate.pose * motion)
    }

    fn particles(&self, most: usize) -> Vec<WeightedPose> {
        let step = self.filter.particles.len().div_ceil(most.max(1)).max(1);
        Self::particles(self).step_by(step).collect()
    }

    fn hypotheses(&self) -> Vec<Hypothesis> {
        Self::hypotheses(self)
    }

    fn set_laser(&mut self, base_link_from_laser: Pose) {
        if base_link_from_laser.is_finite() {
            self.base_link_from_laser = base_link_from_laser;
        }
    }

    fn take_job(&mut self) -> Option<Job> {
        let check = self.take_global_check()?;
        Some(Box::new(move || Box::new(check.run())))
    }

    fn finish_job(&mut self, outcome: JobOutcome) {
        if let Ok(outcome) = outcome.downcast() {
            self.finish_global_check(*outcome);
        }
    }

    fn parameters(&self) -> ParameterValues {
        self.parameters.to_values()
    }

    fn set_parameters(&mut self, prepared: PreparedParameters) -> Result<(), PreparedParameters> {
        self.tune(*prepared.downcast::<Tuning>()?);
        Ok(())
    }

    fn hand_over(&self) -> HandOver {
        let estimate = self.tracker.posterior().transformed(self.map.grid().origin);
        let following = self.tracker.at.filter(|_| self.mode == Mode::Tracking);
        HandOver {
            estimate: following.map(|(stamp, _)| HandedEstimate {
                stamp,
                pose: estimate.pose,
                covariance: estimate.covariance,
            }),
            odometry: self.odometry.received().copied().collect(),
            yaw_rates: self.odometry.yaw_rates().copied().collect(),
            last_scan: self.last_scan,
            updates: self.number,
        }
    }

    /// Takes the other's raw odometry into a track of its own and follows the handed estimate from its stamp on.
    fn take_over(&mut self, from: HandOver) {
        self.number = from.updates;
        self.last_scan = from.last_scan;
        self.odometry = OdometryTrack::replayed(
            &from.odometry,
            &from.yaw_rates,
            self.parameters.motion.use_imu,
            &self.calibration.slip_model,
        );
        let sound = |handed: &HandedEstimate| {
            handed.pose.is_finite()
                && self.map.covers(handed.pose)
                && handed.covariance.iter().all(|v| v.is_finite())
        };
        let Some(handed) = from.estimate.filter(sound) else {
            return self.relocalize();
        };
        let estimate = Estimate {
            pose: handed.pose,
            covariance: handed.covariance,
        }
        .transformed(self.map.grid_from_map());
        self.start(estimate, &estimate);
        let odom = self.odometry.at(handed.stamp, CARRY);
        self.tracker.at = odom.map(|(odom, _)| (handed.stamp, odom));
    }
}

/// Whether slip is learned and taken out of odometry: only a fit of the whole scan is exact enough.
fn learns_slip(parameters: &Parameters) -> bool {
    parameters.motion.learn_slip && parameters.refinement.refine
}

/// By how much the noise is wider than tuned: after a pause, or with slip where the set adapts. The larger of the two: a
/// prediction that allows everything is as easily pulled to a wrong place.
fn noise_factor(seconds: f64, calibration: &Calibration, adaptive: bool) -> f64 {
    let pause = if seconds > PAUSE { AFTER_PAUSE } else { 1.0 };
    if !adaptive {
        return pause;
    }
    let slip = calibration.slip.unexplained.abs() / 0.05 + calibration.slip.yaw_rate.abs() / 0.5;
    (1.0 + slip).min(4.0).max(pause)
}

fn search_settings(parameters: &Parameters) -> SearchSettings {
    SearchSettings {
        search: parameters.search.clone(),
        refinement: parameters.refinement.clone(),
    }
}
