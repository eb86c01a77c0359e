//! Another localizer, such as AMCL or Cartographer, under the same eyes: its poses are taken as they come, carried to each scan
//! by odometry, and judged as those of our own localizers are.

use std::collections::VecDeque;
use std::sync::Arc;

use localizer::received::{CARRY, FASTEST_TURN, KEPT, is_possible, keep_yaw_rate};
use maps::Pose;
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use synpf::{
    Dropped, ExternalPose, HandOver, HandedEstimate, Hypothesis, Localizer, Mode, Odometry, ParameterFault,
    ParameterValues, PoseError, PoseOf, PreparedParameters, Scan, SensorFindings, Stamp, TrackMap, Twist,
    Update, WeightedPose, YawRate,
};

/// Slip is judged over this long \[s\]: single poses of other localizers scatter by centimetres.
const SLIP_TIME: f64 = 1.0;
/// Slip is a share of the way, and none below this \[m\].
const SHORTEST: f64 = 0.3;
/// Poses that are kept to judge slip.
const MOST_ANCHORS: usize = 256;
/// No angle of a scanner is larger \[rad\], and no scan takes longer \[s\].
const MOST_GEOMETRY: f64 = 100.0;
/// Most beams of a scanner that we believe in.
const MOST_BEAMS: usize = 14_400;

/// What is assumed of a localizer that says little about itself.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ExternalParameters {
    /// Standard deviation of a pose without a covariance \[m\].
    pub assumed_std: f64,
    /// The same of its heading \[rad\].
    pub assumed_std_heading: f64,
    /// Share of the way since the latest pose by which its standard deviation grows.
    pub drift: f64,
    /// How much the heading's standard deviation grows on that way [rad/m].
    pub drift_heading: f64,
    /// Ranges from here on are no measurement \[m\].
    pub max_range: f64,
}

impl Default for ExternalParameters {
    fn default() -> Self {
        Self {
            assumed_std: 0.1,
            assumed_std_heading: 0.05,
            drift: 0.05,
            drift_heading: 0.02,
            max_range: 30.0,
        }
    }
}

impl ExternalParameters {
    /// Every value that is out of its range.
    pub fn validate(&self) -> Result<(), Vec<ParameterFault>> {
        let ranges = [
            ("assumed_std", self.assumed_std, 1e-3..=10.0),
            ("assumed_std_heading", self.assumed_std_heading, 1e-3..=3.0),
            ("drift", self.drift, 0.0..=1.0),
            ("drift_heading", self.drift_heading, 0.0..=1.0),
            ("max_range", self.max_range, 1.0..=200.0),
        ];
        let faults: Vec<_> = ranges
            .into_iter()
            .filter(|(_, value, range)| !range.contains(value))
            .map(|(key, value, range)| ParameterFault {
                key: key.into(),
                fault: format!("{value} is not in {} to {}", range.start(), range.end()),
            })
            .collect();
        if faults.is_empty() { Ok(()) } else { Err(faults) }
    }

    /// The set as flat keys and values.
    pub fn to_values(&self) -> ParameterValues {
        localizer::to_values(self)
    }

    /// The set with some values replaced, and the keys that are unknown.
    pub fn with_values(
        &self,
        given: impl IntoIterator<Item = (String, serde_json::Value)>,
    ) -> Result<(Self, Vec<String>), Vec<ParameterFault>> {
        localizer::overlay(self, given, Self::validate)
    }
}

/// Where odometry's frame is in `map` by one pose of the other localizer.
#[derive(Debug, Clone, Copy)]
struct Anchor {
    stamp: Stamp,
    map_from_odom: Pose,
    /// Odometry's pose then; None where the other localizer gives `map_from_odom` itself.
    odom: Option<Pose>,
    covariance: Matrix3<f64>,
}

/// Follows another localizer.
#[derive(Debug)]
pub struct External {
    map: Arc<TrackMap>,
    base_link_from_laser: Pose,
    parameters: ExternalParameters,
    odometry: VecDeque<Odometry>,
    yaw_rates: VecDeque<YawRate>,
    /// The newest pose while odometry has not come as far.
    pending: Option<ExternalPose>,
    /// Oldest first.
    anchors: VecDeque<Anchor>,
    /// Way by odometry since the newest anchor \[m\].
    way: f64,
    /// How far the newest anchor moved the pose \[m\], \[rad\]; taken by the next update.
    correction: [f64; 2],
    /// The latest update: time, pose and covariance.
    estimate: Option<HandedEstimate>,
    last_pose: Option<Stamp>,
    last_scan: Option<Stamp>,
    updates: u64,
}

impl External {
    /// A follower on `map` for a laser mounted at `base_link_from_laser`.
    pub fn new(
        map: Arc<TrackMap>,
        base_link_from_laser: Pose,
        parameters: ExternalParameters,
    ) -> Result<Self, synpf::SetUpError> {
        parameters.validate().map_err(synpf::SetUpError::Parameters)?;
        if !base_link_from_laser.is_finite() {
            return Err(PoseError::NotFinite(base_link_from_laser).into());
        }
        Ok(Self {
            map,
            base_link_from_laser,
            parameters,
            odometry: VecDeque::new(),
            yaw_rates: VecDeque::new(),
            pending: None,
            anchors: VecDeque::new(),
            way: 0.0,
            correction: [0.0; 2],
            estimate: None,
            last_pose: None,
            last_scan: None,
            updates: 0,
        })
    }

    /// Odometry's pose and velocity at a stamp: between two messages, or carried on beyond the last.
    fn odometry_at(&self, stamp: Stamp) -> Option<(Pose, Twist)> {
        let after = self.odometry.partition_point(|odometry| odometry.stamp <= stamp);
        let from = self.odometry.get(after.saturating_sub(1))?;
        let seconds = stamp.since(from.stamp);
        if let Some(to) = self.odometry.get(after)
            && seconds >= 0.0
        {
            let share = seconds / to.stamp.since(from.stamp);
            return Some((from.pose.interpolate(to.pose, share), from.twist));
        }
        let Twist {
            linear_x,
            linear_y,
            angular,
        } = from.twist;
        let moved = [linear_x, linear_y, angular].map(|rate| rate * seconds);
        (seconds.abs() <= CARRY).then(|| (from.pose * Pose::exp(moved), from.twist))
    }

    /// Takes the pending pose in, if odometry has come as far as its stamp, or if it must not wait.
    fn settle(&mut self, must: bool) {
        let Some(external) = self.pending else {
            return;
        };
        let newest = self.odometry.back().map(|odometry| odometry.stamp);
        if external.of != PoseOf::Odometry && !must && newest.is_none_or(|newest| newest < external.stamp) {
            return;
        }
        let (map_from_odom, odom) = if external.of == PoseOf::Odometry {
            (external.pose, None)
        } else {
            // One that is older than the odometry that is kept, or far ahead of it, is of no use.
            let Some((odom, _)) = self.odometry_at(external.stamp) else {
                if must {
                    self.pending = None;
                }
                return;
            };
            let base_link = match external.of {
                PoseOf::Laser => external.pose * self.base_link_from_laser.inverse(),
                PoseOf::BaseLink | PoseOf::Odometry => external.pose,
            };
            (base_link * odom.inverse(), Some(odom))
        };
        self.pending = None;
        let [std, heading] = [self.parameters.assumed_std, self.parameters.assumed_std_heading];
        let assumed = Matrix3::from_diagonal(&Vector3::new(std * std, std * std, heading * heading));
        if let (Some(before), Some(now)) = (self.anchors.back(), self.odometry.back()) {
            let off = (map_from_odom * now.pose).since(before.map_from_odom * now.pose);
            self.correction = [off.x.hypot(off.y), off.heading.abs()];
        }
        self.anchors.push_back(Anchor {
            stamp: external.stamp,
            map_from_odom,
            odom,
            covariance: external.covariance.unwrap_or(assumed),
        });
        self.way = 0.0;
        while self.anchors.len() > MOST_ANCHORS
            || self
                .anchors
                .front()
                .is_some_and(|first| external.stamp.since(first.stamp) > SLIP_TIME)
        {
            self.anchors.pop_front();
        }
    }

    /// Slip and odometry's yaw rate less the other localizer's, over the poses of the last second.
    fn slip(&self) -> [f64; 2] {
        let at = |anchor: &Anchor| {
            let odom = anchor
                .odom
                .or_else(|| self.odometry_at(anchor.stamp).map(|(odom, _)| odom))?;
            Some((odom, anchor.map_from_odom * odom))
        };
        let (Some(first), Some(last)) = (self.anchors.front(), self.anchors.back()) else {
            return [0.0; 2];
        };
        let seconds = last.stamp.since(first.stamp);
        let (Some((odom_0, map_0)), Some((odom_1, map_1))) = (at(first), at(last)) else {
            return [0.0; 2];
        };
        if seconds < 0.5 * SLIP_TIME {
            return [0.0; 2];
        }
        let (wheels, car) = (odom_1.since(odom_0), map_1.since(map_0));
        let way = wheels.x.hypot(wheels.y);
        let slip = if way < SHORTEST {
            0.0
        } else {
            (way - car.x.hypot(car.y)) / way
        };
        [slip, (wheels.heading - car.heading) / seconds]
    }

    /// Covariance now: that of the newest pose, grown on the way since.
    fn covariance(&self, anchor: &Anchor) -> Matrix3<f64> {
        let drift = self.parameters.drift * self.way;
        let turn = self.parameters.drift_heading * self.way;
        anchor.covariance + Matrix3::from_diagonal(&Vector3::new(drift * drift, drift * drift, turn * turn))
    }

    /// End points of the beams with a return, in the frame of `base_link` at the scan's stamp \[m\], with the car's motion
    /// during the sweep taken out.
    fn end_points(&self, scan: &Scan, twist: Twist) -> Vec<[f32; 2]> {
        let valid = scan.nearest()..scan.range_max.min(self.parameters.max_range);
        let moves = [twist.linear_x, twist.linear_y, twist.angular];
        let points = scan.ranges.iter().enumerate().filter_map(|(i, &range)| {
            let range = f64::from(range);
            if !valid.contains(&range) {
                return None;
            }
            let (sin, cos) = (scan.angle_min + scan.angle_increment * i as f64).sin_cos();
            let seconds = scan.time_increment * i as f64;
            let moved = Pose::exp(moves.map(|rate| rate * seconds));
            let laser = moved * self.base_link_from_laser;
            Some(laser.transform([range * cos, range * sin]).map(|v| v as f32))
        });
        points.collect()
    }
}

impl Localizer for External {
    fn initialize(&mut self, _: Pose) -> Result<(), PoseError> {
        Err(PoseError::Elsewhere)
    }

    fn relocalize(&mut self) {}

    fn set_laser(&mut self, base_link_from_laser: Pose) {
        self.base_link_from_laser = base_link_from_laser;
    }

    fn on_odometry(&mut self, odometry: &Odometry) -> Result<(), Dropped> {
        if !(odometry.pose.is_finite() && is_possible(odometry, FASTEST_TURN)) {
            return Err(Dropped::Malformed);
        }
        if let Some(last) = self.odometry.back() {
            if odometry.stamp <= last.stamp {
                return Err(Dropped::TimeBackwards);
            }
            self.way += odometry.pose.distance(last.pose);
        }
        self.odometry.push_back(*odometry);
        if self.odometry.len() > KEPT {
            self.odometry.pop_front();
        }
        self.settle(false);
        Ok(())
    }

    fn on_yaw_rate(&mut self, yaw_rate: &YawRate) -> Result<(), Dropped> {
        keep_yaw_rate(&mut self.yaw_rates, yaw_rate, FASTEST_TURN)
    }

    fn on_external_pose(&mut self, pose: &ExternalPose) -> Result<(), Dropped> {
        if !pose.pose.is_finite() {
            return Err(Dropped::Malformed);
        }
        if self.last_pose.is_some_and(|last| pose.stamp <= last) {
            return Err(Dropped::TimeBackwards);
        }
        self.last_pose = Some(pose.stamp);
        self.pending = Some(*pose);
        self.settle(false);
        Ok(())
    }

    fn on_scan(&mut self, scan: &Scan) -> Result<Update, Dropped> {
        let count = scan.ranges.len();
        let geometry = [
            scan.angle_min,
            scan.angle_increment,
            scan.time_increment * count as f64,
        ];
        if !(1..=MOST_BEAMS).contains(&count)
            || geometry.iter().any(|v| !v.is_finite() || v.abs() > MOST_GEOMETRY)
            || !(0.0..1.0).contains(&geometry[2])
            || scan.angle_increment == 0.0
        {
            return Err(Dropped::Malformed);
        }
        if self.last_scan.is_some_and(|last| scan.stamp <= last) {
            return Err(Dropped::TimeBackwards);
        }
        let latest = self.odometry.back().ok_or(Dropped::NoOdometry)?;
        if scan.stamp.since(latest.stamp) > CARRY {
            return Err(Dropped::StaleOdometry);
        }
        self.last_scan = Some(scan.stamp);
        let (odom, twist) = self.odometry_at(scan.stamp).ok_or(Dropped::StaleOdometry)?;
        self.settle(true);
        let anchor = *self.anchors.back().ok_or(Dropped::NotInitialized)?;
        let points = self.end_points(scan, twist);
        if points.is_empty() {
            return Err(Dropped::NoBeams);
        }
        let pose = anchor.map_from_odom * odom;
        let fit = self.map.scan_fit(&points, self.base_link_from_laser, pose);
        let covariance = self.covariance(&anchor);
        let [slip, yaw_rate_residual] = self.slip();
        self.updates += 1;
        self.estimate = Some(HandedEstimate {
            stamp: scan.stamp,
            pose,
            covariance,
        });
        let (sin, cos) = pose.heading.sin_cos();
        let along = |x: f64, y: f64| {
            let variance =
                x * x * covariance[(0, 0)] + 2.0 * x * y * covariance[(0, 1)] + y * y * covariance[(1, 1)];
            variance.max(0.0).sqrt()
        };
        Ok(Update {
            stamp: scan.stamp,
            number: self.updates,
            pose,
            twist,
            covariance,
            mode: Mode::Tracking,
            particles: 0,
            ess_ratio: 1.0,
            spread: [along(cos, sin), along(-sin, cos)],
            second_mode: 0.0,
            alignment: fit.alignment,
            residual: fit.residual,
            short_beams: fit.short_beams,
            long_beams: fit.long_beams,
            no_return: 1.0 - points.len() as f64 / count as f64,
            w_ratio: 1.0,
            innovation: std::mem::take(&mut self.correction),
            odometry_jump: None,
            slip,
            yaw_rate_residual,
            sensors: SensorFindings::default(),
            doubt: None,
            trust: None,
        })
    }

    fn predict(&self, stamp: Stamp) -> Option<Pose> {
        let (odom, _) = self.odometry_at(stamp)?;
        Some(self.anchors.back()?.map_from_odom * odom)
    }

    fn particles(&self, _: usize) -> Vec<WeightedPose> {
        Vec::new()
    }

    fn hypotheses(&self) -> Vec<Hypothesis> {
        Vec::new()
    }

    fn parameters(&self) -> ParameterValues {
        self.parameters.to_values()
    }

    fn set_parameters(&mut self, prepared: PreparedParameters) -> Result<(), PreparedParameters> {
        self.parameters = *prepared.downcast::<ExternalParameters>()?;
        Ok(())
    }

    fn hand_over(&self) -> HandOver {
        HandOver {
            estimate: self.estimate,
            odometry: self.odometry.iter().copied().collect(),
            yaw_rates: self.yaw_rates.iter().copied().collect(),
            last_scan: self.last_scan,
            updates: self.updates,
        }
    }

    /// Odometry goes on. The pose of the one before is not taken: it is not the other localizer's.
    fn take_over(&mut self, from: HandOver) {
        self.odometry = from.odometry.into();
        self.yaw_rates = from.yaw_rates.into();
        self.last_scan = from.last_scan;
        self.updates = from.updates;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maps::{Cell, OccupancyGrid};

    const LASER: Pose = Pose {
        x: 0.27,
        y: 0.0,
        heading: 0.0,
    };

    /// A room of 8 m x 4 m.
    fn map() -> Arc<TrackMap> {
        let cells = (0..160 * 80).map(|i| match (i % 160, i / 160) {
            (0 | 159, _) | (_, 0 | 79) => Cell::Occupied,
            _ => Cell::Free,
        });
        let grid = OccupancyGrid::new(160, 80, 0.05, Pose::IDENTITY, cells.collect());
        Arc::new(TrackMap::new(grid).expect("a room"))
    }

    fn external() -> External {
        External::new(map(), LASER, ExternalParameters::default()).expect("sound")
    }

    fn at(seconds: f64) -> Stamp {
        Stamp(1_000_000_000).plus(seconds)
    }

    /// A car that drives along x at 1 m/s; odometry's origin is elsewhere, and its wheels slip by `slip`.
    fn truth(seconds: f64) -> Pose {
        Pose::new(2.0 + seconds, 2.0, 0.0)
    }

    fn odometry(seconds: f64, slip: f64) -> Odometry {
        Odometry {
            stamp: at(seconds),
            pose: Pose::new(0.0, 0.0, 1.0) * Pose::new(seconds * (1.0 + slip), 0.0, 0.0),
            twist: Twist {
                linear_x: 1.0 + slip,
                linear_y: 0.0,
                angular: 0.0,
            },
        }
    }

    fn scan(map: &TrackMap, seconds: f64) -> Scan {
        let range = |i: i32| {
            let beam = Pose::new(0.0, 0.0, -2.0 + 0.02 * f64::from(i));
            map.range(truth(seconds) * LASER * beam, 20.0) as f32
        };
        Scan {
            stamp: at(seconds),
            angle_min: -2.0,
            angle_increment: 0.02,
            time_increment: 0.0,
            scan_time: None,
            angle_max: None,
            range_min: 0.05,
            range_max: 20.0,
            ranges: (0..201).map(range).collect(),
        }
    }

    fn pose(seconds: f64, of: PoseOf, pose: Pose) -> ExternalPose {
        ExternalPose {
            stamp: at(seconds),
            pose,
            of,
            covariance: None,
        }
    }

    #[test]
    fn a_pose_of_the_past_is_carried_to_the_scan_by_odometry() {
        for of in [PoseOf::BaseLink, PoseOf::Laser, PoseOf::Odometry] {
            let mut external = external();
            let map = map();
            for tick in 0..50 {
                let now = f64::from(tick) * 0.02;
                external.on_odometry(&odometry(now, 0.0)).expect("taken");
            }
            assert_eq!(external.on_scan(&scan(&map, 0.9)), Err(Dropped::NotInitialized));
            let given = match of {
                PoseOf::BaseLink => truth(0.51),
                PoseOf::Laser => truth(0.51) * LASER,
                PoseOf::Odometry => truth(0.0) * odometry(0.0, 0.0).pose.inverse(),
            };
            external.on_external_pose(&pose(0.51, of, given)).expect("taken");
            let update = external.on_scan(&scan(&map, 0.95)).expect("a pose");
            assert!(
                update.pose.distance(truth(0.95)) < 1e-9,
                "{of:?}: {:?}",
                update.pose
            );
            assert!(update.alignment > 0.95, "{of:?}: {}", update.alignment);
            let predicted = external.predict(at(1.0)).expect("carried on");
            assert!(predicted.distance(truth(1.0)) < 1e-9);
        }
    }

    #[test]
    fn a_wrong_pose_shows_in_the_fit_and_a_silent_localizer_in_the_spread() {
        let (mut external, map) = (external(), map());
        external.on_odometry(&odometry(0.0, 0.0)).expect("taken");
        let wrong = truth(0.0) * Pose::new(0.0, 0.8, 0.3);
        external
            .on_external_pose(&pose(0.0, PoseOf::BaseLink, wrong))
            .expect("taken");
        let update = external.on_scan(&scan(&map, 0.0)).expect("a pose");
        assert!(update.alignment < 0.5, "{}", update.alignment);
        let near = update.spread[0];
        for tick in 1..100 {
            external
                .on_odometry(&odometry(f64::from(tick) * 0.1, 0.0))
                .expect("taken");
        }
        let update = external.on_scan(&scan(&map, 1.0));
        assert_eq!(update.err(), None);
        let later = external.covariance(external.anchors.back().expect("one"))[(0, 0)].sqrt();
        assert!(later > near + 0.3, "after 9.9 m: {later}");
    }

    #[test]
    fn slip_is_seen_and_a_pose_twice_is_refused() {
        let (mut external, map) = (external(), map());
        for tick in 0..100 {
            let now = f64::from(tick) * 0.02;
            external.on_odometry(&odometry(now, 0.2)).expect("taken");
            if tick % 5 == 0 {
                external
                    .on_external_pose(&pose(now, PoseOf::BaseLink, truth(now)))
                    .expect("taken");
            }
        }
        let again = pose(1.9, PoseOf::BaseLink, truth(1.9));
        assert_eq!(external.on_external_pose(&again), Err(Dropped::TimeBackwards));
        let update = external.on_scan(&scan(&map, 1.98)).expect("a pose");
        assert!((update.slip - 1.0 / 6.0).abs() < 0.01, "{}", update.slip);
        assert_eq!(external.initialize(truth(0.0)), Err(PoseError::Elsewhere));
    }
}
