//! How well a scan fits the map at a pose: what an engineer, and the health state, judge by.

use localizer::ScanFit;
use maps::Pose;

use crate::preprocessed_scan::PreprocessedScan;
use crate::track_map::TrackMap;

/// The fit of one scan at one pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Quality {
    /// Share of valid beams that end on a wall: within 0.05 m and the size of a cell, but no less than 0.10 m.
    pub(crate) alignment: f64,
    /// Mean of min(distance to the nearest wall, 1 m) \[m\].
    pub(crate) residual: f64,
    /// Share of beams more than 0.3 m shorter than the map says.
    pub(crate) short: f64,
    /// Share of beams more than 0.3 m longer than the map says.
    pub(crate) long: f64,
}

impl Quality {
    /// Alignment of the beams that no obstacle blocks ([`ScanFit::clear_alignment`]).
    pub(crate) fn clear_alignment(&self) -> f64 {
        let fit = ScanFit {
            alignment: self.alignment,
            residual: self.residual,
            short_beams: self.short,
            long_beams: self.long,
        };
        fit.clear_alignment()
    }

    /// Judges a scan at a pose in the grid's frame ([`ScanFit::measure`]).
    pub(crate) fn new(map: &TrackMap, scan: &PreprocessedScan, pose: Pose) -> Self {
        Self::of_points(map, &scan.points, scan.base_link_from_laser, pose)
    }

    /// The same for end points in the frame of `base_link` \[m\].
    pub(crate) fn of_points(
        map: &TrackMap,
        points: &[[f32; 2]],
        base_link_from_laser: Pose,
        pose: Pose,
    ) -> Self {
        let fit = ScanFit::measure(map.grid(), map.field(), points, base_link_from_laser, pose);
        Self {
            alignment: fit.alignment,
            residual: fit.residual,
            short: fit.short_beams,
            long: fit.long_beams,
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::recovery::scan_likelihood::fit_of;
    use maps::{Cell, OccupancyGrid};

    /// A room of 10 x 6 m in cells of 5 cm, with a door 2 m wide in its right wall. Nothing was mapped around it.
    pub(crate) fn room() -> TrackMap {
        let cell = |column: usize, row: usize| {
            let inside = (20..220).contains(&column) && (20..140).contains(&row);
            let door = column >= 200 && (60..100).contains(&row);
            match (inside, column, row) {
                (false, ..) => Cell::Unknown,
                (true, 20..=22 | 217..=219, _) | (true, _, 20..=22 | 137..=139) if !door => Cell::Occupied,
                _ => Cell::Free,
            }
        };
        TrackMap::new(OccupancyGrid::from_fn(240, 160, 0.05, Pose::IDENTITY, cell)).expect("free space")
    }

    /// What a laser sees all around; there is a wall 2.5 m behind the door.
    pub(crate) fn scan(map: &TrackMap, pose: Pose) -> PreprocessedScan {
        let points = (0..720).map(|i| {
            let angle = f64::from(i) * 0.5f64.to_radians();
            let direction = Pose::new(pose.x, pose.y, pose.heading + angle);
            let range = map.range(direction, 30.0);
            let (sin, cos) = direction.heading.sin_cos();
            let through_door = pose.x + range * cos > 10.95 && (pose.y + range * sin - 4.0).abs() < 1.1;
            let range = if through_door {
                (13.5 - pose.x) / cos
            } else {
                range
            };
            [(range * angle.cos()) as f32, (range * angle.sin()) as f32]
        });
        let mut scan = PreprocessedScan::default();
        scan.points.extend(points);
        scan
    }

    #[test]
    fn beams_through_a_door_that_nobody_mapped_do_not_count() {
        let map = room();
        let pose = Pose::new(9.0, 4.0, 0.3);
        let scan = scan(&map, pose);
        let right = Quality::new(&map, &scan, pose);
        assert!(right.alignment > 0.98, "{right:?}");
        assert!(right.residual < 0.05, "{right:?}");
        assert_eq!((right.short, right.long), (0.0, 0.0));
        assert!(fit_of(&map, &scan, pose) > 0.85);
    }

    #[test]
    fn beams_through_walls_count() {
        let map = room();
        let pose = Pose::new(9.0, 4.0, 0.3);
        let scan = scan(&map, pose);
        // As far to the left as the room is wide: the same walls in view, but for the door.
        let mirrored = Pose::new(3.0, 4.0, 0.3 + std::f64::consts::PI);
        let wrong = Quality::new(&map, &scan, mirrored);
        assert!(wrong.alignment < 0.85 && wrong.long > 0.1, "{wrong:?}");
        assert!(fit_of(&map, &scan, mirrored) < fit_of(&map, &scan, pose) - 0.08);
    }
}
