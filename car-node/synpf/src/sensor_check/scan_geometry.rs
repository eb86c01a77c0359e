//! The geometry of a scan, with numbers that cannot be replaced by ones that can.

use std::f64::consts::TAU;

use localizer::{Scan, SensorFinding, SensorFindings};

use super::sweep_check::SweepCheck;

/// By what a scan's beams are placed in space and time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ScanGeometry {
    /// Angle from one beam to the next, signed \[rad\].
    pub(crate) angle_increment: f64,
    /// Time from one beam to the next \[s\].
    pub(crate) time_increment: f64,
    /// Readings from here on mean "nothing in range" \[m\].
    pub(crate) range_max: f64,
    /// The time from one beam to the next that the scan may have instead \[s\].
    pub(crate) alternative: Option<f64>,
    /// How late the stamp is against odometry's \[s\].
    pub(crate) lag: f64,
}

/// Smaller angles between beams are none \[rad\].
const LEAST_ANGLE: f64 = 1e-6;

/// Within so much of the time of a whole scan [s/s], the beams' times add up; `time_increment` beyond it is wrong.
const WHOLE: f64 = 1.1;

/// A scan takes no longer [s]: 1 Hz.
const LONGEST_SCAN: f64 = 1.0;

impl ScanGeometry {
    /// As the scan states it, or as it must be where that cannot be.
    pub(super) fn of(scan: &Scan, sweep: &mut SweepCheck, findings: &mut SensorFindings) -> Self {
        let beams = scan.ranges.len();
        let gaps = beams.saturating_sub(1) as f64;
        let mut angle_increment = scan.angle_increment;
        let field = scan.angle_max.map(|last| last - scan.angle_min);
        if angle_increment.abs() <= LEAST_ANGLE
            && let Some(derived) = field.map(|field| field / gaps)
            && derived.is_finite()
            && derived.abs() > LEAST_ANGLE
        {
            angle_increment = derived;
            findings.insert(SensorFinding::AngleIncrementMissing, derived);
        }
        let mut range_max = scan.range_max;
        if range_max <= scan.range_min.max(0.0) {
            findings.insert(SensorFinding::RangeMaxWrong, range_max);
            range_max = f64::INFINITY;
        }
        let scan_time = scan.scan_time.filter(|time| (1e-3..LONGEST_SCAN).contains(time));
        let mut time_increment = scan.time_increment;
        let too_long = scan_time.map_or(LONGEST_SCAN, |time| (WHOLE * time).min(LONGEST_SCAN));
        let mut stated = time_increment != 0.0;
        if stated && gaps > 0.0 && time_increment * gaps > too_long {
            findings.insert(SensorFinding::TimeIncrementWrong, time_increment);
            (time_increment, stated) = (0.0, false);
        }
        // A scanner that turns takes a scan's time for the whole circle.
        let alternative = scan_time
            .filter(|_| !stated && gaps > 0.0)
            .map(|time| time * (angle_increment.abs() / TAU).min(1.0 / beams as f64));
        let mut geometry = Self {
            angle_increment,
            time_increment,
            range_max,
            alternative,
            lag: 0.0,
        };
        if let Some(per_beam) = alternative
            && sweep.is_sweep()
        {
            geometry.time_increment = per_beam;
            geometry.alternative = None;
            findings.insert(SensorFinding::SweepFromScanTime, per_beam * gaps);
        } else if sweep.is_decided() {
            geometry.alternative = None;
        }
        geometry
    }

    /// The same with the other time from one beam to the next; None where there is none to try.
    pub(crate) fn as_sweep(&self) -> Option<Self> {
        Some(Self {
            time_increment: self.alternative?,
            ..*self
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use localizer::Stamp;

    fn scan() -> Scan {
        Scan {
            stamp: Stamp(1),
            angle_min: -2.0,
            angle_increment: 0.004,
            time_increment: 0.0,
            scan_time: Some(0.025),
            angle_max: Some(2.0),
            range_min: 0.06,
            range_max: 30.0,
            ranges: vec![5.0; 1001],
        }
    }

    fn read(scan: &Scan) -> (ScanGeometry, SensorFindings) {
        let mut findings = SensorFindings::default();
        let geometry = ScanGeometry::of(scan, &mut SweepCheck::default(), &mut findings);
        (geometry, findings)
    }

    #[test]
    fn what_can_be_is_taken_as_it_is() {
        let stated = Scan {
            time_increment: 17e-6,
            ..scan()
        };
        let (geometry, findings) = read(&stated);
        assert_eq!(findings.iter().count(), 0);
        assert_eq!(geometry.alternative, None);
        assert!((geometry.time_increment - 17e-6).abs() < 1e-12);
    }

    #[test]
    fn a_range_max_of_zero_is_none() {
        let (geometry, findings) = read(&Scan {
            range_max: 0.0,
            ..scan()
        });
        assert!(geometry.range_max.is_infinite());
        assert_eq!(findings.get(SensorFinding::RangeMaxWrong), Some(0.0));
    }

    #[test]
    fn an_angle_increment_of_zero_follows_from_the_first_and_the_last_beam() {
        let (geometry, findings) = read(&Scan {
            angle_increment: 0.0,
            ..scan()
        });
        assert!((geometry.angle_increment - 0.004).abs() < 1e-12);
        assert!(findings.get(SensorFinding::AngleIncrementMissing).is_some());
    }

    #[test]
    fn a_time_increment_as_long_as_a_scan_is_wrong() {
        let (geometry, findings) = read(&Scan {
            time_increment: 0.025,
            ..scan()
        });
        assert_eq!(geometry.time_increment.to_bits(), 0.0f64.to_bits());
        assert!(geometry.alternative.is_some());
        assert_eq!(
            findings.get(SensorFinding::TimeIncrementWrong),
            Some(f64::from(0.025f32))
        );
    }
}
