//! What a localizer has found to be wrong with its sensors.

/// A fault of a sensor that the localizer has found. Each comes with a value; its unit is stated here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SensorFinding {
    /// The gyroscope reports deg/s; it is converted. Ratio of its readings to the turn by the scans.
    GyroInDegrees,
    /// The gyroscope turns the wrong way; its sign is changed. Ratio of its readings to the turn by the scans.
    GyroFlipped,
    /// The gyroscope has a bias, which is taken out [rad/s].
    GyroBias,
    /// The gyroscope does not follow the turn by the scans; it is not used. Share of the turn that it explains.
    GyroIgnored,
    /// The gyroscope reads zero while the car turns; it is not used. Standard deviation of its readings [rad/s].
    GyroAlwaysZero,
    /// Odometry's turn is a fixed multiple of the turn by the scans; it is corrected. That multiple.
    OdometryTurnScale,
    /// Odometry's yaw rate has a bias, which is taken out [rad/s].
    OdometryTurnBias,
    /// Odometry's turn does not follow the turn by the scans. Share of the turn that it explains.
    OdometryTurnWrong,
    /// Odometry's twist is missing, or does not fit its pose; it is derived from the pose. Twist over pose.
    TwistFromPose,
    /// Odometry's pose does not move, moves in steps, or has no orientation; it is integrated from the twist. Distance by the twist \[m\].
    PoseFromTwist,
    /// Odometry's distance is a fixed multiple of the distance by the scans; it is corrected. That multiple.
    WheelScale,
    /// Odometry moves while the scans stand still; it is held. Its speed [m/s].
    Creep,
    /// Odometry stands still while the scans move; the car is carried on by the scans. Its speed [m/s].
    OdometryStands,
    /// The wheels gain or lose speed as no tyre can; the car's own speed is carried on. Wheels less car [m/s].
    WheelsSlide,
    /// The scanner states no `time_increment`; it is taken from `scan_time`. Length of the sweep \[s\].
    SweepFromScanTime,
    /// `time_increment` is as long as a scan; it is corrected. What was stated \[s\].
    TimeIncrementWrong,
    /// `range_max` is no range; the parameter set's largest range is used. What was stated \[m\].
    RangeMaxWrong,
    /// `angle_increment` is zero; it is taken from `angle_min` and `angle_max`. What is used \[rad\].
    AngleIncrementMissing,
    /// The scans' stamps are late against odometry's; it is corrected. By how much \[s\].
    ScanLag,
}

impl SensorFinding {
    /// All of them.
    pub const ALL: [Self; 19] = [
        Self::GyroInDegrees,
        Self::GyroFlipped,
        Self::GyroBias,
        Self::GyroIgnored,
        Self::GyroAlwaysZero,
        Self::OdometryTurnScale,
        Self::OdometryTurnBias,
        Self::OdometryTurnWrong,
        Self::TwistFromPose,
        Self::PoseFromTwist,
        Self::WheelScale,
        Self::Creep,
        Self::OdometryStands,
        Self::WheelsSlide,
        Self::SweepFromScanTime,
        Self::TimeIncrementWrong,
        Self::RangeMaxWrong,
        Self::AngleIncrementMissing,
        Self::ScanLag,
    ];
}

/// The findings that hold at one time, each with its value.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SensorFindings {
    values: [Option<f32>; SensorFinding::ALL.len()],
}

impl SensorFindings {
    /// Adds a finding, or replaces its value.
    pub fn insert(&mut self, finding: SensorFinding, value: f64) {
        self.values[finding as usize] = Some(value as f32);
    }

    /// The value of a finding; None where it does not hold.
    pub fn get(&self, finding: SensorFinding) -> Option<f64> {
        self.values[finding as usize].map(f64::from)
    }

    /// The findings that hold, with their values.
    pub fn iter(&self) -> impl Iterator<Item = (SensorFinding, f64)> + '_ {
        SensorFinding::ALL
            .into_iter()
            .filter_map(|finding| Some((finding, self.get(finding)?)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_inserted_is_found() {
        let mut findings = SensorFindings::default();
        assert_eq!(findings.iter().count(), 0);
        for (index, finding) in SensorFinding::ALL.into_iter().enumerate() {
            assert_eq!(finding as usize, index);
            findings.insert(finding, index as f64);
        }
        assert!(
            findings
                .iter()
                .all(|(finding, value)| (value - finding as usize as f64).abs() < 1e-9)
        );
        assert_eq!(findings.iter().count(), SensorFinding::ALL.len());
    }
}
