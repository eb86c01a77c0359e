//! From a scan to end points: invalid readings left out, and all brought to the scan's stamp.

use localizer::{Dropped, Scan, Stamp};
use maps::Pose;

use crate::parameters::PoseGraphParameters;

/// A scan of more beams is refused: 0.05 deg all around, twice.
const MOST_BEAMS: usize = 14_400;

/// A sweep is brought to its stamp in this many pieces.
const PIECES: usize = 8;

/// A scan as end points in the frame of `base_link` at its stamp \[m\].
#[derive(Debug, Clone, Default)]
pub(crate) struct Points {
    /// Ends of beams with a return.
    pub(crate) returns: Vec<[f32; 2]>,
    /// Points up to where beams have seen free space without a return within range.
    pub(crate) misses: Vec<[f32; 2]>,
    /// Share of the beams without a return.
    pub(crate) no_return: f64,
}

impl Points {
    /// Reads a scan. `moved` gives the car's pose at a later stamp in the frame of that at the scan's.
    pub(crate) fn read(
        scan: &Scan,
        base_link_from_laser: Pose,
        parameters: &PoseGraphParameters,
        moved: impl Fn(Stamp) -> Option<Pose>,
    ) -> Result<Self, Dropped> {
        let count = scan.ranges.len();
        let sweep = scan.time_increment * count as f64;
        let sound = (1..=MOST_BEAMS).contains(&count)
            && scan.angle_min.is_finite()
            && scan.angle_min.abs() < 100.0
            && scan.angle_increment.is_finite()
            && scan.angle_increment.abs() > 1e-6
            && (scan.angle_increment * (count - 1) as f64).abs() < 6.5
            && sweep.is_finite()
            && (0.0..1.0).contains(&sweep)
            && !scan.range_min.is_nan()
            && !scan.range_max.is_nan();
        if !sound {
            return Err(Dropped::Malformed);
        }
        let nearest = scan.nearest().max(parameters.min_range);
        let mut points = Self::default();
        let piece = if sweep > 1e-4 {
            count.div_ceil(PIECES)
        } else {
            count
        };
        let mut missing = 0;
        for begin in (0..count).step_by(piece) {
            let end = (begin + piece).min(count);
            let middle = scan.time_increment * 0.5 * (begin + end) as f64;
            let at = if sweep > 1e-4 {
                moved(scan.stamp.plus(middle)).unwrap_or(Pose::IDENTITY)
            } else {
                Pose::IDENTITY
            };
            let laser = at * base_link_from_laser;
            for i in begin..end {
                let range = f64::from(scan.ranges[i]);
                // False for NaN.
                if !(range >= nearest && range < scan.range_max && range < MOST_RANGE) {
                    missing += 1;
                    continue;
                }
                let (sin, cos) = (scan.angle_min + scan.angle_increment * i as f64).sin_cos();
                let far = range > parameters.max_range;
                let range = if far {
                    parameters.missing_data_ray_length
                } else {
                    range
                };
                let point = laser.transform([range * cos, range * sin]).map(|v| v as f32);
                if far {
                    points.misses.push(point);
                } else {
                    points.returns.push(point);
                }
            }
        }
        points.no_return = f64::from(missing) / count as f64;
        if points.returns.is_empty() {
            return Err(Dropped::NoBeams);
        }
        Ok(points)
    }
}

/// Longer readings are "nothing in range" for every scanner \[m\].
const MOST_RANGE: f64 = 200.0;

#[cfg(test)]
mod tests {
    use super::*;

    fn scan(ranges: Vec<f32>, time_increment: f64) -> Scan {
        Scan {
            stamp: Stamp(0),
            angle_min: 0.0,
            angle_increment: 0.1,
            time_increment,
            scan_time: None,
            angle_max: None,
            range_min: 0.1,
            range_max: 40.0,
            ranges,
        }
    }

    #[test]
    fn invalid_readings_are_left_out_and_far_ones_are_free_space() {
        let scan = scan(
            vec![1.0, f32::NAN, f32::INFINITY, 0.05, 35.0, 2.0, -1.0, 65.0],
            0.0,
        );
        let mount = Pose::new(0.5, 0.0, 0.0);
        let points = Points::read(&scan, mount, &PoseGraphParameters::default(), |_| None).expect("sound");
        assert!((points.returns[0][0] - 1.5).abs() < 1e-6);
        assert_eq!((points.returns.len(), points.misses.len()), (2, 1));
        let [x, y] = points.misses[0];
        assert!(((x - 0.5).hypot(y) - 5.0).abs() < 1e-5);
        assert!((points.no_return - 5.0 / 8.0).abs() < 1e-12);
    }

    #[test]
    fn a_sweep_is_brought_to_its_stamp() {
        let scan = scan(vec![2.0; 32], 1e-3);
        let forwards = |stamp: Stamp| Some(Pose::new(10.0 * stamp.since(Stamp(0)), 0.0, 0.0));
        let points =
            Points::read(&scan, Pose::IDENTITY, &PoseGraphParameters::default(), forwards).expect("sound");
        let x = 10.0 * 0.030 + 2.0 * 3.1f64.cos();
        assert!((f64::from(points.returns[31][0]) - x).abs() < 0.03);
    }

    #[test]
    fn a_geometry_that_makes_no_sense_is_refused() {
        let read = |scan: &Scan| {
            Points::read(scan, Pose::IDENTITY, &PoseGraphParameters::default(), |_| None).map(|_| ())
        };
        assert_eq!(read(&scan(Vec::new(), 0.0)), Err(Dropped::Malformed));
        assert_eq!(read(&scan(vec![1.0; 3], f64::NAN)), Err(Dropped::Malformed));
        assert_eq!(read(&scan(vec![1.0; 100], 0.0)), Err(Dropped::Malformed));
        assert_eq!(read(&scan(vec![f32::NAN; 3], 0.0)), Err(Dropped::NoBeams));
    }
}
