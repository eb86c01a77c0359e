//! Preprocessing of a scan: invalid readings dropped, end points deskewed to one time, and beams chosen.

use maps::Pose;

use crate::beam_layout::{BeamParameters, chosen_beams};
use crate::calibration::Slip;
use crate::odometry_track::OdometryTrack;
use crate::sensor_check::ScanGeometry;
use crate::{Dropped, Scan};

/// One beam at the scan's stamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Beam {
    /// Direction in the laser's frame at the scan's stamp \[rad\].
    pub(crate) angle: f32,
    /// Range from there \[m\]; infinite for no return.
    pub(crate) range: f32,
}

/// A scan as the filter uses it. Buffers are kept from scan to scan.
#[derive(Debug, Clone, Default)]
pub(crate) struct PreprocessedScan {
    /// End points of the beams with a return, in the frame of `base_link` at the scan's stamp \[m\], in order.
    pub(crate) points: Vec<[f32; 2]>,
    /// Mount of the laser, from where the beams start.
    pub(crate) base_link_from_laser: Pose,
    /// For each end point the index of its beam.
    pub(crate) beam_of: Vec<u32>,
    /// The beams to weigh.
    pub(crate) beams: Vec<Beam>,
    /// Share of all beams without a return.
    pub(crate) no_return: f64,
    /// The geometry that `directions` and `chosen` are for.
    geometry: Option<(usize, f64, f64, BeamParameters)>,
    /// Cosine and sine of each beam's angle.
    directions: Vec<[f32; 2]>,
    /// Indices of the beams to weigh.
    chosen: Vec<u32>,
    /// Which beams have a point, for those to weigh: its index, or none.
    point_of: Vec<u32>,
}

/// A scan of more beams is refused: 0.05 deg all around, twice.
const MOST_BEAMS: usize = 14_400;

/// The sweep is deskewed in this many segments. Within a segment the motion counts as uniform.
const SEGMENTS: usize = 8;

/// Odometry is carried on beyond its last message by the length of the sweep and this \[s\].
const CARRIED: f64 = 0.1;

/// Marks a beam without a return.
const NO_POINT: u32 = u32::MAX;

impl PreprocessedScan {
    /// Loads a scan, read by `geometry`. Its beams are transformed to the stamp by odometry, corrected by `slip`.
    ///
    /// Readings that are not finite, below [`Scan::nearest`], or from `range_max` or `max_range` on count as no return. A scan may
    /// differ in geometry from the one before.
    pub(crate) fn load(
        &mut self,
        (scan, geometry): (&Scan, &ScanGeometry),
        track: &OdometryTrack,
        slip: Slip,
        base_link_from_laser: Pose,
        max_range: f64,
        parameters: &BeamParameters,
    ) -> Result<(), Dropped> {
        let count = scan.ranges.len();
        let sweep = geometry.time_increment * count as f64;
        let sound = (1..=MOST_BEAMS).contains(&count)
            && scan.angle_min.is_finite()
            && scan.angle_min.abs() < 100.0
            && geometry.angle_increment.is_finite()
            && geometry.angle_increment.abs() > 1e-6
            && (geometry.angle_increment * (count - 1) as f64).abs() < 6.5
            && sweep.is_finite()
            && (0.0..1.0).contains(&sweep)
            && !scan.range_min.is_nan()
            && !geometry.range_max.is_nan();
        if !sound {
            return Err(Dropped::Malformed);
        }
        self.choose(scan, geometry, parameters);
        self.base_link_from_laser = base_link_from_laser;
        let nearest = scan.nearest() as f32;
        let farthest = geometry.range_max.min(max_range) as f32;

        self.points.clear();
        self.beam_of.clear();
        self.point_of.clear();
        self.point_of.resize(count, NO_POINT);
        let deskew = parameters.deskew && sweep > 1e-4;
        let segment = if deskew { count.div_ceil(SEGMENTS) } else { count };
        let (mut begin, mut start) = (0, base_link_from_laser);
        // By odometry's clock.
        let stamp = scan.stamp.plus(-geometry.lag);
        let at_stamp = track.at(stamp, sweep + CARRIED).map(|(pose, _)| pose.inverse());
        while begin < count {
            let end = (begin + segment).min(count);
            // The laser's pose at the end of the segment, seen from base_link at the scan's stamp.
            let finish = match at_stamp {
                Some(from_odom) if deskew => {
                    let seconds = geometry.time_increment * end as f64;
                    let moved = track.at(stamp.plus(seconds), sweep + CARRIED);
                    moved.map_or(start, |(pose, _)| {
                        slip.corrected(from_odom * pose, seconds) * base_link_from_laser
                    })
                }
                _ => base_link_from_laser,
            };
            self.transform(scan, begin..end, start, finish, nearest..farthest);
            (begin, start) = (end, finish);
        }
        self.no_return = 1.0 - self.points.len() as f64 / count as f64;
        if self.points.is_empty() {
            return Err(Dropped::NoBeams);
        }
        self.load_beams(base_link_from_laser);
        Ok(())
    }

    /// End points of one segment of beams while the laser moves from `start` to `finish`.
    fn transform(
        &mut self,
        scan: &Scan,
        beams: std::ops::Range<usize>,
        start: Pose,
        finish: Pose,
        valid: std::ops::Range<f32>,
    ) {
        let per_beam = 1.0 / beams.len() as f32;
        let (sin, cos) = start.heading.sin_cos();
        let (sin, cos) = (sin as f32, cos as f32);
        let (x, y) = (start.x as f32, start.y as f32);
        let (dx, dy) = (
            (finish.x - start.x) as f32 * per_beam,
            (finish.y - start.y) as f32 * per_beam,
        );
        let turn = maps::wrap_angle(finish.heading - start.heading) as f32 * per_beam;
        let ranges = &scan.ranges[beams.clone()];
        for (k, (&range, direction)) in ranges.iter().zip(&self.directions[beams.clone()]).enumerate() {
            // False for NaN.
            if !(range >= valid.start && range < valid.end) {
                continue;
            }
            let step = k as f32;
            let angle = turn * step;
            let (c, s) = (
                cos * direction[0] - sin * direction[1],
                sin * direction[0] + cos * direction[1],
            );
            // A segment turns by a few hundredths of a radian: the second order is exact to a micrometre.
            let half = 1.0 - 0.5 * angle * angle;
            let (c, s) = (c * half - s * angle, s * half + c * angle);
            let beam = (beams.start + k) as u32;
            self.point_of[beam as usize] = self.points.len() as u32;
            self.points
                .push([x + dx * step + range * c, y + dy * step + range * s]);
            self.beam_of.push(beam);
        }
    }

    /// Computes the beams to weigh, as the laser at the scan's stamp would have measured them.
    fn load_beams(&mut self, base_link_from_laser: Pose) {
        let laser_from_base_link = base_link_from_laser.inverse();
        let (sin, cos) = laser_from_base_link.heading.sin_cos();
        let (sin, cos) = (sin as f32, cos as f32);
        let (x, y) = (laser_from_base_link.x as f32, laser_from_base_link.y as f32);
        self.beams.clear();
        for &beam in &self.chosen {
            let point = self.point_of[beam as usize];
            self.beams.push(if point == NO_POINT {
                let [c, s] = self.directions[beam as usize];
                Beam {
                    angle: s.atan2(c),
                    range: f32::INFINITY,
                }
            } else {
                let [px, py] = self.points[point as usize];
                let (lx, ly) = (x + cos * px - sin * py, y + sin * px + cos * py);
                Beam {
                    angle: ly.atan2(lx),
                    range: lx.hypot(ly),
                }
            });
        }
    }

    /// A scan with the same end points, and nothing else.
    pub(crate) fn end_points(&self) -> Self {
        Self {
            points: self.points.clone(),
            base_link_from_laser: self.base_link_from_laser,
            ..Self::default()
        }
    }

    /// End points of the beams to weigh that have a return.
    pub(crate) fn weighed_points(&self) -> impl Iterator<Item = [f32; 2]> + '_ {
        let points = self.chosen.iter().map(|&beam| self.point_of[beam as usize]);
        points
            .filter(|&point| point != NO_POINT)
            .map(|point| self.points[point as usize])
    }

    /// Computes the directions and the choice of beams again if the scanner's geometry has changed.
    fn choose(&mut self, scan: &Scan, geometry: &ScanGeometry, parameters: &BeamParameters) {
        let key = (
            scan.ranges.len(),
            scan.angle_min,
            geometry.angle_increment,
            parameters.clone(),
        );
        if self.geometry.as_ref() == Some(&key) {
            return;
        }
        let angle = |i: usize| scan.angle_min + geometry.angle_increment * i as f64;
        self.directions.clear();
        self.directions
            .extend((0..scan.ranges.len()).map(|i| [angle(i).cos() as f32, angle(i).sin() as f32]));
        self.chosen = chosen_beams(
            scan.ranges.len(),
            scan.angle_min,
            geometry.angle_increment,
            parameters,
        );
        self.geometry = Some(key);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor_check::SensorCheck;
    use crate::{Odometry, Stamp, Twist};
    use std::f64::consts::PI;

    const COUNT: usize = 1081;

    fn scan(ranges: Vec<f32>) -> Scan {
        Scan {
            stamp: Stamp(1_000_000_000),
            angle_min: -0.75 * PI,
            angle_increment: 1.5 * PI / (COUNT - 1) as f64,
            time_increment: 0.018_75 / (COUNT - 1) as f64,
            scan_time: None,
            angle_max: None,
            range_min: 0.06,
            range_max: 30.0,
            ranges,
        }
    }

    fn driving(twist: Twist) -> OdometryTrack {
        let mut track = OdometryTrack::default();
        for i in 0..100i64 {
            let t = i as f64 * 0.02;
            let pose = Pose::exp([twist.linear_x * t, 0.0, twist.angular * t]);
            track
                .push(
                    &Odometry {
                        stamp: Stamp(i * 20_000_000),
                        pose,
                        twist,
                    },
                    false,
                    &crate::calibration::SlipModel::default(),
                )
                .expect("sound");
        }
        track
    }

    fn load(
        scan: &Scan,
        track: &OdometryTrack,
        parameters: &BeamParameters,
    ) -> Result<PreprocessedScan, Dropped> {
        let mut preprocessed = PreprocessedScan::default();
        preprocessed
            .load(
                (scan, &SensorCheck::default().geometry(scan)),
                track,
                Slip::default(),
                Pose::new(0.27, 0.0, 0.0),
                25.0,
                parameters,
            )
            .map(|()| preprocessed)
    }

    /// Half of the beams say 0.05 m for "no return", and the driver no least range: the pose went to the wall beside the car.
    #[test]
    fn readings_within_the_car_are_no_return() {
        let ranges: Vec<f32> = (0..COUNT).map(|i| if i % 2 == 0 { 0.05 } else { 3.0 }).collect();
        for (range_min, points) in [(0.0, COUNT / 2), (-1.0, COUNT / 2), (0.02, COUNT)] {
            let scan = Scan {
                range_min,
                ..scan(ranges.clone())
            };
            let loaded = load(&scan, &driving(Twist::default()), &BeamParameters::default()).expect("sound");
            assert_eq!(loaded.points.len(), points, "{range_min}");
        }
    }

    #[test]
    fn a_wall_measured_on_the_move_is_straight_after_deskewing() {
        // A wall at x = 10 m seen from a car that drives at 7 m/s and turns at 1 rad/s.
        let twist = Twist {
            linear_x: 7.0,
            linear_y: 0.0,
            angular: 1.0,
        };
        let track = driving(twist);
        let mut moving = scan(vec![f32::INFINITY; COUNT]);
        let (at_stamp, _) = track.at(moving.stamp, 0.0).expect("covered");
        for i in 0..COUNT {
            let (pose, _) = track
                .at(moving.stamp.plus(moving.time_increment * i as f64), 0.0)
                .expect("covered");
            let laser = at_stamp.inverse() * pose * Pose::new(0.27, 0.0, 0.0);
            let direction = laser.heading + moving.angle_min + moving.angle_increment * i as f64;
            if direction.cos() > 0.5 {
                moving.ranges[i] = ((10.0 - laser.x) / direction.cos()) as f32;
            }
        }
        let preprocessed = load(&moving, &track, &BeamParameters::default()).expect("sound");
        assert!(preprocessed.points.len() > 400);
        assert!(
            preprocessed
                .points
                .iter()
                .all(|point| (point[0] - 10.0).abs() < 1e-3)
        );
        let skewed = load(
            &moving,
            &track,
            &BeamParameters {
                deskew: false,
                ..BeamParameters::default()
            },
        );
        let worst = |preprocessed: &PreprocessedScan| {
            preprocessed
                .points
                .iter()
                .map(|p| (p[0] - 10.0).abs())
                .fold(0.0, f32::max)
        };
        assert!(worst(&skewed.expect("sound")) > 0.05);
    }

    #[test]
    fn what_is_no_reading_is_no_return() {
        let mut ranges = vec![5.0; COUNT];
        ranges[..5].copy_from_slice(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, 65.533]);
        ranges[5] = 0.01;
        let preprocessed = load(
            &scan(ranges),
            &OdometryTrack::default(),
            &BeamParameters::default(),
        )
        .expect("sound");
        assert_eq!(preprocessed.points.len(), COUNT - 6);
        assert!((preprocessed.no_return - 6.0 / COUNT as f64).abs() < 1e-12);
        assert!(preprocessed.beams[0].range.is_infinite());
    }

    #[test]
    fn scans_that_make_no_sense_are_refused() {
        let track = OdometryTrack::default();
        let parameters = BeamParameters::default();
        let bad = |change: fn(&mut Scan)| {
            let mut scan = scan(vec![5.0; COUNT]);
            change(&mut scan);
            load(&scan, &track, &parameters).err()
        };
        assert_eq!(bad(|_| ()), None);
        assert_eq!(bad(|s| s.ranges.clear()), Some(Dropped::Malformed));
        assert_eq!(bad(|s| s.angle_min = f64::NAN), Some(Dropped::Malformed));
        assert_eq!(bad(|s| s.angle_increment = 0.0), Some(Dropped::Malformed));
        assert_eq!(bad(|s| s.time_increment = -1.0), Some(Dropped::Malformed));
        assert_eq!(bad(|s| s.ranges.fill(f32::NAN)), Some(Dropped::NoBeams));
        assert_eq!(bad(|s| s.ranges.truncate(1)), None);
    }
}
