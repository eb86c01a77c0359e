//! Where the checks of the sensors meet the filter: what each scan teaches them, and what they have found.

use localizer::received::CARRY;
use localizer::{Scan, SensorFindings};
use maps::Pose;
use nalgebra::{Matrix3, Vector3};

use super::{Step, SynPf};
use crate::calibration::SlipModel;
use crate::estimate::Estimate;
use crate::scan_matcher::{fit, match_scan};
use crate::sensor_check::{ScanGeometry, Silence, SweepCheck};
use crate::{Dropped, Mode};

/// End points by which both readings of a sweep are compared.
const COMPARED: usize = 180;

/// Variances by which the prediction is loosened for that [m^2], [m^2], [rad^2]: 0.2 m and 0.1 rad.
const COMPARED_PRIOR: [f64; 3] = [0.04, 0.04, 0.01];

impl SynPf {
    /// Refuses a scan that repeats an earlier one, and reads its geometry.
    pub(super) fn check_scan(&mut self, scan: &Scan) -> Result<ScanGeometry, Dropped> {
        let driven = self.odometry.driven_sums();
        if self.sensors.repeats(scan, &driven) {
            return Err(Dropped::RepeatedScan);
        }
        let mut geometry = self.sensors.geometry(scan);
        geometry.lag = self.sensors.lag.lag();
        Ok(geometry)
    }

    /// Notes whether the car moves though odometry stands. Returns what is known of it when that has just been found.
    pub(super) fn check_silence(&mut self, scan: &Scan, geometry: &ScanGeometry) -> Option<Silence> {
        let (driven, silent) = (self.odometry.driven_sums(), self.odometry.silent_messages());
        let laser = self.base_link_from_laser;
        let silence = self.sensors.silence(scan, geometry, laser, &driven, silent)?;
        self.odometry.carry_on(silence.twist);
        Some(silence)
    }

    /// Loads the scan, also as the sweep that it may be, and notes whether the car stands.
    pub(super) fn load_scan(&mut self, scan: &Scan, geometry: &ScanGeometry) -> Result<(), Dropped> {
        let (slip, laser) = (self.calibration.slip, self.base_link_from_laser);
        let (max_range, beams) = (self.parameters.sensor.max_range, &self.parameters.beams);
        self.scan
            .load((scan, geometry), &self.odometry, slip, laser, max_range, beams)?;
        let (driven, speed) = (self.odometry.driven_sums(), self.odometry.speed());
        self.odometry.corrections.standing = self.sensors.stands(scan, geometry, laser, &driven, speed);
        self.as_sweep.points.clear();
        if self.mode == Mode::Tracking
            && beams.deskew
            && let Some(sweep) = geometry.as_sweep()
            && let Some((_, twist)) = self.odometry.at(scan.stamp, CARRY)
            && SweepCheck::can_tell(
                twist.linear_x,
                twist.angular,
                sweep.time_increment * scan.ranges.len() as f64,
            )
        {
            // Where it cannot be read so, there is nothing to compare.
            self.as_sweep
                .load((scan, &sweep), &self.odometry, slip, laser, max_range, beams)
                .ok();
        }
        Ok(())
    }

    /// The estimate was moved by a scan from `predicted` on; `moved` is the motion since the scan before.
    pub(super) fn learn_sensors(&mut self, step: &Step, predicted: &Estimate, moved: Pose) {
        if !self.parameters.refinement.refine {
            return;
        }
        let estimate = self.tracker.estimate;
        let (sin, cos) = predicted.pose.heading.sin_cos();
        let ahead = Vector3::new(cos, sin, 0.0);
        let along = |of: &Estimate| (ahead.transpose() * of.covariance * ahead)[0];
        let information = 1.0 - along(&estimate) / along(predicted).max(1e-12);
        if step.seconds > 0.0 {
            let twist = moved.log().map(|v| v / step.seconds);
            self.odometry.correct_twist(twist, information);
        }
        let told = 1.0 / along(&estimate).max(1e-12) - 1.0 / along(predicted).max(1e-12);
        self.sensors.note_pose(estimate.pose, step.seconds, told);
        self.compare_sweep(predicted);
        let Some(latest) = self.odometry.latest() else {
            return;
        };
        let mut corrections = self.odometry.corrections;
        let (track, lag) = (&self.odometry, self.sensors.lag.lag());
        let rescaled = self.sensors.learn(
            step.stamp,
            estimate.pose,
            information,
            latest,
            |stamp| track.driven_until(stamp),
            &mut corrections,
        );
        self.odometry.corrections = corrections;
        if rescaled {
            // What it had learned of the slip was the scale.
            self.calibration.slip_model = SlipModel::default();
        }
        let now = self.sensors.lag.lag();
        if now.to_bits() != lag.to_bits() {
            let odom = self.odometry.at(step.stamp.plus(-now), CARRY);
            self.tracker.at = odom.map(|(odom, _)| (step.stamp, odom));
        }
    }

    /// Holds the scan as it is stated against the same as a sweep: which fits the map better?
    fn compare_sweep(&mut self, predicted: &Estimate) {
        let Self {
            map,
            scan,
            as_sweep,
            calibration,
            parameters,
            sensors,
            ..
        } = self;
        if as_sweep.points.is_empty() {
            return;
        }
        let (field, refinement) = (map.field(), &parameters.refinement);
        // The prediction agrees with the reading that was used so far: it must not decide.
        let prior = Estimate {
            covariance: predicted.covariance + Matrix3::from_diagonal(&Vector3::from(COMPARED_PRIOR)),
            ..*predicted
        };
        let share = |points: &[[f32; 2]]| {
            let matched = match_scan(
                field,
                points,
                prior.pose,
                &prior,
                &prior.covariance,
                calibration.walls,
                refinement,
            );
            let reach = refinement.refine_reach as f32;
            fit(field, points, COMPARED, matched.estimate.pose, reach)
        };
        sensors.sweep.learn(share(&scan.points), share(&as_sweep.points));
    }

    /// What is wrong with the sensors.
    pub(super) fn sensor_findings(&self) -> SensorFindings {
        let mut findings = SensorFindings::default();
        self.sensors.report(self.odometry.speed(), &mut findings);
        self.odometry.report(&mut findings);
        findings
    }
}
